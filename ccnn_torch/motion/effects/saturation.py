"""A limit of the motor's torque."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["SATURATION"]


class _Saturation:
    name = "saturation"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (Number("torque", "torque", 2 / axis.error, (add("weakness"),), inverse=True),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return tuple({"torque": 1 / (share * axis.error)} for share in (0.3, 0.6, 0.9))


SATURATION = _Saturation()
