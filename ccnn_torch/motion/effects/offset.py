"""Zero offset: position and command differ by a constant."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Plain

__all__ = ["OFFSET"]

OFFSET = Plain("offset", "offset", "joint", 0.02, 0.0)
