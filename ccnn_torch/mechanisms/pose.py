"""Poses as frames: position and rotation."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.numerics.rotations import (
    geodesic_angle,
    matrix_to_rotation_vector,
    rotation_vector_rate,
    rotation_vector_to_matrix,
    skew,
)

Frame = tuple[Tensor, Tensor | None]
_LENGTHS, _TURNS = ("x", "y", "z"), ("rx", "ry", "rz")
CHANNELS = (*(Coordinate(c, "m") for c in _LENGTHS), *(Coordinate(c, "rad") for c in _TURNS))
"""Position and rotation vector."""


class PoseError(NamedTuple):
    """Difference of two poses: `position`, `...` [m], and `rotation`, `...` [rad] (None without orientation)."""

    position: Tensor
    rotation: Tensor | None


def pose_error(measured: Frame, reference: Frame) -> PoseError:
    """Euclidean distance (eq. 6) and geodesic angle of two frames.

    Eq. 7 of the paper takes the arccos of a sum of three products, which is undefined for small errors; the geodesic
    angle is the one that it represents.
    """
    position = torch.linalg.vector_norm(measured[0] - reference[0], dim=-1)
    if measured[1] is None or reference[1] is None:
        return PoseError(position, None)
    return PoseError(position, geodesic_angle(measured[1], reference[1]))


def frame_gap(there: Frame, here: Frame, rotation_weight: float) -> Tensor:
    """Position difference and weighted rotation vector from `here` to `there`, `... x 6` or `... x 3`."""
    shift = there[0] - here[0]
    if there[1] is None or here[1] is None:
        return shift
    turn = matrix_to_rotation_vector(there[1] @ here[1].mT)
    lead = leading_shape(shift, turn)
    return torch.cat([shift.expand(*lead, -1), rotation_weight * turn.expand(*lead, -1)], dim=-1)


def only_turns(frame: Frame) -> bool:
    """Whether frames of several poses, `s`, have one position: their errors are of the rotation alone."""
    return frame[1] is not None and bool((frame[0] == frame[0][:1]).all())


def frame_from_coordinates(pose: Tensor, coordinates: tuple[Coordinate, ...], name: str) -> Frame:
    """Frame of a pose whose coordinates are named x, y, z and rx, ry, rz."""
    columns = {c.name: pose[..., i] for i, c in enumerate(coordinates)}
    angles = _angles(coordinates, name)
    zero = torch.zeros_like(pose[..., 0])
    position = torch.stack([columns.get(c, zero) for c in _LENGTHS], dim=-1)
    if not angles:
        return position, None
    return position, rotation_vector_to_matrix(torch.stack([columns.get(c, zero) for c in _TURNS], dim=-1))


def coordinates_jacobian(pose: Tensor, coordinates: tuple[Coordinate, ...], name: str) -> Tensor:
    """Of `frame_from_coordinates`, as `frame_jacobian` gives it: `... x 6 x p`, or `... x 3 x p` without angles."""
    names, angles = [c.name for c in coordinates], _angles(coordinates, name)
    rows = torch.tensor([[float(own == row) for own in names] for row in (*_LENGTHS, *_TURNS)])
    slope = rows.to(pose).expand(*pose.shape[:-1], 6, len(names))
    if not angles:
        return slope[..., :3, :]
    zero = torch.zeros_like(pose[..., 0])
    vector = torch.stack([pose[..., names.index(t)] if t in names else zero for t in _TURNS], -1)
    return torch.cat([slope[..., :3, :], rotation_vector_rate(vector) @ slope[..., 3:, :]], -2)


def _angles(coordinates: tuple[Coordinate, ...], name: str) -> list[str]:
    """Names of a pose's angles, which a frame by name must know; lengths of other names do not move it."""
    angles = [c.name for c in coordinates if c.unit == "rad"]
    strange = [a for a in angles if a not in _TURNS]
    if strange:
        raise InputError(
            f"mechanism '{name}' has the pose angle '{strange[0]}': override frame(pose) to say how it turns"
        )
    return angles


def frame_jacobian(function: Callable[[Tensor], Frame], point: Tensor, copies: int = 1) -> Tensor:
    """Jacobian of position and rotation vector (in the base frame) of a frame-valued function.

    Args:
        function: `... x n` -> position `... x 3`, rotation `... x 3 x 3` or None.
        point: `... x n`.
        copies: as of `jacobian_of`, 6 or 3.

    Returns:
        `... x 6 x n`, or `... x 3 x n` without rotation; NaN where the frame is.
    """

    turns = False

    def flat(x: Tensor) -> Tensor:
        nonlocal turns
        position, rotation = function(x)
        turns = rotation is not None
        return position if rotation is None else torch.cat([position, rotation.flatten(-2)], dim=-1)

    value, slope = jacobian_of(flat, point, lambda value: _twist(value, turns), copies)
    return torch.where(torch.isfinite(value).all(-1)[..., None, None], slope, torch.nan)


def _twist(value: Tensor, turns: bool) -> Tensor:
    """What of the changes of position and rotation matrix side by side, `... x 3` or `... x 12`, is the change of the
    position and the rotation vector: `... x 3 x 3` or `... x 6 x 12`; alike where readings stand for the position."""
    c = value.shape[-1] - 9 * turns
    shift = torch.eye(c, dtype=value.dtype, device=value.device).expand(*value.shape[:-1], c, c)
    if not turns:
        return shift
    # dR = [ω]x R, so that ω_k is half the sum of the products of dR's entries with those of [e_k]x R.
    rotation = value[..., c:].reshape(*value.shape[:-1], 1, 3, 3)
    turn = (skew(torch.eye(3, dtype=value.dtype, device=value.device)) @ rotation).flatten(-2) / 2
    none = turn.new_zeros(*turn.shape[:-2], c, 9), turn.new_zeros(*turn.shape[:-2], 3, c)
    return torch.cat([torch.cat([shift, none[0]], -1), torch.cat([none[1], turn], -1)], -2)
