"""The identified machine of a run: geometry and the effects that the training rows ask for, fitted to each repeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.calibration.dataset import Dataset, pad_rows, rows_of
from ccnn_torch.compensation import Machine, machine_of
from ccnn_torch.coordinates import is_temperature
from ccnn_torch.diagnosis.from_file import (
    TRAINING_ROWS,
    Known,
    Verdict,
    in_time,
    read_verdict,
    usable_verdict,
    with_numbers,
)
from ccnn_torch.diagnosis.from_records import in_own_base, named_mistake, of_commands, situation_of
from ccnn_torch.diagnosis.joint_fit import effects_that_pay, fit_jointly, loose_parameters, on_fitted_frames
from ccnn_torch.diagnosis.residual.linearisation import remainder
from ccnn_torch.diagnosis.residual.rows import picked
from ccnn_torch.display import short_path, with_unit
from ccnn_torch.effects import (
    Acting,
    Effect,
    Situation,
    default_gravity,
    labelled,
    make_effect,
    measured_pose,
    moved_joints,
    reached,
    used_covariates,
    without_pose_effects,
)
from ccnn_torch.effects.thermal import Thermal
from ccnn_torch.effects.time import FrameDrift, elapsed
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox, Mechanism, SerialArm, fit_unknown, judge_frames
from ccnn_torch.mechanisms.frames.partial import completed
from ccnn_torch.numerics.outliers import inlying
from ccnn_torch.pseudoerror import Pseudoerror, joint_deviations
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split
from ccnn_torch.report.results.run import Values

_FROM = "from:"
# Steps of r <- δ - e(q + r); each gains a factor of e's slope, at most 0.1.
_STEPS = 6


@dataclass(frozen=True)
class Physics:
    """The machine of every repeat as it was identified: geometry and effects, without what is learned.

    Attributes:
        source: where the effects come from, for people; empty without any.
        situations: all rows on the nominal machine of each repeat, frames fitted, without time.
        values: all parameters of the real machine, `r x 1 x k` [SI], or `r x s x k` where groups of rows have frames.
        acting: effects on joints and pose, of each repeat.
        every: all of the effects, those on the parameters as well, whose change is in `values`.
        rows: which were fitted to, `r x s` bool.
    """

    source: str
    situations: list[Situation]
    values: Tensor
    acting: list[list[Acting]]
    every: list[list[Acting]]
    rows: Tensor

    def frames(self, repeat: int, moved: Tensor, *second: Tensor) -> Tensor:
        """Frame of the pose of all rows at command and what was learned there, `s x n` [SI], as `reached` gives it.

        second: the same of the second place, where rows are of two.
        """
        here = replace(self.situations[repeat], joints=moved)
        if second:
            here = here.moved([moved, *second], here.parameters)
        return reached(here, self.acting[repeat], self.values[repeat])

    def poses(self, repeat: int, moved: Tensor) -> Tensor:
        """The same as pose coordinates, `s x p` [SI]."""
        here = replace(self.situations[repeat], joints=moved)
        return measured_pose(here, reached(here, self.acting[repeat], self.values[repeat]))

    def targets(self, joints: Tensor, pose: Tensor, settings: dict[str, Any]) -> Pseudoerror:
        """What is left to be learned: the joints at which this machine has the measured pose, less the command.

        Gross outliers among the rows that were fitted to are not learned from.

        Args:
            joints: commanded, `s x n` [SI].
            pose: measured, `s x p` [SI].
            settings: of `joint_deviations`.
        """
        mechanism = self.situations[0].mechanism
        clean = torch.stack(
            [without_pose_effects(one, pose, own) for one, own in zip(self.situations, self.acting, strict=True)]
        )
        each = joints.expand(len(clean), *joints.shape)
        found = joint_deviations(mechanism, each, clean, parameters=self.values, **settings)
        parts = []
        for one, own, whole in zip(self.situations, self.acting, found.deviation, strict=True):
            left = whole
            for _ in range(_STEPS if own else 0):
                left = whole - moved_joints(replace(one, joints=joints + left), own)
            parts.append(left)
        about = zip(self.situations, self.acting, self.values, strict=True)
        left = torch.stack([remainder(one, pose, own, values)[:, :3].norm(dim=-1) for one, own, values in about])
        outlier = self.rows & ~inlying(left, self.rows, 3, 0)
        reasons = found.reasons | {"outlier": outlier}
        return replace(found, deviation=torch.stack(parts), usable=found.usable & ~outlier, reasons=reasons)

    def uses(self, repeat: int) -> list[str]:
        """Names of the covariates without which the effects change."""
        return used_covariates(self.situations[repeat], self.acting[repeat])

    def machine(self, repeat: int, rows: Tensor, margin: float, covariates: list[str]) -> Machine:
        """The machine of one repeat for a model file, as `fit_compensator` takes it.

        Args:
            rows: numbers of the training rows.
            margin: of the compensator's domain.
            covariates: names of the compensator's, in order.

        Raises:
            InputError, MethodFailedError: see `machine_of`.
        """
        there, values = self.in_own_base(repeat, rows)
        there = of_commands(there, self.acting[repeat])
        values = values[: len(there.mechanism.geometry)]
        return machine_of(there, self.acting[repeat], values, covariates, margin)

    def in_own_base(self, repeat: int, rows: Tensor) -> tuple[Situation, Tensor]:
        """Some rows on the nominal machine, and all parameters of the real one, `k` [SI].

        Both in the machine's own base where groups of rows have frames, with the tool of the first training row.
        """
        every, values = self.situations[repeat], self.values[repeat]
        if every.parameters is None or not every.mechanism.grouped:
            return picked(every, rows), values[0]
        first = int(self.rows[repeat].double().argmax())
        there = picked(replace(every, parameters=every.parameters[[first]].expand_as(every.parameters)), rows)
        return in_own_base(there, values[first])

    def block(self) -> dict[str, dict[str, Values]]:
        """For results.json: each coefficient's value in every repeat, by effect and name."""
        found: dict[str, dict[str, Values]] = {}
        for i, (label, one) in enumerate(labelled(self.every[0])):
            found[label] = {}
            for j, c in enumerate(one.effect.coefficients(self.situations[0])):
                values = [float(repeat[i].coefficients[j]) for repeat in self.every]
                if any(values):
                    found[label][c.name] = Values(unit=c.unit, values=values)
            for j, s in enumerate(one.effect.shapes(self.situations[0])):
                found[label][s.name] = Values(unit=s.unit, values=[float(repeat[i].shape[j]) for repeat in self.every])
        return found


def verdict_of(key: str, mechanism: Mechanism) -> Verdict:
    """The verdict that the key `effects` names; raises as `read_verdict`."""
    return read_verdict(key.removeprefix(_FROM), mechanism.name, [joint.name for joint in mechanism.joints])


def fit_physics(
    verdict: Verdict | None,
    mechanism: Mechanism,
    records: Records,
    splits: list[Split],
    parameters: Tensor | None,
    usable: Tensor,
    identify: bool,
) -> tuple[Physics, list[str]]:
    """Fit geometry and a verdict's effects together to the rows of each repeat that are not held out.

    Args:
        verdict: effects with their shapes, which stay; None = no effects.
        parameters: with fitted frames, `r x 1 x k` or `r x s x k`; None = nominal.
        usable: rows fit to learn from, `[r x] s` bool.
        identify: whether all parameters are to be identified.

    Returns:
        The machines, and notes.

    Raises:
        InputError: there is nothing to identify, or records are without a column of an effect.
    """
    if identify and not mechanism.geometry:
        raise InputError(
            f"mechanism '{mechanism.name}' has no parameters that could be identified; write geometry=none"
        )
    gravity = default_gravity(mechanism) if verdict is None or verdict.gravity is None else verdict.gravity
    covariates = {c.name: records.covariates[:, i] for i, c in enumerate(records.covariate_coordinates)}
    guess = None
    if records.pose.shape[-1] == len(mechanism.pose):
        guess = completed(mechanism, records.joints, records.pose, None if parameters is None else parameters[0])
    rows = Situation(mechanism, records.joints, covariates, gravity, parameters, guess)
    known, notes = list[Known](), list[str]()
    if verdict is not None:
        _refuse_lacking(verdict, mechanism, records)
        known, notes = verdict.on(replace(rows, parameters=None), identify)
    situations, every, values, fitted_to = [], [], [], []
    for k, split in enumerate(splits):
        base = None if parameters is None else parameters[k] if mechanism.grouped else parameters[k, 0]
        situation = on_fitted_frames(replace(rows, parameters=base))
        fit = torch.zeros(len(records.joints), dtype=torch.bool)
        fit[Dataset.part(split, "fit")] = True
        fit &= usable.expand(len(splits), -1)[k]
        situation = situation.fitted_to(fit)
        fitted, own = fit_jointly(situation, records.pose, known, fit, loose_parameters(mechanism, identify))
        for one in fitted:
            if one.effect.kind == "parameters":
                own = own + one.change(situation)[0]
        situations.append(situation)
        every.append(fitted)
        values.append(own if own.dim() > 1 else own[None])
        fitted_to.append(fit)
    acting = [[a for a in one if a.effect.kind != "parameters"] for one in every]
    if identify:
        notes.append(
            f"Geometry identified on the training rows of each repeat: {len(mechanism.geometry)} parameters, each "
            "drawn to its nominal value by a plausible error; the network learns only what they leave."
        )
    source = "" if verdict is None else short_path(verdict.path)
    if verdict is not None and known:
        named = ", ".join(dict.fromkeys(k.effect.name for k in known))
        fitted_anew = "Their coefficients were fitted anew to the training rows of each repeat"
        seen = "; their periods and other shapes are the file's, which may have seen the held-out rows"
        found = verdict.path == TRAINING_ROWS
        notes.append(f"Effects{'' if found else f' of {source}'}: {named}. {fitted_anew}{'' if found else seen}.")
    if mechanism.grouped:
        tool = " Its tool is that of the first training row." if mechanism.tool_per else ""
        notes.append(
            "The model is of the machine in its own base: groups of rows have frames of their own, in which those held "
            f"out are judged.{tool}"
        )
    return Physics(source, situations, torch.stack(values), acting, every, torch.stack(fitted_to)), notes


def _refuse_lacking(verdict: Verdict, mechanism: Mechanism, records: Records) -> None:
    """Raise InputError where the records have no column, or no varying one, that the verdict's effects need."""
    inputs = [c.name for c in records.covariate_coordinates]
    for name, _ in verdict.effects:
        effect = make_effect(name)
        lacking = effect.missing(mechanism, inputs)
        if not lacking:
            continue
        what = f"{records.path}: {name} of {verdict.path} needs {lacking}"
        if effect.missing(mechanism, [*records.columns]):
            raise InputError(f"{what}, and there is no such column; add it to the records, or write effects=none")
        raise InputError(
            f"{what}; the column is there but no input of this run, because it is constant or not among covariates: "
            "name it there, give records in which it varies, or write effects=none"
        )


def frames_of_repeats(mechanism: Mechanism, records: Records, splits: list[Split]) -> tuple[Tensor | None, list[str]]:
    """Fit frames that are unknown to the rows of each repeat that are not held out.

    Returns:
        All parameters, nominal but for the frames, `r x 1 x k`, or `r x s x k` where frames are per group; None where
        all frames are known; and notes.
    """
    rows = pad_rows([Dataset.part(split, "fit") for split in splits])
    weights = torch.zeros(len(splits), len(records.joints), dtype=torch.float64)
    weights.scatter_add_(1, rows.index, rows.weights)
    parameters = fit_unknown(mechanism, records.joints, records.pose, weights, records.columns)
    if parameters is None:
        return None, []
    if not mechanism.grouped:
        parameters = parameters.unsqueeze(-2)
    notes = []
    if isinstance(mechanism, SerialArm):
        about = (records.joints, records.pose, parameters, weights, records.path, records.name_rows)
        try:
            notes += judge_frames(mechanism, *about)
        except InputError as reason:
            raise named_mistake(reason, mechanism, records, parameters[0].squeeze(0)) from None
    unknown = " and ".join(getattr(mechanism, "unknown_frames", ()))
    moved = (parameters[0].reshape(-1, parameters.shape[-1])[0] - mechanism.nominal).tolist()
    values = [f"{p.name} {with_unit(v, p.unit)}" for p, v in zip(mechanism.geometry, moved, strict=True) if v]
    notes.append(
        f"Frames fitted first, on the training rows of each repeat: {unknown} ({', '.join(values) or 'as given'}). "
        "Poses are wanted as these frames show them: errors of the machine that look like theirs, such as zeros of "
        "joints, are not corrected."
    )
    return parameters, notes


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


MOST_ROWS = 1000
"""Rows that the search uses: more take longer and show the same."""
_EFFECTS = (
    *("joint_gain", "transmission", "backlash", "friction", "compliance", "thermal_compliance", "sag", "gravity"),
    *("bending", "thermal", "coupling", "error_motion", "flexure"),
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
    if len(rows) > MOST_ROWS:
        rows = rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(seed))[:MOST_ROWS]]
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
    notes = [*_thermal_note(situation, effects, known), *notes]
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


def _thermal_note(situation: Situation, tried: Sequence[Effect], known: Sequence[Known]) -> list[str]:
    """A sentence where temperatures were measured and no growth by them pays: who measured them expects it."""
    names = {e.name for e in tried} - {k.effect.name for k in known}
    told = ", ".join(name for name in situation.covariates if is_temperature(name))
    return [f"Thermal growth was tried with {told} and does not pay."] if Thermal.name in names and told else []
