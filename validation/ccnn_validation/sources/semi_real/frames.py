"""Base frame and tool point of a measured arm: Kabsch's fit within a search for the tool point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from .arm import Arm
from .kinds import Floats

__all__ = ["Seen", "see"]


@dataclass(frozen=True)
class Seen:
    """An arm as the tracker sees it.

    Attributes:
        arm: the arm with its fitted tool point.
        base: rotation of the base frame in the tracker's frame, `3 x 3`.
        own_error: what is left of the measured positions, root mean square of the distance [m].
    """

    arm: Arm
    base: Floats
    own_error: float


def see(arm: Arm, joints: Floats, position: Floats) -> Seen:
    """Fits base frame and tool point to measured positions.

    For each tool point the base frame has a closed form, so that only three numbers are searched, from several starts,
    since it is not linear.

    Args:
        arm: nominal arm.
        joints: `s x n` [rad].
        position: measured, `s x 3` [m].
    """

    def rest(tool: Floats) -> Floats:
        points = arm.with_values(tool=tool).pose(joints).position
        turn, shift = kabsch(points, position)
        return np.ravel(points @ turn.T + shift - position)

    starts = [np.zeros(3), *(0.1 * np.eye(3)), *(-0.1 * np.eye(3))]
    best = min((least_squares(rest, start) for start in starts), key=lambda found: float(found.cost))
    seen = arm.with_values(tool=best.x)
    turn, _ = kabsch(seen.pose(joints).position, position)
    return Seen(seen, turn, float(np.sqrt((best.fun.reshape(-1, 3) ** 2).sum(-1).mean())))


def kabsch(points: Floats, targets: Floats) -> tuple[Floats, Floats]:
    """Rotation and shift that bring points closest to targets, `s x 3` [m]: targets ~ points @ turn.T + shift."""
    middle, goal = points.mean(0), targets.mean(0)
    left, _, right = np.linalg.svd((targets - goal).T @ (points - middle))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return turn, goal - turn @ middle
