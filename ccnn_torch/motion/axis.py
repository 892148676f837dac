"""One position-controlled axis, simulated for many parameters, runs and joints at once.

The motor's torque is the gain times (command less position). With everything divided by the nominal gain, an axis obeys

    inertia * q'' = clip(gain * supply * (u - q + integral * I + derivative * (u' - q')), (1 - fading * q') / weakness)
                    - viscous * q' - F(q') * sign(q') - weight(q) - teeth(q)

where u is the command after delay, speed limit, gear ratio and offset, u' the share `forward` of its speed, late by
`forward_lag`, and I the integral of u - q over the time, in a cascade of u - q + derivative * (u' - q'):
torques are then angles (N m per N m/rad), the inertia is in s^2, the viscous friction in s; a part of that which the
drive makes is within the limit, too. Within a dead band u - q counts as 0. With all of these 0 the position follows
the command exactly: that axis is nominal where nothing is known. Behind a flexible joint, load and weight hang on a
spring that pulls at the motor. Play, and the uneven transmission of a gear or screw, come behind all that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.motion.compilable import is_compiled
from ccnn_torch.motion.course import course, courses, curved
from ccnn_torch.motion.stage import ABSENT, TINY, Given, axis_of
from ccnn_torch.motion.stretches import PLACES, START

Array = NDArray[np.float64]
# Steps longer than this, in units of the axis' own time constant, are divided.
_LONGEST, _MOST_PARTS = 0.15, 8
# Samples of axes for which another thread begins to pay.
_SAMPLES = 5000


class Drive(NamedTuple):
    """What an axis is given: one entry for each of `b` runs of an axis, padded to `s` samples.

    Of several axes in the same runs, one after the other, what they share may stand there once: entries with fewer rows
    than the command are repeated.

    Attributes:
        time: `b x s` [s], increasing, also in the padding.
        command: `b x s` [rad or m].
        start: position and speed of the first sample, `b x 2`; or all of `START`, where it begins within a log.
        supply: supply voltage over the nominal one, less 1, `b x s`; None = 0.
        warm: temperature less that of the coldest sample, `b x s` [K]; None = 0.
        torque: what else resists the motor, over the nominal gain, `b x s` [rad or m].
        bent: share of a parabola by which commands leave the straight line between samples, `b`: 0 where every sample
            is there, nearly 1 of those that were thinned; None = 0.
        usual: median step, `b` [s]; None = that of `time`.
    """

    time: Tensor
    command: Tensor
    start: Tensor
    supply: Tensor | None = None
    warm: Tensor | None = None
    torque: Tensor | None = None
    bent: Tensor | None = None
    usual: Tensor | None = None


def simulate_axes(
    drive: Drive, parameters: Mapping[str, Tensor], fast: bool | None = None, rows: Tensor | None = None
) -> Tensor:
    """Positions of axes.

    Args:
        drive: of `b` runs.
        parameters: any of `ABSENT` by name, each broadcastable to `p x b`; others are nothing to an axis.
        fast: one axis after the other, compiled by numba, or all at once in numpy; None = what is installed.
        rows: runs of each axis, `p x r`, to which its parameters are then broadcast; None = all.

    Returns:
        `p x b x s` (`p x r x s`) [rad or m]; the first dimension is 1 where all parameters' are.
    """
    b, s = drive.command.shape
    # Every entry has the same first dimension then, also where a single value stands for all.
    p = max([1 if rows is None else len(rows), *(len(v) for v in parameters.values())])
    runs = np.broadcast_to(np.arange(b), (p, b)) if rows is None else rows.numpy()
    # Where all runs have the same parameters they stand there once.
    wide = max([1, *(v.shape[-1] for v in parameters.values())])
    given = np.tile(np.array([*ABSENT.values()]), (p, wide, 1))
    for k, name in enumerate(ABSENT):
        if name in parameters:
            given[..., k] = parameters[name].numpy()
    given = given.reshape(-1, len(ABSENT))
    a, has = Given(*given.T), given != np.array([*ABSENT.values()])
    # Which parameters and which run each one has.
    own = (np.arange(p)[:, None] * wide + np.arange(runs.shape[1]) % wide).ravel()
    # A copy: of one that is read-only the loop would be compiled once more.
    run = np.array(runs).ravel()
    # The fastest motion of an axis is that of its mass on the gain: each has steps of its own, whatever is beside it.
    masses = a.inertia / np.maximum(a.gain, TINY)
    fast_ones = np.sqrt(np.where(masses > 0, masses, math.inf))[own]
    usual = np.median(drive.time.diff(dim=-1).numpy(), -1) if drive.usual is None else drive.usual.numpy()
    parts = np.ceil(usual[run % len(usual)] / np.maximum(fast_ones, TINY) / _LONGEST)
    parts = np.clip(parts, 1, _MOST_PARTS).astype(np.int64)
    start = _start_of(drive)
    bent = np.zeros(1) if drive.bent is None else drive.bent.numpy()
    there = (True, bool(a.supply.any()), bool(a.thermal.any()))
    push, supply, warm = (
        np.ascontiguousarray(one.numpy()) if has and one is not None else np.zeros((1, 1))
        for one, has in zip((drive.torque, drive.supply, drive.warm), there, strict=True)
    )
    time, command = (np.ascontiguousarray(one.numpy()) for one in (drive.time, drive.command))
    if is_compiled() if fast is None else fast:
        # Axes know nothing of each other, and the compiled loop lets other threads run.
        lots = np.array_split(np.arange(len(run)), min(torch.get_num_threads(), 1 + len(run) * s // _SAMPLES))

        def moved(lot: NDArray[np.int64]) -> Array:
            found: Array = courses(
                given, has, own[lot], run[lot], time, command, start, bent, push, supply, warm, parts[lot]
            )
            return found

        with ThreadPoolExecutor(len(lots)) as threads:
            together = np.concatenate([*(map if len(lots) == 1 else threads.map)(moved, lots)])
        return torch.from_numpy(together).reshape(*runs.shape, s)
    row = run % len(time)
    delayed = zip(row, run, a.delay[own], strict=True)
    late = np.stack([_late(time[k], command[j], d, float(bent[j % len(bent)])) for k, j, d in delayed])
    u, step = late * (1 + a.ratio[own, None]) + a.offset[own, None], np.diff(time)
    found = np.empty((len(run), s))
    for many in np.unique(parts):
        here = np.flatnonzero(parts == many)
        some = axis_of(Given(*given[own[here]].T))
        has_any = Given(*has[own[here]].any(0).tolist())
        one, begin, bend, resists, volts, heat = (
            v[run[here] % len(v)].T for v in (step, start, bent, push, supply, warm)
        )
        found[here] = course(some, has_any, one, u[here].T.copy(), begin, bend, resists, volts, heat, int(many)).T
    return torch.from_numpy(found).reshape(*runs.shape, s)


def _late(time: Array, command: Array, delay: float, bent: float) -> Array:
    """The command of so much before, `s`; arguments as of `Drive`."""
    at = time - delay
    found: Array = np.interp(at, time, command)
    if bent == 0 or delay == 0:
        return found
    turns = np.diff(command, 2)
    bends = curved(turns[[0, *range(len(turns))]], turns[[*range(len(turns)), -1]])
    which = np.clip(np.searchsorted(time, at, "right") - 1, 0, len(time) - 2)
    share = np.clip((at - time[which]) / (time[which + 1] - time[which]), 0.0, 1.0)
    return found + bent * share * (1 - share) * bends[which]


def _start_of(drive: Drive) -> Array:
    """All of `START`, `b x 19`: where nothing else is known, the means are those of the first sample."""
    start = drive.start.numpy()
    if start.shape[1] == len(START):
        return start
    found, (q, v) = np.zeros((len(start), len(START))), start.T
    torque = 0.0 if drive.torque is None else drive.torque[np.arange(len(start)) % len(drive.torque), 0].numpy()
    means = (0.0, v, np.sign(v), drive.command[:, 0].numpy(), q, torque)
    for k, value in enumerate((q, v, *[q] * PLACES, *means)):
        found[:, k] = value
    return found
