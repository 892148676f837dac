"""Delay between a command and its effect: bus, controller, time stamps."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

# Seconds: a bus of a few ms to a network of tens.
DELAY = MotionEffect("delay", lambda axis: (Number("delay", "s", 0.02, (add("delay"),)),))
