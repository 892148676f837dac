"""The identified machine of a run: geometry and effects, fitted to the training rows of each repeat."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.calibration.rows.dataset import Dataset
from ccnn_torch.compensation import Care, build_machine, expand_effects, expand_geometry, gains, geometric_deviation
from ccnn_torch.coordinates import plausible_error
from ccnn_torch.diagnosis.from_file import TRAINING_ROWS, Known, Verdict, one_row_at_a_time, read_verdict
from ccnn_torch.diagnosis.refit import refit
from ccnn_torch.display import short_path
from ccnn_torch.effects import (
    Acting,
    Situation,
    default_gravity,
    make_effect,
    measured_pose,
    moved_joints,
    reached,
    without_pose_effects,
)
from ccnn_torch.errors import InputError
from ccnn_torch.identification import fit_geometry
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, fit_frames
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.pseudoerror import Pseudoerror, joint_deviations
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split

_FROM = "from:"
# Steps of r <- δ - e(q + r); each gains a factor of e's slope, at most 0.1.
_STEPS = 6
# Times geometry and effects are fitted in turn.
_TURNS = 2
# How much larger than at the training rows what effects take from the kinematics may become.
_ABOVE = 1.1


@dataclass(frozen=True)
class Physics:
    """The machine of every repeat as it was identified: geometry and effects, without what is learned.

    Attributes:
        source: where the effects come from, for people; empty without any.
        situations: all rows on the nominal machine of each repeat, frames fitted, without time.
        values: all parameters of the real machine, `r x 1 x k` [SI].
        acting: effects on joints and pose, of each repeat.
        every: all of the effects, those on the parameters as well, whose change is in `values`.
    """

    source: str
    situations: list[Situation]
    values: Tensor
    acting: list[list[Acting]]
    every: list[list[Acting]]

    def frames(self, repeat: int, moved: Tensor) -> Tensor:
        """Frame of the pose of all rows at command and what was learned there, `s x n` [SI], as `reached` gives it."""
        here = replace(self.situations[repeat], joints=moved)
        return reached(here, self.acting[repeat], self.values[repeat, 0])

    def poses(self, repeat: int, moved: Tensor) -> Tensor:
        """The same as pose coordinates, `s x p` [SI]."""
        here = replace(self.situations[repeat], joints=moved)
        return measured_pose(here, reached(here, self.acting[repeat], self.values[repeat, 0]))

    def targets(self, joints: Tensor, pose: Tensor, settings: dict[str, Any]) -> Pseudoerror:
        """What is left to be learned: the joints at which this machine has the measured pose, less the command.

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
        return replace(found, deviation=torch.stack(parts))

    def uses(self, repeat: int) -> list[str]:
        """Names of the covariates without which the effects change."""
        here, kept = self.situations[repeat], list[str]()
        before = self._acted(here, repeat)
        for name in here.covariates:
            fewer = {n: v for n, v in here.covariates.items() if n != name}
            if not torch.equal(self._acted(replace(here, covariates=fewer), repeat), before):
                kept.append(name)
        return kept

    def _acted(self, situation: Situation, repeat: int) -> Tensor:
        """What the effects change, side by side, `s x d`; NaN where one cannot act without what is missing."""
        parts = [torch.zeros_like(situation.joints[:, :1])]
        for one in self.acting[repeat]:
            lacking = bool(one.effect.missing(situation.mechanism, [*situation.covariates]))
            # Of some effects there is less where a column is missing.
            lacking |= len(one.effect.coefficients(situation)) != len(one.coefficients)
            parts.append(torch.full_like(parts[0], torch.nan) if lacking else one.change(situation).nan_to_num())
        return torch.cat(parts, -1)

    def modules(self, repeat: int, rows: Tensor, margin: float, covariates: list[str]) -> dict[str, Any]:
        """The machine of one repeat for a model file, as `fit_compensator` takes it.

        Args:
            rows: numbers of the training rows.
            margin: of the compensator's domain.
            covariates: names of the compensator's, in order.

        Raises:
            InputError, MethodFailedError: see `build_machine`, `expand_effects` and `expand_geometry`.
        """
        situation, acting, values = self.situations[repeat], self.acting[repeat], self.values[repeat, 0]
        there, mechanism = _rows(situation, rows), situation.mechanism
        closed = isinstance(mechanism, SerialArm) or mechanism.closed_form is not None
        care = None if closed else _care(there)
        effects = expand_effects(there, acting, covariates, margin, care) if acting else None
        machine = build_machine(mechanism, values, effects, there.joints, margin)
        if machine is not None:
            return {"machine": machine}
        geometry = None
        if not torch.equal(values, mechanism.nominal):
            geometry = expand_geometry(geometric_deviation(mechanism, mechanism.nominal, values), there.joints, margin)
        return {"geometry": geometry, "effects": effects}

    def block(self) -> dict[str, Any]:
        """For results.json: each coefficient's value in every repeat, by effect and name."""
        found: dict[str, Any] = {}
        for i, one in enumerate(self.every[0]):
            named: dict[str, Any] = {}
            for j, c in enumerate(one.effect.coefficients(self.situations[0])):
                values = [float(repeat[i].coefficients[j]) for repeat in self.every]
                if any(values):
                    named[c.name] = {"unit": c.unit, "values": values}
            for j, s in enumerate(one.effect.shapes(self.situations[0])):
                named[s.name] = {"unit": s.unit, "values": [float(repeat[i].shape[j]) for repeat in self.every]}
            found[one.effect.name] = named
        return found


def _care(situation: Situation) -> Care:
    """Near singular poses effects of a machine without closed forms grow no further than at the training rows."""
    care = Care(ROTATION_WEIGHT, 0.0)
    gain, inverse_gain = (_ABOVE * float(sizes.max()) for sizes in gains(situation.jacobian, care))
    return care._replace(gain=gain, inverse_gain=inverse_gain)


def identified_alone(mechanism: Mechanism, records: Records, nominal: Tensor, values: Tensor) -> Physics:
    """The machines of all repeats without any effect.

    Args:
        nominal, values: all parameters, frames fitted and identified, `r x 1 x k` [SI].
    """
    gravity = default_gravity(mechanism)
    guess = records.pose if records.pose.shape[-1] == len(mechanism.pose) else None
    situations = [
        Situation(mechanism.with_nominal(own[0]), records.joints, {}, gravity, None, guess)
        for own in nominal.expand_as(values)
    ]
    return Physics("", situations, values, [[] for _ in situations], [[] for _ in situations])


def verdict_of(key: str, mechanism: Mechanism) -> Verdict:
    """The verdict that the key `effects` names; raises as `read_verdict`."""
    return read_verdict(key.removeprefix(_FROM), mechanism.name, [joint.name for joint in mechanism.joints])


def fit_effects(
    verdict: Verdict,
    mechanism: Mechanism,
    records: Records,
    splits: list[Split],
    parameters: Tensor | None,
    usable: Tensor,
    identify: bool,
) -> tuple[Physics, list[str]]:
    """Fit the verdict's coefficients to the rows of each repeat that are not held out; shapes are the file's.

    Args:
        parameters: with fitted frames, `r x 1 x k`; None = nominal.
        usable: rows fit to learn from, `[r x] s` bool.
        identify: whether all parameters are to be identified beside the effects.

    Returns:
        The machines with the effects, and notes.
    """
    if parameters is not None and parameters.shape[1] > 1:
        raise InputError(
            f"effects: {mechanism.name} has frames per group of rows (frame_per, tool_per), and one compensator needs "
            "one frame; take the rows of one group, or write effects=none"
        )
    covariates = {c.name: records.covariates[:, i] for i, c in enumerate(records.covariate_coordinates)}
    gravity = default_gravity(mechanism) if verdict.gravity is None else verdict.gravity
    guess = records.pose if records.pose.shape[-1] == len(mechanism.pose) else None
    _refuse_lacking(verdict, mechanism, records)
    known, notes = verdict.on(Situation(mechanism, records.joints, covariates, gravity, None, guess))
    if identify and any(k.effect.kind == "parameters" for k in known):
        known = [k for k in known if k.effect.kind != "parameters"]
        notes.append("The verdict's geometry is left to geometry=identify, which fits all parameters.")
    situations, every, values = [], [], []
    for k, split in enumerate(splits):
        base = mechanism.nominal if parameters is None else parameters[k, 0]
        machine = mechanism if parameters is None else mechanism.with_nominal(base)
        situation = one_row_at_a_time(Situation(machine, records.joints, covariates, gravity, None, guess))
        rows = torch.zeros(len(records.joints), dtype=torch.bool)
        rows[Dataset.part(split, "fit")] = True
        rows &= usable.expand(len(splits), -1)[k]
        fitted, own = _fitted(situation, records, known, rows, identify)
        situations.append(situation)
        every.append(fitted)
        values.append(own)
    acting = [[a for a in one if a.effect.kind != "parameters"] for one in every]
    named = ", ".join(k.effect.name for k in known)
    fitted_anew = "Their coefficients were fitted anew to the training rows of each repeat"
    if verdict.path == TRAINING_ROWS:
        notes.append(f"Effects: {named}. {fitted_anew}.")
    else:
        notes.append(
            f"Effects of {short_path(verdict.path)}: {named}. {fitted_anew}; their periods and other shapes are the "
            "file's, which may have seen the held-out rows."
        )
    changed = torch.stack(values).unsqueeze(1)
    return Physics(short_path(verdict.path), situations, changed, acting, every), notes


def _refuse_lacking(verdict: Verdict, mechanism: Mechanism, records: Records) -> None:
    """Raise InputError where the records have no column, or no varying one, that the verdict's effects need."""
    inputs = [c.name for c in records.covariate_coordinates]
    for name in verdict.parameters:
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


def _fitted(
    situation: Situation, records: Records, known: list[Known], rows: Tensor, identify: bool
) -> tuple[list[Acting], Tensor]:
    """The effects on some rows, and the machine's parameters that go with them, `k`."""
    mechanism = situation.mechanism
    unknown = getattr(mechanism, "unknown_frames", ())
    loose = [k for k, g in enumerate(mechanism.geometry) if identify or g.name.partition("_")[0] in unknown]
    weights, values = rows.to(torch.float64), mechanism.nominal
    here, acting = situation, refit(situation, records.pose, known, rows, _columns(situation, loose))
    for _ in range(_TURNS if loose else 0):
        without = _without(here, records.pose, acting)
        if identify:
            values = fit_geometry(mechanism, records.joints, without, mechanism.nominal, weights)
        elif isinstance(mechanism, Framed):
            values = mechanism.inlying_frames(records.joints, without, weights)
        else:
            assert isinstance(mechanism, SerialArm)
            values = fit_frames(mechanism, records.joints, without, weights, columns=records.columns)
        here = replace(situation, parameters=values)
        acting = refit(here, records.pose, known, rows, _columns(here, loose))
    for one in acting:
        if one.effect.kind == "parameters":
            values = values + one.change(situation)[0]
    return acting, values


def _columns(situation: Situation, loose: list[int]) -> Tensor | None:
    """What parameters that are fitted beside can do, per plausible error, `s x c x P`."""
    if not loose:
        return None
    sizes = torch.tensor([plausible_error(situation.mechanism.geometry[k]) for k in loose], dtype=torch.float64)
    return situation.parameter_jacobian[..., loose] * sizes


def _without(situation: Situation, measured: Tensor, acting: list[Acting]) -> Tensor:
    """Measured poses with the effects taken away, `s x p` [SI]; as measured where that is no pose."""
    mechanism = situation.mechanism
    there, (place, turn) = reached(situation, acting), mechanism.frame(situation.pose)
    position, rotation = mechanism.frame(measured)
    frame = position - (there[..., :3] - place)
    if rotation is not None and turn is not None and there.shape[-1] == 6:
        turned = rotation_vector_to_matrix(there[..., 3:]) @ turn.mT
        frame = torch.cat([frame, matrix_to_rotation_vector(turned.mT @ rotation)], -1)
    found = measured_pose(situation, torch.nan_to_num(frame))
    fine = torch.isfinite(frame).all(-1, keepdim=True) & torch.isfinite(found).all(-1, keepdim=True)
    return torch.where(fine, found, measured)


def _rows(situation: Situation, rows: Tensor) -> Situation:
    """Some rows of a situation."""
    covariates = {name: value[rows] for name, value in situation.covariates.items()}
    guess = None if situation.guess is None else situation.guess[rows]
    return replace(situation, joints=situation.joints[rows], covariates=covariates, guess=guess)
