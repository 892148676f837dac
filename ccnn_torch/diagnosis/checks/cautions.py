"""Cautions: records and model that do not fit, or a verdict that depends on unrecorded covariates."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import is_temperature
from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.checks.mistakes import PlausibleRows
from ccnn_torch.diagnosis.residual.distance import distance, size_of
from ccnn_torch.diagnosis.residual.linearisation import signature_at
from ccnn_torch.diagnosis.residual.rows import frame_columns
from ccnn_torch.diagnosis.residual.whitening import without_fitted
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.findings import size_words
from ccnn_torch.diagnosis.verdict.judgement import Judgement, implausible_size
from ccnn_torch.diagnosis.verdict.localisation import own_pose
from ccnn_torch.diagnosis.verdict.remainder import times_as_scatter, times_the_noise
from ccnn_torch.display import number_text
from ccnn_torch.effects import EXACT, Coefficient, Situation
from ccnn_torch.effects.thermal import Thermal
from ccnn_torch.effects.time import ROW, Drift, FrameDrift
from ccnn_torch.evidence.dictionary import covariance
from ccnn_torch.evidence.judge import BESIDE_UNKNOWN
from ccnn_torch.evidence.marginal_likelihood import fit_sets, grams_of
from ccnn_torch.evidence.shrink import Gap

# What a verdict is worth beside a caution; and beside one that says that it rests on nothing.
_DOUBTED, _HOLLOW = 0.9, 0.5
# Size of the machine, of which no calibration is so far off.
_LARGE = 0.1
# Standard deviation left, of that which was given; heavy tails left 0.7 of it in sealed machines.
_QUIET = 0.5
_MANY = 0.1
# So many rows set aside are evaluated together, against as many resampled so often; the share of these as close.
_SEVERAL, _DRAWS, _BY_CHANCE = 5, 1000, 0.003
# A joint that moves less than this share of its workspace is at rest.
_STILL = 1e-3
# Effects that only the place of a row distinguishes.
_OF_PLACE = EXACT | {"coupling", "error_motion", "gravity", "transmission"}
# Periods from which an error is seen to repeat.
_PERIODS = 1.5
# Standard deviations from which a coefficient surely has its sign, and by which it surely is as large.
_SURELY = 3.0
# A workshop, with something to spare [K]: -30 to 55 degC. The degF of a hall are more, read as degC.
_COLDEST, _HOTTEST = 243.15, 328.15
# Variances of a joint that are tried, in units of what would be as much as the noise of the usual row.
_VARIANCES = torch.logspace(-2, 3, 41, dtype=torch.float64)
# Log likelihood that the scatter of one joint adds, from which it is no chance: noise alone adds up to 2 in trials.
# And its share of the mean square that is left, below which it is the scatter of a sound joint.
_CLEARLY, _SHARE = 5.0, 0.1


class Caution(NamedTuple):
    """A sentence without a full stop, and the largest probability that a verdict beside it may claim."""

    text: str
    most: float = _DOUBTED


def cautions(
    analysis: Analysis, judgement: Judgement, rows: PlausibleRows, missing: Sequence[Mapping[str, Any]], together: Gap
) -> list[Caution]:
    """Reasons to doubt a verdict; empty where there are none.

    Args:
        analysis: of the rows.
        judgement: the names of the verdict.
        rows: which of them are of the machine at all.
        missing: as in diagnosis.json.
        together: what the verdict's effects take away on held-out rows.
    """
    return [
        *row_cautions(analysis, rows, judgement.names),
        *_of_place(analysis, judgement),
        *_of_changes(analysis),
        *_of_noise(analysis, judgement),
        *_of_nothing_gained(analysis, judgement, together),
        *_of_sizes(analysis, judgement),
        *_of_signs(analysis, judgement),
        *_of_columns(analysis, judgement),
        *_of_inputs(analysis, missing),
        *_of_warmth(analysis, judgement, missing),
        *_of_scatter(analysis, judgement),
        *_of_periods(analysis, judgement),
    ]


def of_inferred(names: Sequence[str]) -> Caution:
    """Covariates that were taken from the order of the rows, which may not be that in which they were measured."""
    lacking, record = [], []
    if signs := [f"{name}[1]" for name in names if name != ROW]:
        lacking.append("directions of approach")
        record.append(f"{', '.join(signs)} (the sign of each joint's last motion)")
    if ROW in names:
        lacking.append("times")
        record.append("time[s]")
    return Caution(
        f"no {' and no '.join(lacking)} are among the covariates; they were taken from the order of the rows: record "
        f"{' and '.join(record)}"
    )


def row_cautions(analysis: Analysis, rows: PlausibleRows, names: Sequence[str] = ()) -> list[Caution]:
    """Those of them that need no verdict; names: of one, where there is one."""
    return [*_of_model(analysis, rows), *_of_plan(analysis, names), *_of_temperature(analysis.situation)]


def _of_place(analysis: Analysis, judgement: Judgement) -> list[Caution]:
    """Rows set aside that lie together: bad ones lie anywhere."""
    aside = ~analysis.whitening.counted & ~analysis.near_singular
    count = int(aside.sum())
    if count < _SEVERAL or judgement.drivers:
        return []
    place = analysis.situation.pose
    place = (place - place.mean(0)) / place.std(0).clamp_min(1e-300)
    drawn = torch.rand(_DRAWS, len(place), generator=torch.Generator().manual_seed(0)).topk(count).indices

    def spread(rows: Tensor) -> Tensor:
        return (rows - rows.mean(-2, keepdim=True)).square().sum((-2, -1))

    if float((spread(place[drawn]) <= spread(place[aside])).double().mean()) > _BY_CHANCE:
        return []
    middle = own_pose(analysis.situation)[aside].mean(0).tolist()
    named = ", ".join(
        f"{c.name} = {number_text(v, 3)} {c.unit}"
        for c, v in zip(analysis.situation.mechanism.pose, middle, strict=False)
    )
    words = f"the {count} rows set aside as far off lie together, about {named}: something may act there alone"
    return [Caution(words, _HOLLOW)]


def _of_changes(analysis: Analysis) -> list[Caution]:
    """Rows set aside just before a change of a load, or from one on: it was written down late, or early."""
    aside = ~analysis.whitening.counted & ~analysis.near_singular
    if int(aside.sum()) < _SEVERAL:
        return []
    # Loads scipy's distributions, which only such rows wait for.
    from scipy.stats import hypergeom

    for name, values in analysis.situation.covariates.items():
        if not name.startswith("load_") or values.dim() != 1:
            continue
        changes = torch.nonzero(values.diff())[:, 0]
        for steps, word, mistake in (((-1, 0), "before", "late"), ((1, 2), "after", "early")):
            near = torch.zeros_like(aside)
            near[torch.cat([changes + step for step in steps]).clamp(0, len(near) - 1)] = True
            both = int((aside & near).sum())
            chance = hypergeom.sf(both - 1, len(near), int(near.sum()), int(aside.sum()))
            if chance < _BY_CHANCE:
                words = f"{both} of the {int(aside.sum())} rows set aside as far off lie just {word} a change of {name}"
                return [Caution(f"{words}: it seems to be written down {mistake}")]
    return []


def _of_plan(analysis: Analysis, names: Sequence[str]) -> list[Caution]:
    """Joints that do not move."""
    situation, said = analysis.situation, []
    low, high = situation.workspace
    moved = (situation.joints.amax(0) - situation.joints.amin(0)) > _STILL * (high - low)
    still = [j.name for j, moves in zip(situation.mechanism.joints, moved.tolist(), strict=True) if not moves]
    if still and len(still) == len(moved):
        one = "all rows are at one place, where what depends on the place cannot be distinguished"
        said.append(Caution(one, _HOLLOW if _OF_PLACE & {*names} else _DOUBTED))
    elif still:
        named = " and ".join(still)
        said.append(Caution(f"{named} did not move: errors of {named} cannot be distinguished from those of a frame"))
    return said


def _of_model(analysis: Analysis, rows: PlausibleRows) -> list[Caution]:
    situation, said = analysis.situation, []
    if rows.lost > _MANY:
        advice = rows.mistake or "look at their units, and at what they have in common"
        said.append(
            Caution(
                f"{100 * rows.lost:.0f} % of the rows are far from where their joints put them and were left out: "
                f"{advice}"
            )
        )
    usual = float(distance(situation, analysis.measured, size_of(situation)).nanmedian())
    if usual > _LARGE:
        said.append(
            Caution(
                f"the gap is {usual:.2g} times the spread of the machine's poses over its workspace, more than any "
                "calibration takes away: check the units, the frames, and that this is the machine"
            )
        )
    return said


def _of_noise(analysis: Analysis, judgement: Judgement) -> list[Caution]:
    """Whether what was given is far from what the verdict's effects, or even the richest explanation, leave."""
    if not analysis.noise_is_known:
        return []
    found, known = judgement.found, "that was given" if analysis.whitening.known else "that the records show"
    left = (found.rss / max(analysis.dictionary.grams.values - found.effective, 1.0)) ** 0.5
    if left < _QUIET and analysis.whitening.known:
        quiet = f"the rows scatter by {number_text(left, 2)} times the noise that was given"
        return [Caution(f"{quiet}: with less of it smaller causes would show")]
    times = times_the_noise(analysis, min(analysis.found, key=lambda f: f.rss))
    times = times_as_scatter(analysis, found) if times <= 1 else times
    # Of a noise that the records show an outside cause says as much.
    if times <= 1 or (judgement.outside and not analysis.whitening.known):
        return []
    loud = f"whatever is tried leaves {number_text(times, 2)} times the noise {known}"
    return [Caution(f"{loud}: it is too small, or something is there that follows nothing recorded")]


def _of_nothing_gained(analysis: Analysis, judgement: Judgement, together: Gap) -> list[Caution]:
    """Whether rows that the fit has not seen show nothing of what the verdict names."""
    if not judgement.names or (together.interval is not None and together.interval[0] > 0):
        return []
    text = "rows not used for fitting do not show that this takes anything away"
    if analysis.whitening.known == 0:
        text += (
            "; the noise was not given and is taken for nearly all of the gap, so that a cause without a recorded "
            "driver counts as noise"
        )
    return [Caution(text, _HOLLOW)]


def _of_sizes(analysis: Analysis, judgement: Judgement) -> list[Caution]:
    """Causes of the verdict that would have to be hundreds of times as large as in any machine."""
    said, most = [], implausible_size(analysis)
    for _, name, coefficients, mean, sd in _numbers(analysis, judgement):
        # A number that the rows hardly determine says nothing of the cause.
        sure = torch.where(torch.tensor([c.secondary for c in coefficients]), 0.0, mean.abs() - _SURELY * sd)
        worst = int(sure.argmax())
        if float(sure[worst]) > most:
            said.append(
                Caution(
                    f"{name} would have to be {float(mean[worst].abs()):.0f} times as large as is plausible "
                    f"({coefficients[worst].name}): check the units; or another cause looks like it, such "
                    "as a load that acts elsewhere",
                    BESIDE_UNKNOWN,
                )
            )
    return said


def _of_signs(analysis: Analysis, judgement: Judgement) -> list[Caution]:
    """Causes of the verdict whose coefficients are clearly negative where physics has none such, and none positive.

    All that the cause does in a joint or leg has to go against such a coefficient: two that look alike share it.
    """
    said = []
    for i, name, coefficients, mean, sd in _numbers(analysis, judgement):
        signed = torch.tensor([c.positive for c in coefficients])
        negative = torch.nonzero(signed & (mean < -_SURELY * sd))[:, 0].tolist()
        columns = analysis.dictionary.columns[..., analysis.dictionary.groups[i]].flatten(0, 1)
        of = [(c.joint, c.leg) for c in coefficients]
        own = torch.tensor([[one == other for other in of] for one in of])
        against = (columns * (columns @ (own * mean).mT)).sum(0) < 0
        negative = [k for k in negative if against[k]]
        if negative and not bool((signed & (mean > _SURELY * sd)).any()):
            where = ", ".join(coefficients[k].name for k in negative)
            wrong = f"{name} would have to be negative ({where}), as in no machine"
            said.append(Caution(f"{wrong}: check the signs of the columns that it uses", BESIDE_UNKNOWN))
    return said


def _numbers(
    analysis: Analysis, judgement: Judgement
) -> Iterator[tuple[int, str, tuple[Coefficient, ...], Tensor, Tensor]]:
    """Of each cause of the verdict its number, name, coefficients, and these with their standard deviations, `m` each,
    in plausible sizes."""
    found = judgement.acting
    sd = covariance(analysis.dictionary, found).diagonal().clamp_min(1e-300).sqrt()
    own_of = torch.split(sd, [len(mean) for mean in found.mean])
    for i, mean, own in zip(found.members, found.mean, own_of, strict=True):
        atom = analysis.atoms[i]
        if atom.name in judgement.names and (coefficients := atom.coefficients(analysis.situation)):
            yield i, atom.name, coefficients, mean, own


def _of_scatter(analysis: Analysis, judgement: Judgement) -> list[Caution]:
    """A joint that scatters where its direction was not recorded: other names may stand for what it does."""
    found = joint_scatter(analysis, judgement)
    if found is None:
        return []
    size = size_words(found.size, found.unit, 2)
    text = (
        f"what is left scatters as if joint {found.joint} stopped {size} to either side, as with backlash or friction: "
        f"record direction{found.joint}; other names may stand for it"
    )
    return [Caution(text, BESIDE_UNKNOWN)]


def _of_periods(analysis: Analysis, judgement: Judgement) -> list[Caution]:
    """A periodic error of which the rows show no more than one period: wear or a stop at one place looks like it."""
    travel = analysis.situation.joints.amax(0) - analysis.situation.joints.amin(0)
    for i in judgement.found.members:
        atom = analysis.atoms[i]
        if atom.name != "transmission" or atom.name not in judgement.names:
            continue
        acting = {c.joint for c in atom.coefficients(analysis.situation)}
        names = [j.name for j in analysis.situation.mechanism.joints]
        seen = {n: float(atom.shape[k] * travel[k]) / (2 * math.pi) for k, n in enumerate(names) if n in acting}
        if seen and max(seen.values()) < _PERIODS:
            joints = " and ".join(n.removeprefix("q") for n in seen)
            words = f"of the periodic error of joint {joints} these rows show {max(seen.values()):.1f} periods"
            return [Caution(f"{words}: another error of one place may look the same", BESIDE_UNKNOWN)]
    return []


def _of_columns(analysis: Analysis, judgement: Judgement) -> list[Caution]:
    """Columns that are late, exchanged or of the other sign, where something is not explained."""
    doubtful = judgement.outside or _strange_temperature(analysis.situation)
    wrong = column_mistake(analysis) if doubtful else ""
    return [Caution(wrong, _HOLLOW)] if wrong else []


def _strange_temperature(situation: Situation) -> bool:
    temperature = situation.covariates.get("temperature")
    return temperature is not None and not _COLDEST < float(temperature.median()) < _HOTTEST


def _of_temperature(situation: Situation) -> list[Caution]:
    if not _strange_temperature(situation):
        return []
    usual = f"{float(situation.covariates['temperature'].median()) - 273.15:.0f} °C"
    return [Caution(f"the temperature is about {usual}: check the unit of its column, degC, degF or K")]


def _of_inputs(analysis: Analysis, missing: Sequence[Mapping[str, Any]]) -> list[Caution]:
    """What the nominal machine itself takes and that was not recorded, where that may be more than the noise."""
    situation = analysis.situation
    lacking = situation.mechanism.lacking([*situation.covariates])
    sizes = {c.partition("[")[0]: e["effects"] for e in missing for c in e["columns"]}
    noise = float(analysis.whitening.sigma.min())
    name = situation.mechanism.name
    return [
        Caution(
            f"{name} takes {c.name}, which was not recorded: what it does counts as noise, or goes to another cause"
        )
        for c in lacking
        if sizes.get(c.name, {}).get(name, noise) >= noise
    ]


def _of_warmth(analysis: Analysis, judgement: Judgement, missing: Sequence[Mapping[str, Any]]) -> list[Caution]:
    """Growth or a drift where no temperature was recorded: its course is guessed, and what grows otherwise drifts."""
    grows = any(Thermal.name in entry["effects"] for entry in missing)
    recorded = any(map(is_temperature, analysis.situation.covariates))
    if not grows or recorded or not {Thermal.name, FrameDrift.name, Drift.name} & {*judgement.names}:
        return []
    guessed = "no temperature was recorded: growth was taken to settle in time, and other growth looks like a drift"
    return [Caution(f"{guessed}: record temperature")]


class Scatter(NamedTuple):
    """A joint's number, from 1, its standard deviation, and the unit of that."""

    joint: int
    size: float
    unit: str


def joint_scatter(analysis: Analysis, judgement: Judgement) -> Scatter | None:
    """The joint whose scatter explains what is left better than noise alike in all directions; None where none does.

    What is left of a row, whitened, is N(0, σ²(I + ρ a aᵀ)), a being what the joint does there: 1 + ρ|a|² is the
    determinant, and ρ(a·r)² / (1 + ρ|a|²) the square that the joint takes (Sherman and Morrison); σ² is profiled out.
    Before that the channels are made alike and independent on average: noise of which one has more than another is no
    scatter of a joint, which changes with the pose. Only joints whose direction of approach was not recorded are asked,
    and whatever the verdict says that the rest follows: what scatters with a direction follows any driver a little.
    """
    situation, white = analysis.situation, analysis.whitening
    joints = [i for i in range(len(situation.mechanism.joints)) if f"direction{i + 1}" not in situation.covariates]
    columns, y = analysis.plain
    found = judgement.found
    # With gaps the channels are not alike, however they are mixed.
    if not joints or y.shape[-1] < 2 or white.seen is not None:
        return None
    used = torch.cat([torch.arange(0), *(analysis.dictionary.groups[i] for i in found.members)])
    left = y - columns[..., used] @ torch.cat([y.new_zeros(0), *found.mean])
    alike = torch.linalg.cholesky_ex(left.mT @ left / len(left)).L
    left = torch.linalg.solve_triangular(alike, left.mT, upper=False).mT
    moved = torch.linalg.solve_triangular(alike, white(situation.jacobian)[white.keep()][..., joints], upper=False)
    along, square = torch.einsum("scj,sc->sj", moved, left), moved.square().sum(1)
    usual = square.median(0).values.clamp_min(1e-300)
    rho = _VARIANCES[:, None] / usual
    spread = 1 + rho[:, None] * square
    whole, count = left.square().sum(), left.numel()
    noise = (whole - (rho[:, None] * along.square() / spread).sum(1)) / count
    gain = -0.5 * (count * torch.log(noise * count / whole) + spread.log().sum(1))
    best = int(gain.argmax())
    k, j = divmod(best, len(joints))
    share = float(rho[k, j] * noise[k, j] * square[:, j].sum() / whole)
    if float(gain[k, j]) < _CLEARLY or share < _SHARE:
        return None
    size = math.sqrt(float(rho[k, j] * noise[k, j]))
    return Scatter(joints[j] + 1, size, situation.mechanism.joints[joints[j]].unit)


# Log odds that an effect must gain by a correction, over all that was found without it: mistakes are rare.
_GAIN = 10.0
# Effects that need columns, by how these begin.
_USED_BY = {
    **{"load_": ("compliance", "friction"), "torque_": ("sag",), "direction": ("backlash", "friction")},
    "temperature": ("thermal",),
}


def column_mistake(analysis: Analysis) -> str:
    """The correction of a column with which one effect explains more than all that was found; empty where none does."""
    atoms = analysis.atoms
    best = analysis.found[0].log_posterior
    likely: dict[str, Atom] = {}
    for found in analysis.found:
        for atom in (atoms[i] for i in found.members if len(found.members) == 1):
            if atom.effect is not None:
                likely.setdefault(atom.name, atom)
    words, most = "", best + _GAIN
    for kind, names in _USED_BY.items():
        columns = [n for n in analysis.situation.covariates if n.startswith(kind)]
        mine = [likely[n] for n in names if n in likely]
        for said, covariates in _corrections(analysis.situation, columns) if mine else ():
            other = replace(analysis.situation, covariates=covariates)
            for atom in mine:
                odds = _evidence(analysis, other, atom) + atom.log_prior
                if odds > most:
                    most = odds
                    words = f"{said}: {atom.name} would then explain more than all that was found; check the columns"
    return words


def _corrections(situation: Situation, columns: list[str]) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """What is wrong, in words, and the covariates as they would be without it."""
    given = dict(situation.covariates)
    if "temperature" in columns and _strange_temperature(situation):
        yield "temperature seems to be in degF", given | {"temperature": 273.15 + (given["temperature"] - 305.15) / 1.8}
    every = " and ".join(columns) if len(columns) < 3 else f"{columns[0]} to {columns[-1]}"
    for step, word in ((-1, "late"), (1, "early")):
        # The row that comes round is one of many.
        yield f"{every} seem to be shifted, one row {word}", given | {n: given[n].roll(step) for n in columns}
    if columns and is_temperature(columns[0]):
        return
    yield f"{every} seem to have the other sign", given | {n: -given[n] for n in columns}
    for name in columns:
        yield f"{name} seems to have the other sign", given | {name: -given[name]}
    for one, other in combinations(columns, 2):
        yield f"{one} and {other} seem to be swapped", given | {one: given[other], other: given[one]}


def _evidence(analysis: Analysis, situation: Situation, atom: Atom) -> float:
    """Log evidence of an effect alone with these covariates."""
    assert atom.effect is not None
    white, keep = analysis.whitening, analysis.whitening.keep()
    columns = torch.nan_to_num(signature_at(situation, situation, atom.effect, atom.shape))
    columns = columns if atom.used is None else columns[..., list(atom.used)]
    fitted = frame_columns(situation, white.counted)
    every = [white(v)[keep] for v in (fitted, analysis.residual[..., None], columns)]
    frames, target, own = (analysis.correlation(v) for v in every)
    y, x = without_fitted(frames, [target, own])
    fit = fit_sets(grams_of(x, y[..., 0]), [[torch.arange(x.shape[-1])]], analysis.dictionary.noise_dof)
    return float(fit.log_evidence[0])
