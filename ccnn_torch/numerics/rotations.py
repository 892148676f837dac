"""Rotations: the few maps this package needs, float64, any leading batch dims.

Warning:
    Quaternions are (w, x, y, z), in scipy (x, y, z, w); Euler angles are intrinsic Z-Y'-X'' (yaw, pitch, roll).
    Eq. 2 of the pseudoerror paper (Zhang and Gao 2012) mixes its angle names; this is the proper ZYX matrix.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

# Below this angle the series' first terms are exact to rounding.
_SMALL = 1e-9


def homogeneous(rotation: Tensor, place: Tensor) -> Tensor:
    """`... x 4 x 4` of a rotation `... x 3 x 3` and a place `... x 3`."""
    whole = rotation.new_zeros(*rotation.shape[:-2], 4, 4)
    whole[..., :3, :3], whole[..., :3, 3], whole[..., 3, 3] = rotation, place, 1.0
    return whole


def rotation_vector_to_matrix(vector: Tensor) -> Tensor:
    """vector: `... x 3` [rad]; returns `... x 3 x 3` (Rodrigues): I + sin θ/θ K + (1 - cos θ)/θ² K²."""
    square = vector.square().sum(-1)[..., None, None]
    small = square < _SMALL**2
    angle = torch.where(small, 1.0, square).sqrt()
    first = torch.where(small, 1.0, torch.sin(angle) / angle)
    second = torch.where(small, 0.5, 2 * (torch.sin(angle / 2) / angle).square())
    k = skew(vector)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + first * k + second * (k @ k)


def matrix_to_rotation_vector(matrix: Tensor) -> Tensor:
    """matrix: `... x 3 x 3`; returns the rotation vector of angle at most pi, `... x 3` [rad]."""
    quaternion = matrix_to_quaternion(matrix)
    scalar, vector = quaternion[..., :1], quaternion[..., 1:]
    square = vector.square().sum(-1, keepdim=True)
    small = square < _SMALL**2
    sine = torch.where(small, 1.0, square).sqrt()
    return torch.where(small, 2 / scalar, 2 * torch.atan2(sine, scalar) / sine) * vector


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """matrix: `... x 3 x 3`; returns the unit quaternion (w, x, y, z) with w >= 0, `... x 4` (Markley 2008, eq. 8)."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    # 4 q qᵀ, of which the row with the largest diagonal entry is the most precise multiple of q.
    products = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], -1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], -1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], -1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], -1),
        ],
        -2,
    )
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = products.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    unit = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    return torch.where(unit[..., :1] < 0, -unit, unit)


def euler_zyx_to_matrix(angles: Tensor) -> Tensor:
    """angles: `... x 3` [rad], (yaw about z, pitch about y', roll about x''); returns `... x 3 x 3`."""
    (cz, cy, cx), (sz, sy, sx) = torch.cos(angles).unbind(-1), torch.sin(angles).unbind(-1)
    entries = [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx]
    entries += [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx, -sy, cy * sx, cy * cx]
    return torch.stack(entries, -1).reshape(*angles.shape, 3)


def matrix_to_euler_zyx(matrix: Tensor) -> Tensor:
    """Inverse of `euler_zyx_to_matrix`; pitch in [-pi/2, pi/2]. Yaw is taken off first, so no pitch is singular."""
    (a, b, c), (d, e, f), (g, _, _) = (row.unbind(-1) for row in matrix.unbind(-2))
    yaw = torch.atan2(d, a)
    cosine, sine = torch.cos(yaw), torch.sin(yaw)
    pitch = torch.atan2(-g, cosine * a + sine * d)
    roll = torch.atan2(sine * c - cosine * f, cosine * e - sine * b)
    return torch.stack([yaw, pitch, roll], -1)


def nearest_euler(angles: Sequence[float], wanted: Sequence[float]) -> list[float]:
    """Of the ways to write a rotation by three angles, full turns among them, the one nearest to another, `3` [rad]."""
    first, middle, last = angles
    ways = ((first, middle, last), (first + math.pi, math.pi - middle, last + math.pi))
    near = [[w + math.remainder(a - w, 2 * math.pi) for a, w in zip(way, wanted, strict=True)] for way in ways]
    return min(near, key=lambda way: math.dist(way, wanted))


def geodesic_angle(first: Tensor, second: Tensor) -> Tensor:
    """Angle of the rotation between two frames, `... x 3 x 3` each; returns `...` [rad], right down to 1e-9 rad."""
    chord: Tensor = torch.linalg.matrix_norm(second - first)
    return 2 * torch.asin((chord / math.sqrt(8)).clamp_max(1.0))


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotation with the least sum of squared differences to a matrix (special Procrustes), both `... x 3 x 3`."""
    left, _, right = torch.linalg.svd(matrix)
    sign = torch.det(left @ right)[..., None, None]
    rotation: Tensor = torch.cat([left[..., :2], left[..., 2:] * sign], -1) @ right
    return rotation


def skew(vector: Tensor) -> Tensor:
    """Matrix of the cross product: vector `... x 3`; returns `... x 3 x 3` with `skew(a) @ b = a x b`."""
    x, y, z = torch.split(vector, 1, -1)
    zero = torch.zeros_like(x)
    return torch.cat([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape, 3)


def vee(matrix: Tensor) -> Tensor:
    """Inverse of `skew`, of the skew part of a matrix: `... x 3 x 3`; returns `... x 3`."""
    flat = matrix.flatten(-2)
    return (flat[..., [7, 2, 3]] - flat[..., [5, 6, 1]]) / 2


def rotation_vector_rate(vector: Tensor) -> Tensor:
    """Rate of rotation, in the fixed axes, per change of the rotation vector (the left Jacobian of the exponential).

    I + (1 - cos θ)/θ² K + (θ - sin θ)/θ³ K², K = skew(vector), θ its length. vector: `... x 3`; returns `... x 3 x 3`.
    """
    square = vector.square().sum(-1)[..., None, None]
    angle = square.sqrt()
    small = square < 1e-6
    safe = torch.where(small, 1.0, angle)
    first = torch.sinc(angle / (2 * torch.pi)).square() / 2
    second = torch.where(small, 1 / 6 - square / 120, (safe - torch.sin(safe)) / safe**3)
    k = skew(vector)
    return torch.eye(3, dtype=vector.dtype) + first * k + second * (k @ k)


def wrap_angle(angle: Tensor) -> Tensor:
    """The same angle in [-pi, pi], any shape [rad]; an angle already there is returned bit by bit."""
    turns = torch.round(angle / (2 * torch.pi))
    return torch.where(turns == 0, angle, angle - turns * 2 * torch.pi)
