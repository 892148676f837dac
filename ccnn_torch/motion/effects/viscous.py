"""Viscous friction: a torque proportional to the speed; back-EMF of a motor looks the same."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["VISCOUS"]


class _Viscous:
    name = "viscous"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        known = axis.nominal.get("viscous", 0.0)
        return (Number("viscous", "viscous", 0.5 * known or 0.03, (add("viscous"),)),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({},)


VISCOUS = _Viscous()
