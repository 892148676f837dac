"""Simulators as nominal models: a user's function, a mechanism, and an MJCF with position actuators."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.plugins import failure, is_plugin, load_plugin

__all__ = ["Simulator", "simulator_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Simulator:
    """A simulator as `time [s] -> positions`.

    Attributes:
        name: as given.
        simulate: `simulate(time, commands, parameters)`: `s`, `s x n`, a dict, and `s x n` back.
        parameters: what it is given.
        notes: sentences without a full stop.
        axes, gains: parameters of each axis as in `ABSENT`, and its gain [N m/rad], where it tells them.
        lengths, weights: of a load at each joint, as of `Facts`, where it tells them.
        loaded: where it does, positions and what resists the motors beside those, over the gains, `s x n` each.
    """

    name: str
    simulate: Callable[[Array, Array, dict[str, float]], Array]
    parameters: Mapping[str, float]
    notes: tuple[str, ...] = ()
    axes: tuple[Mapping[str, float], ...] = ()
    gains: tuple[float, ...] = ()
    lengths: tuple[float | None, ...] = ()
    weights: tuple[tuple[float, float] | None, ...] = ()
    loaded: Callable[[Array, Array], tuple[Array, Array]] | None = None

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


def simulator_of(mechanism: str, keys: Mapping[str, Any], units: Sequence[str]) -> Simulator | None:
    """The simulator of a name; None for a mechanism, whose joints follow their commands.

    Raises:
        InputError: there is none of that name, or it has other joints than the logs.
    """
    if is_plugin(mechanism):
        return _own(mechanism, keys)
    if Path(mechanism).suffix.lower() in (".xml", ".mjcf") and Path(mechanism).is_file():
        from ccnn_torch.motion.mujoco_model import is_mjcf, mujoco_simulator

        if is_mjcf(Path(mechanism)):
            return mujoco_simulator(mechanism, keys, units)
    machine = load_mechanism(mechanism, **keys)
    own = [joint.unit for joint in machine.joints]
    if own != list(units):
        raise InputError(
            f"{mechanism}: has {len(own)} joints ({', '.join(own)}), and the logs {len(units)} ({', '.join(units)}); "
            "name the commands command1… and the positions q1… in the mechanism's order"
        )
    return None


def _own(spec: str, keys: Mapping[str, Any]) -> Simulator:
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
