"""The built-in servo as a nominal model: its keys, in SI, and the parameters of its axes that they stand for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ccnn_torch.errors import InputError
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.stage import ABSENT
from ccnn_torch.spelling import nearest_hint
from ccnn_torch.units import STANDARD_GRAVITY

KEYS: dict[str, str] = {
    "gain": "proportional gain; without it torques are told as angles [N*m/rad]",
    "integral": "integral gain over the proportional one, 1 over the integral time [1/s]",
    "derivative": "derivative gain, of command less position, over the proportional one [s]",
    "forward": "share of the command's speed in that; of a cascade its feedforward of speed, 1 without the key [1]",
    "forward_lag": "time constant of that share [s]",
    "cascade": "1 where the integral is of the speed's error as well, as in a cascade; set by speed_gain [1]",
    "position_gain": "of a cascade, in the place of derivative [1/s]",
    "speed_gain": "of a cascade, in the place of gain: torque by error of speed [N*m*s/rad]",
    "integral_time": "of the speed's error, in the place of integral [s]",
    "inertia": "of the axis about its own axis, without mass * length^2 of its load [kg*m^2]",
    "load_inertia": "part of inertia that is behind a play or flexible joint; without it and mass all is [kg*m^2]",
    "mass": "of the load at the end of its lever, which hangs down at 0 [kg]",
    "length": "lever of the load [m]",
    "viscous": "viscous friction, the motor's damping included [N*m*s/rad]",
    "coulomb": "dry friction [N*m]",
    "load_friction": "dry friction as a share of |torque of motor + that of load|, which at rest is twice the load [1]",
    "stribeck": "dry friction at rest beyond that in motion [N*m]",
    "stribeck_speed": "speed at which that has fallen to 1/e [rad/s]",
    "gravity_sin": "torque of the weight at 90 degrees beyond that of the load [N*m]",
    "gravity_cos": "torque of the weight at 0 [N*m]",
    "cogging_sin": "torque that repeats with the angle, times the sine of cogging_order times the angle [N*m]",
    "cogging_cos": "the same with the cosine [N*m]",
    "cogging_order": "periods of that torque in a turn [1]",
    "flexibility": "inertia of the driven side over the stiffness of the joint [s^2]",
    "flexible_damping": "damping ratio of that spring [1]",
    "encoder_at_motor": "1 where the encoder is at the motor, and that spring behind it [1]",
    "lead_square": "by how much the position goes further, times its square [1/rad]",
    "lead_cube": "the same with its third power [1/rad^2]",
    "lead_sin": "wave of gear or screw: the same with the sine of lead_order times the position [rad]",
    "lead_cos": "the same with the cosine [rad]",
    "lead_order": "periods of that wave in a turn; of a sliding axis 2 pi over the lead [1]",
    "thermal": "change of coulomb for each kelvin above the coldest sample of the logs, as a share of it [1/K]",
    "delay": "from command to motor [s]",
    "offset": "of the position from the command [rad]",
    "ratio": "share by which the position goes further than the command, from 0 on [1]",
    "dead_band": "largest error that the drive does nothing about [rad]",
    "backlash": "whole width of the play [rad]",
    "backlash_loaded": "1 where the load moves freely within the play, and its weight presses it to one side [1]",
    "backlash_friction": "what friction of its own then brakes the load by [rad/s^2]",
    "speed_limit": "of the drive, beyond which it follows no command [rad/s]",
    "acceleration_limit": "of the set point that the drive makes of the commands [rad/s^2]",
    "torque_limit": "of the motor, at the nominal supply and at standstill [N*m]",
    "no_load_speed": "at which nothing of that is left [rad/s]",
    "supply": "nominal voltage, at which gain and torque_limit hold; given, both go with the column supply[V] [V]",
    "supply_share": "how far they do: 1 where supply is given, 0 not at all [1]",
}
"""Keys of the built-in servo with their units on a turning axis; a number for all axes, or a list with one for each."""

TORQUES = (*("inertia", "viscous", "coulomb", "stribeck", "gravity_sin", "gravity_cos", "cogging_sin", "cogging_cos"),)
"""Parameters that are torques, which an axis has over the gain."""
_LEAD = ("lead_square", "lead_cube", "lead_sin", "lead_cos")
_SIGNED = ("delay", "offset", "ratio", "gravity_sin", "gravity_cos", "cogging_sin", "cogging_cos", "thermal", *_LEAD)
_CASCADE = ("position_gain", "speed_gain")
_OTHERWISE = {"backlash": "play", "backlash_loaded": "play_loaded", "backlash_friction": "play_friction"}
# What an axis has as the servo does.
_SAME = {key: key for key in KEYS if key in ABSENT and key not in (*TORQUES, "gain", "supply")} | _OTHERWISE
_SAME["supply_share"] = "supply"

# Limits, of which an axis has one over each.
_INVERSE = {"speed_limit": "slowness", "acceleration_limit": "ramp", "no_load_speed": "fading"}
# Share of an inertia below which a difference of two is none.
_ROUNDING = 1e-9


def servo(keys: Mapping[str, Any], n: int) -> Nominal:
    """The servo with `n` axes.

    Raises:
        InputError: a key is not known, or its value can be none.
    """
    for key in keys:
        if key not in KEYS:
            raise InputError(
                f"mechanism_keys: the servo has no key '{key}'{nearest_hint(key, [*KEYS])}; it has {', '.join(KEYS)}"
            )
    each = {key: _numbers(key, value, n) for key, value in keys.items()}
    axes, gains, lengths, masses = [], [], [], []
    for i in range(n):
        own = _of_cascade({key: values[i] for key, values in each.items()})
        gain = own.get("gain")
        needs = [k for k in (*TORQUES, "load_inertia", "mass", "torque_limit") if own.get(k)]
        if gain is None and needs:
            raise InputError(f"mechanism_keys: {needs[0]} is given without gain; give gain [N*m/rad] as well")
        if own.get("mass") and not own.get("length"):
            raise InputError("mechanism_keys: mass is given without length; give the lever of the load [m] as well")
        unit = gain or 1.0
        if own.get("load_inertia", 0.0) > own.get("inertia", 0.0):
            raise InputError("mechanism_keys: load_inertia is a part of inertia, and larger; give inertia as a whole")
        axis = {name: own[name] / unit for name in TORQUES if name in own}
        load, lever = own.get("mass", 0.0), own.get("length", 0.0)
        axis["inertia"] = axis.get("inertia", 0.0) + load * lever**2 / unit
        axis["load"] = (own.get("load_inertia", 0.0) + load * lever**2) / unit
        axis["gravity_sin"] = axis.get("gravity_sin", 0.0) + load * STANDARD_GRAVITY * lever / unit
        axis |= {name: own[key] for key, name in _SAME.items() if key in own}
        if own.get("torque_limit"):
            axis["weakness"] = unit / own["torque_limit"]
        axis |= {name: 1 / own[key] for key, name in _INVERSE.items() if own.get(key)}
        if own.get("supply"):
            axis.setdefault("supply", 1.0)
        axes.append({name: value for name, value in axis.items() if value})
        gains.append(gain)
        lengths.append(own.get("length"))
        masses.append(load)
    supply = each["supply"][0] if each.get("supply") else None
    return Nominal("servo", tuple(axes), tuple(gains), tuple(lengths), supply, masses=tuple(masses))


def _of_cascade(own: dict[str, float]) -> dict[str, float]:
    """Keys of one axis with those of a cascade told as gain, derivative and integral.

    kv (kp (u - q) + f u' - q') and its integral over a time are kv kp times what PID makes of u - q, but that the
    integral is of all of it.
    """
    given = [key for key in (*_CASCADE, "integral_time") if key in own]
    if not given:
        return own
    other = {"position_gain": "derivative", "speed_gain": "gain", "integral_time": "integral"}
    twice = next((key for key in given if other[key] in own), None)
    if twice is not None:
        raise InputError(f"mechanism_keys: give {twice} or {other[twice]}, not both: one tells the other")
    lacking = next((key for key in _CASCADE if key not in own), None)
    if lacking is not None:
        raise InputError(f"mechanism_keys: {given[0]} is of a cascade, which needs {lacking} as well")
    kp, kv = own["position_gain"], own["speed_gain"]
    found = {key: value for key, value in own.items() if key not in other}
    integral = {"integral": 1 / own["integral_time"]} if "integral_time" in own else {}
    return found | integral | {"gain": kp * kv, "derivative": 1 / kp, "cascade": 1.0}


def axis_keys(nominal: Nominal, axes: Sequence[Mapping[str, float]], added: Sequence[float]) -> dict[str, Any]:
    """Keys of the servo whose axes have these parameters; a gain that is not known is 1, and torques are then angles.

    Args:
        nominal: the servo that they are parameters of.
        axes: as in `ABSENT`.
        added: mass at the end of each lever beyond that of the model [kg].
    """
    each = []
    for i, axis in enumerate(axes):
        unit, lever = nominal.gains[i] or 1.0, nominal.lengths[i] or 0.0
        mass = max(nominal.masses[i] + added[i], 0.0) if lever else 0.0
        behind = nominal.axes[i].get("load", 0.0) * unit - nominal.masses[i] * lever**2
        own = {name: unit * axis.get(name, 0.0) for name in TORQUES}
        own["inertia"] = max(own["inertia"] - mass * lever**2, 0.0)
        own["gravity_sin"] -= mass * STANDARD_GRAVITY * lever
        # A part of what was identified, which may be less than the model had.
        own["load_inertia"] = min(behind, own["inertia"]) if behind > _ROUNDING * own["inertia"] else 0.0
        own |= {"gain": unit * axis.get("gain", 1.0), "mass": mass, "length": lever or 1.0}
        own |= {key: axis.get(name, ABSENT[name]) for key, name in _SAME.items()}
        own |= {key: 1 / axis[name] if axis.get(name) else 0.0 for key, name in _INVERSE.items()}
        own["torque_limit"] = unit / axis["weakness"] if axis.get("weakness") else 0.0
        each.append(own)
    usual = {key: ABSENT.get(name, 0.0) for key, name in _SAME.items()}
    found = {key: [own[key] for own in each] for key in each[0] if any(own[key] != usual.get(key, 0.0) for own in each)}
    return found | ({"supply": nominal.supply} if nominal.supply and "supply_share" in found else {})


def _numbers(key: str, value: Any, n: int) -> list[float]:
    values = value if isinstance(value, list | tuple) else [value] * n
    signed, above = key in _SIGNED, key in ("gain", "supply", "length", *_CASCADE, "integral_time")
    fine = len(values) == n and all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) and (signed or v >= 0)
        for v in values
    )
    if not fine or (above and not all(v > 0 for v in values)):
        what = "a number" if signed else "above 0" if above else "a number not below 0"
        raise InputError(
            f"mechanism_keys: {key} must be {what}, or a list with one for each of the {n} joints, not {value}"
        )
    return [float(v) for v in values]
