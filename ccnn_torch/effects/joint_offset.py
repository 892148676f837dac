"""Constant error of each joint: mounting of an encoder, reference position."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter, plausible_error
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism


class JointOffset:
    """Δq_i = c_i."""

    name = "joint_offset"
    kind: Kind = "joints"
    description = "a constant error of each joint, as of a reference switch or an encoder's zero"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Nothing is needed."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a joint."""
        return tuple(
            Coefficient(j.name, j.unit, plausible_error(Parameter(j.name, j.unit, 0.0)), joint=j.name)
            for j in situation.mechanism.joints
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """The identity at every row, `... x s x n x n`."""
        n = situation.joints.shape[-1]
        eye = torch.eye(n, dtype=situation.joints.dtype, device=situation.joints.device)
        return eye.expand(*situation.joints.shape[:-1], n, n)
