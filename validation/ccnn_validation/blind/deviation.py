"""Errors of a blind machine at unit size, and the poses that it then reaches in its true kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_validation.blind.machines import BlindMachine

__all__ = ["Deviation", "measured_pose", "stack", "weighted"]


@dataclass(frozen=True)
class Deviation:
    """One cause at unit size; what it does not change is 0. Leading dims `...` are cases and causes.

    Attributes:
        joints: change of the joints, `... x s x n` [SI].
        parameters: change of the mechanism's parameters, `... x s x k` [SI].
        base: twist of the measuring frame, `... x 6`: translation [m] and rotation vector [rad] about the origin.
        tool: of the point that is measured on the platform, `... x 6`, in its frame.
        stretch: of the measuring device's axes, `... x 3 x 3` [1].
        platform: twist of the platform at each row, `... x s x 6`, about its point, in the base frame.
    """

    joints: Tensor
    parameters: Tensor
    base: Tensor
    tool: Tensor
    stretch: Tensor
    platform: Tensor

    @staticmethod
    def none(machine: BlindMachine, rows: int) -> Deviation:
        """A machine without error."""
        n, k = len(machine.mechanism.joints), len(machine.mechanism.geometry)
        shapes = ((rows, n), (rows, k), (6,), (6,), (3, 3), (rows, 6))
        return Deviation(*(torch.zeros(shape, dtype=torch.float64) for shape in shapes))


def stack(parts: Sequence[Deviation]) -> Deviation:
    """Side by side along a new first dimension."""
    return Deviation(*(torch.stack([getattr(p, f.name) for p in parts]) for f in fields(Deviation)))


def weighted(parts: Deviation, size: Tensor) -> Deviation:
    """Sum over causes. parts: `r x e x …`; size: `r x e`; returns `r x …`."""

    def total(part: Tensor) -> Tensor:
        return (part * size.reshape(*size.shape, *(1,) * (part.dim() - 2))).sum(1)

    return Deviation(*(total(getattr(parts, f.name)) for f in fields(Deviation)))


def measured_pose(machine: BlindMachine, joints: Tensor, pose: Tensor, wrong: Deviation) -> Tensor:
    """The pose that would be measured without noise.

    Args:
        machine: the nominal one.
        joints: commanded, `r x s x n` [SI].
        pose: nominal, `r x s x p` [SI]: where the search for the true one starts.
        wrong: the errors in their true size, leading dim `r`.

    Returns:
        `r x s x p` [SI].
    """
    mechanism = machine.mechanism
    reached = mechanism.forward_kinematics(joints + wrong.joints, mechanism.nominal + wrong.parameters, pose)
    position, rotation = mechanism.frame(reached)
    position = position + wrong.platform[..., :3]
    if rotation is not None:
        rotation = rotation_vector_to_matrix(wrong.platform[..., 3:]) @ rotation
        position = position + (rotation @ wrong.tool[:, None, :3, None])[..., 0]
        rotation = rotation @ rotation_vector_to_matrix(wrong.tool[:, None, 3:])
        rotation = rotation_vector_to_matrix(wrong.base[:, None, 3:]) @ rotation
    turned = rotation_vector_to_matrix(wrong.base[:, None, 3:]) @ position[..., None]
    position = turned[..., 0] + wrong.base[:, None, :3]
    position = position + (wrong.stretch[:, None] @ position[..., None])[..., 0]
    return machine.coordinates(position, rotation)
