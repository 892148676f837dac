"""Backlash: the driven side follows when the play has been crossed, or rests where its load presses it."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add

# Seconds in which that friction stops a load that is nearly as fast as the axis ever is.
_STOPPED = 0.5

BACKLASH = MotionEffect(
    "backlash",
    # The whole width of the play.
    lambda axis: (Number("backlash", "joint", 0.01, (add("play"),), 1.0),),
    # Friction holds the driven side where it is, or the load presses it to one side, against some friction of its own.
    lambda axis: ({"play_loaded": 0.0}, {"play_loaded": 1.0, "play_friction": axis.speed / _STOPPED}),
)
