"""The nominal model of a motion: what is known of every axis, and what positions it makes of the commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.motion.effects import MotionEffect
from ccnn_torch.motion.effects.registry import own_parameter
from ccnn_torch.motion.log import Log
from ccnn_torch.motion.stretches import Stretches
from ccnn_torch.plugins import failure, load_plugin

Array = NDArray[np.float64]
# Of a simulator's parameter, for a difference quotient.
_STEP = 0.02


class Driven(NamedTuple):
    """What drives the axes, `n x b x s` each.

    Attributes:
        followed: positions that they follow [rad or m]: the commands, or what a simulator makes of them.
        supply, warm: as of `Drive`, `b x s`.
        torque: what resists their motors on the measured motion, over the gain [rad or m]; None = nothing.
        simulated: positions of the nominal model; None where the nominal axes tell them.
        there: what resists the motors on that motion, as `torque`.
        own: what a unit of each of a simulator's own parameters changes in its positions, by name.
        carried: what 1 kg at the tool adds to `torque` [rad or m per kg].
    """

    followed: Tensor
    supply: Tensor
    warm: Tensor
    torque: Tensor | None = None
    simulated: Tensor | None = None
    there: Tensor | None = None
    own: Mapping[str, Tensor] = {}
    carried: Tensor | None = None


class Loaded(NamedTuple):
    """What a simulator of loads makes of commands, `s x n` each.

    Attributes:
        positions: simulated [rad or m].
        there: what resists the motors on that motion beside friction and inertia of their own axes, over the gains.
        torque: the same on the measured motion.
        carried: what 1 kg at the tool adds to it [per kg].
    """

    positions: Array
    there: Array
    torque: Array
    carried: Array


@dataclass(frozen=True)
class Nominal:
    """A nominal model.

    Attributes:
        name: as given.
        axes: parameters of each axis, as in `ABSENT`.
        gains: N m/rad of each axis, None where it is not known.
        lengths: lever of each axis' load [m].
        masses: of each axis' load at the end of its lever [kg]; empty where the model is no servo.
        heaviest: as of `Facts`.
        supply: nominal supply voltage; None where the motor's strength is not known to follow it.
        simulator: makes the positions that the axes follow; None where they follow the commands.
        loaded: `time, commands, measured` positions -> as of `Loaded`; None where the axes tell the positions.
        notes: sentences without a full stop.
        known: as of `Problem`.
    """

    name: str
    axes: tuple[Mapping[str, float], ...]
    gains: tuple[float | None, ...]
    lengths: tuple[float | None, ...]
    supply: float | None = None
    simulator: Simulator | None = None
    notes: tuple[str, ...] = ()
    heaviest: float | None = None
    masses: tuple[float, ...] = ()
    loaded: Callable[[Array, Array, Array | None], Loaded] | None = None
    known: Mapping[str, float] = field(default_factory=dict)

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
        simulator, supply, warm = self.simulator, torch.zeros_like(data.time), torch.zeros_like(data.time)
        if "supply" in data.beside:
            volts = data.beside["supply"]
            usual = self.supply or float(volts[data.judged].median())
            supply = volts / usual - 1 if usual else supply
        if "temperature" in data.beside:
            warm = data.beside["temperature"] - data.beside["temperature"][data.judged].min()
        found = Driven(data.command, supply, warm)
        if self.loaded is not None:
            made_of = [self.loaded(log.time, log.command, log.position) for log in logs]
            simulated, there, torque, carried = (_along([one[k] for one in made_of], data) for k in range(4))
            return found._replace(torque=torque, simulated=simulated, there=there, carried=carried)
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
            return found._replace(followed=made, own=own)
        return found


def _along(made: Sequence[Array], data: Stretches) -> Tensor:
    """What was made for each log, at the samples of the stretches, `n x b x s`."""
    found = data.command.clone()
    for k, number in enumerate(data.run.tolist()):
        rows = data.log[k]
        here = torch.from_numpy(made[number])[rows.clamp_min(0)].mT
        last = int((rows >= 0).sum()) - 1
        found[:, k] = torch.where(rows >= 0, here, here[:, last : last + 1])
    return found


@dataclass(frozen=True)
class Simulator:
    """A simulator as `time [s] -> positions`.

    Attributes:
        name: as given.
        simulate: `simulate(time, commands, parameters)`: `s`, `s x n`, a dict, and `s x n` back.
        parameters: what it is given.
    """

    name: str
    simulate: Callable[[Array, Array, dict[str, float]], Array]
    parameters: Mapping[str, float]

    def positions(self, time: Array, command: Array) -> Array:
        """Positions of one run, `s x n`; time `s`, command `s x n`.

        Raises:
            InputError: the simulator fails, or returns something else than finite positions.
        """
        try:
            answer = self.simulate(time.copy(), command.copy(), dict(self.parameters))
        except InputError:
            raise
        # A user's code may raise any exception.
        except (Exception, SystemExit) as error:
            raise InputError(f"{self.name}: {failure(error, self.name)}") from error
        try:
            values = np.asarray(answer, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError(f"{self.name}: simulate returned no table of numbers, but {type(answer)}") from None
        if values.shape == (len(command),) and command.shape[1] == 1:
            values = values[:, None]
        if values.shape != command.shape:
            raise InputError(
                f"{self.name}: simulate returned an array of shape {values.shape} for commands of shape "
                f"{command.shape}; it must return a position for each"
            )
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(1))[0])
            raise InputError(
                f"{self.name}: simulate returned no finite position at {time[row]:.4g} s; make it stable for these "
                "commands"
            )
        return values


def own_simulator(spec: str, keys: Mapping[str, Any]) -> Simulator:
    """A user's simulator; keys: values of its parameters in the place of its own.

    Raises:
        InputError: it is none.
    """
    found = load_plugin(spec, (object,))
    if isinstance(found, type):
        found = found()
    simulate = getattr(found, "simulate", found)
    if not callable(simulate):
        raise InputError(
            f"{spec}: is no simulator; give it a function simulate(time, commands, parameters) that returns positions"
        )
    parameters = dict(getattr(found, "parameters", {})) | dict(keys)
    for name, value in parameters.items():
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{spec}: its parameter '{name}' must be a finite number, not {value}")
    return Simulator(spec, simulate, parameters)
