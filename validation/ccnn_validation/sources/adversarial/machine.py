"""The machines of this source as numpy functions: poses, twists between poses, and derivatives by differences."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from ccnn_torch.mechanisms import Mechanism, load_mechanism

__all__ = ["ARM", "PARALLEL", "Array", "Machine", "machine_of"]

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

PARALLEL = ("five_bar", "tripod", "stewart", "delta", "delta_linear")
ARM = "arm"

_ARM_TEXT = """robot: bench arm
dof: 6
joints: [q1, q2, q3, q4, q5, q6]
convention: {convention} Denavit-Hartenberg
units: {{length: mm, angle: rad}}
a: [62.0, 418.0, 31.0, 0, 0, 0]
alpha: [-1.5707963267948966, 0, -1.5707963267948966, 1.5707963267948966, -1.5707963267948966, 0]
d: [383.0, 0, 0, 407.0, 0, 88.0]
theta: [0, 0, 0, 0, 0, 0]
base_frame: [120.0, -210.0, 790.0, 0.0, 0.0, 0.4]
tool_frame: [21.0, 0.0, 118.0, 0.0, 0.3, 0.0]
"""
_ARM_LOW = (-1.6, -2.2, -0.5, -1.5, 0.5, -2.0)
_ARM_HIGH = (1.6, -0.9, 0.9, 1.5, 1.6, 2.0)
# Weight of rotation against position [m/rad] where the condition of a configuration is judged.
_WORST, _LEVER = 40.0, 0.3
_STEP = 1e-5


@dataclass(frozen=True)
class Machine:
    """A machine.

    Attributes:
        name: of the mechanism, or `arm`.
        text: what the case names as its mechanism: the same name, or the arm's geometry file.
        model: the project's mechanism with the nominal parameters.
        keys: keys of the mechanism's constructor.
    """

    name: str
    text: str
    model: Mechanism
    keys: Mapping[str, object] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Number of joints, n."""
        return len(self.model.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(j.name for j in self.model.joints)

    @property
    def pose_names(self) -> tuple[str, ...]:
        """Names of the pose coordinates."""
        return tuple(c.name for c in self.model.pose)

    @property
    def pose_units(self) -> tuple[str, ...]:
        """Units of the pose coordinates: m or rad."""
        return tuple(c.unit for c in self.model.pose)

    @property
    def turning(self) -> NDArray[np.bool_]:
        """Which joints turn, `n`."""
        return np.array([j.unit == "rad" for j in self.model.joints])

    @property
    def spatial(self) -> bool:
        """Whether the pose ends in a rotation vector."""
        return self.pose_names[-3:] == ("rx", "ry", "rz")

    @property
    def nominal(self) -> Array:
        """Nominal parameters, `k` [SI]."""
        return _array(self.model.nominal)

    def forward(self, joints: Array, parameters: Array | None = None, near: Array | None = None) -> Array:
        """Poses `... x p` of joints `... x n`; parameters broadcast, `near` is a pose close by."""
        with torch.no_grad():
            values, guess = (None if x is None else _tensor(x) for x in (parameters, near))
            return _array(self.model.forward_kinematics(_tensor(joints), values, guess))

    def inverse(self, pose: Array, parameters: Array | None = None) -> Array:
        """Joints `... x n` of poses `... x p` of a parallel machine, closed form."""
        with torch.no_grad():
            return _array(self.model.solve_inverse(_tensor(pose), None if parameters is None else _tensor(parameters)))

    def twist(self, after: Array, before: Array) -> Array:
        """From one pose to the other, `... x p`: differences [m, rad], a rotation vector in the base frame."""
        change = np.array(after - before)
        if self.spatial:
            first, last = (Rotation.from_rotvec(x[..., -3:].reshape(-1, 3)) for x in (before, after))
            change[..., -3:] = (last * first.inv()).as_rotvec().reshape(*change.shape[:-1], 3)
        return change

    def moved(self, pose: Array, twist: Array) -> Array:
        """The pose after a twist, `... x p`."""
        after = np.array(pose + twist)
        if self.spatial:
            before, turn = (
                Rotation.from_rotvec(np.array(np.broadcast_to(x, after.shape)[..., -3:]).reshape(-1, 3))
                for x in (pose, twist)
            )
            after[..., -3:] = (turn * before).as_rotvec().reshape(*after.shape[:-1], 3)
        return after

    def jacobian(self, joints: Array, pose: Array) -> Array:
        """Twist by each joint, `s x p x n`, by central differences; of the closed-form inverse where there is one."""
        if self.name == ARM:
            shifts = _STEP * np.eye(self.count)[:, None, :]
            change = self.twist(self.forward(joints + shifts), self.forward(joints - shifts)) / (2 * _STEP)
            return np.moveaxis(change, 0, -1)
        shifts = _STEP * np.eye(len(self.pose_names))[:, None, :]
        change = (self.inverse(self.moved(pose, shifts)) - self.inverse(self.moved(pose, -shifts))) / (2 * _STEP)
        inverse = np.moveaxis(change, 0, -1)
        good: Rows = np.asarray(np.isfinite(inverse).all((-1, -2)))
        good[good] &= np.abs(np.linalg.det(inverse[good])) > 1e-12
        found = np.full_like(inverse, np.nan)
        found[good] = np.linalg.inv(inverse[good])
        return found

    def parameter_jacobian(self, joints: Array, pose: Array, which: NDArray[np.int64]) -> Array:
        """Twist by some of the parameters, `s x p x len(which)`, in the same way."""
        shifts = _STEP * np.eye(len(self.nominal))[which][:, None, :]
        if self.name == ARM:
            ahead, behind = (self.forward(joints, self.nominal + sign * shifts) for sign in (1.0, -1.0))
            return np.moveaxis(self.twist(ahead, behind) / (2 * _STEP), 0, -1)
        ahead, behind = (self.inverse(pose, self.nominal + sign * shifts) for sign in (1.0, -1.0))
        # Joints held: what the inverse changes by is taken back by the pose.
        return -self.jacobian(joints, pose) @ np.moveaxis((ahead - behind) / (2 * _STEP), 0, -1)

    def parameters_like(self, *beginnings: str, unit: str = "m") -> NDArray[np.int64]:
        """Numbers of the parameters of a unit whose names begin with one of the texts (all when none is given)."""
        outer = ("base_", "tool_") if self.name == ARM else ()
        found = [
            i
            for i, g in enumerate(self.model.geometry)
            if g.unit == unit and not g.name.startswith(outer or ("\0",)) and g.name.startswith(beginnings or ("",))
        ]
        return np.array(found, dtype=np.int64)

    def place(self, cube: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Joints `s x n` and poses `s x p` of points of the unit cube, and which are well away from singularities.

        The cube is the inner part of the box of poses, for the arm the box of joints.
        """
        if self.name == ARM:
            joints = np.array(_ARM_LOW) + cube * (np.array(_ARM_HIGH) - np.array(_ARM_LOW))
            pose = self.forward(joints)
        else:
            low, high = (_array(b) for b in self.model.bounds)
            share = 0.6 if self.name == "five_bar" else 0.85
            pose = (low + high) / 2 + share * (cube - 0.5) * (high - low)
            joints = self.inverse(pose)
        jacobian = self.jacobian(joints, pose)
        jacobian = np.asarray(jacobian * np.where(np.array(self.pose_units) == "rad", _LEVER, 1.0)[:, None])
        good: Rows = np.asarray(np.isfinite(jacobian).all((-1, -2)))
        values = np.linalg.svd(np.where(good[:, None, None], jacobian, 0.0).astype(np.float64), compute_uv=False)
        return joints, pose, good & (values[:, 0] < _WORST * values[:, -1])

    @functools.cached_property
    def span(self) -> tuple[Array, Array]:
        """Lowest and highest value of each joint within the cube, `n` each [SI]."""
        joints, _, good = self.place(np.random.default_rng(0).random((300, len(self.pose_names))))
        return joints[good].min(0), joints[good].max(0)

    @property
    def middle(self) -> Array:
        """Middle of that, `n` [SI]."""
        return np.asarray((self.span[0] + self.span[1]) / 2)


@functools.cache
def machine_of(name: str, convention: str = "standard") -> Machine:
    """The machine of a name; the arm's geometry file may state a wrong convention."""
    if name != ARM:
        return Machine(name, name, load_mechanism(name))
    text = _ARM_TEXT.format(convention=convention)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.yaml"
        path.write_text(text, encoding="utf-8")
        return Machine(ARM, text, load_mechanism(str(path)))


def _tensor(values: Array) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float64))


def _array(values: Tensor) -> Array:
    return np.asarray(values.numpy(), dtype=np.float64)
