"""How much of an added error other explanations take away: the frames, the geometry, gains and couplings of joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .arm import Arm, Pose
from .kinds import Floats

__all__ = ["gain_basis", "left_over", "stack"]

METRES_PER_RADIAN = 0.3
FIELDS = ("a", "d", "alpha", "theta", "beta")


def stack(first: Pose, second: Pose, oriented: bool) -> Floats:
    """Difference of two sets of poses, second less first, `s x 3` or `s x 6` [m]; rotations to first order."""
    moved = second.position - first.position
    if not oriented:
        return moved
    turn = second.rotation @ first.rotation.swapaxes(-1, -2)
    skew = (turn - turn.swapaxes(-1, -2)) / 2
    vector = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    return np.concatenate([moved, METRES_PER_RADIAN * vector], -1)


def left_over(arm: Arm, joints: Floats, error: Floats, more: Sequence[Floats] = (), geometry: bool = True) -> float:
    """Share of an error (root mean square) that frames, geometry and further columns do not take.

    Args:
        arm: nominal arm with its tool.
        joints: `s x n` [rad].
        error: `s x 3` or `s x 6` as of `stack`.
        more: further errors of the same form, each free in strength.
        geometry: False = frames and `more` alone.
    """
    oriented = error.shape[-1] == 6
    columns = [*frame_basis(arm, joints, oriented), *(geometry_basis(arm, joints, oriented) if geometry else []), *more]
    matrix = np.stack([c.ravel() for c in columns], -1)
    sizes = np.linalg.norm(matrix, axis=0)
    # Parameters without an effect on the pose would only add rounding errors.
    matrix = matrix[:, sizes > 1e-9 * sizes.max()] / sizes[sizes > 1e-9 * sizes.max()]
    found = np.linalg.lstsq(matrix, error.ravel(), rcond=1e-8)[0]
    return float(np.linalg.norm(error.ravel() - matrix @ found) / np.linalg.norm(error))


def gain_basis(arm: Arm, joints: Floats, oriented: bool, coupled: bool) -> list[Floats]:
    """Errors of joints that are proportional to a joint: to itself (gain), or to another one (coupling).

    Args:
        arm: nominal arm.
        joints: `s x n` [rad].
        oriented: with orientation.
        coupled: True = couplings, False = gains.
    """
    slopes = joint_slopes(arm, joints, oriented)
    n = joints.shape[-1]
    pairs = [(i, j) for i in range(n) for j in range(n) if (i != j) == coupled]
    return [slopes[..., i] * (joints[:, j] - joints[:, j].mean())[:, None] for i, j in pairs]


def joint_slopes(arm: Arm, joints: Floats, oriented: bool) -> Floats:
    """Derivatives of the pose by the joints, `s x 3 x n` or `s x 6 x n` [m]."""
    jacobian = arm.jacobian(joints)
    if not oriented:
        return jacobian[:, :3]
    return np.concatenate([jacobian[:, :3], METRES_PER_RADIAN * jacobian[:, 3:]], 1)


def frame_basis(arm: Arm, joints: Floats, oriented: bool) -> list[Floats]:
    """Errors of the base frame and of the tool frame."""
    pose = arm.pose(joints)
    rows, out = len(joints), []
    for axis in np.eye(3):
        along, turned = np.broadcast_to(axis, (rows, 3)), np.cross(axis, pose.position)
        tool = pose.rotation @ axis
        zero = np.zeros((rows, 3))
        if oriented:
            turns = np.broadcast_to(METRES_PER_RADIAN * axis, (rows, 3)), METRES_PER_RADIAN * tool
            pairs = [(along, zero), (turned, turns[0]), (tool, zero), (zero, turns[1])]
            out += [np.concatenate(pair, -1) for pair in pairs]
        else:
            out += [along, turned, tool]
    return out


def geometry_basis(arm: Arm, joints: Floats, oriented: bool) -> list[Floats]:
    """Errors of all lengths and angles of the links, by central differences."""
    out, step, n = [], 1e-5, joints.shape[-1]
    for field in FIELDS:
        for i in range(n):
            change = step * np.eye(n)[i]
            low, high = (arm.with_values(**{field: getattr(arm, field) + sign * change}) for sign in (-1, 1))
            out.append(stack(low.pose(joints), high.pose(joints), oriented) / (2 * step))
    return out
