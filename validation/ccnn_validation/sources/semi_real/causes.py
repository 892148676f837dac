"""A cause as the sources' families give it: a change of the pose that grows with one number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .arm import Pose
from .kinds import Floats
from .situation import Rows

__all__ = ["Cause", "changes_joints", "named", "on_joints"]

Names = frozenset[str]


@dataclass(frozen=True)
class Cause:
    """One known error.

    Attributes:
        words: what it is.
        pose: pose in the base frame for a strength; at 0 it is the nominal arm's.
        columns: covariates that it follows, of `time`, `temperature`, `load`, `direction`, `speed`.
        accepted: sets of names that are right to be gained.
        strengths: in units of the arm's own error, one is drawn.
        outside: True = no name of the library is all of it.
        drivers: right drivers of what is outside.
        clashes: covariates that are not given beside it, since by chance they tell about the same.
        others: further errors (as of `absorb.stack`) that must not explain it as well as geometry does.
        own: errors of the same cause: where the measured arm itself shows them, nothing new is right as well.
        least_share: share of what geometry leaves of the error that `others` must leave, else another one is drawn.
        fit: False = these rows do not show it, another one is drawn.
        rows: the rows, where the cause changes what was recorded beside the poses.
    """

    words: str
    pose: Callable[[float], Pose]
    accepted: tuple[Names, ...]
    columns: tuple[str, ...] = ()
    strengths: tuple[float, ...] = (0.25, 0.5, 1.0, 3.0)
    outside: bool | None = None
    drivers: tuple[str, ...] = ()
    clashes: tuple[str, ...] = ()
    others: tuple[Floats, ...] = ()
    own: tuple[Floats, ...] = ()
    least_share: float = 0.0
    fit: bool = True
    rows: Rows | None = None


def changes_joints(rows: Rows, change: Floats) -> Callable[[float], Pose]:
    """Poses of joints that are off by a strength times `change`, `s x n` [rad]."""
    return lambda strength: rows.arm.pose(rows.joints + strength * change)


def on_joints(rows: Rows, numbers: Floats, values: Floats) -> Floats:
    """`s x n` with values `s x k` in the columns `numbers`, else 0."""
    out = np.zeros_like(rows.joints)
    out[:, numbers] = values
    return out


def named(*names: str) -> tuple[Names, ...]:
    """One set for each name: each of them alone is right."""
    return tuple(frozenset({name}) for name in names)
