"""One implicit stage of an axis, for many axes at once.

The rule is SDIRK2 (Alexander 1977), whose two implicit stages are solved in closed form, dry friction included, so that
an axis without mass, or one that sticks, needs no smaller steps. The far side of a flexible joint is linear in the
motor's speed at the end of a stage but for its weight, which is taken at the stage's begin, and so is solved with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ABSENT: dict[str, float] = {
    "gain": 1.0,
    "integral": 0.0,
    "derivative": 0.0,
    "inertia": 0.0,
    "load": 0.0,
    "viscous": 0.0,
    "drive_damping": 0.0,
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
    "play_friction": 0.0,
    "flexibility": 0.0,
    "flexible_damping": 0.1,
    "encoder_at_motor": 0.0,
}
"""Parameters of an axis and the values of one that follows its command: angles in rad (m of a sliding axis), s, 1."""

Array = NDArray[np.float64]
GAMMA = 1 - 1 / math.sqrt(2)
TINY = 1e-9
# How steep a wave is followed: shares of what gain and friction, and inertia, resist a motion with within a stage.
_STEEP, _SWINGING = 0.5, 0.05
# Largest slope of exp(-x^2).
_STEEPEST = math.sqrt(2 / math.e)
# rad/s or m/s: no axis is faster, and no number may overflow.
_FASTEST = 1e4


State = tuple[Array, ...]
"""Position and speed of the motor, of the load where it hangs on a spring; last the torque of the integral action."""


class _Fixed(NamedTuple):
    """Of one sample: length of a stage, gain (with what the integral adds to it within the stage), rate of the
    integral, limit and dry friction, inertia and resistance over the length, stiffness; of a flexible joint its inertia
    and its damping over the stage, over its stiffness, and the share of a speed of the motor that its load follows
    with."""

    h: Array
    gain: Array
    rate: Array
    limit: Array
    dry: Array
    mass: Array
    light: Array
    stiff: Array
    over: Array
    drag: Array
    follows: Array


class Rule:
    """One implicit stage; what no axis has is left out of the arithmetic."""

    def __init__(self, a: Mapping[str, Array]) -> None:
        self.a = a
        self.limit = 1 / np.maximum(a["weakness"], TINY)
        self.has = {n: bool(np.any(a[n] != ABSENT[n])) for n in ABSENT}
        self.dry = any(self.has[n] for n in ("coulomb", "load_friction", "stribeck"))
        self.waves = self.has["cogging_sin"] or self.has["cogging_cos"]
        self.heavy = self.has["gravity_sin"] or self.has["gravity_cos"]
        # A sine and a cosine of one angle are one sine, which is what costs time here.
        self.weight, self.hang = wave_of(a["gravity_sin"], a["gravity_cos"])
        self.wave, self.phase = wave_of(a["cogging_sin"], a["cogging_cos"])
        self.inertia, self.soft = a["inertia"], bool(np.any(a["flexibility"] > 0))
        if self.soft:
            load = load_inertia(a)
            # A load of no inertia does not pull at the motor, and its weight stays there.
            self.hung = (a["flexibility"] > 0) & (load > 0)
            self.stiffness = np.where(self.hung, load, 0.0) / np.maximum(a["flexibility"], TINY)
            self.slack = np.where(self.hung, 1 / np.maximum(self.stiffness, TINY), 0.0)
            self.drag = 2 * a["flexible_damping"] * np.sqrt(np.maximum(a["flexibility"], 0))
            self.inertia = np.where(self.hung, np.maximum(self.inertia - load, 0.0), self.inertia)

    def begun(self, q: Array, v: Array, faster: Array, u: Array, push: Array | None) -> State:
        """The state of an axis whose encoder shows `q`, `v` and its acceleration: a spring carries the load's weight,
        and the integral action what the command `u` does not."""
        state = self._hanging(q, v, push)
        if not self.has["integral"]:
            return state
        friction = self.a["coulomb"] * np.sign(v)
        load = self.pulling(q, push) + self.a["inertia"] * faster + self.a["viscous"] * v + friction
        return *state, np.where(self.a["integral"] > 0, load - self.a["gain"] * (u - q), 0.0)

    def _hanging(self, q: Array, v: Array, push: Array | None) -> State:
        if not self.soft:
            return q, v
        sag = self.slack * self.pulling(q, push)
        behind = self.a["encoder_at_motor"] == 0
        return np.where(behind, q + sag, q), v, np.where(behind, q, q - sag), v

    def read(self, state: State) -> Array:
        """What the encoder shows."""
        return np.where(self.a["encoder_at_motor"] > 0, state[0], state[2]) if self.soft else state[0]

    def fixed(self, h: Array, share: Array | None, dry: Array) -> _Fixed:
        """What all stages of a sample have in common; share: of the motor's strength that the supply allows."""
        gain, limit = (self.a["gain"], self.limit) if share is None else (self.a["gain"] * share, self.limit * share)
        mass = self.inertia / h
        light, over, drag, follows = mass + self.a["viscous"], h, h, h
        if self.soft:
            over, drag = self.a["flexibility"] / h, h + self.drag
            follows = drag / (over + drag)
            light = light + self.stiffness * drag * (1 - follows)
        rate = gain * self.a["integral"]
        gain = gain + rate * h
        return _Fixed(h, gain, rate, limit, dry, mass, np.maximum(light, TINY), gain * h, over, drag, follows)

    def pulling(self, q: Array, push: Array | None) -> Array | float:
        """Torque of the weight and of the other joints at a position."""
        weight = self.weight * np.sin(q + self.hang) if self.heavy else 0.0
        return weight if push is None else weight + push

    def step(self, state: State, u: Array, fixed: _Fixed, push: Array | None) -> State:
        """The state at the end of a stage."""
        a, h, limit, q, v = self.a, fixed.h, fixed.limit, *state[:2]
        motor = fixed.gain * (u - q)
        if self.has["integral"]:
            motor = motor + state[-1]
        # What the gear carries beside the motor's torque.
        carried = self.pulling(q, push)
        against, loose = carried, q
        if self.soft:
            x, w = state[2:4]
            apart, pulled = q - x, self.pulling(x, push)
            # The load's speed at the end of the stage is this and `follows` times the motor's.
            loose = (fixed.over * w + apart - self.slack * pulled) / (fixed.over + fixed.drag)
            carried = np.where(self.hung, pulled, carried)
            against = np.where(self.hung, self.stiffness * (apart - fixed.drag * loose), against)
        free = fixed.mass * v - against
        light = fixed.light
        if self.waves:
            # Linearised, and no steeper than a stage can follow: else the last digit would decide where it goes.
            order, steepest = a["cogging_order"], _STEEP * (light - fixed.mass + fixed.stiff) + _SWINGING * fixed.mass
            wave = np.minimum(self.wave * order, steepest / h)
            free = free - wave / order * np.sin(order * q + self.phase)
            light = light + h * wave * np.cos(order * q + self.phase)
        friction = fixed.dry
        if self.has["stribeck"]:
            # So does it fall with the speed.
            least = _STEEPEST * a["stribeck"] / (light + fixed.stiff)
            friction = friction + a["stribeck"] * np.exp(-np.square(v / np.maximum(a["stribeck_speed"], least)))
        speed = self.solved(free, motor, friction, carried, light, fixed.stiff)
        if self.has["weakness"]:
            # The part of the damping that the drive makes is within its limit.
            torque = motor - (fixed.stiff + a["drive_damping"]) * speed
            held = np.minimum(np.maximum(torque, -limit), limit)
            if not np.array_equal(held, torque):
                lighter = np.maximum(light - a["drive_damping"], TINY)
                weak = self.solved(free, held, friction, carried, lighter, 0 * held)
                speed = np.where(torque == held, speed, weak)
        speed = np.minimum(np.maximum(speed, -_FASTEST), _FASTEST)
        ended: State = q + h * speed, speed
        if self.soft:
            far = np.minimum(np.maximum(loose + fixed.follows * speed, -_FASTEST), _FASTEST)
            ended = *ended, state[2] + h * far, far
        if self.has["integral"]:
            # Beyond the limit of the motor it stands still (anti-windup).
            grown = state[-1] + fixed.rate * h * (u - ended[0])
            ended = *ended, np.minimum(np.maximum(grown, -limit), limit)
        return ended

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


def wave_of(sine: Array, cosine: Array) -> tuple[Array, Array]:
    """Size and phase of a sine and a cosine."""
    return np.hypot(sine, cosine), np.arctan2(cosine, sine)


def load_inertia(a: Mapping[str, Array]) -> Array:
    """Inertia behind a joint: that of the load, or where it is not known all of the axis'."""
    return np.where(a["load"] > 0, a["load"], a["inertia"])
