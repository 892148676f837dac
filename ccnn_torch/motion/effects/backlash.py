"""Backlash: the driven side follows when the play has been crossed, or rests where its load presses it."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

BACKLASH = MotionEffect(
    "backlash",
    # The whole width of the play.
    lambda axis: (Number("backlash", "joint", 0.01, (add("play"),), 1.0),),
    # Friction holds the driven side where it is, or the load presses it to one side.
    lambda axis: ({"play_loaded": 0.0}, {"play_loaded": 1.0}),
)
