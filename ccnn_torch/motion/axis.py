"""One position-controlled axis, simulated for many parameters, runs and joints at once.

The motor's torque is the gain times (command less position). With everything divided by the nominal gain, an axis obeys

    inertia * q'' = clip(gain * supply * (u - q), 1 / weakness) - viscous * q' - F(q') * sign(q') - weight(q) - teeth(q)

where u is the command after delay, speed limit and offset: torques are then angles (N m per N m/rad), the inertia is
in s^2, the viscous friction in s. With all of these 0 the position follows the command exactly: that axis is nominal
where nothing is known. The rule for the integration is SDIRK2 (Alexander 1977), whose two implicit stages are solved in
closed form, dry friction included, so that an axis without mass, or one that sticks, needs no smaller steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

ABSENT: dict[str, float] = {
    "gain": 1.0,
    "inertia": 0.0,
    "load": 0.0,
    "viscous": 0.0,
    "coulomb": 0.0,
    "load_friction": 0.0,
    "stribeck": 0.0,
    "stribeck_speed": 0.1,
    "thermal": 0.0,
    "gravity_sin": 0.0,
    "gravity_cos": 0.0,
    "cogging_sin": 0.0,
    "cogging_cos": 0.0,
    "cogging_order": 1.0,
    "weakness": 0.0,
    "slowness": 0.0,
    "delay": 0.0,
    "offset": 0.0,
    "supply": 0.0,
    "play": 0.0,
    "play_loaded": 0.0,
    "flexibility": 0.0,
    "flexible_damping": 0.1,
}
"""Parameters of an axis and the values of one that follows its command: angles in rad (m of a sliding axis), s, 1."""

Array = NDArray[np.float64]
_GAMMA = 1 - 1 / math.sqrt(2)
_TINY = 1e-9
# rad/s or m/s: no axis is faster, and no number may overflow.
_FASTEST = 1e4
# Steps longer than this, in units of the axis' own time constant, are divided.
_LONGEST, _MOST_PARTS = 0.6, 8


class Drive(NamedTuple):
    """What an axis is given: one entry for each of `b` runs of an axis, padded to `s` samples.

    Attributes:
        time: `b x s` [s], increasing, also in the padding.
        command: `b x s` [rad or m].
        start: position and speed of the first sample, `b x 2`.
        supply: supply voltage over the nominal one, less 1, `b x s`; None = 0.
        warm: temperature less that of the first sample, `b x s` [K]; None = 0.
        torque: what else resists the motor, over the nominal gain, `b x s` [rad or m]; it comes as late as the command.
    """

    time: Tensor
    command: Tensor
    start: Tensor
    supply: Tensor | None = None
    warm: Tensor | None = None
    torque: Tensor | None = None


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


def simulate_axes(drive: Drive, parameters: Mapping[str, Tensor]) -> Tensor:
    """Positions of axes.

    Args:
        drive: of `b` runs.
        parameters: any of `ABSENT` by name, each broadcastable to `p x b`.

    Returns:
        `p x b x s` [rad or m]; the first dimension is 1 where all parameters' are.
    """
    like = drive.command
    # Every entry has the same first dimension then, also where a single value stands for all.
    shape = torch.Size([max([1, *(len(v) for v in parameters.values())]), len(like)])
    tensors = {n: parameters.get(n, like.new_full((1, 1), v)).expand(shape) for n, v in ABSENT.items()}
    u, torque = drive.command, drive.torque
    if bool((tensors["delay"] != 0).any()):
        # Weights and the other joints are late as well, as the motion is.
        u = delayed(drive.time, u, tensors["delay"])
        torque = None if torque is None else delayed(drive.time, torque, tensors["delay"])
    u = u.expand(*shape, -1) + tensors["offset"][..., None]
    a = {n: v.numpy() for n, v in tensors.items()}
    steps = drive.time.diff(dim=-1).numpy().T
    # Samples first: one sample of all runs lies together in memory.
    commands = np.ascontiguousarray(u.permute(2, 0, 1).numpy())
    push = None if torque is None else np.ascontiguousarray(torque.expand(*shape, -1).permute(2, 0, 1).numpy())
    if np.any(a["slowness"] > 0):
        commands = _limited(steps, commands, 1 / np.maximum(a["slowness"], _TINY), _held_at(drive, push, a))
    moved = _moved(drive, steps, commands, push, a)
    if np.any(a["flexibility"] > 0):
        moved = _flexed(steps, moved, a)
    if np.any(a["play"] > 0):
        loaded = a["play_loaded"] > 0
        driven = _played(moved, a["play"] / 2)
        if np.any(loaded):
            driven = np.where(loaded, _hung(steps, moved, push, a), driven)
        moved = driven
    return torch.from_numpy(moved).permute(1, 2, 0)


def _moved(drive: Drive, steps: Array, u: Array, push: Array | None, a: Mapping[str, Array]) -> Array:
    """The motor's side, `s x p x b`."""
    # The fastest motion of the axis is that of its mass on the gain.
    masses = a["inertia"] / np.maximum(a["gain"], _TINY)
    fast = math.sqrt(float(masses[masses > 0].min())) if np.any(masses > 0) else math.inf
    parts = int(min(max(math.ceil(float(np.median(steps)) / max(fast, _TINY) / _LONGEST), 1), _MOST_PARTS))
    start = drive.start.numpy()
    q, v = (np.broadcast_to(start[:, k], u.shape[1:]) for k in range(2))
    share = None
    if np.any(a["supply"]) and drive.supply is not None and bool((drive.supply != 0).any()):
        share = np.maximum(1 + a["supply"] * drive.supply.numpy().T[:, None], 0)
    warm = drive.warm.numpy().T if np.any(a["thermal"]) and drive.warm is not None else None
    rule = _Rule(a)
    found = np.empty_like(u)
    found[0] = q
    ahead = (1 - _GAMMA) / _GAMMA
    for k in range(len(steps)):
        h = steps[k] * (_GAMMA / parts)
        dry = a["coulomb"] if warm is None else a["coulomb"] * np.maximum(1 + a["thermal"] * warm[k], 0)
        fixed = rule.fixed(h, None if share is None else share[k + 1], dry)
        slope = (u[k + 1] - u[k]) / parts
        for i in range(parts):
            before = u[k] + i * slope
            against = (None, None) if push is None else tuple(_between(push, k, (i + c) / parts) for c in (_GAMMA, 1.0))
            q1, v1 = rule.step(q, v, before + _GAMMA * slope, fixed, against[0])
            q, v = rule.step(q + ahead * (q1 - q), v + ahead * (v1 - v), before + slope, fixed, against[1])
        found[k + 1] = q
    return found


def _between(values: Array, k: int, share: float) -> Array:
    return np.asarray(values[k] + share * (values[k + 1] - values[k]))


class _Fixed(NamedTuple):
    """Of one sample: length of a stage, gain, limit and dry friction, inertia and damping over it, stiffness."""

    h: Array
    gain: Array
    limit: Array
    dry: Array
    mass: Array
    light: Array
    stiff: Array


class _Rule:
    """One implicit stage; what no axis has is left out of the arithmetic."""

    def __init__(self, a: Mapping[str, Array]) -> None:
        self.a = a
        self.limit = 1 / np.maximum(a["weakness"], _TINY)
        self.has = {n: bool(np.any(a[n] != ABSENT[n])) for n in ABSENT}
        self.dry = any(self.has[n] for n in ("coulomb", "load_friction", "stribeck"))
        self.waves = self.has["cogging_sin"] or self.has["cogging_cos"]
        self.heavy = self.has["gravity_sin"] or self.has["gravity_cos"]
        # A sine and a cosine of one angle are one sine, which is what costs time here.
        self.weight, self.hang = _wave(a["gravity_sin"], a["gravity_cos"])
        self.wave, self.phase = _wave(a["cogging_sin"], a["cogging_cos"])

    def fixed(self, h: Array, share: Array | None, dry: Array) -> _Fixed:
        """What all stages of a sample have in common; share: of the motor's strength that the supply allows."""
        gain, limit = (self.a["gain"], self.limit) if share is None else (self.a["gain"] * share, self.limit * share)
        mass = self.a["inertia"] / h
        light = np.maximum(mass + self.a["viscous"], _TINY)
        return _Fixed(h, gain, limit, dry, mass, light, gain * h)

    def step(self, q: Array, v: Array, u: Array, fixed: _Fixed, push: Array | None) -> tuple[Array, Array]:
        """Position and speed at the end of a stage."""
        a, h, limit = self.a, fixed.h, fixed.limit
        motor = fixed.gain * (u - q)
        free = fixed.mass * v
        # What the gear carries beside the motor's torque.
        carried: Array | float = 0.0
        if self.heavy:
            carried = self.weight * np.sin(q + self.hang)
        if push is not None:
            carried = carried + push
        free = free - carried
        if self.waves:
            free = free - self.wave * np.sin(a["cogging_order"] * q + self.phase)
        friction = fixed.dry
        if self.has["stribeck"]:
            friction = friction + a["stribeck"] * np.exp(-np.square(v / a["stribeck_speed"]))
        speed = self.solved(free, motor, friction, carried, fixed.light, fixed.stiff)
        if self.has["weakness"]:
            torque = motor - fixed.stiff * speed
            held = np.minimum(np.maximum(torque, -limit), limit)
            if not np.array_equal(held, torque):
                weak = self.solved(free, held, friction, carried, fixed.light, 0 * held)
                speed = np.where(torque == held, speed, weak)
        speed = np.minimum(np.maximum(speed, -_FASTEST), _FASTEST)
        return q + h * speed, speed

    def solved(
        self, free: Array, motor: Array, friction: Array, carried: Array | float, light: Array, stiff: Array
    ) -> Array:
        """Speed under all torques against dry friction; stiff: how fast the motor's falls with it."""
        resistance, push = light + stiff, free + motor
        if self.has["load_friction"]:
            share, load = self.a["load_friction"], motor + carried
            friction = friction + share * np.abs(load)
            resistance = resistance - share * stiff * np.sign(push * load)
        if self.dry:
            push = push - np.minimum(np.maximum(push, -friction), friction)
        return push / resistance


def _wave(sine: Array, cosine: Array) -> tuple[Array, Array]:
    """Size and phase of a sine and a cosine."""
    return np.hypot(sine, cosine), np.arctan2(cosine, sine)


def _held_at(drive: Drive, push: Array | None, a: Mapping[str, Array]) -> Array:
    """The command, `p x b`, at which an axis moves as it does at its start, but for its friction and inertia."""
    q, v = drive.start[:, 0].numpy(), drive.start[:, 1].numpy()
    weight, hang = _wave(a["gravity_sin"], a["gravity_cos"])
    load = weight * np.sin(q + hang) + a["viscous"] * v + (0.0 if push is None else push[0])
    return np.asarray(q + load / np.maximum(a["gain"], _TINY))


def _limited(steps: Array, u: Array, fastest: Array, begin: Array) -> Array:
    """Commands that change no faster than [rad/s], and may be behind already where they begin, `p x b`."""
    found = u.copy()
    found[0] = begin
    for k in range(len(steps)):
        reach = fastest * steps[k]
        found[k + 1] = found[k] + np.minimum(np.maximum(u[k + 1] - found[k], -reach), reach)
    return found


def _played(q: Array, half: Array) -> Array:
    """The driven side of a play, which rests in the middle at first."""
    found = q.copy()
    for k in range(1, len(q)):
        found[k] = np.maximum(np.minimum(found[k - 1], q[k] + half), q[k] - half)
    return found


def _load(a: Mapping[str, Array]) -> Array:
    """Inertia behind a joint: that of the load, or where it is not known all of the axis'."""
    return np.where(a["load"] > 0, a["load"], a["inertia"])


def _falling(a: Mapping[str, Array]) -> tuple[Array, Array]:
    """Size and phase of the acceleration by which the weight turns the far side of a joint back [rad/s^2]."""
    weight, hang = _wave(a["gravity_sin"], a["gravity_cos"])
    inertia = _load(a)
    return np.where(inertia > 0, weight / np.maximum(inertia, _TINY), 0.0), hang


def _hung(steps: Array, q: Array, push: Array | None, a: Mapping[str, Array]) -> Array:
    """The driven side of a play that falls freely between its ends, and does not bounce there."""
    fall, hang = _falling(a)
    inertia, half = _load(a), a["play"] / 2
    light = np.where(inertia > 0, 1 / np.maximum(inertia, _TINY), 0.0)
    found = q.copy()

    def pulled(x: Array, k: int) -> Array:
        return np.asarray(fall * np.sin(x + hang) + (0.0 if push is None else push[k] * light))

    x, v = q[0] - half * np.sign(pulled(q[0], 0)), np.zeros_like(q[0])
    found[0] = x
    for k in range(len(steps)):
        h = steps[k]
        v = v - h * pulled(x, k)
        free = x + h * v
        low, high = q[k + 1] - half, q[k + 1] + half
        held = np.minimum(np.maximum(free, low), high)
        v = np.where(held == free, v, (q[k + 1] - q[k]) / h)
        x = held
        found[k + 1] = x
    return found


def _flexed(steps: Array, motor: Array, a: Mapping[str, Array]) -> Array:
    """The far side of a spring that is driven by the motor's position: inertia over stiffness [s^2] and damping ratio.

    Implicit as in `_Rule`; a spring that is stiffer than the steps can show follows the motor. Its weight makes it sag.
    """
    flexibility, damping = a["flexibility"], a["flexible_damping"]
    fall, hang = _falling(a)
    sag = flexibility * fall
    x, v = motor[0] - sag * np.sin(motor[0] + hang), np.zeros_like(motor[0])
    drag = 2 * damping * np.sqrt(np.maximum(flexibility, 0))
    ahead = (1 - _GAMMA) / _GAMMA
    found = motor.copy()

    def stage(x: Array, v: Array, m: Array, rate: Array, h: Array) -> tuple[Array, Array]:
        mass = flexibility / h
        speed = (mass * v + (m - x) - sag * np.sin(x + hang) + drag * rate) / (mass + drag + h)
        return x + h * speed, speed

    for k in range(len(steps)):
        h, m0, m1 = steps[k] * _GAMMA, motor[k], motor[k + 1]
        rate = (m1 - m0) / steps[k]
        x1, v1 = stage(x, v, m0 + _GAMMA * (m1 - m0), rate, h)
        x, v = stage(x + ahead * (x1 - x), v + ahead * (v1 - v), m1, rate, h)
        found[k + 1] = x
    return found
