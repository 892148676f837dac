"""Play between motor and joint: where a joint comes to rest depends on the side that it comes from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects._columns import by_joint
from ccnn_torch.effects._protocol import Coefficient, Kind, Shape
from ccnn_torch.effects._situation import PLATFORM_WEIGHT, WEIGHTS, Situation
from ccnn_torch.mechanisms import Mechanism

__all__ = ["Backlash"]

_SCALE = {"m": 1.5e-4, "rad": 2e-4}
# Pushes at which a joint leaves its flank, in units of the usual one, and how soft the change is.
_HOLDS = (0.1, 0.2, 0.4, 0.7, 1.2, 2.0, 3.5, 6.0)
_SOFT = 0.35


class Backlash:
    """Δq_i = -b_i s_i / 2 + e_i D(w_i) / 2 + h_i s_i (1 - B(w_i)) / 2: s the direction of approach, w the push.

    A joint rests on the flank that drove it, half the play b behind the motor's middle, unless weight and load push it
    onto the other flank whichever way it came. Friction f holds it with its motion, so that it rests at
    b/2 tanh((w - f s) / edge): the part that does not depend on s is odd in w (e, the soft edge), D = (t₊ + t₋) / 2, and
    the part with s is even and fades where w is large (h, held), B = (t₊ - t₋) / 2, with
    t± = tanh((w ± hold) / (0.35 hold)). Weight and hold, the push at which friction gives, are shapes.
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
        """The machine's weight beside a load that was recorded, and the push that friction holds."""
        secondary = tuple(k for k, c in enumerate(self.coefficients(situation)) if c.secondary)
        hold = Shape("hold", "1", _HOLDS, secondary)
        return (Shape("weight", "N", WEIGHTS, secondary), hold) if situation.loaded else (hold,)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 3 · (joints whose direction is known)`."""
        weight = shape[..., 0] if situation.loaded else shape.new_tensor(PLATFORM_WEIGHT)
        push, side = situation.push(weight), situation.direction
        hold = shape[..., -1, None, None]
        up, down = (torch.tanh((push + sign * hold) / (_SOFT * hold)) for sign in (1.0, -1.0))
        held = 1 - (up - down) / 2
        columns = torch.broadcast_tensors(-side / 2, (up + down) / 4, side * held / 2)  # type: ignore[no-untyped-call]
        return by_joint(torch.stack(columns, -1), situation.directed)
