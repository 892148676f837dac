"""Identified link parameters of a serial arm as a deviation of its joints, in operators that every export has."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.mechanisms import SerialArm

__all__ = ["SerialGeometry"]

# In a redundant arm the joints are not determined by the pose; so much damping [m per joint unit] always keeps the
# normal equations regular, and leaves out less than 1e-4 of what a lever of 0.1 m corrects.
_LEAST_DAMPING = 1e-3
_STEPS = 2


class SerialGeometry(nn.Module):
    """Joint deviation with which the nominal arm stands where the identified arm stands: δ(q) = g(f(q)) - q.

    f is the identified forward kinematics, g the nominal inverse kinematics: here two damped Gauss-Newton steps from q
    that share the Jacobian at q, which the deviation (milliradians) changes by thousandths. Near a singularity the
    damping bounds δ. Only sums, products, quotients, sines and cosines: no solver is called and no arc function, so
    that the graph runs in ONNX Runtime in double.

    Attributes:
        nominal, identified: all parameters of the arm, frames included, `... x k` [SI].
        extrapolates: what is true of the links is true outside the domain of the training rows as well.
        export_tolerance: share of the limit to which exports agree: differences of lengths near 1 m are rounded.
    """

    extrapolates = True
    export_tolerance = 1e-9
    nominal: Tensor
    identified: Tensor
    _weight: Tensor
    _damped: Tensor
    _unit: Tensor

    def __init__(
        self, arm: SerialArm, nominal: Tensor, identified: Tensor, rotation_weight: float = 0.04, damping: float = 0.01
    ) -> None:
        """Take the two geometries.

        Args:
            arm: the arm.
            nominal: parameters whose links are the maker's and whose frames were fitted to them, `... x k` [SI].
            identified: parameters with links and frames fitted together, `... x k` [SI].
            rotation_weight: of orientation against position [m/rad].
            damping: directions in which a joint moves the tool less than this are held back [m per joint unit]; at
                least 1e-3.
        """
        super().__init__()
        self.arm = arm
        self.rotation_weight, self.damping = rotation_weight, damping
        self.register_buffer("nominal", nominal.detach().clone())
        self.register_buffer("identified", identified.detach().clone())
        # Buffers, since the ONNX exporter writes plain numbers in single precision.
        weight = torch.ones(6 if arm.orientation != "none" else 3, dtype=torch.float64)
        weight[3:] = rotation_weight
        unit = torch.eye(len(arm.joints), dtype=torch.float64)
        self.register_buffer("_weight", weight, persistent=False)
        self.register_buffer("_damped", max(damping, _LEAST_DAMPING) ** 2 * unit, persistent=False)
        self.register_buffer("_unit", unit, persistent=False)

    def forward(self, joints: Tensor) -> Tensor:
        """joints: commanded, `... x n` [SI]; returns δ, `... x n` [SI]."""
        position, rotation = self.arm.forward_frame(joints, self.identified)
        slope = self.arm.jacobian(joints, self.nominal) * self._weight[:, None]
        normal = slope.mT @ slope + self._damped
        deviation = torch.zeros_like(joints)
        for _ in range(_STEPS):
            here, turned = self.arm.forward_frame(joints + deviation, self.nominal)
            gap = position - here
            if self.arm.orientation != "none":
                gap = torch.cat([gap, _small_turn(rotation @ turned.mT)], dim=-1)
            deviation = deviation + _solve(normal, slope.mT @ (self._weight * gap)[..., None], self._unit)
        return deviation

    def repeat(self, index: int) -> SerialGeometry:
        """The deviation of one repeat of parameters `r x 1 x k`, which `describe` can write."""
        own = (self.nominal[index, 0], self.identified[index, 0])
        return SerialGeometry(self.arm, *own, self.rotation_weight, self.damping)

    def describe(self) -> dict[str, Any]:
        """Everything `from_description` needs; the parameters are tensors and stand beside it."""
        return {
            "kind": "serial_geometry",
            "arm": json.loads(json.dumps(self.arm.recipe["keys"])),
            "parameters": [parameter.name for parameter in self.arm.geometry],
            "rotation_weight": self.rotation_weight,
            "damping": self.damping,
        }

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> SerialGeometry:
        """The same arm with its nominal parameters twice; the tensors are loaded afterwards."""
        arm = SerialArm(**description["arm"])
        return cls(arm, arm.nominal, arm.nominal, description["rotation_weight"], description["damping"])


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
