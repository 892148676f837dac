"""Backlash: the driven side follows when the play has been crossed, or rests where its load presses it."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["BACKLASH"]


class _Backlash:
    name = "backlash"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        # The whole width of the play.
        return (Number("backlash", "joint", 0.01, (add("play"),), 1.0),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        # Friction holds the driven side where it is, or the load presses it to one side.
        return ({"play_loaded": 0.0}, {"play_loaded": 1.0})


BACKLASH = _Backlash()
