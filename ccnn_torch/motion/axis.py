"""One position-controlled axis, simulated for many parameters, runs and joints at once.

The motor's torque is the gain times (command less position). With everything divided by the nominal gain, an axis obeys

    inertia * q'' = clip(gain * supply * (u - q + integral * I + derivative * (u' - q')), 1 / weakness)
                    - viscous * q' - F(q') * sign(q') - weight(q) - teeth(q)

where u is the command after delay, speed limit and offset, and I the integral of u - q over the time: torques are then
angles (N m per N m/rad), the inertia is in s^2, the viscous friction in s; a part of that which the drive makes is
within the limit, too. Within a dead band u - q counts as 0. With all of these 0 the position follows the command
exactly: that axis is nominal where nothing is known. Behind a flexible joint, load and weight hang on a spring that
pulls at the motor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.motion.compilable import is_compiled
from ccnn_torch.motion.course import compiled, course
from ccnn_torch.motion.stage import ABSENT, TINY, Axis, Has, axis_of, each_has

Array = NDArray[np.float64]
# Steps longer than this, in units of the axis' own time constant, are divided.
_LONGEST, _MOST_PARTS = 0.6, 8


class Drive(NamedTuple):
    """What an axis is given: one entry for each of `b` runs of an axis, padded to `s` samples.

    Attributes:
        time: `b x s` [s], increasing, also in the padding.
        command: `b x s` [rad or m].
        start: position and speed of the first sample, and its acceleration where it does not begin at rest, `b x 2` or
            `b x 3`.
        supply: supply voltage over the nominal one, less 1, `b x s`; None = 0.
        warm: temperature less that of the coldest sample, `b x s` [K]; None = 0.
        torque: what else resists the motor, over the nominal gain, `b x s` [rad or m].
        bent: share of a parabola by which commands leave the straight line between samples, `b`: 0 where every sample
            is there, nearly 1 of those that were thinned; None = 0.
    """

    time: Tensor
    command: Tensor
    start: Tensor
    supply: Tensor | None = None
    warm: Tensor | None = None
    torque: Tensor | None = None
    bent: Tensor | None = None


def delayed(time: Tensor, values: Tensor, delay: Tensor) -> Tensor:
    """Values a delay earlier, linear between samples, the first one before the first sample.

    Args:
        time: `b x s` [s].
        values: `b x s`.
        delay: `p x b` [s].

    Returns:
        `p x b x s`.
    """
    p, (b, s) = len(delay), time.shape
    wanted = (time - delay[..., None]).transpose(0, 1).reshape(b, p * s).contiguous()
    after = torch.searchsorted(time.contiguous(), wanted).clamp(1, s - 1)
    t0, t1 = time.gather(1, after - 1), time.gather(1, after)
    x0, x1 = values.gather(1, after - 1), values.gather(1, after)
    share = ((wanted - t0) / (t1 - t0)).clamp(0, 1)
    return (x0 + (x1 - x0) * share).reshape(b, p, s).transpose(0, 1)


def simulate_axes(drive: Drive, parameters: Mapping[str, Tensor], fast: bool | None = None) -> Tensor:
    """Positions of axes.

    Args:
        drive: of `b` runs.
        parameters: any of `ABSENT` by name, each broadcastable to `p x b`; others are nothing to an axis.
        fast: one axis after the other, compiled by numba, or all at once in numpy; None = what is installed.

    Returns:
        `p x b x s` [rad or m]; the first dimension is 1 where all parameters' are.
    """
    b, s = drive.command.shape
    # Every entry has the same first dimension then, also where a single value stands for all.
    p = max([1, *(len(v) for v in parameters.values())])
    a = {n: np.full((p, b), v) for n, v in ABSENT.items()}
    for name in a.keys() & parameters.keys():
        a[name][:] = parameters[name].numpy()
    axis, offset = Axis(*(v.ravel() for v in axis_of(a))), a["offset"].ravel()
    # The fastest motion of an axis is that of its mass on the gain: each has steps of its own, whatever is beside it.
    masses = axis.whole / np.maximum(axis.gain, TINY)
    fast_ones = np.sqrt(np.where(masses > 0, masses, math.inf))
    usual = np.tile(np.median(drive.time.diff(dim=-1).numpy(), -1), p)
    parts = np.clip(np.ceil(usual / np.maximum(fast_ones, TINY) / _LONGEST), 1, _MOST_PARTS).astype(np.int64)
    start = np.zeros((b, 3))
    start[:, : drive.start.shape[1]] = drive.start.numpy()
    bent = np.zeros(b) if drive.bent is None else drive.bent.numpy()
    there = (True, bool(axis.supply.any()), bool(axis.thermal.any()))
    beside = [
        np.ascontiguousarray(one.expand(b, -1).numpy()) if has and one is not None else np.zeros((b, 1))
        for one, has in zip((drive.torque, drive.supply, drive.warm), there, strict=True)
    ]
    push, supply, warm = beside
    if is_compiled() if fast is None else fast:
        time, command = (np.ascontiguousarray(one.expand(b, -1).numpy()) for one in (drive.time, drive.command))
        together = compiled(axis, offset, time, command, start, bent, push, supply, warm, parts)
        return torch.from_numpy(together).reshape(p, b, s)
    delay, late = torch.from_numpy(a["delay"]), drive.command.expand(p, -1, -1)
    if bool((delay != 0).any()):
        late = torch.where(delay[..., None] != 0, delayed(drive.time, drive.command, delay), late)
    u = (late.reshape(p * b, s) + torch.from_numpy(offset)[:, None]).numpy()
    step, run = drive.time.diff(dim=-1).numpy(), np.tile(np.arange(b), p)
    found = np.empty((p * b, s))
    for many in np.unique(parts):
        here = np.flatnonzero(parts == many)
        own = Axis(*(v[here] for v in axis))
        has = Has(*(bool(v.any()) for v in each_has(own)))
        one, begin, bend, resists, volts, heat = (v[run[here]].T for v in (step, start, bent, push, supply, warm))
        found[here] = course(own, has, one, u[here].T.copy(), begin, bend, resists, volts, heat, int(many)).T
    return torch.from_numpy(found).reshape(p, b, s)
