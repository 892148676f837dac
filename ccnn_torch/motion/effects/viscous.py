"""Viscous friction: a torque proportional to the speed; back-EMF of a motor looks the same."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add


def _numbers(axis: Facts) -> tuple[Number, ...]:
    known = axis.nominal.get("viscous", 0.0)
    return (Number("viscous", "viscous", 0.5 * known or 0.03, (add("viscous"),)),)


VISCOUS = MotionEffect("viscous", _numbers)
