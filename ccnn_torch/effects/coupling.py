"""Motion of one joint caused by another: gears of a wrist, belts over several axes, crosstalk of encoders."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.joint_gain import ZERO
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism


class Coupling:
    """Δq_i = Σ c_ij (q_j - middle of its workspace) + z_i over j ≠ i; z (secondary): it may be 0 elsewhere."""

    name = "coupling"
    kind: Kind = "joints"
    description = "one joint's motion that moves another, as in a wrist's gears or a belt over several axes"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """A second joint."""
        return "" if len(mechanism.joints) > 1 else "a second joint: a single one has nothing to be coupled to"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One for each ordered pair of joints; a length per angle is 0.1 m a radian as likely as a share."""
        joints = situation.mechanism.joints
        size = {"m/rad": 1e-4, "rad/m": 1e-2}
        pairs = [(i, j) for i in joints for j in joints if i.name != j.name]
        units = ["1" if i.unit == j.unit else f"{i.unit}/{j.unit}" for i, j in pairs]
        found = [
            Coefficient(f"{i.name} by {j.name}", unit, size.get(unit, 1e-3), joint=i.name)
            for (i, j), unit in zip(pairs, units, strict=True)
        ]
        found += [Coefficient(f"{j.name} zero", j.unit, ZERO[j.unit], joint=j.name, secondary=True) for j in joints]
        return tuple(found)

    def counted_from(self, situation: Situation) -> dict[str, int]:
        """As of `JointGain`: the joint that moves the other one."""
        joints = situation.mechanism.joints
        return {f"{i.name} by {j.name}": k for i in joints for k, j in enumerate(joints) if i.name != j.name}

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x n²`."""
        n = situation.joints.shape[-1]
        others = torch.nonzero(~torch.eye(n, dtype=torch.bool).flatten()).squeeze(-1)
        eye = torch.eye(n, dtype=situation.joints.dtype, device=situation.joints.device)
        # moved joint, pair (i, j): 1 where the moved joint is i, times the position of joint j.
        moved = eye[:, :, None] * situation.from_middle[..., None, None, :]
        return torch.cat([moved.flatten(-2)[..., others], eye.expand(*moved.shape[:-2], n)], -1)
