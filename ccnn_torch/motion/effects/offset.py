"""Zero offset: position and command differ by a constant."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

OFFSET = MotionEffect("offset", lambda axis: (Number("offset", "joint", 0.02, (add("offset"),), 0.0),))
