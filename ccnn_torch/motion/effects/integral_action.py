"""Integral action of the controller: a torque that grows as long as the position is not the commanded one."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

# Its plausible size is that of an integral time of a second.
INTEGRAL_ACTION = MotionEffect(
    "integral_action",
    lambda axis: (Number("integral gain", "1/s", 1.0, (add("integral"),)),),
    lambda axis: [{"integral gain": start} for start in (0.3, 3.0)],
)
