"""What an effect sees: rows of commanded joints with their covariates, and what follows from the nominal machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ccnn_torch.least_squares import jacobian_of
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.mechanisms._pose import frame_jacobian

__all__ = ["Situation", "default_gravity"]

_STANDARD = 9.80665


def default_gravity(mechanism: Mechanism) -> Tensor:
    """Along -y for a machine that moves in the x-y plane alone, else along -z; `3` [m/s²], base frame."""
    names = {c.name for c in mechanism.pose}
    flat = "z" not in names and {"x", "y"} <= names
    return torch.tensor([0.0, -_STANDARD if flat else 0.0, 0.0 if flat else -_STANDARD], dtype=torch.float64)


@dataclass(frozen=True)
class Situation:
    """Rows in the order measured, and the nominal machine in them.

    Attributes:
        mechanism: the nominal one.
        joints: commanded, `... x s x n` [SI].
        covariates: by name, `... x s` each [SI]: `time`, `temperature`, `load_NAME` (force along the pose coordinate
            NAME on the platform [N], or moment [N·m]), `direction1`…`directionN` (sign of the joint's last motion),
            `speed…`.
        gravity: `3` [m/s²], base frame.
        parameters: of the nominal machine, broadcast against the rows; None = its nominal ones.
        guess: poses near by, for mechanisms whose forward kinematics has no closed form, `... x s x p`; or None.
    """

    mechanism: Mechanism
    joints: Tensor
    covariates: Mapping[str, Tensor]
    gravity: Tensor
    parameters: Tensor | None = None
    guess: Tensor | None = None

    @cached_property
    def pose(self) -> Tensor:
        """Nominal pose at the commanded joints, `... x s x p` [SI]."""
        return self.mechanism.forward_kinematics(self.joints, self.parameters, self.guess).detach()

    @cached_property
    def jacobian(self) -> Tensor:
        """Derivative of position and rotation vector by the joints, `... x s x c x n`, c = 3 or 6."""
        return self.mechanism.jacobian(self.joints, self.parameters, self.pose).detach()

    @cached_property
    def parameter_jacobian(self) -> Tensor:
        """The same by the mechanism's parameters, `... x s x c x k`."""
        values = self.mechanism.resolve(self.parameters).expand(*self.joints.shape[:-1], -1)

        def frame(theta: Tensor) -> tuple[Tensor, Tensor | None]:
            return self.mechanism.frame(self.mechanism.forward_kinematics(self.joints, theta, self.pose))

        return frame_jacobian(frame, values).detach()

    @cached_property
    def coordinate_jacobian(self) -> Tensor:
        """Derivative of the pose coordinates by the joints, `... x s x p x n`."""

        def pose(joints: Tensor) -> Tensor:
            return self.mechanism.forward_kinematics(joints, self.parameters, self.pose)

        return jacobian_of(pose, self.joints)[1].detach()

    @cached_property
    def load_torque(self) -> Tensor:
        """What the external load asks of each joint, by virtual work, `... x s x n` [N or N·m]; 0 without a load.

        Drives hold minus this.
        """
        along = [self.covariates.get(f"load_{c.name}") for c in self.mechanism.pose]
        force = torch.stack([torch.zeros_like(self.joints[..., 0]) if q is None else q for q in along], -1)
        torque: Tensor = self.coordinate_jacobian.mT @ force.unsqueeze(-1)
        return torque.squeeze(-1)

    @cached_property
    def weight_torque(self) -> Tensor:
        """What 1 N of weight on the platform asks of each joint, `... x s x n` [N or N·m per N]."""
        down = self.gravity / torch.linalg.vector_norm(self.gravity).clamp_min(1e-300)
        torque: Tensor = self.jacobian[..., :3, :].mT @ down
        return torque

    @cached_property
    def direction(self) -> Tensor:
        """Sign of each joint's last motion, `... x s x n` [1]; 0 for a joint without such a column."""
        columns = [self.covariates.get(f"direction{i + 1}") for i in range(self.joints.shape[-1])]
        return torch.stack([torch.zeros_like(self.joints[..., 0]) if d is None else d for d in columns], -1)
