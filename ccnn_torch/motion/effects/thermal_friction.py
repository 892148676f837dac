"""Dry friction that changes with the temperature (grease, seals): seen beside dry friction that is known or found."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

# A smaller change of the temperature shows nothing.
_LEAST = 5.0

THERMAL_FRICTION = MotionEffect(
    "thermal_friction",
    lambda axis: (Number("change", "1/K", 0.02, (add("thermal"),), -0.5),),
    missing=lambda axis: (
        "" if axis.temperature >= _LEAST else f"a column temperature[degC] that changes by {_LEAST:.0f} K"
    ),
)
