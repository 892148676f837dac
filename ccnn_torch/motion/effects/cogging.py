"""A torque that repeats with the angle: cogging of the motor, teeth of a gear."""

from __future__ import annotations

import math

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add

FEWEST = 6.0
"""Periods in a turn: a motor has no fewer (the least common multiple of 3 slots and 2 poles), and a gear more teeth.
Fewer are a weight, or any other smooth function of the position."""
# Orders that are tried, and the largest.
_TRIED, _HIGHEST = 14, 60.0


def _orders(axis: Facts) -> list[dict[str, float]]:
    # Periods from the whole motion on.
    lowest = max(FEWEST, 2 * math.pi / axis.span) if axis.unit == "rad" else 4 * math.pi / axis.span
    ratio = max(_HIGHEST / lowest, 6.0) ** (1 / (_TRIED - 1))
    return [{"cogging_order": lowest * ratio**k} for k in range(_TRIED)]


COGGING = MotionEffect(
    "cogging",
    lambda axis: tuple(Number(wave, "torque", 0.02, (add(f"cogging_{wave}"),)) for wave in ("sin", "cos")),
    _orders,
)
