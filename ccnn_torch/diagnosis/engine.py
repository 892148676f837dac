"""Diagnose rows: which effects cause the gap, where it is, and the share that they explain."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.checks.cautions import cautions, of_inferred
from ccnn_torch.diagnosis.checks.mistakes import PlausibleRows, plausible_rows
from ccnn_torch.diagnosis.checks.unrecorded import measured_order, missing_covariates, of_order, order_shows
from ccnn_torch.diagnosis.discrepancy.local import CROSS
from ccnn_torch.diagnosis.discrepancy.smooth import SPEED
from ccnn_torch.diagnosis.from_file import not_held_notes
from ccnn_torch.diagnosis.next_measurements import next_measurements
from ccnn_torch.diagnosis.progress import at_step
from ccnn_torch.diagnosis.residual.noise_evidence import Noise, noise_of_repeats
from ccnn_torch.diagnosis.residual.rows import copies_of, picked
from ccnn_torch.diagnosis.result import Diagnosis, content_of, order_block, verdict_block
from ccnn_torch.diagnosis.search.analysis import Analysis, analyse
from ccnn_torch.diagnosis.verdict.blocks import Blocks, blocks, by_block
from ccnn_torch.diagnosis.verdict.judgement import Judgement, judge_rows, without_names
from ccnn_torch.diagnosis.verdict.localisation import localise
from ccnn_torch.diagnosis.verdict.text import lacking_text, shared_text, unseen_text
from ccnn_torch.effects import (
    Effect,
    Situation,
    check_names,
    effect_names,
    make_effect,
    missing_on,
    owned,
    pose_residual,
)
from ccnn_torch.effects.time import ROW, Homing
from ccnn_torch.errors import InputError, RowsError
from ccnn_torch.evidence.judge import BESIDE_UNKNOWN

OUTLIER = "outlier"
# More rows, and more measured values, than this name a cause no better: so many are drawn.
_MOST_ROWS, _MOST_VALUES = 2000, 9000
_FEWEST_ROWS = 20
UNSHOWN = "rows in which it shows: in these it changes no pose"
# Names below this probability are accepted only where rows not used for fitting show what they take away.
_LIKELY = 0.8
# Times the noise from which a row is bad and not unlucky: alone; and where more than so many rows in a hundred, one
# at least, are beyond the second, since the tail of a t distribution with three degrees comes that far now and then.
_GROSS, _GROSS_TOGETHER, _SHARE_TOGETHER = 60.0, 15.0, 0.01


def candidates(
    situation: Situation, effects: Sequence[Effect | str] | None = None
) -> tuple[list[Effect], dict[str, str]]:
    """Effects that these records could show, and for the others what is missing.

    Raises:
        InputError: the records can show none of them, two have one name, or a user's own breaks what `Effect` says.
    """
    every = _made(situation, effects)
    lacking = {e.name: missing_on(e, situation) for e in every}
    check_names(every)
    if every and all(lacking.values()):
        need = "; ".join(f"{name} needs {why}" for name, why in lacking.items())
        raise InputError(f"effects: these records can show none of the candidates: {need}")
    usable = (e for e in every if not lacking[e.name])
    return [e.of(situation) if isinstance(e, Homing) else e for e in usable], {
        n: why for n, why in lacking.items() if why
    }


def _made(situation: Situation, effects: Sequence[Effect | str] | None) -> list[Effect]:
    """Candidates, those of the library and of the mechanism when None."""
    whole = effect_names(situation.mechanism)
    if isinstance(effects, str):
        raise InputError(f"effects: '{effects}' is one name and not a list of names; write ['{effects}']")
    named = [n for e in (["all"] if effects is None else effects) for n in (whole if e == "all" else [e])]
    return [make_effect(e, situation.mechanism) if isinstance(e, str) else owned(e) for e in named]


class _Judged(NamedTuple):
    """Rows with a verdict.

    Attributes:
        rows: which of them are of the machine at all.
        chosen: those evaluated, `t`.
        copies: how many repeat another one.
        effects: candidates.
        lacking: those that the records cannot show, and what is missing.
        known: the noise that was given, or that the records show.
        analysis, judgement: of the rows evaluated.
        made: the verdict on held-out rows.
        inferred: covariates that were not recorded but follow from the order of the rows.
    """

    rows: PlausibleRows
    chosen: Tensor
    copies: int
    effects: list[Effect]
    lacking: dict[str, str]
    known: Noise | None
    analysis: Analysis
    judgement: Judgement
    made: Blocks
    inferred: tuple[str, ...]


def diagnose_rows(
    situation: Situation,
    measured: Tensor,
    noise: Tensor | None = None,
    effects: Sequence[Effect | str] | None = None,
    seed: int = 0,
    instrument: Noise | None = None,
    constant: Collection[str] = (),
) -> Diagnosis:
    """Diagnose rows of commanded joints and measured poses.

    Args:
        situation: `s` rows without further leading dims, in the order measured, with what was measured beside them.
        measured: poses, `s x p` [SI].
        noise: standard deviation of each channel of position and rotation vector, `c` [m, rad]; estimated when None.
        effects: candidates, or their names, "all" for those of the library; the whole library when None.
        seed: of folds and resampling.
        instrument: the noise as columns of the records have it; where there are none, and no `noise`, readings of one
            target show it.
        constant: columns of the records that never change: what they say is not taken from the order of the rows.

    Raises:
        InputError: too few rows, or too many of them that the mechanism cannot have reached.
    """
    said = _judged(situation, measured, noise, effects, seed, instrument)
    for name, kind in of_order(situation).items():
        if any(column.startswith(name) for column in constant):
            continue
        columns = kind.columns(situation, measured_order(situation))
        # A term that follows the order of the rows leaves nothing to show.
        told = name == ROW and any(d.startswith("time") for d in said.judgement.drivers)
        if not told and not order_shows(
            said.analysis, said.judgement, {n: v[said.chosen] for n, v in columns.items()}, kind
        ):
            continue
        more = replace(situation, covariates={**situation.covariates, **columns})
        other = _judged(more, measured, noise, effects, seed, instrument, (*said.inferred, *columns))
        # Names that could not be asked for before, or a driver that was not there.
        if {*said.lacking, *(e.name for e in kind.effects)} & {*other.judgement.names} or any(
            d.startswith(name) for d in other.judgement.drivers
        ):
            said, situation = other, more
    return _diagnosis(said, noise is not None, seed)


def _judged(
    situation: Situation,
    measured: Tensor,
    noise: Tensor | None,
    effects: Sequence[Effect | str] | None,
    seed: int,
    instrument: Noise | None,
    inferred: tuple[str, ...] = (),
) -> _Judged:
    """Arguments as for `diagnose_rows`; inferred: as in what is returned."""
    at_step("searching the effects")
    rows = usable_rows(situation, measured)
    copies = int((rows.fine & copies_of(situation, measured)).sum())
    situation, measured, chosen = drawn_rows(situation, measured, rows.fine, seed)
    every = _made(situation, effects)
    usable, lacking = candidates(situation, every)
    if noise is not None:
        known: Noise | None = Noise(noise, "given")
    else:
        known = instrument or noise_of_repeats(situation, measured)
    analysis = analyse(situation, measured, usable, noise, None if known is None else known.sd)
    at_step("judging on held-out rows")
    judgement, residual = judge_rows(analysis), pose_residual(situation, measured)
    made = Blocks(analysis, judgement, residual, seed)
    unlikely = bool(judgement.names) and not judgement.outside and judgement.probability < _LIKELY
    if unlikely:
        interval = made.main(made.together).interval
        if interval is None or interval[0] <= 0:
            judgement = without_names(analysis, judgement)
            made = Blocks(analysis, judgement, residual, seed)
    return _Judged(rows, chosen, copies, every, lacking, known, analysis, judgement, made, inferred)


def _diagnosis(said: _Judged, is_given: bool, seed: int) -> Diagnosis:
    """is_given: whether the noise was; seed: of folds and resampling."""
    rows, analysis, judgement, made = said.rows, said.analysis, said.judgement, said.made
    # What no column would bring into sight is no reason to record one.
    unseen = said.lacking | dict.fromkeys(analysis.rows.idle, UNSHOWN)
    together = made.main(made.together)
    gap, gap_rotation, listed = blocks(made)
    nothing = not judgement.names and not judgement.outside
    outlier = nothing and bool(rows.astray.any() or gross_outliers(analysis).any())
    found = [*judgement.names, *judgement.drivers]
    missing = missing_covariates(analysis, said.effects, said.lacking, found, seed)
    doubts = cautions(analysis, judgement, rows, missing, together)
    doubts += [of_inferred(said.inferred)] if said.inferred else []
    every_driver = dict.fromkeys(d for one in judgement.drivers for d in one.split(CROSS))
    drivers = [d for d in every_driver if not d.startswith(SPEED)]
    # A condition says more than the joint that it acts beside.
    drivers.sort(key=lambda d: d.startswith("joint"))
    names = [OUTLIER] if outlier else judgement.names
    probability = min([judgement.probability, *(caution.most for caution in doubts)])
    why = why_set_aside(analysis, rows, said.chosen)
    shown = said.known is not None and (is_given or analysis.instrument is not None)
    source = said.known.source if said.known is not None and shown else "estimated"
    places, intervals = localise(analysis, made.residual, seed)
    at_step("by block")
    far = by_block(made)
    at_step("next measurements")
    proposed = next_measurements(analysis, judgement, seed)
    content = content_of(
        mechanism={
            "name": analysis.situation.mechanism.name,
            "joints": [joint.name for joint in analysis.situation.mechanism.joints],
            "gravity": analysis.situation.gravity.tolist(),
        },
        noise=source,
        gap=gap,
        gap_rotation=gap_rotation,
        where=places,
        where_ci95=intervals,
        effects=listed,
        in_order=order_block(judgement.names, [made.main(held) for held in made.steps]),
        by_block=far,
        verdict=verdict_block(names, probability, together, judgement.outside, drivers),
        next_measurements=proposed,
        missing_covariates=missing,
        not_seen=unseen,
        rows_set_aside=sorted(why),
        why_set_aside=[why[row] for row in sorted(why)],
        cautions=[caution.text for caution in doubts],
        notes=_notes(said, unseen, missing, proposed),
        machine=None,
    )
    return Diagnosis(content, tuple(analysis.acting(judgement.acting)), analysis, judgement, inferred=said.inferred)


def _notes(
    said: _Judged,
    unseen: Mapping[str, str],
    missing: Sequence[Mapping[str, Any]],
    proposed: Sequence[Mapping[str, Any]],
) -> list[str]:
    """What was left out and why, one sentence each without a full stop; arguments as in `diagnosis.json`."""
    rows, chosen, copies, analysis, judgement = said.rows, said.chosen, said.copies, said.analysis, said.judgement
    mechanism, covariates = analysis.situation.mechanism, [*analysis.situation.covariates]
    notes = [unseen_text(name, reason) for name, reason in unseen.items()]
    notes += [lacking_text(mechanism.name, condition) for condition in mechanism.lacking(covariates)]
    notes += not_held_notes(judgement.names)
    for atom in (analysis.atoms[i] for i in judgement.found.members):
        if atom.note and atom.is_discrepancy:
            rows_of = ", ".join(str(int(chosen[row]) + 1) for row in atom.begins)
            notes.append(atom.note + (f" from row {rows_of} on (counted from 1)" if rows_of else ""))
    if copies:
        notes.append(f"{copies} rows are exact copies of others and were counted once")
    notes += [shared_text(analysis.correlation)] if analysis.correlation.value else []
    if len(analysis.measured) < int(rows.fine.sum()) - copies:
        notes.append(f"{len(analysis.measured)} of {len(rows.fine)} rows, drawn at random, were evaluated")
    atoms = analysis.atoms
    beside = [atoms[i] for i in judgement.fullest.members if i not in judgement.found.members]
    corrections = [a.name for a in beside if not a.is_discrepancy]
    if judgement.names and corrections:
        share = (judgement.found.rss - judgement.fullest.rss) / analysis.gap
        notes.append(
            f"the values of {' and '.join(judgement.names)} are from a fit that also holds "
            f"{' and '.join(corrections)}; it would explain {100 * share:.2g} % more of the residual, too little to be "
            "named"
        )
    if judgement.outside and not proposed:
        notes.append("no measurement is proposed: no model predicts the measurements of a cause outside the library")
    doubtful = not judgement.outside or judgement.probability <= BESIDE_UNKNOWN
    if not judgement.names and doubtful and analysis.whitening.known == 0 and missing:
        columns = ", ".join(column for entry in missing for column in entry["columns"])
        notes.append(
            "the noise was not given, so that a cause that follows nothing recorded counts as noise: compare the noise "
            f"with that of the measuring device, and record what may be missing ({columns})"
        )
    return notes


def why_set_aside(analysis: Analysis, rows: PlausibleRows, chosen: Tensor) -> dict[int, str]:
    """Reason by row, counted from 0 in the file; rows: all of them; chosen: those evaluated."""
    why = dict.fromkeys(torch.nonzero(~rows.fine).squeeze(-1).tolist(), "the machine does not reach it")
    why |= dict.fromkeys(torch.nonzero(rows.astray).squeeze(-1).tolist(), "far from where its joints put it")
    aside, near = ~analysis.whitening.counted, analysis.near_singular
    why |= dict.fromkeys(chosen[aside & ~near].tolist(), "far from what any fit to the other rows says")
    return why | dict.fromkeys(chosen[aside & near].tolist(), "next to a singularity")


def gross_outliers(analysis: Analysis) -> Tensor:
    """Rows set aside that are so far off that no heavy tail of ordinary noise makes them, `s` bool."""
    white = analysis.whitening
    size = (white.picked(analysis.residual) / white.sigma).abs().amax(-1)
    aside = ~white.counted & ~analysis.near_singular
    far = aside & (size > _GROSS_TOGETHER)
    together = int(far.sum()) > max(1.0, _SHARE_TOGETHER * len(far))
    return far if together else aside & (size > _GROSS)


def usable_rows(situation: Situation, measured: Tensor) -> PlausibleRows:
    """Rows that the mechanism can have reached.

    Raises:
        RowsError: too few rows, or most of them out of reach or far from where the model puts them.
    """
    rows = len(situation.joints)
    if rows < _FEWEST_ROWS:
        raise RowsError(f"{rows} rows are too few for a diagnosis; measure at least {_FEWEST_ROWS}, better 100")
    return plausible_rows(situation, measured)


def drawn_rows(situation: Situation, measured: Tensor, fine: Tensor, seed: int) -> tuple[Situation, Tensor, Tensor]:
    """As many of the fine rows as are evaluated, in order and without copies, and which they are."""
    chosen = torch.nonzero(fine & ~copies_of(situation, measured)).squeeze(-1)
    most = min(_MOST_ROWS, _MOST_VALUES // len(situation.mechanism.pose))
    if len(chosen) > most:
        drawn = torch.randperm(len(chosen), generator=torch.Generator().manual_seed(seed))[:most]
        chosen = chosen[drawn.sort().values]
    if len(chosen) == len(fine):
        return situation, measured, chosen
    return picked(situation, chosen), measured[chosen], chosen
