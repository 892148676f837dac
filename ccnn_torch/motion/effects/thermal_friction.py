"""Dry friction that changes with the temperature (grease, seals): seen beside dry friction that is known or found."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["THERMAL_FRICTION"]

# A smaller change of the temperature shows nothing.
_LEAST = 5.0


class _ThermalFriction:
    name = "thermal_friction"

    def missing(self, axis: Facts) -> str:
        return "" if axis.temperature >= _LEAST else f"a column temperature[degC] that changes by {_LEAST:.0f} K"

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (Number("change", "1/K", 0.02, (add("thermal"),), -0.5),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({},)


THERMAL_FRICTION = _ThermalFriction()
