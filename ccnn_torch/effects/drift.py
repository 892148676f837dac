"""Drift of the joints in time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import by_joint, of_rows, one_by_one
from ccnn_torch.effects.lag import elapsed
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

# In an hour.
_SCALE = {"m": 3e-5, "rad": 5e-5}
_HOUR = 3600.0
# Terms of the random walk's expansion; what they leave out is 5 % of its variance at its end.
_WALK = 4
_RATES = 8
# The logarithm's time constant, as shares of the whole time.
_SHARES = (0.003, 1.0)


class Drift:
    """Δq_i = a_i t + b_i ln(1 + t / r) + a random walk; t since the first row.

    r is how long it takes for the drift to slow down. The random walk (secondary) is the Karhunen-Loève expansion of
    Brownian motion over the time T of the rows, its first four terms √2 sin((k - ½) π t / T) / ((k - ½) π).
    """

    name = "drift"
    kind: Kind = "joints"
    description = "drift of the joints in time: linear, logarithmic, or random"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Time."""
        return "" if "time" in covariates else "the time of each row: time[s]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Steady, logarithmic, and the terms of the random walk, joint by joint."""
        found = []
        for j in situation.mechanism.joints:
            size = _SCALE[j.unit]
            found.append(Coefficient(f"{j.name} steady", f"{j.unit}/s", size / _HOUR, joint=j.name))
            found.append(Coefficient(f"{j.name} slowing", j.unit, size / 3, joint=j.name))
            found += [
                Coefficient(f"{j.name} walk {k + 1}", j.unit, size / 2, joint=j.name, secondary=True)
                for k in range(_WALK)
            ]
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The time in which the drift slows down."""
        whole = _duration(situation)
        low, high = (math.log(share * whole) for share in _SHARES)
        step = (high - low) / (_RATES - 1)
        return (Shape("slowing", "s", tuple(math.exp(low + step * k) for k in range(_RATES)), _slowing(situation)),)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 6n`."""
        return by_joint(self._moves(situation, shape))

    def one_by_one(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """The same in some of the rows, without its zeros: what each coefficient does to the joint that it moves.

        rows: which, `t`; None = all. Returns `... x t x m`.
        """
        return one_by_one(of_rows(self._moves(situation, shape), rows, -3))

    def _moves(self, situation: Situation, shape: Tensor) -> Tensor:
        time = elapsed(situation.covariates["time"]).expand(situation.joints.shape[:-1])
        whole = _duration(situation)
        share = time / whole
        rate = shape.clamp_min(1e-9)
        parts = [time, torch.log1p(time / rate)]
        turns = [(k + 0.5) * math.pi for k in range(_WALK)]
        parts += [math.sqrt(2) * torch.sin(turn * share) / turn for turn in turns]
        same = torch.stack(torch.broadcast_tensors(*parts), -1)  # type: ignore[no-untyped-call]
        return same.unsqueeze(-2).expand(*same.shape[:-1], situation.joints.shape[-1], -1)


def _duration(situation: Situation) -> float:
    """Of the longest set of rows [s]."""
    return max(float(elapsed(situation.covariates["time"]).max()), 1e-6)


def _slowing(situation: Situation) -> tuple[int, ...]:
    return tuple((2 + _WALK) * i + 1 for i in range(len(situation.mechanism.joints)))
