"""Dry friction: a torque against the motion, constant, and a share of the motor's torque (gears under load)."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["COULOMB"]


class _Coulomb:
    name = "coulomb"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        return (
            Number("coulomb", "torque", 0.02, (add("coulomb"),)),
            Number("share of load", "1", 0.2, (add("load_friction"),), 0.05),
        )

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({},)


COULOMB = _Coulomb()
