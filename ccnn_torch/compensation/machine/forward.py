"""Where a machine's frame is, how the joints move it, and that for forward kinematics of closed form."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.compensation.geometry.closed_form import frame_slope
from ccnn_torch.mechanisms import Mechanism

# A Jacobian that no machine has [m or rad per joint unit].
_STEEPEST = 1e6


class Placed(NamedTuple):
    """The frame of the pose, and its derivative.

    Attributes:
        position: `... x 3` [m].
        rotation: `... x 3 x 3`; None where the pose has no orientation.
        linear, turning: velocity and rate of rotation by each joint, base frame, `... x n x 3` [m, rad per joint unit].
        lost: 1 where the machine has no such pose, else 0, `... x 1`; None where it has one everywhere.
    """

    position: Tensor
    rotation: Tensor | None
    linear: Tensor
    turning: Tensor
    lost: Tensor | None = None

    def shifted(self, shift: Tensor) -> Placed:
        """Moved by position and rotation vector `... x c` [m, rad] in the base frame; the derivative is kept.

        The exponential of the rotation is its series, right to rounding below 0.3 rad.
        """
        position = self.position + shift[..., :3]
        if self.rotation is None or shift.shape[-1] == 3:
            return self._replace(position=position)
        vector = shift[..., 3:]
        zero = torch.zeros_like(vector[..., 0])
        x, y, z = vector.unbind(-1)
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*zero.shape, 3, 3)
        square = (vector * vector).sum(-1)[..., None, None]
        sine = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
        cosine = (1 - square / 12 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90)))) / 2
        rotation = self.rotation + (sine * skew + cosine * (skew @ skew)) @ self.rotation
        return self._replace(position=position, rotation=rotation)


class ForwardForm(nn.Module):
    """One geometry of a machine whose forward kinematics is a closed form; derivatives by central differences."""

    values: Tensor

    def __init__(self, mechanism: Mechanism, values: Tensor) -> None:
        """values: all parameters, `k` [SI]."""
        super().__init__()
        self._mechanism = (mechanism,)
        self.register_buffer("values", values.detach().clone(), persistent=False)

    def at(self, joints: Tensor) -> Placed:
        """At joints `... x n` [SI]; in its home pose, which nothing moves, where the machine has none."""
        mechanism = self._mechanism[0]
        rows = joints.reshape(-1, joints.shape[-1])
        pose = mechanism.forward_kinematics(rows, self.values)
        there = torch.isfinite(pose).all(-1, keepdim=True)
        position, rotation = mechanism.frame(torch.where(there, pose, mechanism.home_pose))
        stand = torch.where(there, rows, mechanism.home_joints)
        rates = frame_slope(lambda q: mechanism.frame(mechanism.forward_kinematics(q, self.values)), stand).mT
        # At the edge of what it reaches a neighbour has no pose.
        steep = torch.relu(rates.abs() - _STEEPEST).sum((-2, -1)).unsqueeze(-1)
        there = torch.logical_and(there, steep <= 0)
        rates = torch.where(there.unsqueeze(-1), rates, torch.zeros_like(rates))
        lead = joints.shape[:-1]

        def shaped(value: Tensor) -> Tensor:
            return value.reshape(*lead, *value.shape[1:])

        turned = None if rotation is None else shaped(rotation)
        lost = torch.where(there, 0.0, 1.0)
        return Placed(shaped(position), turned, shaped(rates[..., :3]), shaped(rates[..., 3:]), shaped(lost))
