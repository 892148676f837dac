"""Effects between motor and load: play, a flexible joint, and a torque that repeats with the angle."""

from __future__ import annotations

import math

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add

FEWEST = 6.0
"""Periods in a turn: a motor has no fewer (the least common multiple of 3 slots and 2 poles), and a gear more teeth.
Fewer are a weight, or any other smooth function of the position."""
# Orders that are tried whatever the logs show, and the largest of them.
_TRIED, _HIGHEST = 14, 60.0
# Seconds in which friction stops a load that is nearly as fast as the axis ever is.
_STOPPED = 0.5


def _orders(axis: Facts) -> list[dict[str, float]]:
    # Periods from the whole motion on.
    lowest = max(FEWEST, 2 * math.pi / axis.span) if axis.unit == "rad" else 4 * math.pi / axis.span
    ratio = max(_HIGHEST / lowest, 6.0) ** (1 / (_TRIED - 1))
    tried = [lowest * ratio**k for k in range(_TRIED)]
    return [{"cogging_order": order} for order in (*tried, *(order for order in axis.ripples if order > lowest))]


def _swinging(frequency: float) -> float:
    """Inertia over stiffness of a spring that swings so often in a second."""
    return 1 / (2 * math.pi * frequency) ** 2


# The driven side follows when the play has been crossed, or rests where its load presses it.
BACKLASH = MotionEffect(
    "backlash",
    # The whole width of the play.
    lambda axis: (Number("backlash", "joint", 0.01, (add("play"),), 1.0),),
    # Friction holds the driven side where it is, or the load presses it to one side, against some friction of its own.
    lambda axis: ({"play_loaded": 0.0}, {"play_loaded": 1.0, "play_friction": axis.speed / _STOPPED}),
)

# The load hangs on a spring with little damping behind the motor, and pulls at it.
FLEXIBLE_JOINT = MotionEffect(
    "flexible_joint",
    lambda axis: (Number("inertia over stiffness", "s^2", _swinging(8.0), (add("flexibility"),)),),
    lambda axis: [
        {"inertia over stiffness": _swinging(frequency), "flexible_damping": damping, "encoder_at_motor": at_motor}
        for at_motor in (0.0, 1.0)
        for frequency in (3.0, 8.0, 16.0)
        for damping in (0.03, 0.2)
    ],
)


def _waves(axis: Facts) -> list[dict[str, float]]:
    # Eccentric wheels, once and twice a turn, and what the logs show.
    usual = (1.0, 2.0) if axis.unit == "rad" else (4 * math.pi / axis.span,)
    return [{"lead_order": order} for order in (*usual, *axis.ripples)]


# Gear or screw whose position returns to an error with each turn: behind the drive, which does not see it.
TRANSMISSION = MotionEffect(
    "transmission",
    lambda axis: tuple(
        Number(wave, "joint", 0.002 * axis.span, (add(f"lead_{wave}"),), 0.0) for wave in ("sin", "cos")
    ),
    _waves,
)

# The same without a return: a screw that is worn or warm in its middle, a scale that is stretched unevenly.
ERROR_MOTION = MotionEffect(
    "error_motion",
    lambda axis: (
        Number("square", f"1/{axis.unit}", 0.01 / axis.span, (add("lead_square"),), 0.0),
        Number("cube", f"1/{axis.unit}^2", 0.02 / axis.span**2, (add("lead_cube"),), 0.0),
    ),
)

# Cogging of the motor, teeth of a gear.
COGGING = MotionEffect(
    "cogging",
    lambda axis: tuple(Number(wave, "torque", 0.02, (add(f"cogging_{wave}"),)) for wave in ("sin", "cos")),
    _orders,
)
