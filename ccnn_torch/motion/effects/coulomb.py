"""Dry friction: a torque against the motion, constant, and a share of the motor's torque (gears under load)."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

COULOMB = MotionEffect(
    "coulomb",
    lambda axis: (
        Number("coulomb", "torque", 0.02, (add("coulomb"),)),
        Number("share of the gear's torque", "1", 0.2, (add("load_friction"),), 0.05),
    ),
)
