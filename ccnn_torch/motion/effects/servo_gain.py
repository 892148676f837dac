"""Gain of the position control.

Of an axis of which nothing is known the proportional gain has nothing to work against; a finite gain then shows
as a lag.
"""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add, scaled

_PROPORTIONAL, _DERIVATIVE = "proportional gain", "derivative gain"


def _numbers(axis: Facts) -> tuple[Number, ...]:
    if not axis.driven:
        # The time by which the position lags, 1 over the velocity gain.
        return (Number("lag", "s", 0.03, (add("viscous"),)),)
    return (
        Number(_PROPORTIONAL, "1", 0.5, (scaled("gain"),), 0.0),
        # Of command less position, over the proportional gain; one of the position alone is viscous friction.
        Number(_DERIVATIVE, "s", 0.03, (add("derivative"),)),
    )


def _shapes(axis: Facts) -> list[dict[str, float | None]]:
    """One gain or the other."""
    if not axis.driven:
        return [{}]
    derivative = (0.01, -0.01) if axis.nominal.get("derivative") else (0.01,)
    either = [{_PROPORTIONAL: v, _DERIVATIVE: None} for v in (0.3, -0.3)]
    return [*either, *({_PROPORTIONAL: None, _DERIVATIVE: v} for v in derivative)]


SERVO_GAIN = MotionEffect("servo_gain", _numbers, _shapes)
