"""The part of the pseudoerror that identified link parameters explain, as a module that can be exported."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ccnn_torch.mechanisms.serial import SerialArm

__all__ = ["GeometricDeviation"]


class GeometricDeviation(nn.Module):
    """Joint deviation with which the nominal arm stands where the identified arm stands: δ(q) = g(f(q)) - q.

    f is the identified forward kinematics, g the nominal inverse kinematics, here a few damped Gauss-Newton steps from
    q. Near a singularity the damping bounds δ. Only sums, products, quotients, sines and cosines: no call of a solver
    and no arc function, so that the graph runs in ONNX Runtime in double.

    Attributes:
        nominal, identified: all parameters of the arm, frames included, `k` [SI].
        weight: of the pose's differences, 1 for position and `rotation_weight` for orientation, `c`.
        damped, unit: `damping`² and 1 on a diagonal, `n x n`.
    """

    nominal: Tensor
    identified: Tensor
    weight: Tensor
    damped: Tensor
    unit: Tensor

    def __init__(
        self,
        arm: SerialArm,
        nominal: Tensor,
        identified: Tensor,
        rotation_weight: float = 0.3,
        damping: float = 0.03,
        steps: int = 3,
    ) -> None:
        """Take the two geometries.

        Args:
            arm: the arm.
            nominal: parameters whose links are the maker's and whose frames were fitted to them, `k` [SI].
            identified: parameters with links and frames fitted together, `k` [SI].
            rotation_weight: [m/rad].
            damping: directions in which a joint moves the tool less than this are held back [m per joint unit].
            steps: Gauss-Newton steps.
        """
        super().__init__()
        self.arm = arm
        self.register_buffer("nominal", nominal.clone())
        self.register_buffer("identified", identified.clone())
        # Buffers, since the ONNX exporter writes plain numbers in single precision.
        weight = [1.0] * 3 + [rotation_weight] * (3 if arm.orientation != "none" else 0)
        self.register_buffer("weight", torch.tensor(weight, dtype=torch.float64))
        self.register_buffer("damped", damping**2 * torch.eye(len(arm.joints), dtype=torch.float64))
        self.register_buffer("unit", torch.eye(len(arm.joints), dtype=torch.float64))
        self.steps = steps

    def forward(self, joints: Tensor) -> Tensor:
        """joints: commanded, `... x n` [SI]; returns δ, `... x n` [SI]."""
        position, rotation = self.arm.forward_frame(joints, self.identified)
        deviation = torch.zeros_like(joints)
        for _ in range(self.steps):
            here, turned = self.arm.forward_frame(joints + deviation, self.nominal)
            gap = position - here
            if self.arm.orientation != "none":
                gap = torch.cat([gap, _small_turn(rotation @ turned.mT)], dim=-1)
            slope = self.arm.jacobian(joints + deviation, self.nominal) * self.weight[:, None]
            normal = slope.mT @ slope + self.damped
            deviation = deviation + _solve(normal, slope.mT @ (self.weight * gap)[..., None], self.unit)
        return deviation


def _small_turn(rotation: Tensor) -> Tensor:
    """Rotation vector of a small rotation, right to the third order of the angle. rotation: `... x 3 x 3`."""
    skew = (rotation - rotation.mT) / 2
    return torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)


def _solve(matrix: Tensor, right: Tensor, unit: Tensor) -> Tensor:
    """Gauss-Jordan without pivoting, unrolled: the matrix is positive definite. `... x n x n`, `... x n x 1`."""
    table = torch.cat([matrix, right], dim=-1)
    count = matrix.shape[-1]
    for k in range(count):
        row = table[..., k : k + 1, :] / table[..., k : k + 1, k : k + 1]
        table = table - (table[..., :, k : k + 1] - unit[:, k : k + 1]) * row
    return table[..., count]
