"""Supply voltage: the motor's strength and its limit go with it, damping and friction do not."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add, scaled

# A smaller change of the recorded voltage shows nothing.
_LEAST = 0.03


def _recorded(axis: Facts) -> bool:
    return axis.supply >= _LEAST


def _limited(axis: Facts) -> bool:
    """Whether a wrong nominal voltage is more than a wrong gain."""
    return axis.driven and bool(axis.nominal.get("weakness", 0.0))


def _missing(axis: Facts) -> str:
    if _recorded(axis) or _limited(axis):
        return ""
    return f"a column supply[V] that changes by {100 * _LEAST:.0f} %, or a model with the motor's limit"


_SHARE, _VOLTAGE = "share of the voltage's change", "motor's strength"


def _numbers(axis: Facts) -> tuple[Number, ...]:
    share = Number(_SHARE, "1", 1.0, (add("supply"),), 0.5)
    # The gain and the limit that the model has hold at another voltage than the motor's.
    voltage = Number(_VOLTAGE, "1", 0.3, (scaled("gain"), scaled("weakness", -1.0)))
    return (*([share] if _recorded(axis) else []), *([voltage] if _limited(axis) else []))


def _shapes(axis: Facts) -> list[dict[str, float | None]]:
    """One number or the other."""
    found: list[dict[str, float | None]] = [{_VOLTAGE: None}] if _recorded(axis) else []
    return found + ([{_SHARE: None, _VOLTAGE: v} for v in (0.3, -0.3)] if _limited(axis) else [])


SUPPLY = MotionEffect("supply", _numbers, _shapes, _missing)
