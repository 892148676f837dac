"""Rotation matrices of many rows at once, and their differences as rotation vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def about(axis: Array, angle: Array) -> Array:
    """Rotations about one axis by the angles of `s` rows [rad], `s x 3 x 3`."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * k + (1 - cosine) * (k @ k))


def matrix(vector: Array) -> Array:
    """Rotation matrix of one rotation vector [rad]."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def difference(first: Array, second: Array) -> Array:
    """Rotation vectors that lead from the first to the second orientations, in the base frame, `s x 3` [rad].

    Exact for any angle below a half turn; smooth at zero, where derivatives are taken.
    """
    turn = second @ first.swapaxes(-1, -2)
    vee = (
        np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1) / 2
    )
    sine = np.linalg.norm(vee, axis=-1)
    angle = np.arctan2(sine, (np.trace(turn, axis1=1, axis2=2) - 1) / 2)
    return np.asarray(vee * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None])
