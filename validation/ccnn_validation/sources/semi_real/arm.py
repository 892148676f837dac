"""A serial arm in standard Denavit-Hartenberg convention: frames of its links, the measured point, its Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .kinds import Floats

__all__ = ["Arm", "Pose"]


@dataclass(frozen=True)
class Pose:
    """Poses in the arm's base frame, or in the tracker's.

    Attributes:
        position: `s x 3` [m].
        rotation: `s x 3 x 3`, of the flange or of the measured target.
    """

    position: Floats
    rotation: Floats


@dataclass(frozen=True)
class Arm:
    """Geometry of an arm: link i = Rz(q + theta) Tz(d) Tx(a) Rx(alpha) Ry(beta).

    Attributes:
        a, alpha, d, theta, beta: `n` or `s x n`, [m] and [rad]; beta is a tilt about the link's own y, nominally 0.
        tool: the measured point in the flange's frame, `3` or `s x 3` [m].
    """

    a: Floats
    alpha: Floats
    d: Floats
    theta: Floats
    beta: Floats
    tool: Floats

    def with_values(self, **values: Floats) -> Arm:
        """The same arm with other values of some fields."""
        return replace(self, **values)

    def links(self, joints: Floats) -> tuple[Floats, Floats]:
        """Frames of base and links.

        Args:
            joints: `s x n` [rad].

        Returns:
            Origins `s x (n + 1) x 3` [m] and rotations `s x (n + 1) x 3 x 3`; number 0 is the base.
        """
        rows, n = joints.shape
        lengths_a, lengths_d = np.broadcast_to(self.a, (rows, n)), np.broadcast_to(self.d, (rows, n))
        alpha, beta = np.broadcast_to(self.alpha, (rows, n)), np.broadcast_to(self.beta, (rows, n))
        turn = joints + self.theta
        origins, rotations = [np.zeros((rows, 3))], [np.broadcast_to(np.eye(3), (rows, 3, 3))]
        for i in range(n):
            half = rotations[-1] @ about("z", turn[:, i])
            step = np.stack([lengths_a[:, i], np.zeros(rows), lengths_d[:, i]], -1)
            origins.append(origins[-1] + (half @ step[..., None])[..., 0])
            rotations.append(half @ about("x", alpha[:, i]) @ about("y", beta[:, i]))
        return np.stack(origins, 1), np.stack(rotations, 1)

    def pose(self, joints: Floats) -> Pose:
        """Position of the measured point and rotation of the flange, in the base frame; joints `s x n` [rad]."""
        origins, rotations = self.links(joints)
        tool = np.broadcast_to(self.tool, (len(joints), 3))
        return Pose(origins[:, -1] + (rotations[:, -1] @ tool[..., None])[..., 0], rotations[:, -1])

    def jacobian(self, joints: Floats) -> Floats:
        """Derivatives of position and rotation by the joints, in the base frame, `s x 6 x n` [m/rad, 1]."""
        origins, rotations = self.links(joints)
        axes = rotations[:, :-1, :, 2]
        arms = self.pose(joints).position[:, None] - origins[:, :-1]
        return np.concatenate([np.cross(axes, arms), axes], -1).swapaxes(-1, -2)


def about(axis: str, angle: Floats) -> Floats:
    """Rotations about one axis; angle `s` [rad] -> `s x 3 x 3`."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    out = np.zeros((*angle.shape, 3, 3))
    out[..., i, i] = 1
    out[..., j, j] = out[..., k, k] = np.cos(angle)
    out[..., k, j] = np.sin(angle)
    out[..., j, k] = -np.sin(angle)
    return out
