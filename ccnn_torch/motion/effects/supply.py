"""Supply voltage: the motor's strength and its limit go with it, damping and friction do not."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add, scaled

# A smaller change of the recorded voltage shows nothing.
_LEAST = 0.03
# Share of the motor's limit from which that shows.
_NEAR = 0.5


def _recorded(axis: Facts) -> bool:
    return axis.supply >= _LEAST


def _limited(axis: Facts) -> bool:
    """Whether a wrong nominal voltage is more than a wrong gain: the motor comes near its limit."""
    return axis.driven and axis.nominal.get("weakness", 0.0) * axis.error >= _NEAR


def _missing(axis: Facts) -> str:
    if _recorded(axis) or _limited(axis):
        return ""
    return f"a column supply[V] that changes by {100 * _LEAST:.0f} %, or a motion near the limit that the motor has"


_SHARE, _VOLTAGE = "share of the voltage's change", "motor's strength"


def _numbers(axis: Facts) -> tuple[Number, ...]:
    # Every axis has both; what it cannot show does nothing there.
    share, voltage = float(_recorded(axis)), float(_limited(axis))
    return (
        Number(_SHARE, "1", 1.0, (add("supply", share),), 0.5),
        # The gain and the limit that the model has hold at another voltage than the motor's.
        Number(_VOLTAGE, "1", 0.3, (scaled("gain", voltage), scaled("weakness", -voltage))),
    )


def _shapes(axis: Facts) -> list[dict[str, float | None]]:
    """One number or the other."""
    return [{_VOLTAGE: None}, *({_SHARE: None, _VOLTAGE: v} for v in (0.3, -0.3))]


SUPPLY = MotionEffect("supply", _numbers, _shapes, _missing)
