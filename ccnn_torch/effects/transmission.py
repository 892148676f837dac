"""Periodic errors of the drives: eccentricity of gears, wobble of screws, interpolation of encoders."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.effects.columns import by_joint, of_rows, one_by_one
from ccnn_torch.effects.protocol import Coefficient, Kind, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

_SCALE = {"m": 5e-5, "rad": 1e-4}
# Waves: harmonics of the period, and how large they are likely to be.
_HARMONICS = tuple(
    (f"{wave}{'' if k == 1 else f' {k}'}", size)
    for k, size in ((1, 1.0), (2, 0.5), (3, 0.02), (4, 0.02))
    for wave in ("sin", "cos")
)
# Harmonics of a turn; those of a harmonic drive's ball cage and teeth lie near the hundredth.
_MOST_PER_TURN = 130
# Periods over the travel of a sliding joint; fewer than the first are indistinguishable from a bend.
_PERIODS = (1.5, 40.0)
# Of a period over the travel between neighbours of the grid; a wave is lost from a whole one on.
_PERIOD_STEP = 1 / 3


class Transmission:
    """Δq_i = a_i sin(f_i q_i) + b_i cos(f_i q_i) and their harmonics up to the fourth; f_i unknown.

    The second may be as large as the first (a gear's two teeth in mesh), the third and the fourth are small.
    """

    name = "transmission"
    kind: Kind = "joints"
    description = "a periodic error of a drive, of unknown period, as of a gear, a screw or an encoder"
    ordered = False

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Nothing is needed."""
        return ""

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Sine and cosine of a joint's period, then of its harmonics, joint by joint."""
        return tuple(
            Coefficient(f"{j.name} {wave}", j.unit, _SCALE[j.unit] * size, joint=j.name, secondary=size < 1)
            for j in situation.mechanism.joints
            for wave, size in _HARMONICS
        )

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The frequency of each joint's error: whole numbers a turn, or from 1.5 periods over the travel upward."""
        low, high = (edge.tolist() for edge in situation.workspace)
        count = len(_HARMONICS)
        return tuple(
            Shape(
                f"{j.name} frequency",
                f"rad/{j.unit}" if j.unit != "rad" else "1",
                _frequencies(j.unit, high[i] - low[i]),
                tuple(range(count * i, count * (i + 1))),
                refined=j.unit != "rad",
            )
            for i, j in enumerate(situation.mechanism.joints)
        )

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x 8n`."""
        return by_joint(self._moves(situation.joints, shape))

    def one_by_one(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """The same in some of the rows, without its zeros: what each coefficient does to the joint that it moves.

        rows: which, `t`; None = all. Returns `... x t x m`.
        """
        return one_by_one(self._moves(of_rows(situation.joints, rows), shape))

    def _moves(self, joints: Tensor, shape: Tensor) -> Tensor:
        angle = joints * shape.unsqueeze(-2)
        sine, cosine = torch.sin(angle), torch.cos(angle)
        waves = [sine, cosine]
        # The next harmonic by the sum of angles: sines are what a grid of hundreds of frequencies takes its time for.
        for _ in range(len(_HARMONICS) // 2 - 1):
            s, c = waves[-2:]
            waves += [s * cosine + c * sine, c * cosine - s * sine]
        return torch.stack(waves, -1)


def _frequencies(unit: str, travel: float) -> tuple[float, ...]:
    """Grid of a joint's frequencies, ascending [rad per joint's unit]."""
    if unit == "rad":
        return tuple(float(k) for k in range(1, _MOST_PER_TURN + 1))
    steps = round((_PERIODS[1] - _PERIODS[0]) / _PERIOD_STEP)
    whole = 2 * math.pi / max(travel, 1e-6)
    return tuple(whole * (_PERIODS[0] + _PERIOD_STEP * k) for k in range(steps + 1))
