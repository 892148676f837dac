"""What a cause is, which joints it is drawn for, and what the machine shows with its causes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.sources.shop.machine import Array, Errors, Machine, Pose, Rows

__all__ = ["INNER", "Cause", "Random", "one_joint", "ordinary", "picked", "seen", "shifted", "with_joints"]

Random = np.random.Generator
INNER = {"painter6": [1, 2, 3, 4], "arm7": [1, 2, 3, 4, 5], "scara": [1], "planar3r": [1]}
"""Joints of an arm that its base and tool frame cannot stand for."""


@dataclass(frozen=True)
class Cause:
    """A cause, of a size near the ordinary one of a workshop at strength 1.

    Attributes:
        answers: names any of which is right; of what is outside the library, drivers any of which is right.
        errors: errors of joints and sizes at rows, for a strength.
        moved: the pose with what moves it as a whole, for a strength; None = nothing does.
        needs: columns without which it cannot be found: direction, load, temperature, time or speed.
        adds: columns of its own that were recorded as well, at rows; None = none.
    """

    answers: tuple[str, ...]
    errors: Callable[[Rows, float], Errors] = lambda rows, strength: {}
    moved: Callable[[Pose, Rows, float], Pose] | None = None
    needs: tuple[str, ...] = ()
    adds: Callable[[Rows], dict[str, Array]] | None = None


def with_joints(name: str, errors: Callable[[Rows, float], Array], *needs: str, also: Sequence[str] = ()) -> Cause:
    """A cause that changes the joints only."""
    return Cause((name, *also), lambda rows, strength: {"joints": errors(rows, strength)}, needs=needs)


def picked(machine: Machine, rng: Random, joints: Sequence[int] | None = None, most: int = 2) -> Array:
    """Shares of the joints, `n`: 0.6 to 1.4 of either sign for up to `most` of them, 0 for the others."""
    joints = list(range(machine.count)) if joints is None else list(joints)
    share = np.zeros(machine.count)
    which = rng.choice(joints, min(len(joints), int(rng.integers(1, most + 1))), False)
    share[which] = rng.choice([-1, 1], len(which)) * rng.uniform(0.6, 1.4, len(which))
    return share


def ordinary(machine: Machine) -> Array:
    """Ordinary size of the joints' errors, `n`: 0.1 mrad or 0.04 mm."""
    return np.array([1e-4 if unit == "rad" else 4e-5 for unit in machine.joint_units])


def one_joint(machine: Machine, rng: Random) -> int:
    """One joint, of an arm an inner one."""
    return int(rng.choice(INNER.get(machine.name) or range(machine.count)))


def shifted(pose: Pose, shift: Array, turn: Array) -> Pose:
    """A pose moved and turned in the base frame [m, rad], by all rows' or one's."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    return pose[0] @ rotation.T + shift, rotation @ pose[1]


def seen(machine: Machine, rows: Rows, causes: Sequence[Cause], strengths: Sequence[float]) -> Pose:
    """The pose without noise at the rows of a machine with the causes."""
    errors: dict[str, Array] = {}
    for cause, strength in zip(causes, strengths, strict=True):
        for name, change in cause.errors(rows, strength).items():
            errors[name] = change if name not in errors else errors[name] + change
    pose = machine.pose(rows.joints, errors)
    for cause, strength in zip(causes, strengths, strict=True):
        if cause.moved is not None:
            pose = cause.moved(pose, rows, strength)
    return pose
