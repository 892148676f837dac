"""Supply voltage: the motor's strength and its limit go with it, damping and friction do not."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add, scaled

# A smaller change of the recorded voltage shows nothing.
_LEAST = 0.03


def _missing(axis: Facts) -> str:
    if axis.supply >= _LEAST or (axis.nominal.get("weakness", 0.0) and axis.driven):
        return ""
    return f"a column supply[V] that changes by {100 * _LEAST:.0f} %, or a model with the motor's limit"


def _numbers(axis: Facts) -> tuple[Number, ...]:
    if axis.supply >= _LEAST:
        return (Number("share of its change", "1", 1.0, (add("supply"),), 0.5),)
    return (Number("log voltage", "1", 0.3, (scaled("gain"), scaled("weakness", -1.0)), 0.0),)


SUPPLY = MotionEffect(
    "supply",
    _numbers,
    lambda axis: ({},) if axis.supply >= _LEAST else ({"log voltage": 0.3}, {"log voltage": -0.3}),
    _missing,
)
