"""`effects: auto`: the effects that the training rows ask for."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.calibration.dataset import rows_of
from ccnn_torch.diagnosis.from_file import TRAINING_ROWS, Verdict, in_time, usable_verdict, with_numbers
from ccnn_torch.diagnosis.from_records import situation_of
from ccnn_torch.diagnosis.joint_fit import effects_that_pay, fit_jointly, loose_parameters, on_fitted_frames
from ccnn_torch.effects import make_effect, without_pose_effects
from ccnn_torch.effects.time import FrameDrift, elapsed
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox, Mechanism
from ccnn_torch.records import Records


def without_frame_drift(
    mechanism: Mechanism, records: Records, rows: Tensor, verdict: Verdict, identify: bool
) -> tuple[Records, Verdict | None, list[str]]:
    """Records as from a frame that stood where it stood at the first row, where a verdict names a drift of it.

    The drift is fitted to some rows together with the verdict's other effects and the machine's parameters, its shapes
    staying, and taken out of all.

    Args:
        rows: numbers of the rows that are not held out.
        identify: whether all parameters of the machine are fitted beside.

    Returns:
        The records; the verdict without the drift, None where it then names nothing; and notes.
    """
    others, drift = verdict.of_machine()
    if drift is None:
        return records, verdict, []
    recorded = situation_of(records, mechanism)
    situation = in_time(on_fitted_frames(recorded), moments(records))
    known = [*others.on(recorded, identify)[0], with_numbers(FrameDrift(), situation, drift)]
    fine = torch.zeros(len(records), dtype=torch.bool)
    fine[rows] = True
    fine &= torch.isfinite(situation.pose).all(-1)
    loose = loose_parameters(situation.mechanism, identify)
    *_, found = fit_jointly(situation, records.pose, known, fine, loose).acting
    pose = without_pose_effects(situation, records.pose, [found])
    moved = float(found.change(situation)[..., :3].norm(dim=-1).max())
    note = (
        f"A drift of the measuring frame ({FrameDrift.name}, up to {1e3 * moved:.3g} mm) was fitted to the training "
        "rows of the first repeat and taken out of all measured poses: it is no error of the machine, and commands are "
        "not corrected for it."
    )
    return replace(records, pose=pose), others if others.effects else None, [note]


def moments(records: Records) -> Tensor:
    """Time of each row since the first one [s], or its number where none was recorded in all rows."""
    time = torch.as_tensor(records.columns.get("time", ()), dtype=torch.float64)
    return elapsed(time) if len(time) and bool(time.isfinite().all()) else torch.arange(len(records)).double()


# Rows that the search uses: more take longer and show the same.
_MOST_ROWS = 1000
_EFFECTS = (
    *("joint_gain", "transmission", "backlash", "friction", "compliance", "sag", "gravity", "thermal"),
    *("coupling", "flexure"),
)
"""What is looked for where nothing is asked: all of the library that acts within the machine and that a command can
know. Frames and geometry are fitted beside, and a drift of the measuring frame where the rows have times; an error of
the measuring device is none of the machine."""


def search_effects(
    mechanism: Mechanism, records: Records, rows: Tensor, names: list[str] | None, seed: int, identify: bool
) -> tuple[Verdict | None, list[str]]:
    """Look for effects in some rows, at most 1000 of them.

    Args:
        rows: numbers of the rows that are not held out.
        names: effects to look for; those that act within the machine when None.
        seed: of the choice of rows.
        identify: whether all parameters of the machine are fitted beside.

    Returns:
        The effects that pay, None without any; and notes, one sentence each.
    """
    if isinstance(mechanism, BlackBox):
        return None, ["Effects were not searched: of a simulator every row takes long; see ccnn diagnose."]
    if len(rows) > _MOST_ROWS:
        rows = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))[:_MOST_ROWS]]
    rows = rows.sort().values
    few = rows_of(records, rows)
    try:
        recorded = situation_of(few, mechanism)
    except InputError as reason:
        return None, [f"Effects were not searched: {reason}"]
    made = [make_effect(name, mechanism) for name in _EFFECTS if names is None or name in names]
    made += [make_effect(name, mechanism) for name in names or () if name not in _EFFECTS]
    asked = [e for e in made if not (identify and e.kind == "parameters") and e.name != FrameDrift.name]
    asked = [e for e in asked if names is not None or not e.missing(mechanism, [*recorded.covariates])]
    named = Verdict(TRAINING_ROWS, recorded.gravity, tuple((e.name, {}) for e in asked))
    usable, notes = usable_verdict(named, recorded)
    notes = notes if names is not None else []
    situation = on_fitted_frames(recorded)
    # What drifts by the time of the rows is not taken for what their joints or loads do.
    drifts = "time" in records.columns if names is None else FrameDrift.name in names
    situation = in_time(situation, moments(records)[rows]) if drifts else situation
    fine = torch.isfinite(situation.pose).all(-1)
    if not bool(fine.any()):
        return None, [f"Effects were not searched: {mechanism.name} takes none of the training rows."]
    kept = () if usable is None else tuple(name for name, _ in usable.effects)
    effects = [e for e in asked if e.name in kept] + ([FrameDrift()] if drifts else [])
    loose = loose_parameters(situation.mechanism, identify)
    known = effects_that_pay(situation, few.pose, effects, fine, loose) if effects else []
    if not known:
        return None, ["Effects were searched in the training rows, and none pays.", *notes]
    acting, _ = fit_jointly(situation, few.pose, known, fine, loose)
    numbers = []
    for one, fitted in zip(known, acting, strict=True):
        coefficients, shapes = one.effect.coefficients(situation), one.effect.shapes(situation)
        values = {coefficients[k].name: float(fitted.coefficients[k]) for k in one.used}
        values |= {s.name: float(v) for s, v in zip(shapes, one.shape, strict=True)}
        numbers.append((one.effect.name, values))
    said = ", ".join(dict.fromkeys(name for name, _ in numbers))
    notes = [f"Effects without which the training rows would be less probable: {said}.", *notes]
    return replace(named, effects=tuple(numbers)), notes
