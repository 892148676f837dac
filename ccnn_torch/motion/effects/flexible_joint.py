"""A flexible joint: the load hangs on a spring with little damping behind the motor, and pulls at it.

Its number is the inertia of that side over the stiffness; 1 / (2 pi sqrt(number)) is the frequency at which it swings.
"""

from __future__ import annotations

import math

from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add


def _of(frequency: float) -> float:
    return 1 / (2 * math.pi * frequency) ** 2


FLEXIBLE_JOINT = MotionEffect(
    "flexible_joint",
    lambda axis: (Number("inertia over stiffness", "s^2", _of(8.0), (add("flexibility"),)),),
    lambda axis: [
        {"inertia over stiffness": _of(frequency), "flexible_damping": damping, "encoder_at_motor": at_motor}
        for at_motor in (0.0, 1.0)
        for frequency in (3.0, 8.0, 16.0)
        for damping in (0.03, 0.2)
    ],
)
