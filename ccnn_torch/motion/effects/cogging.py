"""A torque that repeats with the angle: cogging of the motor, teeth of a gear, an eccentric wheel."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["COGGING"]

# Orders that are tried, and the largest.
_TRIED, _HIGHEST = 14, 60.0


class _Cogging:
    name = "cogging"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (
            Number("sin", "torque", 0.02, (add("cogging_sin"),)),
            Number("cos", "torque", 0.02, (add("cogging_cos"),)),
        )

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        # Periods from the whole motion on; below a second order it is a weight.
        lowest = max(2.0, 2 * math.pi / axis.span) if axis.unit == "rad" else 4 * math.pi / axis.span
        ratio = max(_HIGHEST / lowest, 6.0) ** (1 / (_TRIED - 1))
        return tuple({"cogging_order": lowest * ratio**k} for k in range(_TRIED))


COGGING = _Cogging()
