"""Inertia of the axis that the model lacks or has wrong: armature, gears, load that turns."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add


def _numbers(axis: Facts) -> tuple[Number, ...]:
    # Of an axis whose inertia is known half of it; else that of an axis of 3 Hz.
    known = axis.nominal.get("inertia", 0.0)
    return (Number("inertia", "inertia", 0.5 * known or 0.003, (add("inertia"),)),)


INERTIA = MotionEffect("inertia", _numbers)
