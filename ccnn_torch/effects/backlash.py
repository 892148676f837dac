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
    """Δq_i = -b_i s_i / 2 + e_i tanh(w_i) / 2 + h_i s_i tanh²(w_i) / 2: s the direction of approach, w the push.

    A joint rests on the flank that drove it, half the play b behind the motor's middle, unless weight and load push it
    onto the other flank whichever way it came. Friction f holds it with its motion, so that it rests at
    b/2 tanh((w - f s) / edge): the part that does not depend on s is odd in w (e, the soft edge), the part with s grows
    less where w is large (h, held).
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
        """Play, soft edge and what is held, of each joint whose direction is known."""
        parts = (("", 1.0), (" soft edge", 0.5), (" held", 0.5))
        return tuple(
            Coefficient(
                f"{j.name}{part}", j.unit, _SCALE[j.unit] * size, joint=j.name, secondary=size < 1, positive=size == 1
            )
            for j in (situation.mechanism.joints[i] for i in situation.directed)
            for part, size in parts
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """None."""
        return ()

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 3 · (joints whose direction is known)`."""
        pushed, side = torch.tanh(situation.push), situation.direction
        columns = torch.stack([-side / 2, pushed / 2, side * pushed.square() / 2], -1)
        return by_joint(columns, situation.directed)
