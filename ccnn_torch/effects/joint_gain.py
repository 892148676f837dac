"""A scale error of each joint: a screw's lead, a gear ratio, an encoder's count."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ccnn_torch.effects._columns import by_joint
from ccnn_torch.effects._protocol import Coefficient, Kind, Shape
from ccnn_torch.effects._situation import Situation
from ccnn_torch.mechanisms import Mechanism

__all__ = ["JointGain"]


class JointGain:
    """Δq_i = c_i (q_i - middle of its workspace)."""

    name = "joint_gain"
    kind: Kind = "joints"
    description = "joints that move by a constant share too far or too short, as by a screw's lead or a gear ratio"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Nothing is needed."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a joint."""
        return tuple(Coefficient(j.name, "1", 1e-3, joint=j.name) for j in situation.mechanism.joints)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x n`."""
        return by_joint(situation.from_middle.unsqueeze(-1))
