"""`effects: from:FILE`: effects of a diagnosis, fitted to the training rows, as a part of the compensator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.calibration.rows.dataset import Dataset
from ccnn_torch.compensation import Care, PhysicalEffects, effect_deviation, expand_effects, settled_effects
from ccnn_torch.coordinates import plausible_error
from ccnn_torch.diagnosis.from_file import Known, Verdict, one_row_at_a_time, read_verdict
from ccnn_torch.diagnosis.refit import refit
from ccnn_torch.display import short_path
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect, measured_pose, reached
from ccnn_torch.errors import InputError
from ccnn_torch.identification import fit_geometry
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm
from ccnn_torch.mechanisms.frames.fit import fit_frames
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split

_FROM = "from:"
# Steps of r <- δ - ε(q + r); each gains a factor of ε's slope, at most 0.1.
_STEPS = 6
# Times geometry and effects are fitted in turn.
_TURNS = 2
# Of orientation against position for arms [m/rad], as their frames and links are fitted.
_ARM_ROTATION = 0.3


@dataclass(frozen=True)
class KnownEffects:
    """The verdict's effects with the numbers of every repeat.

    Attributes:
        path: the diagnosis.
        situations: all rows on the machine of each repeat, without time.
        acting: effects on joints and pose, of each repeat.
        every: all of the verdict's, those on the parameters as well.
        covariates: names of the compensator's, in order.
        care: what is done near singular poses.
    """

    path: str
    situations: list[Situation]
    acting: list[list[Acting]]
    every: list[list[Acting]]
    covariates: list[str]
    care: Care

    def deviation(self, joints: Tensor) -> Tensor:
        """ε at commanded joints of all rows, `r x s x n` [SI]."""
        found = []
        for situation, acting, at in zip(self.situations, self.acting, joints, strict=True):
            mechanism, guess = situation.mechanism, situation.guess

            def jacobian(q: Tensor, mechanism: Mechanism = mechanism, guess: Tensor | None = guess) -> Tensor:
                return mechanism.jacobian(q, None, guess).detach()

            here = replace(situation, joints=at)
            found.append(effect_deviation(here, acting, jacobian, self.care) if acting else torch.zeros_like(at))
        return torch.stack(found)

    def remainder(self, joints: Tensor, deviation: Tensor) -> Tensor:
        """What is left to be learned of deviations, r + ε(q + r) = δ; all `r x s x n` [SI]."""
        left = deviation - self.deviation(joints)
        for _ in range(_STEPS):
            left = deviation - self.deviation(joints + left)
        return left

    def module(self, repeat: int, rows: Tensor, margin: float) -> PhysicalEffects | None:
        """ε of one repeat for a model file; rows: numbers of the training rows; None where only parameters are off.

        Raises:
            InputError, MethodFailedError: see `expand_effects`.
        """
        if not self.acting[repeat]:
            return None
        there = _rows(self.situations[repeat], rows)
        return expand_effects(there, self.acting[repeat], self.covariates, margin, self.care)

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


def verdict_of(key: str, mechanism: Mechanism) -> Verdict:
    """The verdict that the key `effects` names; raises as `read_verdict`."""
    return read_verdict(key.removeprefix(_FROM), mechanism.name, [joint.name for joint in mechanism.joints])


def fit_effects(
    verdict: Verdict,
    mechanism: Mechanism,
    records: Records,
    splits: list[Split],
    parameters: Tensor | None,
    total: Tensor,
    usable: Tensor,
    identify: bool,
    margin: float,
    settings: tuple[float, float],
) -> tuple[KnownEffects, Tensor | None, list[str]]:
    """Fit the verdict's coefficients to the rows of each repeat that are not held out; shapes are the file's.

    Args:
        parameters: with fitted frames, `r x 1 x k`; None = nominal.
        total: deviations of that machine, `[r x] s x n` [SI].
        usable: rows fit to learn from, `[r x] s` bool.
        identify: whether all parameters are to be identified beside the effects.
        settings: rotation weight and damping of the pseudoerror.

    Returns:
        The effects; the parameters that go with them, `r x 1 x k`, or None where these are nominal; notes.
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
    arm = isinstance(mechanism, SerialArm)
    situations, acting, values = [], [], []
    for k, split in enumerate(splits):
        base = mechanism.nominal if parameters is None else parameters[k, 0]
        machine = mechanism if parameters is None else mechanism.with_nominal(base)
        situation = one_row_at_a_time(Situation(machine, records.joints, covariates, gravity, None, guess))
        rows = torch.zeros(len(records.joints), dtype=torch.bool)
        rows[Dataset.part(split, "fit")] = True
        rows &= usable.expand(len(splits), -1)[k]
        fitted, own = _fitted(situation, records, known, rows, identify)
        situations.append(situation)
        acting.append(fitted)
        values.append(own)
    moving = [[a for a in one if a.effect.kind != "parameters"] for one in acting]
    changed = torch.stack(values).unsqueeze(1)
    base_all = mechanism.nominal.expand_as(changed) if parameters is None else parameters
    weight, damping = (_ARM_ROTATION if arm else settings[0]), settings[1]
    care = Care(weight, damping)
    names = [c.name for c in records.covariate_coordinates]
    if moving[0]:
        fit = Dataset.part(splits[0], "fit")
        limit = (1.5 * total.expand(len(splits), *total.shape[-2:])[0, fit].abs().amax(0)).clamp_min(1e-12)
        there = _rows(situations[0], torch.nonzero(usable.expand(len(splits), -1)[0]).squeeze(-1))
        care = settled_effects(there, moving[0], names, limit, margin, weight, damping).care
    named = ", ".join(k.effect.name for k in known)
    notes.append(
        f"Effects of {short_path(verdict.path)}: {named}. Their coefficients were fitted anew to the training rows of "
        "each repeat; their periods and other shapes are the file's, which may have seen the held-out rows."
    )
    found = KnownEffects(short_path(verdict.path), situations, moving, acting, names, care)
    return found, None if torch.equal(changed, base_all) else changed, notes


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
