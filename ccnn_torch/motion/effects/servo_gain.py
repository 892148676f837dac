"""Gain of the position control.

Of an axis of which nothing is known the proportional gain has nothing to work against; a finite gain then shows
as a lag.
"""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add, scaled


def _numbers(axis: Facts) -> tuple[Number, ...]:
    if not axis.driven:
        # The time by which the position lags, 1 over the velocity gain.
        return (Number("lag", "s", 0.03, (add("viscous"),)),)
    return (Number("proportional gain", "1", 0.5, (scaled("gain"),), 0.0),)


SERVO_GAIN = MotionEffect(
    "servo_gain",
    _numbers,
    lambda axis: ({"proportional gain": 0.3}, {"proportional gain": -0.3}) if axis.driven else ({},),
)
