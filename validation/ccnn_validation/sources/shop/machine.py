"""What every machine of the workshop has: joints, a pose that errors change, and the torques of loads and weight."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["GRAVITY", "Array", "Errors", "Machine", "Pose", "Rows", "difference", "jacobian", "of_load", "of_weight"]

Array = NDArray[np.float64]
Pose = tuple[Array, Array]
"""Positions `s x 3` [m] and rotation matrices `s x 3 x 3` at the joints of `s` rows."""
Errors = Mapping[str, Any]
"""What a cause changes: `joints` (added, `s x n`), `growth` (relative, of all lengths), or sizes of a machine."""
GRAVITY = 9.81
"""[m/s^2]"""


@dataclass
class Rows:
    """Rows of a plan.

    Attributes:
        joints: `s x n` [rad or m].
        columns: what is recorded beside joints and pose, `s` each: time [s], temperature [degC], load_x ... [N] in the
            machine's frame, direction1 ... [1], speed1 ... [rad/s or m/s].
        acceleration: `s x n`, where the machine moves while it is measured.
    """

    joints: Array
    columns: dict[str, Array]
    acceleration: Array | None = None

    def of_joints(self, name: str) -> Array:
        """The columns `direction` or `speed` of all joints, `s x n`."""
        return np.stack([self.columns[f"{name}{i + 1}"] for i in range(self.joints.shape[1])], -1)

    @property
    def load(self) -> Array:
        """Force at the tool in the machine's frame, `s x 3` [N]."""
        zero = np.zeros(len(self.joints))
        return np.stack([self.columns.get(f"load_{axis}", zero) for axis in "xyz"], -1)


class Machine(ABC):
    """A machine.

    Attributes:
        name: of it.
        joint_units: `rad` or `m` of each joint.
        down: direction of gravity in its base frame.
        turns: whether its orientation can be measured.
        frames: `identity`, or `unknown` where the tracker stands somewhere and base and tool frame are to be found.
        low, high: range of its joints (arms) or of the pose (other machines).
        sizes: standard deviation and shape of the errors of its sizes [m or rad], by name (arms: none).
    """

    name: str
    joint_units: tuple[str, ...]
    down: Array = np.array([0.0, 0.0, -1.0])
    turns: bool = False
    frames: str = "identity"
    low: Array
    high: Array
    sizes: Mapping[str, tuple[float, tuple[int, ...]]] = MappingProxyType({})

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.joint_units)

    @property
    def axes(self) -> str:
        """Axes along which the position is recorded."""
        return "xyz"

    @abstractmethod
    def pose(self, joints: Array, errors: Errors | None = None) -> Pose:
        """Pose at the joints, with errors of joints and sizes."""

    @abstractmethod
    def energy(self, joints: Array) -> Array:
        """Potential energy `s` [J]."""

    @abstractmethod
    def plan(self, rows: int, rng: np.random.Generator, kind: str) -> Array:
        """Joints of about so many rows: `random`, a `grid`, or a `cube` (some places, five times over)."""

    @abstractmethod
    def told(self) -> tuple[str, dict[str, Any]]:
        """The mechanism as the diagnosis is told it: a name with its keys, or the text of a file."""


def difference(one: Pose, other: Pose) -> Array:
    """The first pose less the second, `s x 6` [m, rad]."""
    return np.hstack([one[0] - other[0], Rotation.from_matrix(one[1] @ other[1].transpose(0, 2, 1)).as_rotvec()])


def jacobian(machine: Machine, joints: Array, step: float = 1e-6) -> Array:
    """Change of position and orientation per joint by central differences, `s x 6 x n`."""
    moves = step * np.eye(machine.count)
    both = [(machine.pose(joints + move), machine.pose(joints - move)) for move in moves]
    return np.stack([difference(after, before) / (2 * step) for after, before in both], -1)


def of_load(machine: Machine, rows: Rows) -> Array:
    """Torques or forces of the load at the joints, `s x n` [N m or N]."""
    return np.asarray(np.einsum("nci,nc->ni", jacobian(machine, rows.joints)[:, :3], rows.load))


def of_weight(machine: Machine, joints: Array, step: float = 1e-5) -> Array:
    """Torques or forces of the machine's own weight at the joints, `s x n` [N m or N]."""
    moves = step * np.eye(machine.count)
    return -np.stack([(machine.energy(joints + m) - machine.energy(joints - m)) / (2 * step) for m in moves], -1)
