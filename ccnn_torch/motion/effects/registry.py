"""The effects of motion by name."""

from __future__ import annotations

from collections.abc import Sequence

from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects.backlash import BACKLASH
from ccnn_torch.motion.effects.cogging import COGGING
from ccnn_torch.motion.effects.coulomb import COULOMB
from ccnn_torch.motion.effects.delay import DELAY
from ccnn_torch.motion.effects.flexible_joint import FLEXIBLE_JOINT
from ccnn_torch.motion.effects.gravity import GRAVITY
from ccnn_torch.motion.effects.inertia import INERTIA
from ccnn_torch.motion.effects.integral_action import INTEGRAL_ACTION
from ccnn_torch.motion.effects.offset import OFFSET
from ccnn_torch.motion.effects.payload import PAYLOAD
from ccnn_torch.motion.effects.protocol import MotionEffect
from ccnn_torch.motion.effects.saturation import SATURATION
from ccnn_torch.motion.effects.servo_gain import SERVO_GAIN
from ccnn_torch.motion.effects.speed_limit import SPEED_LIMIT
from ccnn_torch.motion.effects.stribeck import STRIBECK
from ccnn_torch.motion.effects.supply import SUPPLY
from ccnn_torch.motion.effects.thermal_friction import THERMAL_FRICTION
from ccnn_torch.motion.effects.viscous import VISCOUS
from ccnn_torch.plugins import is_plugin, load_plugin
from ccnn_torch.spelling import nearest

EFFECTS: dict[str, MotionEffect] = {
    effect.name: effect
    for effect in (
        *(DELAY, SERVO_GAIN, OFFSET, GRAVITY, PAYLOAD, INERTIA, VISCOUS, COULOMB, STRIBECK, BACKLASH),
        *(FLEXIBLE_JOINT, SPEED_LIMIT, SATURATION, SUPPLY, COGGING, THERMAL_FRICTION, INTEGRAL_ACTION),
    )
}

EXACT = frozenset({"delay", "servo_gain", "offset", "gravity", "payload", "inertia"})
"""Effects whose form is that of rigid bodies and of the control loop; friction, play and limits differ from theirs."""


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
            near = nearest(name, list(EFFECTS))
            hint = f"; '{near}' is the nearest" if near else ""
            raise InputError(f"effects: there is no effect of motion '{name}'{hint}; known: {', '.join(EFFECTS)}")
    return list(found.values())
