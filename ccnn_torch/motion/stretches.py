"""Logs cut into stretches of a second or two, which are simulated side by side.

A stretch begins with a lead that is simulated and not judged: what is not known of the state at its start has faded by
its end. The folds of a cross-validation are whole runs, or stretches of a run where there is only one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.display import count_text
from ccnn_torch.errors import InputError
from ccnn_torch.motion.log import Log

PLACES = 8
START = (
    *("q0", "v0", *(f"q{k}" for k in range(PLACES)), "acceleration", "speed", "direction", "command", "position"),
    *("torque", "error", "time", "moved"),
)
"""What is known of an axis at the first sample: its position and speed; positions while the log began of which the
samples are a part, and means over that time, which tell what an integral action held; and from then to the first
sample the integral of command less position, the time, and how far the command moved."""

# Seconds of the part that is judged, and of the lead.
_JUDGED, _LEAD = 1.2, 0.3
# A stretch is judged over at least so long.
_SHORTEST = 0.4
# Samples are thinned to this spacing [s]: nothing that is looked for is faster.
_STEP = 0.008
# At most so many stretches are evaluated, spread evenly over the logs.
_MOST = 48
# Share of the mean speed at which a direction is settled.
_SOFT = 0.1
# Half the width of the window in which the speed is the slope of a parabola [s].
_WINDOW = 0.03


Array = NDArray[np.float64]


class Stretches(NamedTuple):
    """`n` joints, `b` stretches, `s` samples, padded.

    Attributes:
        time: `b x s` [s], increasing also in the padding.
        command, position: `n x b x s` [rad or m].
        speed: smoothed, `n x b x s`.
        judged: whether a sample counts, `b x s`.
        run: the number of the log of each, `b`.
        beside: recorded columns by name, `b x s`.
        log: every sample's place in its log, `b x s`, int64.
        units: of the joints.
        notes: what was left out, one sentence each without a full stop.
        bent: as of `Drive`; None where no log was thinned.
        begin: `START` of each stretch but for its position and speed, the torque 0, `n x b x 17`; None where nothing
            is known beyond its samples.
    """

    time: Tensor
    command: Tensor
    position: Tensor
    speed: Tensor
    judged: Tensor
    run: Tensor
    beside: dict[str, Tensor]
    log: Tensor
    units: tuple[str, ...]
    notes: tuple[str, ...]
    begin: Tensor | None
    bent: Tensor | None = None

    def under(self, torque: Tensor) -> Stretches:
        """With what resists the motors, `n x b x s`, at the first sample of the first stretch of each run."""
        if self.begin is None:
            return self
        begin = self.begin.clone()
        begin[..., START.index("torque") - 2] = torque[:, torch.searchsorted(self.run, self.run), 0]
        return self._replace(begin=begin)


def cut_stretches(logs: Sequence[Log]) -> Stretches:
    """Cut logs of one machine into stretches.

    Raises:
        InputError: no part with the drive on is long enough.
    """
    pieces: list[tuple[int, NDArray[np.int64], int]] = []
    means: list[Array] = []
    notes = [note for log in logs for note in log.notes]
    strides = []
    for number, log in enumerate(logs):
        step = float(np.median(np.diff(log.time)))
        # Half a step more, so that 3.9 ms are not thinned to 7.8.
        stride = max(int((_STEP + 0.5 * step) / step), 1)
        strides.append(stride)
        ends = np.flatnonzero(log.cut | np.diff(log.on, prepend=log.on[:1]))
        for part in np.split(np.arange(len(log.time)), ends):
            rows = part[::stride]
            found = _pieces(log.time[rows], rows) if log.on[part].all() else []
            pieces += [(number, *piece) for piece in found]
            means += [*_begins(log, part, [rows[0] - part[0] for rows, _ in found])] if found else []
    if not pieces:
        raise InputError(
            f"{', '.join(log.name for log in logs)}: no part with the drive on and without gaps lasts "
            f"{_LEAD + _SHORTEST:g} s"
        )
    if max(strides) > 1:
        notes.append(f"one sample in {max(strides)} was evaluated, one in {_STEP * 1e3:.0f} ms or so")
    if len(pieces) > _MOST:
        notes.append(f"{_MOST} of {count_text(len(pieces), 'stretch')}, spread evenly over the logs, were evaluated")
        kept = np.unique(np.linspace(0, len(pieces) - 1, _MOST).round().astype(int))
        pieces, means = [pieces[i] for i in kept], [means[i] for i in kept]
    # A command is a straight line between the samples of the log, not between those that are left.
    bent = torch.tensor([1 - strides[number] ** -2 for number, _, _ in pieces], dtype=torch.float64)
    begin = torch.from_numpy(np.stack(means, 1))
    return _padded(logs, pieces, notes)._replace(bent=bent if max(strides) > 1 else None, begin=begin)


def _begins(log: Log, part: NDArray[np.int64], stretches: Sequence[int]) -> Iterator[Array]:
    """`begin` of stretches that begin at these samples of a part of a log, `n x 17` each."""
    time, command, position = log.time[part], log.command[part], log.position[part]
    speed, error = smooth_speed(time, position), command - position
    steps = np.diff(time)[:, None]
    wound = np.concatenate([np.zeros_like(error[:1]), np.cumsum(0.5 * steps * (error[1:] + error[:-1]), 0)])
    # Not from the very first sample on, where a speed is known worst.
    first, last = (int(np.searchsorted(time, time[0] + t)) for t in (_WINDOW, _WINDOW + _LEAD))
    here = slice(first, max(last, first + 2))
    over = time[here][-1] - time[first]

    def mean(values: Array) -> Array:
        return np.asarray(np.trapezoid(values[here], time[here], axis=0) / over)

    faster = (speed[here][-1] - speed[first]) / over
    usual = (faster, mean(speed), mean(np.sign(speed)), mean(command), mean(position), np.zeros_like(faster))
    some = position[here][np.linspace(0, len(time[here]) - 1, PLACES).round().astype(int)]
    for k in stretches:
        since = (
            wound[k] - mean(wound),
            time[k] - mean(np.broadcast_to(time[:, None], error.shape)),
            command[k] - usual[3],
        )
        yield np.stack([*some, *usual, *since], -1)


def smooth_speed(time: Array, position: Array) -> Array:
    """Slope of a parabola through the neighbours of each sample, `s x n` [rad/s] (Savitzky and Golay 1964)."""
    step = float(np.median(np.diff(time)))
    half = min(max(round(_WINDOW / step), 2), (len(time) - 1) // 2)
    if half < 2:
        return np.gradient(position, time, axis=0)
    # Of both, as the steps are not equal.
    slopes = _slopes(np.column_stack([time, position]), half)
    return slopes[:, 1:] / slopes[:, :1]


def direction(speed: Tensor, usual: Tensor) -> Tensor:
    """The sign of a speed, soft near standstill, of which a last digit then decides nothing; usual: mean size."""
    return torch.tanh(speed / (_SOFT * usual).clamp_min(1e-12))


def _slopes(values: Array, half: int) -> Array:
    """Slope for each sample, `s x n`, of the parabola through `half` neighbours on both sides; at the ends of the
    first and the last one."""
    place = np.arange(-half, half + 1.0)
    curved = np.square(place) - np.square(place).mean()
    windows = np.lib.stride_tricks.sliding_window_view(values, len(place), axis=0)
    slope, bend = windows @ (place / (place @ place)), 2 * windows[[0, -1]] @ (curved / (curved @ curved))
    ends = place[:half, None], place[half + 1 :, None]
    return np.concatenate([slope[0] + ends[0] * bend[0], slope, slope[-1] + ends[1] * bend[1]])


def _pieces(time: Array, rows: NDArray[np.int64]) -> list[tuple[NDArray[np.int64], int]]:
    """Rows of each stretch with its lead, and the number of samples of the lead."""
    if len(time) < 8 or time[-1] - time[0] < _LEAD + _SHORTEST:
        return []
    lead = int(np.searchsorted(time, time[0] + _LEAD))
    count = max(round((time[-1] - time[lead]) / _JUDGED), 1)
    begins = np.searchsorted(time, np.linspace(time[lead], time[-1], count + 1))
    found = []
    for a, b in pairwise(begins.tolist()):
        first = int(np.searchsorted(time, time[a] - _LEAD))
        found.append((rows[first : b + 1 if b == len(time) - 1 else b], int(a) - first))
    return found


def _padded(logs: Sequence[Log], pieces: Sequence[tuple[int, NDArray[np.int64], int]], notes: list[str]) -> Stretches:
    length, n = max(len(rows) for _, rows, _ in pieces), len(logs[0].units)
    names = set.intersection(*(set(log.beside) for log in logs))
    time = np.zeros((len(pieces), length))
    command, position, speed = (np.zeros((n, len(pieces), length)) for _ in range(3))
    judged = np.zeros((len(pieces), length), dtype=np.bool_)
    place = np.full((len(pieces), length), -1, dtype=np.int64)
    beside = {name: np.zeros((len(pieces), length)) for name in sorted(names)}
    for k, (number, rows, lead) in enumerate(pieces):
        log, m, every = logs[number], len(rows), np.arange(length)
        # The last sample again and again, ever later.
        filled, beyond = np.minimum(every, m - 1), np.maximum(every - m + 1, 0)
        index, place[k, :m], judged[k, lead:m] = rows[filled], rows, True
        time[k] = log.time[index] + beyond * np.median(np.diff(log.time[rows]))
        speed[:, k] = smooth_speed(log.time[rows], log.position[rows])[filled].T
        command[:, k], position[:, k] = log.command[index].T, log.position[index].T
        for name, column in beside.items():
            column[k] = log.beside[name][index]
    return Stretches(
        time=torch.from_numpy(time),
        command=torch.from_numpy(command),
        position=torch.from_numpy(position),
        speed=torch.from_numpy(speed),
        judged=torch.from_numpy(judged),
        run=torch.tensor([number for number, _, _ in pieces]),
        beside={name: torch.from_numpy(v) for name, v in beside.items()},
        log=torch.from_numpy(place),
        units=logs[0].units,
        notes=tuple(notes),
        begin=None,
    )


def nearly_largest(values: Tensor) -> Tensor:
    """Of sizes `… x s`."""
    return torch.quantile(values.abs(), _NEARLY, dim=-1)


PHASES = ("standstill", "reversal", "fast", "slow")
# Shares of nearly the largest speed.
_STILL, _FAST = 0.03, 0.5
# Quantile of what counts as nearly the largest.
_NEARLY = 0.98
# Seconds before and after a change of direction.
_AROUND = 0.15


def phases_of(data: Stretches) -> Tensor:
    """Phase of each sample of each joint by its measured speed, an index of `PHASES`, `n x b x s`."""
    speed, width = data.speed, 2 * int(_AROUND / data.time.diff(dim=-1).median()) + 1
    most = nearly_largest(speed[:, data.judged])[:, None, None]
    moving = speed.abs() > _STILL * most
    sign = torch.sign(speed) * moving
    # The last direction in which it moved, so that a stop between two directions is a reversal too.
    place = torch.arange(sign.shape[-1]).expand(sign.shape)
    last = sign.gather(-1, torch.where(sign != 0, place, 0).cummax(-1).values)
    turned = torch.nn.functional.pad((last[..., 1:] * last[..., :-1] < 0).double(), (1, 0))
    near = torch.nn.functional.max_pool1d(turned, width, 1, width // 2) > 0
    found = torch.full(speed.shape, PHASES.index("slow"))
    found[speed.abs() > _FAST * most] = PHASES.index("fast")
    found[near] = PHASES.index("reversal")
    found[~moving & ~near] = PHASES.index("standstill")
    return found
