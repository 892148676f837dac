"""Inertia of the axis that the model lacks or has wrong: armature, gears, load that turns."""

from __future__ import annotations

from collections.abc import Mapping

from ccnn_torch.motion.effects.protocol import Facts, Number, add

__all__ = ["INERTIA"]


class _Inertia:
    name = "inertia"

    def missing(self, axis: Facts) -> str:
        return ""

    def numbers(self, axis: Facts) -> tuple[Number, ...]:
        # Of an axis whose inertia is known half of it; else that of an axis of 3 Hz.
        known = axis.nominal.get("inertia", 0.0)
        return (Number("inertia", "inertia", 0.5 * known or 0.003, (add("inertia"),)),)

    def shapes(self, axis: Facts) -> tuple[Mapping[str, float], ...]:
        return ({},)


INERTIA = _Inertia()
