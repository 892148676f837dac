"""Backlash between motor and joint: the rest position depends on the direction of approach."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import by_joint, of_rows, one_by_one
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import PLATFORM_WEIGHT, WEIGHTS, Situation
from ccnn_torch.mechanisms import Mechanism

_SCALE = {"m": 1.5e-4, "rad": 2e-4}
# Pushes at which a joint leaves its flank, in units of the usual one; and how soft the change is.
_HOLDS = (0.1, 0.2, 0.4, 0.7, 1.2, 2.0, 3.5, 6.0, 60.0)
_SOFT = 0.3
_EDGES = ((" softer", 2 * _SOFT), (" harder", 0.5 * _SOFT))


class Backlash:
    """Δq_i = b_i / 2 tanh((w_i / h - s_i) / e) / tanh(1 / e): s the direction of approach, w the push on the joint.

    A joint rests on the flank that drove it, half the backlash b behind the motor's middle, unless weight and load push
    it onto the other flank whichever way it came; friction holds it there up to the push h. The machine's weight and h
    are shapes, h for all joints alike; without a push that reaches h this is -b s / 2. Secondary: the same with an edge
    twice and half as soft as e = 0.3, less the part with e, so that b stays the backlash.
    """

    name = "backlash"
    kind: Kind = "joints"
    description = "backlash of the drives: the rest position depends on the direction of approach"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """The direction of approach of at least one joint."""
        there = any(f"direction{i + 1}" in covariates for i in range(len(mechanism.joints)))
        n = len(mechanism.joints)
        return "" if there else f"the sign of each joint's last motion before it stopped: direction1[1]…direction{n}[1]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Play, and what a softer and a harder edge change, of each joint whose direction is known."""
        parts = (("", 1.0, False), *((edge, 0.5, True) for edge, _ in _EDGES))
        return tuple(
            Coefficient(
                f"{j.name}{part}",
                j.unit,
                _SCALE[j.unit] * size,
                joint=j.name,
                secondary=mends,
                mends=mends,
                positive=not mends,
            )
            for j in (situation.mechanism.joints[i] for i in situation.directed)
            for part, size, mends in parts
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The machine's weight beside a load that was recorded, and the push that friction holds."""
        hold = Shape("hold", "1", _HOLDS, usual=_HOLDS[-1])
        return (Shape("weight", "N", WEIGHTS, usual=PLATFORM_WEIGHT), hold) if situation.loaded else (hold,)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 3 · (joints whose direction is known)`."""
        return by_joint(self._moves(situation, shape), situation.directed)

    def one_by_one(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """The same in some of the rows, without its zeros: what each coefficient does to the joint that it moves.

        rows: which, `t`; None = all. Returns `... x t x m`.
        """
        return one_by_one(self._moves(situation, shape, rows), situation.directed)

    def _moves(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        weight = shape[..., 0] if situation.loaded else shape.new_tensor(PLATFORM_WEIGHT)
        hold = shape[..., -1, None, None]
        left = situation.push(weight, rows) / hold - of_rows(situation.direction, rows)
        rest = _rest(left, _SOFT)
        edges = [_rest(left, soft) - rest for _, soft in _EDGES]
        return torch.stack([rest, *edges], -1)


def _rest(left: Tensor, soft: float) -> Tensor:
    """Where a joint rests within its backlash, ±1/2 where nothing pushes it off its flank."""
    return torch.tanh(left / soft) / (2 * math.tanh(1 / soft))
