"""The nominal model of a motion: what is known of every axis, and what positions it makes of the commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.motion.effects import MotionEffect
from ccnn_torch.motion.effects.own_parameter import own_parameter
from ccnn_torch.motion.effects.payload import STANDARD_GRAVITY
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.simulators import Simulator, own_simulator
from ccnn_torch.motion.stage import ABSENT
from ccnn_torch.motion.stretches import Stretches
from ccnn_torch.plugins import is_plugin
from ccnn_torch.spelling import nearest

KEYS: dict[str, str] = {
    "gain": "proportional gain; without it torques are told as angles [N*m/rad]",
    "inertia": "of the axis about its own axis, without mass * length^2 of its load [kg*m^2]",
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
    "thermal": "change of coulomb for each kelvin above the coldest sample of the logs, as a share of it [1/K]",
    "delay": "from command to motor [s]",
    "offset": "of the position from the command [rad]",
    "backlash": "whole width of the play [rad]",
    "backlash_loaded": "1 where the load presses the play to one side [1]",
    "speed_limit": "of the drive, beyond which it follows no command [rad/s]",
    "torque_limit": "of the motor, at the nominal supply [N*m]",
    "supply": "nominal voltage, at which gain and torque_limit hold; given, both go with the column supply[V] [V]",
    "supply_share": "how far they do: 1 where supply is given, 0 not at all [1]",
}
"""Keys of the built-in servo with their units on a turning axis; a number for all axes, or a list with one for each."""

TORQUES = (*("inertia", "viscous", "coulomb", "stribeck", "gravity_sin", "gravity_cos", "cogging_sin", "cogging_cos"),)
"""Parameters that are torques, which an axis has over the gain."""
_SIGNED = ("delay", "offset", "gravity_sin", "gravity_cos", "cogging_sin", "cogging_cos", "thermal")
# Of a simulator's parameter, for a difference quotient.
_STEP = 0.02
_SAME = {
    **{"delay": "delay", "offset": "offset", "backlash": "play", "backlash_loaded": "play_loaded"},
    **{"load_friction": "load_friction", "stribeck_speed": "stribeck_speed", "cogging_order": "cogging_order"},
    **{"flexibility": "flexibility", "flexible_damping": "flexible_damping", "thermal": "thermal"},
    "encoder_at_motor": "encoder_at_motor",
    "supply_share": "supply",
}


Array = NDArray[np.float64]


class Driven(NamedTuple):
    """What drives the axes, `n x b x s` each.

    Attributes:
        followed: positions that they follow [rad or m].
        torque: what resists their motors, over the gain [rad or m]; None = nothing.
        simulated: positions of the nominal model; None where the nominal axes tell them.
        own, carried: as of `Problem`.
    """

    followed: Tensor
    torque: Tensor | None = None
    simulated: Tensor | None = None
    own: Mapping[str, Tensor] = {}
    carried: Tensor | None = None


@dataclass(frozen=True)
class Nominal:
    """A nominal model.

    Attributes:
        name: as given.
        axes: parameters of each axis, as in `ABSENT`.
        gains: N m/rad of each axis, None where it is not known.
        lengths: lever of each axis' load [m].
        heaviest: as of `Facts`.
        supply: nominal supply voltage; None where the motor's strength is not known to follow it.
        simulator: makes the positions that the axes follow; None where they follow the commands.
        loaded: `time, commands` -> positions, what resists the motors beside those of `axes`, over the gains, and what
            1 kg at the tool adds to that, `s x n` each; None where the axes tell the positions.
        notes: sentences without a full stop.
    """

    name: str
    axes: tuple[Mapping[str, float], ...]
    gains: tuple[float | None, ...]
    lengths: tuple[float | None, ...]
    supply: float | None = None
    simulator: Simulator | None = None
    notes: tuple[str, ...] = ()
    heaviest: float | None = None
    loaded: Callable[[Array, Array], tuple[Array, Array, Array]] | None = None

    @property
    def own_effects(self) -> list[MotionEffect]:
        """Wrong values of a simulator's own parameters."""
        own = self.simulator.parameters if self.simulator is not None else {}
        return [own_parameter(name, value) for name, value in own.items()]

    def driven(self, logs: Sequence[Log], data: Stretches, about: Mapping[str, float] | None = None) -> Driven:
        """What drives the axes: the commands, or where a simulator tells no more than positions these.

        Args:
            logs: runs.
            data: their stretches.
            about: what is added to a simulator's parameters where its positions are linearised in them.

        Raises:
            InputError: the simulator fails.
        """
        simulator = self.simulator
        if self.loaded is not None:
            made_of = [self.loaded(log.time, log.command) for log in logs]
            simulated, torque, carried = (_along([one[k] for one in made_of], data) for k in range(3))
            return Driven(data.command, torque, simulated, carried=carried)
        if simulator is not None:
            centre = {name: value + (about or {}).get(name, 0.0) for name, value in simulator.parameters.items()}

            def made_with(**other: float) -> Tensor:
                own = replace(simulator, parameters={**centre, **other})
                return _along([own.positions(log.time, log.command) for log in logs], data)

            made, own = made_with(), {}
            for name, value in centre.items():
                step = _STEP * (abs(value) or 1.0)
                own[name] = (made_with(**{name: value + step}) - made_with(**{name: value - step})) / (2 * step)
                made = made - (value - simulator.parameters[name]) * own[name]
            return Driven(made, own=own)
        return Driven(data.command)


def _along(made: Sequence[Array], data: Stretches) -> Tensor:
    """What was made for each log, at the samples of the stretches, `n x b x s`."""
    found = data.command.clone()
    for k, number in enumerate(data.run.tolist()):
        rows = data.log[k]
        here = torch.from_numpy(made[number])[rows.clamp_min(0)].mT
        last = int((rows >= 0).sum()) - 1
        found[:, k] = torch.where(rows >= 0, here, here[:, last : last + 1])
    return found


def nominal_of(mechanism: str, keys: Mapping[str, Any], units: Sequence[str]) -> Nominal:
    """The nominal model by its name.

    Args:
        mechanism: `servo`, a simulator `file.py:NAME`, an MJCF with position actuators, or a mechanism.
        keys: of the built-in servo (`KEYS`), or of the mechanism.
        units: of the joints in the logs.

    Raises:
        InputError: a name or a key is not known, or the model has another number of joints than the logs.
    """
    n = len(units)
    if mechanism == "servo":
        return _servo(keys, n)
    nothing = Nominal(mechanism, ({},) * n, (None,) * n, (None,) * n)
    if is_plugin(mechanism):
        return replace(nothing, simulator=own_simulator(mechanism, keys))
    if Path(mechanism).suffix.lower() in (".xml", ".mjcf") and Path(mechanism).is_file():
        from ccnn_torch.motion.mujoco_model import mujoco_nominal

        if "<mujoco" in read_text(mechanism, CONFIG_LIMIT, "write an MJCF"):
            return mujoco_nominal(mechanism, keys, units)
    own = [joint.unit for joint in load_mechanism(mechanism, **keys).joints]
    if own != list(units):
        raise InputError(
            f"{mechanism}: has {len(own)} joints ({', '.join(own)}), and the logs {len(units)} ({', '.join(units)}); "
            "name the commands command1… and the positions q1… in the mechanism's order"
        )
    return nothing


def _servo(keys: Mapping[str, Any], n: int) -> Nominal:
    for key in keys:
        if key not in KEYS:
            near = nearest(key, list(KEYS))
            raise InputError(
                f"mechanism_keys: the servo has no key '{key}'"
                f"{f'; {near!r} is the nearest' if near else ''}; it has {', '.join(KEYS)}"
            )
    each = {key: _numbers(key, value, n) for key, value in keys.items()}
    axes, gains, lengths = [], [], []
    for i in range(n):
        own = {key: values[i] for key, values in each.items()}
        gain = own.get("gain")
        needs = [k for k in (*TORQUES, "mass", "torque_limit") if own.get(k)]
        if gain is None and needs:
            raise InputError(f"mechanism_keys: {needs[0]} is given without gain; give gain [N*m/rad] as well")
        if own.get("mass") and not own.get("length"):
            raise InputError("mechanism_keys: mass is given without length; give the lever of the load [m] as well")
        unit = gain or 1.0
        axis = {name: own[name] / unit for name in TORQUES if name in own}
        load, lever = own.get("mass", 0.0), own.get("length", 0.0)
        axis["inertia"] = axis.get("inertia", 0.0) + load * lever**2 / unit
        axis["load"] = load * lever**2 / unit
        axis["gravity_sin"] = axis.get("gravity_sin", 0.0) + load * STANDARD_GRAVITY * lever / unit
        axis |= {name: own[key] for key, name in _SAME.items() if key in own}
        if own.get("torque_limit"):
            axis["weakness"] = unit / own["torque_limit"]
        if own.get("speed_limit"):
            axis["slowness"] = 1 / own["speed_limit"]
        if own.get("supply"):
            axis.setdefault("supply", 1.0)
        axes.append({name: value for name, value in axis.items() if value})
        gains.append(gain)
        lengths.append(own.get("length"))
    supply = each["supply"][0] if each.get("supply") else None
    return Nominal("servo", tuple(axes), tuple(gains), tuple(lengths), supply)


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
        mass = max(nominal.axes[i].get("load", 0.0) * unit / lever**2 + added[i], 0.0) if lever else 0.0
        own = {name: unit * axis.get(name, 0.0) for name in TORQUES}
        own["inertia"] = max(own["inertia"] - mass * lever**2, 0.0)
        own["gravity_sin"] -= mass * STANDARD_GRAVITY * lever
        own |= {"gain": unit * axis.get("gain", 1.0), "mass": mass, "length": lever or 1.0}
        own |= {key: axis.get(name, ABSENT[name]) for key, name in _SAME.items()}
        own["speed_limit"] = 1 / axis["slowness"] if axis.get("slowness") else 0.0
        own["torque_limit"] = unit / axis["weakness"] if axis.get("weakness") else 0.0
        each.append(own)
    usual = {key: ABSENT.get(name, 0.0) for key, name in _SAME.items()}
    found = {key: [own[key] for own in each] for key in each[0] if any(own[key] != usual.get(key, 0.0) for own in each)}
    return found | ({"supply": nominal.supply} if nominal.supply and "supply_share" in found else {})


def _numbers(key: str, value: Any, n: int) -> list[float]:
    values = value if isinstance(value, list | tuple) else [value] * n
    signed, above = key in _SIGNED, key in ("gain", "supply", "length")
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
