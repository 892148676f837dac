"""Scale error of each joint: lead of a screw, gear ratio, counts of an encoder."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import by_joint
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

_GAIN = 1e-3
ZERO = {"m": 3e-4, "rad": 1e-3}
"""What a gain makes between the middle of a joint's workspace and where the joint counts from [joint's unit]."""


class JointGain:
    """Δq_i = c_i (q_i - middle of its workspace) + z_i; z (secondary): it may be 0 elsewhere than in the middle."""

    name = "joint_gain"
    kind: Kind = "joints"
    description = "joints that move by a constant share too far or too short, as by a screw's lead or a gear ratio"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Nothing is needed."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Gain and zero of each joint."""
        return tuple(
            one
            for j in situation.mechanism.joints
            for one in (
                Coefficient(j.name, "1", _GAIN, joint=j.name),
                Coefficient(f"{j.name} zero", j.unit, ZERO[j.unit], joint=j.name, secondary=True),
            )
        )

    def counted_from(self, situation: Situation) -> dict[str, int]:
        """Coefficients that multiply a joint's command less the middle of its workspace, and the number of that joint.

        A command of that middle has the joint where the zero says.
        """
        return {joint.name: i for i, joint in enumerate(situation.mechanism.joints)}

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 2n`."""
        return by_joint(torch.stack([situation.from_middle, torch.ones_like(situation.joints)], -1))
