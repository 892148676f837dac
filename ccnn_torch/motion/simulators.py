"""Simulators as nominal models."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.plugins import failure, load_plugin

Array = NDArray[np.float64]


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
