"""Zeros of an arm's joints that are elsewhere than in its model, by any angle, one joint counting the other way."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.display import number_text
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT, best_closed_form
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

# Places that are searched from, and steps of each before the best of them are searched on.
_ROUNDS = ((72, 3), (18, 3), (5, 8))
# Rows of the search.
_ROWS = 30
_DIFFERENCE = 1e-6
_DAMPED = 1e-3
# Zeros nearer than this are where they should be [rad].
_SAME = math.radians(0.05)


def wrong_zeros(arm: SerialArm, joints: Tensor, measured: Tensor, enough: float) -> str:
    """Zeros with which an arm's model and the rows agree, in words; empty where there are none.

    Args:
        arm: with both frames unknown, which take the zeros of the first and the last joint.
        joints: `s x n` [SI].
        measured: poses, `s x p`.
        enough: the usual position error [m] with which they agree.
    """
    rows = torch.linspace(0, len(joints) - 1, min(_ROWS, len(joints))).round().long()
    joints, measured = joints[rows], measured[rows]
    middle = [i for i in range(1, len(arm.joints) - 1) if arm.joints[i].unit == "rad"]
    if not middle:
        return ""
    generator = torch.Generator().manual_seed(0)
    starts = math.pi * (2 * torch.rand(_ROUNDS[0][0], len(middle), generator=generator, dtype=joints.dtype) - 1)
    starts[0] = 0.0
    for turned in (None, *(i for i, joint in enumerate(arm.joints) if joint.unit == "rad")):
        signs = torch.ones_like(joints[0])
        if turned is not None:
            signs[turned] = -1.0
        zeros = _searched(arm, signs * joints, measured, middle, starts)
        usual = _left(arm, signs * joints, measured, middle, zeros)[..., :3].norm(dim=-1).median(-1).values
        best = int(usual.argmin())
        if float(usual[best]) < enough:
            names, told, written = [j.name for j in arm.joints], [], {}
            there = torch.remainder(zeros[best] + math.pi, 2 * math.pi) - math.pi
            if turned is not None:
                told.append(f"joint {names[turned]} seems to count in the other direction")
                written[names[turned]] = f"-{names[turned]}"
            for i, zero in zip(middle, there.tolist(), strict=True):
                if abs(zero) > _SAME:
                    angle = f"{math.degrees(abs(zero)):.3f}"
                    sign = "-" if zero < 0 else "+"
                    told.append(f"joint {names[i]} seems to stand at {sign.strip('+')}{angle}° where it counts 0")
                    written[names[i]] = f"{written.get(names[i], names[i])} {sign} {angle} deg"
            if told:
                entries = ", ".join(f'{name}: "{text}"' for name, text in written.items())
                left = number_text(1e3 * float(usual[best]), 3)
                return f"{', '.join(told)}, which leaves {left} mm; write joint_map: {{{entries}}} to have it so"
    return ""


def _left(arm: SerialArm, joints: Tensor, measured: Tensor, middle: list[int], zeros: Tensor) -> Tensor:
    """What zeros `... x m` leave in position and weighted rotation, frames in closed form; `... x s x 6` or `3` [m]."""
    offsets = torch.zeros(*zeros.shape[:-1], 1, joints.shape[-1], dtype=joints.dtype)
    offsets[..., 0, middle] = zeros
    rotation, position = arm.flange(joints + offsets)
    seen = arm.frame(measured.expand(*zeros.shape[:-1], *measured.shape))
    weights = torch.ones(len(joints), dtype=joints.dtype)
    frames = best_closed_form(rotation, position, seen, arm.nominal[-6:], weights, ROTATION_WEIGHT)
    base, tool = (rotation_vector_to_matrix(frames[..., None, k : k + 3]) for k in (3, 9))
    lever = position + (rotation @ frames[..., None, 6:9, None])[..., 0]
    place: Tensor = (base @ lever[..., None])[..., 0] + frames[..., None, :3] - seen[0]
    if seen[1] is None:
        return place
    turn = matrix_to_rotation_vector(base @ rotation @ tool @ seen[1].mT)
    return torch.cat([place, ROTATION_WEIGHT * turn], -1)


def _searched(arm: SerialArm, joints: Tensor, measured: Tensor, middle: list[int], zeros: Tensor) -> Tensor:
    """Damped Gauss-Newton from all starts side by side, `k x m`."""

    def left(values: Tensor) -> Tensor:
        return _left(arm, joints, measured, middle, values).flatten(-2)

    here, damping = left(zeros), torch.full_like(zeros[:, :1], _DAMPED)
    eye = torch.eye(len(middle), dtype=zeros.dtype)
    for kept, steps in _ROUNDS:
        best = here.square().sum(-1).argsort()[:kept]
        zeros, here, damping = zeros[best], here[best], damping[best]
        for _ in range(steps):
            slopes = ((left(zeros[:, None] + _DIFFERENCE * eye) - here[:, None]) / _DIFFERENCE).mT
            inner, right = slopes.mT @ slopes, slopes.mT @ here[..., None]
            usual = inner.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
            tried = zeros - torch.linalg.solve(inner + damping[..., None] * usual * eye, right)[..., 0]
            there = left(tried)
            better = (there.square().sum(-1) < here.square().sum(-1))[:, None]
            zeros, here = torch.where(better, tried, zeros), torch.where(better, there, here)
            damping = torch.where(better, damping / 5, damping * 10)
    return zeros
