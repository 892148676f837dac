"""Joints of poses where several reach them: the branch of the row before."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ccnn_torch.numerics.rotations import wrap_angle

if TYPE_CHECKING:
    from ccnn_torch.mechanisms.mechanism import Mechanism

# Initial guesses solved at once where that of the previous row does not converge.
_STARTS = 64
# Of a region, how far beyond its ends still counts as in it.
_ROOM = 0.05
# A larger step of a joint from one row to the next is no path's [rad, m].
_JUMP = 0.5
EXACT = (1e-8, 1e-8)
"""Largest pose error at joints that were computed [m, rad]."""
ROUNDED = (1e-4, 1e-3)
"""The same of poses that a controller showed rounded, which a machine of few joints misses by that [m, rad]."""


def turning(mechanism: Mechanism) -> Tensor:
    """Joints whose values a turn apart are one, `n` bool: of unit rad, and within one turn all over the workspace.

    Those that go farther, winches and motors, are counted on.
    """
    corners = torch.cartesian_prod(*torch.stack([mechanism.low, mechanism.high], -1).detach())
    joints = mechanism.solve_inverse(corners.reshape(-1, len(mechanism.pose)))
    joints = torch.where(torch.isfinite(joints), joints, mechanism.home_joints)
    revolute = torch.tensor([j.unit == "rad" for j in mechanism.joints], device=joints.device)
    return revolute & (joints.amax(0) - joints.amin(0) <= 2 * math.pi)


def arrives(mechanism: Mechanism, joints: Tensor, poses: Tensor, within: tuple[float, float] = EXACT) -> Tensor:
    """Whether joints `... x n` bring the nominal machine to poses `... x p`, `...`; a search stops at the nearest one.

    Args:
        within: largest distance [m] and angle [rad].
    """
    error = mechanism.pose_error(mechanism.forward_kinematics(joints, guess=poses), poses)
    # A comparison with NaN is false, so a pose without joints is not reached either.
    there = error.position < within[0]
    return there if error.rotation is None else there & (error.rotation < within[1])


def follow(
    mechanism: Mechanism,
    poses: Tensor,
    guess: Tensor,
    within: tuple[float, float] = EXACT,
    region: Tensor | None = None,
) -> Tensor:
    """Joints of successive poses `s x p`, each on the branch of the previous row, the first on that of `guess`.

    Where that branch has no solution, take the one nearest to the previous row, out of many initial guesses; where it
    leaves a region, lowest and highest joints `n x 2`, by a jump that no path makes, the one nearest within it.
    """
    starts = mechanism.sample_joints(_STARTS, torch.Generator().manual_seed(0))

    def nearest(pose: Tensor, starts: Tensor, inside: Tensor | None = None) -> tuple[Tensor, bool]:
        found = mechanism.solve_inverse(pose.expand(_STARTS, -1), guess=starts)
        good = arrives(mechanism, found, pose.expand(_STARTS, -1), within)
        good = good if inside is None else good & _is_within(mechanism, found, inside)
        distance = mechanism.wrap(found - guess).norm(dim=-1)
        return found[torch.where(good, distance, torch.inf).argmin()], bool(good.any())

    rows = []
    for pose in poses:
        joints = mechanism.solve_inverse(pose, guess=guess)
        if not bool(arrives(mechanism, joints, pose, within)):
            joints, _ = nearest(pose, starts)
        jumped = float(mechanism.wrap(joints - guess).abs().max()) > _JUMP
        if region is not None and jumped and not bool(_is_within(mechanism, joints, region)):
            spread = (starts - starts.amin(0)) / (starts.amax(0) - starts.amin(0)).clamp_min(1e-12)
            other, good = nearest(pose, region[:, 0] + (region[:, 1] - region[:, 0]) * spread, region)
            joints = other if good else joints
        rows.append(joints)
        guess = torch.where(arrives(mechanism, joints, pose, within), joints, guess)
    return torch.stack(rows)


def _is_within(mechanism: Mechanism, joints: Tensor, region: Tensor) -> Tensor:
    """Whether joints `... x n`, in any turn, are in a region, lowest and highest `n x 2`, or close to it, `...`."""
    middle, half = region.mean(-1), (0.5 + _ROOM) * (region[:, 1] - region[:, 0])
    return (mechanism.wrap(joints - middle).abs() <= half).all(-1)


def commanded_joints(mechanism: Mechanism, poses: Tensor, guess: Tensor | None) -> Tensor:
    """See `Mechanism.commanded_joints`."""
    if guess is None and mechanism.orientations:
        joints = follow(mechanism, poses, mechanism.home_joints, ROUNDED)
        # Turns are counted from the middle of all rows.
        middle = torch.atan2(torch.sin(joints).mean(0), torch.cos(joints).mean(0))
        turning = torch.tensor([c.unit == "rad" for c in mechanism.joints])
        joints = torch.where(turning, middle + wrap_angle(joints - middle), joints)
    else:
        joints = mechanism.solve_inverse(poses, guess=guess).detach()
    return torch.where(arrives(mechanism, joints, poses, ROUNDED)[..., None], joints, torch.nan)
