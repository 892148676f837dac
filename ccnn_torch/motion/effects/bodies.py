"""Effects of masses that the model lacks or has wrong: weight, inertia, payload."""

from __future__ import annotations

from ccnn_torch.motion.effects.protocol import Facts, MotionEffect, Number, add
from ccnn_torch.units import STANDARD_GRAVITY

CARRIED = "carried"
"""The parameter of an axis that is the mass at the tool [kg]."""
# Share of an axis' error that 100 kg at the tool must make for it to show a mass there.
_LEAST = 0.01
_TINY = 1e-12


def _unloaded(axis: Facts) -> str:
    if axis.carried is not None:
        return "" if 100 * axis.carried >= _LEAST * axis.error else "a joint that the mass loads"
    if axis.unit != "rad":
        return "a turning joint"
    return "" if axis.length and axis.gain else "the axis' gain and the lever of its load (keys gain and length)"


def _mass(axis: Facts) -> tuple[Number, ...]:
    if axis.carried is not None:
        # A mass that would explain the error.
        return (Number("mass", "kg", axis.error / max(axis.carried, _TINY), (add(CARRIED),), most=axis.heaviest),)
    lever, gain = axis.length or 1.0, axis.gain or 1.0
    acts = (
        add("gravity_sin", STANDARD_GRAVITY * lever / gain),
        add("inertia", lever**2 / gain),
        # The model knows which part of the inertia is behind the gear.
        add("load", lever**2 / gain if axis.nominal.get("load") else 0.0),
    )
    # A mass whose weight differs the command and the position by a tenth of a radian.
    return (Number("mass", "kg", 0.1 * gain / (STANDARD_GRAVITY * lever), acts),)


# Sag of an axis that turns against its own weight. Sine and cosine of the joint's angle, since the direction of the
# weight is not known; of a sliding axis a constant, which is an offset.
GRAVITY = MotionEffect(
    "gravity",
    lambda axis: (
        Number("torque at 90 degrees", "torque", 0.1, (add("gravity_sin"),), 0.2),
        Number("torque at 0 degrees", "torque", 0.1, (add("gravity_cos"),), 0.0),
    ),
    missing=lambda axis: (
        "" if axis.unit == "rad" else "a turning joint (the weight on a sliding one looks like an offset)"
    ),
)

# A mass at the tool or at the end of an axis' lever.
PAYLOAD = MotionEffect("payload", _mass, missing=_unloaded)

# Armature, gears, load that turns: of an axis whose inertia is known half of it; else that of an axis of 3 Hz.
INERTIA = MotionEffect(
    "inertia",
    lambda axis: (Number("inertia", "inertia", 0.5 * axis.nominal.get("inertia", 0.0) or 0.003, (add("inertia"),)),),
)
