"""Delay between a command and its effect: bus, controller, time stamps."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Plain

__all__ = ["DELAY"]

# Seconds: a bus of a few ms to a network of tens.
DELAY = Plain("delay", "delay", "s", 0.02)
