"""A limit of the motor's torque."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

SATURATION = MotionEffect(
    "saturation",
    lambda axis: (Number("torque", "torque", 2 / axis.error, (add("weakness"),), inverse=True),),
    lambda axis: [{"torque": 1 / (share * axis.error)} for share in (0.3, 0.6, 0.9)],
)
