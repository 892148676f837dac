"""Stribeck friction: more dry friction near standstill, falling with the square of the speed (Armstrong 1994)."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

STRIBECK = MotionEffect(
    "stribeck",
    lambda axis: (Number("stribeck", "torque", 0.02, (add("stribeck"),), 0.5),),
    # The speed at which it has fallen to 1/e.
    lambda axis: [{"stribeck_speed": share * axis.speed} for share in (0.03, 0.1, 0.3)],
)
