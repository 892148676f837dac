"""What changed on a machine since its model was made, from a few new rows.

What the model predicts is taken off, and what is left is explained by small changes of single parts: the zero of one
joint, the numbers of one link or leg, the frames. Each is linear with a normal prior of its plausible size, the noise
is what the model left of rows held out when it was made, and sets of changes are weighed by their marginal likelihood
(`ccnn_torch.evidence`). A dozen rows suffice, since nothing else is fitted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from ccnn_torch.compensation import LoadedModel
from ccnn_torch.diagnosis.candidates.atom import Atom, scaled_signature
from ccnn_torch.diagnosis.residual.whitening import moving_channels, without_fitted
from ccnn_torch.display import count_text, display_unit, number_text, with_unit
from ccnn_torch.effects import (
    Coefficient,
    Situation,
    default_gravity,
    effect_names,
    make_effect,
    measured_channels,
    missing_on,
    pose_residual,
)
from ccnn_torch.effects.columns import inside
from ccnn_torch.effects.constant import PARAMETER, Frame
from ccnn_torch.effects.words import words_of
from ccnn_torch.errors import InputError
from ccnn_torch.evidence.beam import search
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet, covariance
from ccnn_torch.evidence.judge import Explanation, Verdict, judge, marginal, posterior
from ccnn_torch.evidence.priors import EFFECT
from ccnn_torch.mechanisms import Instrument, Mechanism, sees_directions
from ccnn_torch.mechanisms.drawn import drawn
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.designs import Candidates
from ccnn_torch.report.results.verify import Change, ChangedNumber, Gap, NextPose, SinceResults, Told
from ccnn_torch.verification.job import Rows, can_be_moved, fit_motion, missing_of, motion_text, new_rows, predict
from ccnn_torch.verification.promise import configurations, promise_of

_T = TypeVar("_T")
FEWEST = 4
"""Configurations from which a change is told."""
# What is lost, moved or exchanged while a machine works; gear ratios, lengths and springs change ten times more rarely.
_USUAL, _RARE = ("joint_offset", "frame", "tool"), math.log(0.1)
# What every machine has that was identified.
_OF_A_MACHINE = (*_USUAL, "joint_gain", "geometry")
# A device that is so far from where it stood was set up anew: first order does not hold, and nobody calls it an error.
_FAR = {"m": 0.02, "rad": 0.02}
# The frames of an arm by the effect that moves them.
_FRAMES = {"frame": "base", "tool": "tool"}
# What is left beside the verdict is more than the model promises where chance makes as much so rarely.
_CHANCE = 0.01
# A change would have been seen from so many standard deviations of its number: odds of about 20 to 1.
_SEEN = 4.0
# A number is known from so small a standard deviation, in plausible sizes.
_KNOWN = 0.3
# From this probability on a change is told as one: of claims above it 94 of 99 were right (docs/how_to/verify.md).
_SURE = 0.9
# Poses that are proposed, of so many drawn; those that say less [nat] are not worth measuring.
_WANTED, _DRAWN, _TELLING = 5, 400, 0.01
_SPACE = 3


@dataclass(frozen=True)
class _Rows:
    """New rows about the model.

    Attributes:
        situation: `s` rows.
        residual: measured less predicted pose, `s x c` [m, rad].
        groups: configuration of each row, `s`.
        scale: what a channel is multiplied by to be in units of the noise, a configuration counting once, `s x c`;
            0 where it was not measured.
        channels: which of the pose's channels, `c`.
        noise_dof: weight of that noise, in values.
        moved: how the measuring device stands elsewhere than when the model was made, as of `fit_motion`; 0 where it
            does not.
        promise: RMS that the model promises of `position` [m] and `rotation` [rad].
    """

    situation: Situation
    residual: Tensor
    groups: Tensor
    scale: Tensor
    channels: Tensor
    noise_dof: float
    moved: Tensor
    promise: Mapping[str, float]

    @property
    def lengths(self) -> Tensor:
        """Which of the channels are lengths, `c` bool."""
        every = self.situation.mechanism.channels
        return torch.tensor([every[int(k)].unit == "m" for k in self.channels])

    @property
    def values(self) -> float:
        """How many values count."""
        count = int(self.groups.max()) + 1
        return float(count * (self.scale > 0).sum() / len(self.groups))


def what_changed(
    model: LoadedModel, records: Any, mechanism: str | None = None, *, seed: int = 0, **how: Any
) -> tuple[SinceResults, dict[str, Tensor]]:
    """What changed since a model was made, and the arrays of its picture.

    Args:
        model, mechanism, how: as of `new_rows`.
        records: new rows of the uncompensated machine, what `load_records` takes.
        seed: of the poses that are proposed.

    Raises:
        InputError: the rows lack a column, are not of this machine, or are too few.
    """
    machine, loaded = new_rows(model, records, mechanism, **how)
    rows = _rows_of(model, machine, loaded)
    count = int(rows.groups.max()) + 1
    if count < FEWEST:
        raise InputError(
            f"{loaded.path}: has {count_text(count, 'configuration')}; measure {FEWEST} or more, better ten, that are "
            "spread over the workspace"
        )
    atoms = _atoms(rows.situation, _may_change(model, rows.situation.mechanism))
    x = [a.columns[:, rows.channels] * rows.scale[..., None] for a in atoms]
    y = rows.residual * rows.scale
    notes = missing_of(model, loaded)
    if bool(rows.moved.any()):
        # What a motion of the device does, too, is not seen any more.
        frame = next(k for k, a in enumerate(atoms) if a.name == Frame.name)
        first, *rest = without_fitted(x[frame], [y[..., None], *x])
        y, x, atoms = first[..., 0], _but(rest, frame), _but(atoms, frame)
        notes.append(
            f"The measuring device stands elsewhere than when the model was made, by {motion_text(rows.moved)}: this "
            "was taken off, and what looks like it is not seen in these rows."
        )
    dictionary, sets = search(atoms, x, y, rows.noise_dof, values=rows.values)
    sets = [found for found in sets if not _is_a_zero_alone(rows, dictionary, found)]
    explanations = posterior([(1.0, [(_names(atoms, f), (), f.log_posterior, f) for f in sets])])
    verdict = judge(explanations, explanations, lambda e: () if _is_more(rows, e.best) else None, of_classes=True)
    results = SinceResults(
        model=Path(model.path).name,
        records=Path(loaded.path).name,
        mechanism=rows.situation.mechanism.name,
        rows=len(rows.groups),
        configurations=count,
        changed=[_told(rows, dictionary, verdict, i, k) for k, i in enumerate(verdict.chosen.best.members)],
        probability=verdict.probability,
        rest=verdict.outside,
        position=_gap(rows, dictionary, verdict.chosen.best, "m"),
        rotation=_gap(rows, dictionary, verdict.chosen.best, "rad") if bool((~rows.lengths).any()) else None,
        changes=_changes(rows, dictionary, explanations),
        next_measurements=_next(model, rows, dictionary, explanations, verdict, seed),
        notes=notes,
        text="",
    )
    results.text = since_text(results)
    return results, _drawn(rows, dictionary, verdict.chosen.best)


def _rows_of(model: LoadedModel, machine: Mechanism, loaded: Any) -> _Rows:
    found = predict(model, machine, loaded, False)
    machine, joints = found.mechanism, found.joints
    covariates = {c.name: loaded.covariates[:, i] for i, c in enumerate(loaded.covariate_coordinates)}
    guess = completed(machine, joints, found.pose)
    situation = Situation(machine, joints, covariates, default_gravity(machine), None, guess)
    channels = moving_channels(situation)
    moved = _moved(found)
    residual = pose_residual(situation, found.undone(moved)) - pose_residual(situation, found.predicted)
    residual = residual[:, channels]
    seen = measured_channels(situation, found.pose)
    known = torch.isfinite(residual) if seen is None else seen[:, channels] & torch.isfinite(residual)
    groups = configurations(joints, machine.joints)
    lengths = torch.tensor([machine.channels[int(k)].unit == "m" for k in channels])
    promise, sigma = promise_of(model) or {}, residual.new_empty(len(channels))
    kept: dict[str, float] = {}
    for kind, mine in (("position", lengths), ("rotation", ~lengths)):
        if not bool(mine.any()):
            continue
        block = promise.get(kind)
        if block is None:
            raise InputError(
                f"{model.path}: promises no error of the {kind} for new rows, so nothing says what is a change; take a "
                "model that held rows out, an identified.yaml with its identified.json beside it, and not of distances"
            )
        kept[kind] = float(block["rms"])
        sigma[mine] = kept[kind] / math.sqrt(int(mine.sum()))
    dof = min(2 * promise["configurations"] / promise[kind]["spread"] for kind in kept)
    share = torch.bincount(groups)[groups].to(sigma.dtype).rsqrt()
    scale = torch.where(known, share[:, None] / sigma, 0.0)
    filled = torch.where(known, residual, 0.0)
    return _Rows(situation, filled, groups, scale, channels, dof, moved, kept)


def _moved(found: Rows) -> Tensor:
    """The rigid motion of a measuring device that was set up anew; none where it is so small that it is a candidate."""
    none = torch.zeros(6, dtype=torch.float64)
    if not can_be_moved(found.mechanism) or int((~found.pose.isnan().any(-1)).sum()) < FEWEST:
        return none
    motion = fit_motion(found.mechanism, found.predicted, found.pose)
    far = bool(motion[:3].norm() > _FAR["m"]) or bool(motion[3:].norm() > _FAR["rad"])
    return motion if far else none


def _may_change(model: LoadedModel, mechanism: Mechanism) -> list[str]:
    """Effects that can have changed: what a machine without a network does not hold may have been there before."""
    names = effect_names(mechanism)
    if model.machine is None:
        return names
    held = {*_OF_A_MACHINE, *(acting.effect.name for acting in model.machine.acting)}
    return [name for name in names if name in held or name.startswith(PARAMETER)]


def _atoms(situation: Situation, names: Sequence[str]) -> list[Atom]:
    """Changes of single parts: an effect's numbers joint by joint or leg by leg where each belongs to one."""
    atoms = []
    for name in names:
        effect = make_effect(name, situation.mechanism)
        # A frame that was fitted when the model was made may have moved since.
        fitted = _FRAMES.get(name) in getattr(inside(situation.mechanism), "unknown_frames", ())
        if effect.ordered or (not fitted and missing_on(effect, situation)) or effect.shapes(situation):
            continue
        parts: dict[str, list[int]] = {}
        coefficients = effect.coefficients(situation)
        for k, one in enumerate(coefficients):
            parts.setdefault(_part(one), []).append(k)
        if "" in parts:
            parts = {"": list(range(len(coefficients)))}
        signature = scaled_signature(situation, effect, situation.joints[0, :0])
        prior = EFFECT - math.log(max(len(parts), 1)) + (0.0 if name in _USUAL else _RARE)
        for part, used in parts.items():
            columns = torch.nan_to_num(signature[..., used])
            if bool(columns.any()):
                named = f"{name} {part}".strip()
                atoms.append(Atom(named, effect, situation.joints[0, :0], columns, prior, tuple(used)))
    return atoms


def _but(values: Sequence[_T], left_out: int) -> list[_T]:
    return [value for k, value in enumerate(values) if k != left_out]


def _part(coefficient: Coefficient) -> str:
    if coefficient.joint is not None:
        return coefficient.joint
    return "" if coefficient.leg is None else f"leg {coefficient.leg}"


def _names(atoms: Sequence[Atom], found: FittedSet) -> frozenset[str]:
    return frozenset(atoms[i].name for i in found.members)


def _is_more(rows: _Rows, found: FittedSet) -> bool:
    """Whether a set leaves more than the model promises."""
    # Imported here: few commands need it.
    from scipy.stats import f

    free = max(rows.values - found.effective, 1.0)
    return float(f.sf(found.rss / free, free, rows.noise_dof)) < _CHANCE


def _is_a_zero_alone(rows: _Rows, dictionary: Dictionary, found: FittedSet) -> bool:
    """Whether a set has a gear ratio that the rows show to be right: then it is its zero, which another set has."""
    begin, sd = 0, None
    for i, mean in zip(found.members, found.mean, strict=True):
        atom = dictionary.atoms[i]
        assert isinstance(atom, Atom)
        own = torch.tensor([not c.secondary for c in atom.coefficients(rows.situation)])
        if not bool(own.all()):
            sd = covariance(dictionary, found).diagonal().sqrt() if sd is None else sd
            mine = sd[begin : begin + len(mean)][own]
            if bool(((mean[own].abs() < 3 * mine) & (mine < _KNOWN)).all()):
                return True
        begin += len(mean)
    return False


def _words(atom: Atom) -> str:
    """The change in words, `zero offset of q3`."""
    assert atom.effect is not None
    short = words_of(atom.effect.name).short
    part = atom.name.removeprefix(atom.effect.name).strip()
    return f"{short} of {part}" if part else short


def _told(rows: _Rows, dictionary: Dictionary, verdict: Verdict[FittedSet], index: int, place: int) -> Told:
    atom, found = dictionary.atoms[index], verdict.chosen.best
    assert isinstance(atom, Atom) and atom.effect is not None
    begin = sum(len(mean) for mean in found.mean[:place])
    sd = covariance(dictionary, found).diagonal().sqrt()[begin : begin + len(found.mean[place])]
    numbers = [
        ChangedNumber(name=c.name, unit=c.unit, value=float(m) * c.scale, sd=float(s) * c.scale)
        for c, m, s in zip(atom.coefficients(rows.situation), found.mean[place], sd, strict=True)
    ]
    look = words_of(atom.effect.name).look.format(
        where=atom.name.removeprefix(atom.effect.name).strip() or "the machine"
    )
    like = verdict.classes.get(atom.name, ())
    instead = [_words(a) for name in like for a in dictionary.atoms if isinstance(a, Atom) and a.name == name]
    return Told(name=atom.name, text=_words(atom), numbers=numbers, instead=instead, look=look)


def _changes(rows: _Rows, dictionary: Dictionary, explanations: Sequence[Explanation[FittedSet]]) -> list[Change]:
    found = []
    for i, atom in enumerate(dictionary.atoms):
        assert isinstance(atom, Atom)
        first, *more = atom.coefficients(rows.situation)
        size = dictionary.columns[..., dictionary.groups[i]].square().sum().sqrt()
        found.append(
            Change(
                name=atom.name,
                text=_words(atom),
                probability=marginal(explanations, atom.name),
                seen_from=None if more else _SEEN * first.scale / float(size),
                unit=first.unit,
            )
        )
    return sorted(found, key=lambda change: -change.probability)


def _gap(rows: _Rows, dictionary: Dictionary, found: FittedSet, unit: str) -> Gap:
    mine = rows.lengths if unit == "m" else ~rows.lengths
    known = rows.scale > 0

    def rms(left: Tensor) -> float:
        squares = torch.where(known, left, 0.0)[:, mine].square().sum(-1)
        return float(squares[known[:, mine].any(-1)].mean().sqrt())

    after = rms(_left_out(rows, dictionary, found)) if found.members else None
    promised = rows.promise["position" if unit == "m" else "rotation"]
    # A direction is a vector of length 1.
    length = unit == "m" and not sees_directions(rows.situation.mechanism)
    return Gap(unit="m" if length else "rad", before=rms(rows.residual), after=after, promised=promised)


def _drawn(rows: _Rows, dictionary: Dictionary, found: FittedSet) -> dict[str, Tensor]:
    """The machine with the errors of the new rows about the model, and what the change leaves; {} of readings."""
    here, places = rows.situation, [k for k, channel in enumerate(rows.channels.tolist()) if channel < _SPACE]
    if isinstance(here.mechanism, Instrument) or not places:
        return {}
    after = _left_out(rows, dictionary, found) if found.members else rows.residual
    axes = rows.channels[places]
    whole = [each.new_zeros(len(each), _SPACE).index_copy_(1, axes, each[:, places]) for each in (rows.residual, after)]
    place = here.mechanism.frame(here.pose)[0]
    return drawn(here.mechanism, here.joints, here.pose, place, *whole)


def _left_out(rows: _Rows, dictionary: Dictionary, found: FittedSet) -> Tensor:
    """What a set leaves of each configuration when it is fitted to the others, `s x c` [m, rad]."""
    size = torch.cat([m.new_full((len(m),), s / 2).exp() for m, s in zip(found.mean, found.log_scale, strict=True)])
    index = torch.cat([dictionary.groups[i] for i in found.members])
    x, y = dictionary.columns[..., index] * size, dictionary.y
    count = int(rows.groups.max()) + 1
    normal = x.new_zeros(count, len(size), len(size)).index_add_(0, rows.groups, torch.einsum("sci,scj->sij", x, x))
    along = x.new_zeros(count, len(size)).index_add_(0, rows.groups, torch.einsum("sci,sc->si", x, y))
    inner = normal.sum(0) - normal + found.noise * torch.eye(len(size), dtype=x.dtype)
    without = torch.linalg.solve(inner, along.sum(0) - along)
    left = y - (x @ without[rows.groups][..., None])[..., 0]
    return torch.where(rows.scale > 0, left / rows.scale.clamp_min(1e-300), 0.0)


def _next(
    model: LoadedModel,
    rows: _Rows,
    dictionary: Dictionary,
    explanations: Sequence[Explanation[FittedSet]],
    verdict: Verdict[FittedSet],
    seed: int,
) -> list[NextPose]:
    """Poses that tell the verdict from its nearest rival, or make its numbers sharper where a pose tells nothing."""
    first = verdict.chosen.best
    rivals = [e for e in explanations if e.names != verdict.chosen.names]
    if not first.members and (not rivals or verdict.probability > 1 - _TELLING):
        return []
    there = _poses(model, rows, seed)
    noise = (1 / rows.scale.clamp_min(1e-300)).where(rows.scale > 0, torch.nan).nanmedian(0).values

    def columns(found: FittedSet) -> Tensor:
        parts = [there.jacobian[..., :0]]
        for i in found.members:
            atom = dictionary.atoms[i]
            assert isinstance(atom, Atom) and atom.effect is not None and atom.used is not None
            parts.append(scaled_signature(there, atom.effect, atom.shape)[..., list(atom.used)])
        return torch.nan_to_num(torch.cat(parts, -1))[:, rows.channels] / noise[:, None]

    own = covariance(dictionary, first)
    if rivals:
        other = rivals[0].best
        both = torch.cat([columns(first), -columns(other)], -1)
        spread = torch.block_diag(own, covariance(dictionary, other))  # type: ignore[no-untyped-call]
        asked = Candidates.of(both, spread, torch.cat([both[0, 0, :0], *first.mean, *other.mean]))
        found = _best(rows, there, asked, sorted(verdict.chosen.names ^ rivals[0].names))
        if found or not first.members:
            return found
    return _best(rows, there, Candidates.of(columns(first), own), [])


def _poses(model: LoadedModel, rows: _Rows, seed: int) -> Situation:
    """Joints between the ends of the model's domain, or of the new rows; conditions as some row had them."""
    here, generator = rows.situation, torch.Generator().manual_seed(seed)
    domain = model.facts.get("domain", {}).get("inputs", {})
    low, high = here.joints.amin(0), here.joints.amax(0)
    for k, joint in enumerate(here.mechanism.joints):
        if joint.name in domain:
            low[k], high[k] = domain[joint.name]["low"], domain[joint.name]["high"]
    share = torch.rand(_DRAWN, len(low), generator=generator, dtype=low.dtype)
    row = torch.randint(len(here.joints), (_DRAWN,), generator=generator)
    covariates = {name: values[row] for name, values in here.covariates.items()}
    guess = None if here.guess is None else here.guess[row]
    return replace(here, joints=low + (high - low) * share, covariates=covariates, guess=guess)


def _best(rows: _Rows, there: Situation, asked: Candidates, separates: list[str]) -> list[NextPose]:
    whole = torch.isfinite(there.jacobian).flatten(1).all(-1)

    def gain() -> Tensor:
        return 0.5 * (asked.information() if asked.difference is None else asked.divergence())

    alone, taken = torch.nan_to_num(gain()), []
    for _ in range(_WANTED):
        worth = torch.where(whole, torch.nan_to_num(gain()), 0.0)
        best = int(worth.argmax())
        if float(worth[best]) < _TELLING:
            break
        taken.append(best)
        whole = whole.clone()
        whole[best] = False
        asked.change(best, 1)
    names = [joint.name for joint in rows.situation.mechanism.joints]
    return [
        NextPose(
            joints=dict(zip(names, there.joints[k].tolist(), strict=True)), gain=float(alone[k]), separates=separates
        )
        for k in taken
    ]


def since_text(results: SinceResults) -> str:
    """The verdict in two or three sentences."""
    what = "position" if results.position.unit == "m" else "direction"
    before, after, promised = (
        with_unit(v, results.position.unit, like=results.position.before)
        for v in (results.position.before, results.position.after, results.position.promised)
    )
    rows = count_text(results.rows, "new row")
    limit = f", the model promises {promised}"
    if not results.changed:
        said = "Something changed that none of the changes here explains"
        said = said if results.rest else "Nothing changed that these rows show"
        return f"{said}: on {rows} the {what} is off by {before} RMS{limit} (p {results.probability:.2f})."
    changed = " and ".join(_said(one) for one in results.changed)
    sure = "Changed" if results.probability >= _SURE else "Perhaps changed"
    more = " Beside this more is left than the model promises." if results.rest else ""
    return (
        f"{sure} since the model was made: {changed} (p {results.probability:.2f}, ± at 95 %). "
        f"On {rows} the {what} is off by {before} RMS, and by {after} with this change, each row left out in turn"
        f"{limit}.{more}"
    )


def _said(one: Told) -> str:
    instead = f" (or {' or '.join(one.instead)})" if one.instead else ""
    clear = [number for number in one.numbers if abs(number.value) > 1.96 * number.sd] or one.numbers
    sizes = []
    for number in clear:
        scale, unit = display_unit(number.unit, abs(number.value))
        sizes.append(f"{number.value / scale:+.3g} ± {number_text(1.96 * number.sd / scale, 2)} {unit}")
    if len(one.numbers) == 1:
        return f"{one.text} by {sizes[0]}{instead}"
    named = ", ".join(f"{number.name} {size}" for number, size in zip(clear, sizes, strict=True))
    rest = len(one.numbers) - len(clear)
    more = f"; {rest} more {'is' if rest == 1 else 'are'} not clear of 0" if rest else ""
    return f"{one.text} ({named}{more}){instead}"
