"""Play between motor and joint: where a joint comes to rest depends on the side that it comes from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects._columns import by_joint
from ccnn_torch.effects._protocol import Coefficient, Kind, Shape
from ccnn_torch.effects._situation import Situation
from ccnn_torch.mechanisms import Mechanism

__all__ = ["Backlash"]

_SCALE = {"m": 1.5e-4, "rad": 2e-4}


class Backlash:
    """Δq_i = -b_i s_i / 2 + e_i w_i / 2: s the direction of approach, w how hard weight and load push, in -1..1.

    A joint rests on the flank that drove it, half the play b behind the motor's middle, unless what pushes it holds it
    on the other flank whichever way it came: then the play is not fully taken up, and e says how much of it.
    """

    name = "backlash"
    kind: Kind = "joints"
    description = "play of the drives: joints rest short of the command on the side that they come from"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """The direction of approach of at least one joint."""
        there = any(f"direction{i + 1}" in covariates for i in range(len(mechanism.joints)))
        n = len(mechanism.joints)
        return "" if there else f"the sign of each joint's last motion before it stopped: direction1[1]…direction{n}[1]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Play and soft edge of each joint whose direction is known."""
        joints = [situation.mechanism.joints[i] for i in situation.directed]
        return tuple(
            Coefficient(
                f"{j.name}{' soft edge' if secondary else ''}",
                j.unit,
                _SCALE[j.unit] * (0.3 if secondary else 1.0),
                joint=j.name,
                secondary=secondary,
                positive=not secondary,
            )
            for j in joints
            for secondary in (False, True)
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 2 · (joints whose direction is known)`."""
        columns = torch.stack([-situation.direction / 2, situation.push / 2], -1)
        return by_joint(columns, situation.directed)
