"""The pose that a machine with effects reaches, and the first-order change of the pose by an effect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.effects.protocol import Coefficient, Effect
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

BY = " by "
"""Between the name of an effect and what its groups are called."""


class ByGroup(Effect):
    """Another effect with coefficients of its own in each group of rows; a group's rows share the base frame."""

    def __init__(self, effect: Effect, word: str, frames: Mapping[str, Tensor]) -> None:
        """Take the effect, what a group is called, and the base frame of each group by name, `6` [m, rad]."""
        self.effect, self.kind, self.frames = effect, effect.kind, dict(frames)
        self.name = f"{effect.name}{BY}{word}"
        self.description = f"{effect.description}: another one in each {word}"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """As the effect."""
        return self.effect.missing(mechanism, covariates)

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Those of the effect, group by group."""
        own = self.effect.coefficients(situation)
        return tuple(replace(c, name=f"{group}: {c.name}", joint=None, leg=None) for group in self.frames for c in own)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x d x (groups · m)`."""
        values = situation.mechanism.resolve(situation.parameters)[..., :6]
        inside = [(values == frame).all(-1, keepdim=True) for frame in self.frames.values()]
        own = self.effect.basis(situation, shape)
        return torch.cat([own * mine.expand(*own.shape[:-2], 1)[..., None] for mine in inside], -1)


# Each squares what is left, from a millimetre on.
_ROUNDS = 4


class Acting(NamedTuple):
    """An effect with its numbers: `shape` `... x h`, `coefficients` `... x m` [SI]."""

    effect: Effect
    shape: Tensor
    coefficients: Tensor

    def change(self, situation: Situation) -> Tensor:
        """Of joints, parameters or pose channels, by the effect's kind, `... x s x d`."""
        basis = self.effect.basis(situation, self.shape)
        return (basis @ self.coefficients.unsqueeze(-2).unsqueeze(-1)).squeeze(-1)


def labelled(acting: Sequence[Acting]) -> list[tuple[str, Acting]]:
    """Effects with their names, which are counted where one acts several times: `transmission`, `transmission 2`."""
    names, found = [one.effect.name for one in acting], []
    for i, one in enumerate(acting):
        times = names[: i + 1].count(names[i])
        found.append((names[i] if times == 1 else f"{names[i]} {times}", one))
    return found


def signature(situation: Situation, effect: Effect, shape: Tensor, there: Situation | None = None) -> Tensor:
    """First-order change of position and rotation vector per unit of each coefficient, `... x s x c x m`.

    there: the same rows on the machine about which it is linear; that of the situation when None. Rows of two places
    change by what the effect does at both.
    """
    there = there or situation
    if effect.kind == "parameters":
        return there.parameter_jacobian @ effect.basis(situation, shape)
    each = [effect.basis(place, shape) for place in situation.places]
    if effect.kind == "joints":
        each = [place.jacobian @ basis for place, basis in zip(there.places, each, strict=True)]
    return each[0] if len(each) == 1 else each[0] + each[1]


def moved(situation: Situation, acting: Sequence[Acting], parameters: Tensor | None = None) -> Situation:
    """The same rows with joints and parameters as the effects make them; parameters: as in `reached`."""
    joints = [place.joints for place in situation.places]
    parameters = situation.mechanism.resolve(situation.parameters if parameters is None else parameters)
    for one in acting:
        if one.effect.kind == "joints":
            joints = [q + one.change(place) for q, place in zip(joints, situation.places, strict=True)]
        elif one.effect.kind == "parameters":
            parameters = parameters + one.change(situation)
    return situation.moved(joints, parameters)


def reached(situation: Situation, acting: Sequence[Acting], parameters: Tensor | None = None) -> Tensor:
    """Position `... x s x 3` [m] and rotation matrix, as the frame of the pose measured on a machine with the effects.

    Args:
        situation: rows.
        acting: effects with their numbers.
        parameters: of the machine that moves, `... x k` [SI]; those of the situation when None. What the effects look
            at is that of the situation.

    Returns:
        The frame's position and rotation vector side by side, `... x s x c`: c = 3 without orientation, else 6; of
        instruments as many as there are readings.
    """
    there = moved(situation, acting, parameters)
    position, rotation = situation.mechanism.frame(
        situation.machine.forward_kinematics(there.joints, there.parameters, there.guess)
    )
    for one in acting:
        for place in situation.places if one.effect.kind == "pose" else ():
            change = one.change(place)
            position = position + change[..., : position.shape[-1]]
            if rotation is not None:
                rotation = rotation_vector_to_matrix(change[..., -3:]) @ rotation
    if rotation is None:
        return position
    return torch.cat([position, matrix_to_rotation_vector(rotation)], -1)


def moved_joints(situation: Situation, acting: Sequence[Acting]) -> Tensor:
    """What the effects on the joints add to them, `... x s x n` [SI]."""
    changes = [one.change(situation) for one in acting if one.effect.kind == "joints"]
    return sum(changes, torch.zeros_like(situation.joints))


def used_covariates(situation: Situation, acting: Sequence[Acting]) -> list[str]:
    """Names of the covariates without which the effects change."""
    before = _changes(situation, acting)
    kept = []
    for name in situation.covariates:
        fewer = {n: v for n, v in situation.covariates.items() if n != name}
        if not torch.equal(_changes(replace(situation, covariates=fewer), acting), before):
            kept.append(name)
    return kept


def _changes(situation: Situation, acting: Sequence[Acting]) -> Tensor:
    """What the effects change, side by side, `s x d`; NaN where one cannot act without what is missing."""
    parts = [torch.zeros_like(situation.joints[:, :1])]
    for one in acting:
        lacking = bool(one.effect.missing(situation.mechanism, [*situation.covariates]))
        # Of some effects there is less where a column is missing.
        lacking |= len(one.effect.coefficients(situation)) != len(one.coefficients)
        parts.append(torch.full_like(parts[0], torch.nan) if lacking else one.change(situation).nan_to_num())
    return torch.cat(parts, -1)


def without_pose_effects(situation: Situation, measured: Tensor, acting: Sequence[Acting]) -> Tensor:
    """Measured poses `... x s x p` [SI] with the effects on the pose taken away; as measured where that is no pose."""
    changes = [one.change(situation) for one in acting if one.effect.kind == "pose"]
    if not changes:
        return measured
    position, rotation = situation.mechanism.frame(measured)
    for change in reversed(changes):
        position = position - change[..., : position.shape[-1]]
        if rotation is not None:
            rotation = rotation_vector_to_matrix(change[..., -3:]).mT @ rotation
    frame = position if rotation is None else torch.cat([position, matrix_to_rotation_vector(rotation)], -1)
    found = measured_pose(situation, torch.nan_to_num(frame))
    fine = torch.isfinite(frame).all(-1, keepdim=True) & torch.isfinite(found).all(-1, keepdim=True)
    return torch.where(fine, found, measured)


def measured_pose(situation: Situation, frame: Tensor) -> Tensor:
    """Pose coordinates whose frame is closest to a given one near by, by Gauss and Newton from the nominal pose.

    Args:
        situation: `... x s` rows.
        frame: position and rotation vector side by side, as `reached` gives them, `... x s x c` [m, rad].

    Returns:
        `... x s x p` [SI].
    """
    mechanism = situation.mechanism
    if mechanism.orientations:
        return frame
    turns = mechanism.frame(mechanism.home_pose)[1] is not None
    position = frame[..., :-3] if turns else frame
    rotation = rotation_vector_to_matrix(frame[..., -3:]) if turns else None
    pose = situation.pose.expand(*frame.shape[:-1], -1)
    for _ in range(_ROUNDS):
        there = mechanism.frame(pose)
        gap = position - there[0]
        if rotation is not None and there[1] is not None:
            gap = torch.cat([gap, matrix_to_rotation_vector(rotation @ there[1].mT)], -1)
        slope = mechanism.frame_slope(pose).detach()[..., : mechanism.compared]
        step: Tensor = torch.linalg.solve(slope.mT @ slope, slope.mT @ gap.unsqueeze(-1))
        pose = pose + torch.nn.functional.pad(step.squeeze(-1), (0, pose.shape[-1] - mechanism.compared))
    return pose


def measured_channels(situation: Situation, measured: Tensor) -> Tensor | None:
    """Channels of position and rotation vector that a measured pose shows, `s x c` bool; None where it shows all.

    measured: `s x p` [SI]; NaN where not measured.
    """
    if not bool(measured.isnan().any()):
        return None
    moving = situation.frame_slope != 0
    return ~(moving & measured.isnan()[:, None, : moving.shape[-1]]).any(-1)


def filled(situation: Situation, measured: Tensor) -> Tensor:
    """Poses with the nominal ones in what was not measured; rows of which nothing was stay NaN."""
    lacking = measured.isnan()
    return (
        torch.where(lacking & ~lacking.all(-1, keepdim=True), situation.pose, measured) if lacking.any() else measured
    )


def pose_residual(situation: Situation, measured: Tensor) -> Tensor:
    """Measured less nominal pose: position [m], and the rotation vector between them in the base frame [rad].

    Args:
        measured: `... x s x p` [SI]; NaN where not measured.

    Returns:
        `... x s x c`, c = 3 without orientation, else 6; 0 in channels that the mechanism cannot
        move and in what was not measured.
    """
    measured = filled(situation, measured)
    there, nominal = situation.mechanism.frame(measured), situation.mechanism.frame(situation.pose)
    position = there[0] - nominal[0]
    if there[1] is None or nominal[1] is None:
        return position
    return torch.cat([position, matrix_to_rotation_vector(there[1] @ nominal[1].mT)], -1)
