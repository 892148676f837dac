"""The effects of motion by name, and those of a simulator's own parameters."""

from __future__ import annotations

from collections.abc import Sequence

from ccnn_torch.effects.constant import PARAMETER
from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects import bodies, control, friction, gears
from ccnn_torch.motion.effects.protocol import MotionEffect, Number, add
from ccnn_torch.plugins import is_plugin, load_plugin
from ccnn_torch.spelling import nearest_hint

EFFECTS: dict[str, MotionEffect] = {
    effect.name: effect
    for effect in (
        *(control.DELAY, control.SERVO_GAIN, control.OFFSET, control.JOINT_GAIN),
        *(bodies.GRAVITY, bodies.PAYLOAD, bodies.INERTIA),
        *(friction.VISCOUS, friction.COULOMB, friction.STRIBECK, gears.BACKLASH, gears.FLEXIBLE_JOINT),
        *(control.SPEED_LIMIT, control.SATURATION, control.SUPPLY, gears.COGGING, friction.THERMAL_FRICTION),
        *(control.INTEGRAL_ACTION, control.DEAD_BAND, control.ACCELERATION_LIMIT, control.FEEDFORWARD),
        *(gears.TRANSMISSION, gears.ERROR_MOTION),
    )
}

EXACT = frozenset({"delay", "servo_gain", "feedforward", "offset", "joint_gain", "gravity", "payload", "inertia"})
"""Effects whose form is that of rigid bodies and of the control loop; friction, play and limits differ from theirs."""

OWN = "own "
"""What the names of a simulator's own parameters begin with among those of an axis."""


def own_parameter(key: str, value: float) -> MotionEffect:
    """What the simulator gives at another value of one of its parameters, to first order."""
    # Half of it is a plausible error; of one that is 0 nothing is known.
    number = Number(key, "", 0.5 * abs(value) or 1.0, (add(f"{OWN}{key}"),), 0.0, model=value)
    return MotionEffect(f"{PARAMETER}{key}", lambda axis: (number,))


def motion_effects(names: Sequence[str] | None = None) -> list[MotionEffect]:
    """Effects by name, or by `path/to/file.py:NAME`; `all`, or None, stands for the whole library.

    Raises:
        InputError: a name is not known.
    """
    found: dict[str, MotionEffect] = {}
    for name in ["all"] if names is None else names:
        if name == "all":
            found |= EFFECTS
        elif is_plugin(name):
            own = load_plugin(name, (MotionEffect,))
            effect: MotionEffect = own() if isinstance(own, type) else own
            found[effect.name] = effect
        elif name in EFFECTS:
            found[name] = EFFECTS[name]
        else:
            hint = nearest_hint(name, [*EFFECTS])
            raise InputError(f"effects: there is no effect of motion '{name}'{hint}; known: {', '.join(EFFECTS)}")
    # In the same order always, so that the order in which they are asked for decides no tie.
    return sorted(found.values(), key=lambda effect: [*EFFECTS, effect.name].index(effect.name))
