"""One implicit stage of an axis.

A stage takes numbers, or arrays of many axes: from sample to sample go all axes at once in numpy, or one after the
other where numba is installed. The rule is SDIRK2 (Alexander 1977), whose two implicit stages are solved in closed
form, dry friction included, so that an axis without mass, or one that sticks, needs no smaller steps. The far side of
a flexible joint is linear in the motor's speed at the end of a stage but for its weight, which is taken at the stage's
begin, and so is solved with it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.motion.compilable import compilable, pick, some

Array = NDArray[np.float64]
GAMMA = 1 - 1 / math.sqrt(2)
TINY = 1e-9
# How steep a wave is followed: shares of what gain and friction, and inertia, resist a motion with within a stage.
_STEEP, _SWINGING = 0.4, 0.05
# Largest slope of exp(-x^2).
_STEEPEST = math.sqrt(2 / math.e)
# rad/s or m/s: no axis is faster, and no number may overflow.
_FASTEST = 1e4
# Seconds for which an axis stood before a log.
_STOOD = 10.0
# Times the parts of a step in which dry friction stops an axis or lets it go.
_FINER = 4
# From the middle stage to where the last one begins.
_AHEAD = (1 - GAMMA) / GAMMA


class Given(NamedTuple):
    """Parameters of axes: angles in rad (m of a sliding axis), s, 1; the values are those of one that follows its
    command. Of `has` true where some axis has another value; what none has is left out, which changes nothing."""

    gain: Any = 1.0
    integral: Any = 0.0
    derivative: Any = 0.0
    forward: Any = 1.0
    forward_lag: Any = 0.0
    cascade: Any = 0.0
    inertia: Any = 0.0
    load: Any = 0.0
    viscous: Any = 0.0
    drive_damping: Any = 0.0
    coulomb: Any = 0.0
    load_friction: Any = 0.0
    stribeck: Any = 0.0
    stribeck_speed: Any = 0.1
    thermal: Any = 0.0
    gravity_sin: Any = 0.0
    gravity_cos: Any = 0.0
    cogging_sin: Any = 0.0
    cogging_cos: Any = 0.0
    cogging_order: Any = 1.0
    weakness: Any = 0.0
    fading: Any = 0.0
    slowness: Any = 0.0
    ramp: Any = 0.0
    delay: Any = 0.0
    offset: Any = 0.0
    ratio: Any = 0.0
    dead_band: Any = 0.0
    supply: Any = 0.0
    play: Any = 0.0
    play_loaded: Any = 0.0
    play_friction: Any = 0.0
    flexibility: Any = 0.0
    flexible_damping: Any = 0.1
    encoder_at_motor: Any = 0.0
    lead_square: Any = 0.0
    lead_cube: Any = 0.0
    lead_sin: Any = 0.0
    lead_cos: Any = 0.0
    lead_order: Any = 1.0


ABSENT: dict[str, float] = Given()._asdict()
"""Parameters of an axis and the values of one that follows its command."""


class Axis(NamedTuple):
    """Parameters of axes, and what follows from them.

    Attributes:
        own: the parameters.
        viscous, drive_damping: with what the derivative gain adds.
        weight, hang, wave, phase: sizes and phases of the weight and the cogging: a sine and a cosine of one angle are
            one sine, which is what costs time here.
        limit: of the motor's torque at standstill.
        line: how fast that falls with the speed.
        inertia: of the motor's side where a load hangs on a spring.
        hung: 1 where it does: a load of no inertia does not pull at the motor, and its weight stays there.
        stiffness, slack, drag: of that spring, one over it, and its damping over it.
        damping: part of `viscous` and `drive_damping` that the derivative gain makes.
        light: one over the inertia behind a play.
    """

    own: Given
    viscous: Array
    drive_damping: Array
    weight: Array
    hang: Array
    wave: Array
    phase: Array
    limit: Array
    line: Array
    inertia: Array
    hung: Array
    stiffness: Array
    slack: Array
    drag: Array
    damping: Array
    light: Array


class State(NamedTuple):
    """Position and speed of the motor, and of the load where it hangs on a spring; torque of the integral action."""

    q: Array
    v: Array
    x: Array
    w: Array
    held: Array


class _Fixed(NamedTuple):
    """Of one sample: length of a stage, gain (with what the integral adds to it within the stage), rate of the
    integral, what that adds to the damping (of a cascade), limit and dry friction, inertia and resistance over the
    length, stiffness; of a flexible joint its inertia
    and its damping over the stage, over its stiffness, and the share of a speed of the motor that its load follows
    with."""

    h: Array
    gain: Array
    rate: Array
    damped: Array
    limit: Array
    dry: Array
    mass: Array
    light: Array
    stiff: Array
    over: Array
    drag: Array
    follows: Array


class Sample(NamedTuple):
    """What axes are given from one sample to the next.

    Attributes:
        step: the time between them.
        before, after: commands.
        bend: four times what the command is above a straight line in the middle.
        push, pushed: what resists the motor beside its axis, at both.
        supply: voltage over the nominal one, less 1.
        warm: temperature less that of the coldest sample.
    """

    step: Array
    before: Array
    after: Array
    bend: Array
    push: Array
    pushed: Array
    supply: Array
    warm: Array


@compilable
def within(value: Array, most: Array | float) -> Array:
    """The value, its size limited."""
    found: Array = np.minimum(np.maximum(value, -most), most)
    return found


@compilable
def axis_of(a: Given) -> Axis:
    """Axes by their parameters."""
    weight, hang = wave_of(a.gravity_sin, a.gravity_cos)
    wave, phase = wave_of(a.cogging_sin, a.cogging_cos)
    # Inertia behind a joint: that of the load, or where it is not known all of the axis'.
    load = pick(a.load > 0, a.load, a.inertia)
    hung = 1.0 * ((a.flexibility > 0) & (load > 0))
    stiffness = hung * load / np.maximum(a.flexibility, TINY)
    # Half of what a derivative gain does resists the speed, within the limit of the motor.
    damping = a.gain * a.derivative
    return Axis(
        own=a,
        viscous=a.viscous + damping,
        drive_damping=a.drive_damping + damping,
        weight=weight,
        hang=hang,
        wave=wave,
        phase=phase,
        limit=1 / np.maximum(a.weakness, TINY),
        line=pick(a.weakness > TINY, a.fading / np.maximum(a.weakness, TINY), 0.0 * a.fading),
        inertia=pick(hung > 0, np.maximum(a.inertia - load, 0.0), a.inertia),
        hung=hung,
        stiffness=stiffness,
        slack=hung / np.maximum(stiffness, TINY),
        drag=2 * a.flexible_damping * np.sqrt(np.maximum(a.flexibility, 0.0)),
        damping=damping,
        light=pick(load > 0, 1 / np.maximum(load, TINY), 0.0 * load),
    )


@compilable
def begun(axis: Axis, start: Array, push: Array) -> State:
    """The state of axes that begin as `start` says (see `Drive`): a spring carries the load's weight, and the integral
    action held what the command did not when the log began."""
    q, v, load = start[0], start[1], 0.0 * start[0]
    sag = axis.slack * (axis.weight * np.sin(q + axis.hang) + push)
    for k in range(2, 10):
        load = (
            load
            + axis.weight * np.sin(start[k] + axis.hang)
            + axis.wave * np.sin(axis.own.cogging_order * start[k] + axis.phase)
        )
    load = (
        load / 8
        + axis.own.inertia * start[10]
        + (axis.viscous - axis.damping) * start[11]
        + axis.own.coulomb * start[12]
    )
    added = start[16] + (axis.own.offset + axis.own.ratio * start[13]) * start[17] - axis.own.delay * start[18]
    # Of the derivative part: what is fed forward of the command's speed, less the speed; in a cascade its integral.
    led = axis.own.derivative * (axis.own.forward - 1) * start[11]
    wound = axis.own.derivative * (axis.own.forward * start[18] - (start[0] - start[14]))
    added = added + axis.own.cascade * wound
    # What is integrated too slowly for that holds nothing.
    held = 1 - np.exp(-_STOOD * axis.own.integral)
    error = (1 + axis.own.ratio) * start[13] + axis.own.offset - start[14] + led
    held = held * (load + start[15] - axis.own.gain * error)
    held = held + axis.own.gain * axis.own.integral * added
    held = pick(axis.own.integral > 0, within(held, axis.limit), 0.0 * q)
    at_motor = axis.own.encoder_at_motor > 0
    return State(pick(at_motor, q, q + sag), v, pick(at_motor, q - sag, q), v, held)


@compilable
def advanced(axis: Axis, has: Given, state: State, given: Sample, parts: int) -> State:
    """The state at the next sample, in so many parts; in more where dry friction stops the axis or lets it go."""
    # Of an axis without friction the last digit says which way it creeps.
    rubs = (axis.own.coulomb > 0) | (axis.own.load_friction > 0) | (axis.own.stribeck > 0)
    found, turned = state, rubs | True
    for many in (parts, _FINER * parts):
        if some(turned):
            now = _divided(axis, has, state, given, many)
            found = State(
                pick(turned, now.q, found.q),
                pick(turned, now.v, found.v),
                pick(turned, now.x, found.x),
                pick(turned, now.w, found.w),
                pick(turned, now.held, found.held),
            )
            turned = rubs & (np.sign(state.v) != np.sign(now.v))
    return found


@compilable
def _divided(axis: Axis, has: Given, state: State, given: Sample, parts: int) -> State:
    """The state at the next sample, in so many parts."""
    fixed = _fixed(axis, has, given, parts)
    share, risen = 1.0 / parts, given.pushed - given.push
    slope = (given.after - given.before) * share
    for i in range(parts):
        before, first, last = given.before + i * slope, (i + GAMMA) * share, (i + 1.0) * share
        asked = before + GAMMA * slope + first * (1 - first) * given.bend
        middle = _stage(axis, has, fixed, state, asked, given.push + first * risen)
        between = State(
            state.q + _AHEAD * (middle.q - state.q),
            state.v + _AHEAD * (middle.v - state.v),
            state.x + _AHEAD * (middle.x - state.x),
            state.w + _AHEAD * (middle.w - state.w),
            state.held + _AHEAD * (middle.held - state.held),
        )
        asked = before + slope + last * (1 - last) * given.bend
        state = _stage(axis, has, fixed, between, asked, given.push + last * risen)
    return state


@compilable
def _fixed(axis: Axis, has: Given, given: Sample, parts: int) -> _Fixed:
    """What all stages of a sample have in common."""
    h, strength = given.step * (GAMMA / parts), np.maximum(1 + axis.own.supply * given.supply, 0.0)
    dry = axis.own.coulomb * np.maximum(1 + axis.own.thermal * given.warm, 0.0)
    gain, limit, mass = axis.own.gain * strength, axis.limit * strength, axis.inertia / h
    light, over, drag, follows = mass + axis.viscous, h, h, h
    if has.flexibility:
        over, drag = axis.own.flexibility / h, h + axis.drag
        follows = drag / (over + drag)
        light = light + axis.stiffness * drag * (1 - follows)
    rate = gain * axis.own.integral
    gain = gain + rate * h
    damped = rate * h * axis.own.derivative * axis.own.cascade
    light = np.maximum(light + damped, TINY)
    return _Fixed(h, gain, rate, damped, limit, dry, mass, light, gain * h, over, drag, follows)


@compilable
def _pulling(axis: Axis, has: Given, q: Array, push: Array) -> Array:
    """Torque of the weight and of the other joints at a position."""
    if has.gravity_sin or has.gravity_cos:
        return axis.weight * np.sin(q + axis.hang) + push
    return push


@compilable
def _error(axis: Axis, has: Given, error: Array) -> Array:
    """What the drive makes of an error: nothing within its dead band."""
    if has.dead_band:
        return error - within(error, axis.own.dead_band)
    return error


@compilable
def _stage(axis: Axis, has: Given, fixed: _Fixed, state: State, u: Array, push: Array) -> State:
    """The state at the end of a stage."""
    h, limit, q, v, x, w, held = fixed.h, fixed.limit, state.q, state.v, state.x, state.w, state.held
    motor, stiff = fixed.gain * _error(axis, has, u - q) + held, fixed.stiff
    if has.dead_band:
        # Within it nothing resists; an axis without a mass goes on as if something did.
        stiff = pick((np.abs(u - q) < axis.own.dead_band) & (fixed.mass > 0), 0.0 * stiff, stiff)
    # What the gear carries beside the motor's torque: the weight of what hangs on a spring is that of the far side.
    carried = _pulling(axis, has, pick(axis.hung > 0, x, q) if has.flexibility else q, push)
    against, loose = carried, q
    if has.flexibility:
        apart = q - x
        # The load's speed at the end of the stage is this and `follows` times the motor's.
        loose = (fixed.over * w + apart - axis.slack * carried) / (fixed.over + fixed.drag)
        against = pick(axis.hung > 0, axis.stiffness * (apart - fixed.drag * loose), carried)
    free = fixed.mass * v - against
    light = fixed.light
    if has.cogging_sin or has.cogging_cos:
        # Linearised, and no steeper than a stage can follow, the less so the more of a wave it passes without a mass:
        # else the last digit would decide where it goes.
        passed = np.square(axis.own.cogging_order * h * v)
        steepest = _STEEP * (light - fixed.mass + stiff) / (1.0 + passed) + _SWINGING * fixed.mass
        wave = np.minimum(axis.wave * axis.own.cogging_order, steepest / h)
        free = free - wave / axis.own.cogging_order * np.sin(axis.own.cogging_order * q + axis.phase)
        light = light + h * wave * np.cos(axis.own.cogging_order * q + axis.phase)
    friction = fixed.dry
    if has.stribeck:
        # It falls with the speed of the stage before, no steeper than that an axis without mass forgets it.
        least = _STEEPEST * axis.own.stribeck / (_STEEP * (light - fixed.mass + stiff) + fixed.mass)
        friction = friction + axis.own.stribeck * np.exp(-np.square(v / np.maximum(axis.own.stribeck_speed, least)))
    speed = _solved(axis, has, free, motor, friction, carried, light, stiff)
    if has.weakness:
        # The part of the damping that the drive makes is within its limit, which falls with the speed.
        damping = axis.drive_damping + fixed.damped - axis.line
        torque = motor - (stiff + damping) * speed
        most = within(torque, limit)
        lighter = np.maximum(light - damping, TINY)
        weak = _solved(axis, has, free, most, friction, carried, lighter, 0.0 * most)
        speed = pick(torque == most, speed, weak)
    speed = within(speed, _FASTEST)
    end = q + h * speed
    if has.flexibility:
        w = within(loose + fixed.follows * speed, _FASTEST)
        x = x + h * w
    if has.integral:
        # Beyond the limit of the motor it stands still (anti-windup).
        held = held + fixed.rate * h * _error(axis, has, u - end) - fixed.damped * speed
        held = within(held, limit)
    return State(end, speed, x, w, held)


@compilable
def _solved(
    axis: Axis, has: Given, free: Array, motor: Array, friction: Array, carried: Array, light: Array, stiff: Array
) -> Array:
    """Speed under all torques against dry friction; stiff: how fast the motor's falls with it."""
    resistance, push = light + stiff, free + motor
    if has.load_friction:
        load = motor + carried
        friction = friction + axis.own.load_friction * np.abs(load)
        resistance = resistance - axis.own.load_friction * stiff * np.sign(push * load)
    if has.coulomb or has.load_friction or has.stribeck:
        push = push - within(push, friction)
    return push / resistance


@compilable
def wave_of(sine: Array, cosine: Array) -> tuple[Array, Array]:
    """Size and phase of a sine and a cosine."""
    return np.hypot(sine, cosine), np.arctan2(cosine, sine)
