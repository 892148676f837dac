"""One position-controlled axis, simulated for many parameters, runs and joints at once.

The motor's torque is the gain times (command less position). With everything divided by the nominal gain, an axis obeys

    inertia * q'' = clip(gain * supply * (u - q + integral * I + derivative * (u' - q')), 1 / weakness)
                    - viscous * q' - F(q') * sign(q') - weight(q) - teeth(q)

where u is the command after delay, speed limit and offset, and I the integral of u - q over the time: torques are then
angles (N m per N m/rad), the inertia is in s^2, the viscous friction in s; a part of that which the drive makes is
within the limit, too. With all of these 0 the position follows the command exactly: that axis is nominal where nothing
is known. Behind a flexible joint, load and weight hang on a spring that pulls at the motor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.motion.compilable import is_compiled, loop
from ccnn_torch.motion.stage import (
    ABSENT,
    TINY,
    Axis,
    Course,
    State,
    axis_of,
    begun,
    compiled,
    load_inertia,
    plainly,
    wave_of,
)

Array = NDArray[np.float64]
Move = Callable[[Axis, State, Course, NDArray[np.int64]], Array]
"""`plainly` or `compiled`."""
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


def simulate_axes(drive: Drive, parameters: Mapping[str, Tensor], move: Move | None = None) -> Tensor:
    """Positions of axes.

    Args:
        drive: of `b` runs.
        parameters: any of `ABSENT` by name, each broadcastable to `p x b`.
        move: what goes from sample to sample; None = compiled where numba is installed, else `plainly`.

    Returns:
        `p x b x s` [rad or m]; the first dimension is 1 where all parameters' are.
    """
    like = drive.command
    # Every entry has the same first dimension then, also where a single value stands for all.
    shape = torch.Size([max([1, *(len(v) for v in parameters.values())]), len(like)])
    tensors = {n: parameters.get(n, like.new_full((1, 1), v)).expand(shape) for n, v in ABSENT.items()}
    u, torque = drive.command, drive.torque
    if bool((tensors["delay"] != 0).any()):
        u = torch.where(tensors["delay"][..., None] != 0, delayed(drive.time, u, tensors["delay"]), u)
    u = u.expand(*shape, -1) + tensors["offset"][..., None]
    a = {n: v.numpy() for n, v in tensors.items()}
    steps = drive.time.diff(dim=-1).numpy().T
    # Samples first: one sample of all runs lies together in memory.
    commands = np.ascontiguousarray(u.permute(2, 0, 1).numpy())
    push = None if torque is None else np.ascontiguousarray(torque.expand(*shape, -1).permute(2, 0, 1).numpy())
    if np.any(a["slowness"] > 0):
        slow = a["slowness"] > 0
        limited = _limited(steps, commands, 1 / np.maximum(a["slowness"], TINY), _held_at(drive, push, a))
        commands = np.where(slow, limited, commands)
    if np.any(a["derivative"]):
        commands = commands + _lead(steps, commands, a["derivative"], a["integral"])
        # The other half of it resists the speed, within the limit of the motor.
        damping = a["gain"] * a["derivative"]
        a |= {n: a[n] + damping for n in ("viscous", "drive_damping")}
    moved = _moved(drive, steps, commands, push, a, move or (compiled if is_compiled() else plainly))
    if np.any(a["play"] > 0):
        loaded = a["play_loaded"] > 0
        driven = played(moved, a["play"] / 2)
        if np.any(loaded):
            driven = np.where(loaded, hung(steps, moved, push, a), driven)
        moved = driven
    return torch.from_numpy(moved).permute(1, 2, 0)


def _moved(drive: Drive, steps: Array, u: Array, push: Array | None, a: Mapping[str, Array], move: Move) -> Array:
    """What the encoder shows but for a play, `s x p x b`."""
    # The fastest motion of an axis is that of its mass on the gain: each has steps of its own, whatever is beside it.
    masses = a["inertia"] / np.maximum(a["gain"], TINY)
    fast = np.sqrt(np.where(masses > 0, masses, math.inf))
    many = np.clip(np.ceil(np.median(steps, 0) / np.maximum(fast, TINY) / _LONGEST), 1, _MOST_PARTS).astype(np.int64)
    shape, none = u.shape[1:], np.zeros((1, *u.shape[1:]))
    start, axis = drive.start.numpy(), axis_of(a)
    q, v, faster = (np.broadcast_to(start[:, k], shape) if k < start.shape[1] else np.zeros(shape) for k in range(3))
    state = begun(axis, a, q, v, faster, u[0], none[0] if push is None else push[0])
    bend = none if drive.bent is None else _bend(u) * drive.bent.numpy()
    supply, warm = (
        none if values is None or not np.any(a[name]) else np.broadcast_to(values.numpy().T[:, None], u.shape)
        for name, values in (("supply", drive.supply), ("thermal", drive.warm))
    )
    step = np.broadcast_to(steps[:, None], (len(steps), *shape))
    course = Course(*(v.reshape(len(v), -1) for v in (step, u, bend, none if push is None else push, supply, warm)))
    flat, state = Axis(*(v.ravel() for v in axis)), State(*(v.ravel() for v in state))
    return move(flat, state, course, many.ravel()).reshape(u.shape)


def _bend(u: Array) -> Array:
    """Of each step four times what a parabola through the samples is above the middle of a straight line; 0 at a jump
    or corner, `(s - 1) x p x b`."""
    second = np.diff(u, 2, axis=0)
    second = np.concatenate([second[:1], second, second[-1:]]) if len(second) else np.zeros_like(u)
    a, b = second[:-1], second[1:]
    return np.asarray(-0.5 * np.where(a * b > 0, np.sign(a) * np.minimum(np.abs(a), np.abs(b)), 0.0))


def _between(values: Array, k: int, share: float) -> Array:
    return np.asarray(values[k] + share * (values[k + 1] - values[k]))


def _held_at(drive: Drive, push: Array | None, a: Mapping[str, Array]) -> Array:
    """The command, `p x b`, at which an axis moves as it does at its start, but for its friction and inertia."""
    q, v = drive.start[:, 0].numpy(), drive.start[:, 1].numpy()
    weight, hang = wave_of(a["gravity_sin"], a["gravity_cos"])
    load = weight * np.sin(q + hang) + a["viscous"] * v + (0.0 if push is None else push[0])
    return np.asarray(q + load / np.maximum(a["gain"], TINY))


@loop
def _limited(steps: Array, u: Array, fastest: Array, begin: Array) -> Array:
    """Commands that change no faster than [rad/s], and may be behind already where they begin, `p x b`."""
    found = u.copy()
    found[0] = begin
    for k in range(len(steps)):
        reach = fastest * steps[k]
        found[k + 1] = found[k] + np.minimum(np.maximum(u[k + 1] - found[k], -reach), reach)
    return found


def _lead(steps: Array, u: Array, derivative: Array, integral: Array) -> Array:
    """What a derivative gain adds to commands, `s x p x b`; less what the integral action would make of that, which
    integrates the commands alone."""
    step, rise = steps[:, None], np.diff(u, axis=0)
    inner = (rise[1:] + rise[:-1]) / (step[1:] + step[:-1])
    found: Array = derivative * np.concatenate([rise[:1] / step[:1], inner, rise[-1:] / step[-1:]])
    return _faded(steps, found, integral) if np.any(integral) else found


@loop
def _faded(steps: Array, lead: Array, integral: Array) -> Array:
    found = lead.copy()
    for k in range(len(steps)):
        fades = 0.5 * integral * steps[k]
        faded = (found[k] * (1 - fades) + lead[k + 1] - lead[k]) / (1 + fades)
        found[k + 1] = np.where(integral > 0, faded, lead[k + 1])
    return found


@loop
def played(q: Array, half: Array) -> Array:
    """The driven side of a play, which rests in the middle at first."""
    found = q.copy()
    for k in range(1, len(q)):
        found[k] = np.maximum(np.minimum(found[k - 1], q[k] + half), q[k] - half)
    return found


def hung(steps: Array, q: Array, push: Array | None, a: Mapping[str, Array]) -> Array:
    """The driven side of a play, which is free between its ends but for its friction, and does not bounce there."""
    weight, hang = wave_of(a["gravity_sin"], a["gravity_cos"])
    inertia = load_inertia(a)
    light = np.where(inertia > 0, 1 / np.maximum(inertia, TINY), 0.0)
    # Accelerations by which the weight and the other joints turn it back [rad/s^2].
    pushed = np.zeros((1, *q.shape[1:])) if push is None else push * light
    return _hung(steps, q, pushed, weight * light, hang, a["play"] / 2, a["play_friction"])


@loop
def _hung(steps: Array, q: Array, push: Array, fall: Array, hang: Array, half: Array, friction: Array) -> Array:
    found, v = q.copy(), np.zeros_like(q[0])
    x = q[0] - half * np.sign(fall * np.sin(q[0] + hang) + push[0])
    found[0] = x
    for k in range(len(steps)):
        h = steps[k]
        v = v - h * (fall * np.sin(x + hang) + push[min(k, len(push) - 1)])
        # Its bearing brakes it, up to standstill.
        v = np.sign(v) * np.maximum(np.abs(v) - h * friction, 0.0)
        free = x + h * v
        held = np.minimum(np.maximum(free, q[k + 1] - half), q[k + 1] + half)
        v = np.where(held == free, v, (q[k + 1] - q[k]) / h)
        x = held
        found[k + 1] = x
    return found
