"""Backlash: the driven side follows when the play has been crossed."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Plain

__all__ = ["BACKLASH"]

# The whole width of the play.
BACKLASH = Plain("backlash", "play", "joint", 0.01, 1.0)
