"""A machine whose joints give under the torques that its drives had in each row."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter, force_of, per_force, torque_of
from ccnn_torch.mechanisms.frames.set_ups import SetUps
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import Frame

GIVE = {"m": 1e-7, "rad": 2e-6}
"""Plausible compliance of a drive: 1e-7 m/N (10 N/µm), 2e-6 rad/(N·m)."""


class Giving(Mechanism):
    """A machine with the compliance of some joints as parameters behind its own, `compliance q2`.

    Its joints are those of the machine and, as the last columns, the force or torque of each of these drives: joint i
    is at q_i + c_i τ_i.

    Attributes:
        machine: stiff.
    """

    def __init__(self, machine: Mechanism, giving: Sequence[int]) -> None:
        """giving: numbers of the joints that give, from 0."""
        joints = [machine.joints[i] for i in giving]
        super().__init__(
            name=machine.name,
            joints=[*machine.joints, *(Coordinate(torque_of(j), force_of(j.unit)) for j in joints)],
            pose=machine.pose,
            geometry=[
                *machine.geometry,
                *(Parameter(f"compliance {j.name}", per_force(j.unit), 0.0, scale=GIVE[j.unit]) for j in joints),
            ],
            low=machine.low.tolist(),
            high=machine.high.tolist(),
            home_pose=machine.home_pose.tolist(),
            home_joints=[*machine.home_joints.tolist(), *(0.0 for _ in joints)],
        )
        self.machine, self.orientations = machine, machine.orientations
        self._moves = torch.eye(len(machine.joints), dtype=torch.float64)[list(giving)]

    def one(self, parameters: Tensor) -> Mechanism:
        """The stiff machine, of parameters `K`, in the first set-up where it was in several."""
        values = parameters[: len(self.machine.geometry)]
        return self.machine.one(values) if isinstance(self.machine, SetUps) else self.machine.with_nominal(values)

    def _stiff(self, joints: Tensor, parameters: Tensor | None) -> tuple[Tensor, Tensor]:
        """Joints where they are, and the parameters of the stiff machine."""
        values, n, k = self.resolve(parameters), len(self.machine.joints), len(self.machine.geometry)
        return joints[..., :n] + (values[..., k:] * joints[..., n:]) @ self._moves, values[..., :k]

    def forward_frame(self, joints: Tensor, parameters: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As of an arm."""
        assert isinstance(self.machine, SerialArm | SetUps)
        return self.machine.forward_frame(*self._stiff(joints, parameters))

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """As of the machine."""
        return self.machine.forward_kinematics(*self._stiff(joints, parameters), guess)

    def frame(self, pose: Tensor) -> Frame:
        """As of the machine."""
        return self.machine.frame(pose)
