"""Effects of friction."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

# A smaller change of the temperature shows nothing.
_LEAST_WARMING = 5.0

# A torque against the motion, constant, and a share of the motor's torque (gears under load).
COULOMB = MotionEffect(
    "coulomb",
    lambda axis: (
        Number("coulomb", "torque", 0.02, (add("coulomb"),)),
        Number("share of the gear's torque", "1", 0.2, (add("load_friction"),), 0.05),
    ),
)

# A torque proportional to the speed; back-EMF of a motor looks the same.
VISCOUS = MotionEffect(
    "viscous",
    lambda axis: (Number("viscous", "viscous", 0.5 * axis.nominal.get("viscous", 0.0) or 0.03, (add("viscous"),)),),
)

# More dry friction near standstill, falling with the square of the speed (Armstrong 1994).
STRIBECK = MotionEffect(
    "stribeck",
    lambda axis: (Number("stribeck", "torque", 0.02, (add("stribeck"),), 0.5),),
    # The speed at which it has fallen to 1/e.
    lambda axis: [{"stribeck_speed": share * axis.speed} for share in (0.03, 0.1, 0.3)],
)

# Dry friction that changes with the temperature (grease, seals): seen beside dry friction that is known or found.
THERMAL_FRICTION = MotionEffect(
    "thermal_friction",
    lambda axis: (Number("change", "1/K", 0.02, (add("thermal"),), -0.5),),
    missing=lambda axis: (
        ""
        if axis.temperature >= _LEAST_WARMING
        else f"a column temperature[degC] that changes by {_LEAST_WARMING:.0f} K"
    ),
)
