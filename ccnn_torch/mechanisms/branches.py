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


def follow(mechanism: Mechanism, poses: Tensor, guess: Tensor, within: tuple[float, float] = EXACT) -> Tensor:
    """Joints of successive poses `s x p`, each on the branch of the previous row, the first on that of `guess`.

    Where that branch has no solution, take the one nearest to the previous row, out of many initial guesses.
    """
    starts = mechanism.sample_joints(_STARTS, torch.Generator().manual_seed(0))
    rows = []
    for pose in poses:
        joints = mechanism.solve_inverse(pose, guess=guess)
        if not bool(arrives(mechanism, joints, pose, within)):
            found = mechanism.solve_inverse(pose.expand(_STARTS, -1), guess=starts)
            distance = mechanism.wrap(found - guess).norm(dim=-1)
            good = arrives(mechanism, found, pose.expand(_STARTS, -1), within)
            joints = found[torch.where(good, distance, torch.inf).argmin()]
        rows.append(joints)
        guess = torch.where(arrives(mechanism, joints, pose, within), joints, guess)
    return torch.stack(rows)


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
