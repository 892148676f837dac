"""A cause as the sources' families give it: a change of the pose that grows with one number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .arm import Pose
from .situation import Rows

__all__ = ["Cause", "changes_joints"]

Names = frozenset[str]


@dataclass(frozen=True)
class Cause:
    """One known error.

    Attributes:
        words: what it is.
        pose: pose in the base frame for a strength; 0 is the nominal arm's. None = nothing is added.
        columns: covariates without which it cannot be told, of `time`, `temperature`, `load`, `direction`, `speed`.
        accepted: sets of names that are right to be gained.
        strengths: in units of the arm's own error.
        outside: True = no name of the library is right.
        drivers: right drivers of what is outside.
        clashes: covariates that must not be given beside it, since they would tell the same.
        rows: the rows, where the cause changes what was recorded beside the poses.
    """

    words: str
    pose: Callable[[float], Pose] | None
    columns: tuple[str, ...] = ()
    accepted: tuple[Names, ...] = ()
    strengths: tuple[float, ...] = (0.25, 0.5, 1.0, 3.0)
    outside: bool | None = None
    drivers: tuple[str, ...] = ()
    clashes: tuple[str, ...] = ()
    others: tuple[NDArray, ...] = ()
    least_left: float = 0.5
    rows: Rows | None = field(default=None, repr=False)


def changes_joints(rows: Rows, change: NDArray) -> Callable[[float], Pose]:
    """Poses of joints that are off by a strength times `change`, `s x n` [rad]."""
    return lambda strength: rows.arm.pose(rows.joints + strength * change)


def on_joints(rows: Rows, numbers: NDArray, values: NDArray) -> NDArray:
    """`s x n` with values `s x k` in the columns `numbers`, else 0."""
    out = np.zeros_like(rows.joints)
    out[:, numbers] = values
    return out
