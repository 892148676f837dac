"""Gains of the position control: the proportional one, and a damping one on the speed.

Of an axis of which nothing is known the proportional gain has nothing to work against; a finite gain then shows
as a lag.
"""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add, scaled

__all__ = ["SERVO_GAIN"]


class _ServoGain:
    name = "servo_gain"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        if not axis.driven:
            # The time by which the position lags, 1 over the velocity gain.
            return (Number("lag", "s", 0.03, (add("viscous"),)),)
        return (Number("log proportional", "1", 0.5, (scaled("gain"),), 0.0),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({"log proportional": 0.3}, {"log proportional": -0.3}) if axis.driven else ({},)


SERVO_GAIN = _ServoGain()
