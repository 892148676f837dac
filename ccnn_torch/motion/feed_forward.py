"""Commands that make an identified machine go where it is asked: its simulator inverted step by step.

u <- u + the smoothed (wanted - simulated position), divided by what a pulse of the command makes of the position:
iterative learning control (Arimoto 1984; Norrlöf and Gunnarsson 2002) with the simulator in the place of the machine.
Beside that stands the error itself, undivided. Of some shares of both steps the best is taken, and none that takes a
command farther from the wanted position, or out of the range of the motion, than a bound. Before the motion the machine
stands where it begins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ccnn_torch.motion.axis import Drive, simulate_axes
from ccnn_torch.motion.nominal import Nominal
from ccnn_torch.motion.stage import ABSENT

Array = NDArray[np.float64]
_STEPS, _SHARES = 30, (1.0, 0.5, 0.2)
# Share of the error's RMS that a step must take away, or it is the last.
_GAINED = 0.01
# Seconds of the rest before the first command, and of the Gaussian that smooths a step.
_REST, _SMOOTH = 1.0, 0.01
# Least size of a frequency response that is divided by, and the pulse that shows it: its width [s], and its size as a
# share of the largest error.
_WEAKEST, _PULSE, _HEIGHT = 0.05, 0.02, 0.5
# The bound, in largest errors of the machine as it is, and how far out of the range of the motion, in its spans.
_BOUND, _BEYOND = 3.0, 0.5
# Steps to the command at which the machine stands where the motion begins.
_STANDING = 8


class Around(NamedTuple):
    """What surrounds the axes during a motion, `s` each; None = as usual.

    Attributes:
        supply: voltage over the nominal one, less 1.
        warm: temperature less that which the model holds at [K].
    """

    supply: Array | None = None
    warm: Array | None = None

    def at(self, rows: NDArray[np.int64] | slice) -> Around:
        """The same of some samples."""
        return Around(*(None if own is None else own[rows] for own in self))


AS_USUAL = Around()


class Corrected(NamedTuple):
    """A corrected command, `s x n` each [rad or m].

    Attributes:
        command: to be sent.
        plain, position: simulated positions without and with the correction.
    """

    command: Array
    plain: Array
    position: Array


def moved(
    nominal: Nominal,
    axes: Sequence[Mapping[str, float]],
    time: Array,
    commands: Array,
    around: Around = AS_USUAL,
) -> Array:
    """Positions of a model whose axes have other parameters, from rest at the first command on.

    Args:
        nominal: the model.
        axes: parameters of each axis as in `ABSENT`, in the place of the model's.
        time: `s` [s].
        commands: `p x s x n` [rad or m].
        around: of the motion.

    Returns:
        `p x s x n`.
    """
    step = float(np.median(np.diff(time)))
    before = np.arange(time[0] - _REST, time[0] - 0.5 * step, step)
    clock = torch.from_numpy(np.concatenate([before, time]))
    p, _, n = commands.shape
    asked = np.concatenate([np.repeat(commands[:, :1], len(before), 1), commands], 1)
    torque = simulated = None
    followed = asked
    if nominal.loaded is not None:
        made = [nominal.loaded(clock.numpy(), one, None) for one in asked]
        simulated, torque = (np.stack([m[k] for m in made]) for k in range(2))
    elif nominal.simulator is not None:
        followed = np.stack([nominal.simulator.positions(clock.numpy(), one) for one in asked])

    def rows(values: Array) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values.transpose(0, 2, 1).reshape(p * n, -1)))

    def course(values: Array | None) -> torch.Tensor | None:
        return None if values is None else torch.from_numpy(np.r_[np.full(len(before), values[0]), values])[None]

    begin = rows(followed if simulated is None else simulated)[:, 0]
    drive = Drive(
        clock.expand(p * n, -1),
        rows(followed),
        torch.stack([begin, torch.zeros_like(begin)], -1),
        course(around.supply),
        course(around.warm),
    )
    against = None if torque is None else rows(torque)

    def simulate(own: Sequence[Mapping[str, float]]) -> torch.Tensor:
        values = {
            name: torch.tensor([[axis.get(name, ABSENT[name]) for axis in own] * p], dtype=torch.float64)
            for name in {"delay"}.union(*own)
        }
        # Weights and the other joints are as late as the motion is.
        late = None
        if against is not None:
            begins = (clock[None] - values["delay"].mT).numpy()
            pairs = zip(begins, against.numpy(), strict=True)
            late = torch.from_numpy(np.stack([np.interp(t, clock.numpy(), row) for t, row in pairs]))
        return simulate_axes(drive._replace(torque=late), values)[0]

    found = simulate(axes)
    if simulated is not None:
        found = found + rows(simulated) - simulate(nominal.axes)
    return found.reshape(p, n, -1).permute(0, 2, 1).numpy()[:, len(before) :]


def corrected_command(
    nominal: Nominal,
    axes: Sequence[Mapping[str, float]],
    time: Array,
    wanted: Array,
    around: Around = AS_USUAL,
    errors: Sequence[float] | None = None,
) -> Corrected:
    """The commands at which a model goes where it is wanted, as near as the bound allows.

    Args:
        nominal, axes: the machine as identified, as of `moved`.
        time: `s` [s], increasing.
        wanted: positions, `s x n` [rad or m].
        around: of the motion.
        errors: largest ones in the logs that the machine was identified on [rad or m]; a command leaves the range of
            the wanted motion by no more than that or half of that range, and the largest error without correction.
    """
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(time)))
    rest = _standing(nominal, axes, time, wanted[0], around)
    plain = moved(nominal, axes, time, wanted[None], around)[0]
    error = wanted - plain
    largest = np.abs(error).max(0)
    limit = _BOUND * largest
    beyond = np.minimum(np.maximum(_BEYOND * np.ptp(wanted, 0), np.inf if errors is None else errors), largest)
    lowest = np.maximum(wanted - limit, wanted.min(0) - beyond)
    highest = np.minimum(wanted + limit, wanted.max(0) + beyond)
    command, position, left = wanted, plain, _rms(error)
    divided = _division(nominal, axes, time, wanted, plain, around)
    for _ in range(_STEPS):
        # Where an axis sticks, or slips, a pulse tells nothing of it: the error itself is a step as well.
        moves = [gaussian_filter1d(one, _SMOOTH / step, axis=0) for one in (divided(error), error)]
        trials = np.stack([np.clip(command + share * move, lowest, highest) for move in moves for share in _SHARES])
        # Whoever waits at the first command stands where the motion begins.
        trials[:, 0] = np.clip(rest, lowest[0], highest[0])
        found = moved(nominal, axes, time, trials, around)
        lefts = np.stack([_rms(wanted - q) for q in found])
        best = np.argmin(lefts, 0)
        better = lefts.min(0) < left
        pick = np.arange(wanted.shape[1])
        # Every joint takes its own step; one that gains nothing stays.
        command = np.where(better, trials[best, :, pick].T, command)
        position = np.where(better, found[best, :, pick].T, position)
        before, left = left, np.where(better, lefts.min(0), left)
        error = wanted - position
        if bool(np.all(left > (1 - _GAINED) * before)):
            break
    return Corrected(command, plain, position)


def _division(
    nominal: Nominal, axes: Sequence[Mapping[str, float]], time: Array, wanted: Array, plain: Array, around: Around
) -> Callable[[Array], Array]:
    """What makes of positions `s x n` the commands that move a model so, to first order about the motion.

    Its frequency response is that of a short pulse in the middle of the motion.
    """
    size, length = _HEIGHT * np.abs(wanted - plain).max(0), 2 * len(time)
    pulse = np.exp(-0.5 * ((time - time[len(time) // 2]) / _PULSE) ** 2)[:, None] * size
    made = moved(nominal, axes, time, wanted[None] + pulse, around)[0] - plain
    given, answer = (np.fft.rfft(x, length, axis=0) for x in (pulse, made))
    # Where the pulse itself has nothing, nothing is known.
    seen = np.abs(given) > _WEAKEST * np.abs(given).max(0, initial=0.0)
    response = np.where(seen, answer / np.where(seen, given, 1.0), 0.0)
    inverse = response.conj() / (np.abs(response) ** 2 + _WEAKEST**2)

    def divided(values: Array) -> Array:
        # Mirrored, so that it does not end with a jump.
        both = np.concatenate([values, values[::-1]])
        return np.fft.irfft(inverse * np.fft.rfft(both, axis=0), length, axis=0)[: len(time)]

    return divided


def _standing(
    nominal: Nominal, axes: Sequence[Mapping[str, float]], time: Array, wanted: Array, around: Around
) -> Array:
    """The command at which a machine stands where it is wanted, `n`."""
    command = wanted.copy()
    for _ in range(_STANDING):
        held = np.broadcast_to(command, (1, 2, len(command)))
        command = command + wanted - moved(nominal, axes, time[:2], held, around.at(slice(2)))[0, 0]
    return command


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.square(values).mean(0)))
