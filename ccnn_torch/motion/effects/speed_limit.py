"""A limit of the speed: the drive follows a command no faster."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["SPEED_LIMIT"]


class _SpeedLimit:
    name = "speed_limit"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (Number("speed", "speed", 2 / axis.speed, (add("slowness"),), inverse=True),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return tuple({"speed": 1 / (share * axis.speed)} for share in (0.25, 0.5, 0.75, 0.9))


SPEED_LIMIT = _SpeedLimit()
