"""Numbers of effects in units: of `diagnosis.json`, and for a model that is corrected."""

from __future__ import annotations

from typing import Any

from ccnn_torch.motion.effects import Facts, Number
from ccnn_torch.motion.fit import Fit
from ccnn_torch.motion.library import Library

__all__ = ["parameters_of", "unit_of"]

_SHAPE_UNITS = {"cogging_order": "1", "flexible_damping": "1", "play_loaded": "1"}
# A limit that is so far away is none.
_TINY = 1e-9


def unit_of(unit: str, axis: Facts) -> tuple[str, float]:
    """The unit of a number in words of the axis, and the factor to it: torques by the gain, where it is known."""
    gain = axis.gain or 1.0
    force = "N*m" if axis.unit == "rad" else "N"
    known = {
        "joint": (axis.unit, 1.0),
        "speed": (f"{axis.unit}/s", 1.0),
        "torque": (force if axis.gain else axis.unit, gain),
        "inertia": ("kg*m^2" if axis.unit == "rad" else "kg", gain) if axis.gain else ("s^2", 1.0),
        "viscous": (f"{force}*s/{axis.unit}", gain) if axis.gain else ("s", 1.0),
    }
    return known.get(unit, (unit, 1.0))


def parameters_of(library: Library, axis: int, fit: Fit, effect: int) -> dict[str, dict[str, Any]]:
    """The numbers of one effect of a fit, as `parameters` of diagnosis.json; value: the difference to the model."""
    facts = library.facts[axis]
    found: dict[str, dict[str, Any]] = {}
    flat = fit.spec.flat
    deviation = fit.covariance.diagonal().clamp_min(0).sqrt()
    for j in library.places[effect]:
        number: Number = library.numbers[axis][j]
        unit, factor = unit_of(number.unit, facts)
        value = float(fit.spec.theta[j]) * number.scale
        sd = float(deviation[flat.index(j)]) * number.scale
        if number.inverse:
            value += facts.nominal.get(number.acts[0][0], 0.0)
            value, sd = 1 / max(value, _TINY), sd / max(value, _TINY) ** 2
        found[f"q{axis + 1} {number.name}"] = {
            "value": value * factor,
            "sd": sd * factor,
            "unit": unit,
            "part": f"joint {axis + 1}",
        }
    own = {place for variant in library.variants[effect] for place in variant.held}
    for name, place in library.held.items():
        value = float(fit.spec.theta[place])
        if place in own and value:
            unit = _SHAPE_UNITS.get(name, f"{facts.unit}/s")
            found[f"q{axis + 1} {name}"] = {"value": value, "sd": None, "unit": unit, "part": f"joint {axis + 1}"}
    return found
