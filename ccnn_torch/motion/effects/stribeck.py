"""Stribeck friction: more dry friction near standstill, falling with the square of the speed (Armstrong 1994)."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["STRIBECK"]


class _Stribeck:
    name = "stribeck"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (Number("stribeck", "torque", 0.02, (add("stribeck"),), 0.5),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        # The speed at which it has fallen to 1/e.
        return tuple({"stribeck_speed": share * axis.speed} for share in (0.03, 0.1, 0.3))


STRIBECK = _Stribeck()
