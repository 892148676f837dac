"""A limit of the speed: the drive follows a command no faster."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

SPEED_LIMIT = MotionEffect(
    "speed_limit",
    lambda axis: (Number("speed", "speed", 2 / axis.speed, (add("slowness"),), inverse=True),),
    lambda axis: [{"speed": 1 / (share * axis.speed)} for share in (0.25, 0.5, 0.75, 0.9)],
)
