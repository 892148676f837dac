"""The course of an axis from sample to sample: its command, its motion, and its play.

Every row of an array is a number where the axes go one after the other, compiled; in numpy it is one of all axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.motion.compilable import compilable, fixed_tuple, loop, pick
from ccnn_torch.motion.stage import TINY, Array, Axis, Given, Sample, advanced, axis_of, begun, within


@compilable
def course(
    axis: Axis,
    has: Given,
    step: Array,
    u: Array,
    start: Array,
    bent: Array,
    push: Array,
    supply: Array,
    warm: Array,
    parts: int,
) -> Array:
    """What encoders show, `s` rows.

    Args:
        axis, has: the axes, and which parameters some of them have.
        step: time from each sample to the next, `s - 1` rows.
        u: the command, late and offset already, `s` rows.
        start: as of `Drive`, a row for each of `START`.
        bent: as of `Drive`, a row.
        push, supply, warm: as of `Drive`; `s` rows, or one where there is nothing.
        parts: into how many every step is divided.
    """
    q, v = start[0], start[1]
    if has.slowness or has.ramp:
        u = _limited(axis, step, u, q, v, push[0])
    if has.derivative:
        u = _led(axis, step, u, bent)
    state = begun(axis, start, push[0])
    found, driven = np.empty_like(u), axis.own.encoder_at_motor > 0
    found[0] = pick(driven, state.q, state.x)
    for k in range(len(step)):
        after, late = min(k + 1, len(push) - 1), min(k + 1, len(supply) - 1)
        state = advanced(
            axis,
            has,
            state,
            Sample(
                step[k],
                u[k],
                u[k + 1],
                bent * _bend(u, k),
                push[min(k, len(push) - 1)],
                push[after],
                supply[late],
                warm[min(k, len(warm) - 1)],
            ),
            parts,
        )
        found[k + 1] = pick(driven, state.q, state.x) if has.flexibility else state.q
    if has.play:
        behind = _played(axis, found)
        if has.play_loaded:
            hung = _hung(axis, step, found, push)
            for k in range(len(hung)):
                behind[k] = pick(axis.own.play_loaded > 0, hung[k], behind[k])
        found = behind
    if has.lead_square or has.lead_cube or has.lead_sin or has.lead_cos:
        for k in range(len(found)):
            found[k] = _geared(axis, found[k])
    return found


@compilable
def _geared(axis: Axis, q: Array) -> Array:
    """Where a gear or screw of uneven transmission is, where an even one is at `q`."""
    own, angle = axis.own, axis.own.lead_order * q
    smooth = np.square(q) * (own.lead_square + own.lead_cube * q)
    found: Array = q + smooth + own.lead_sin * np.sin(angle) + own.lead_cos * np.cos(angle)
    return found


@compilable
def _limited(axis: Axis, step: Array, u: Array, q: Array, v: Array, push: Array) -> Array:
    """Commands whose speed, or whose acceleration, the drive limits, and that may be behind already where they begin:
    there an axis moves as it does at its start, but for its friction and inertia.

    With a limited acceleration they take the speed at which they can still come to rest at the command, or beside it
    where that moves.
    """
    load = axis.weight * np.sin(q + axis.hang) + (axis.viscous - axis.damping) * v + push
    slow, ramped = (axis.own.slowness > 0) | (axis.own.ramp > 0), axis.own.ramp > 0
    fastest, most = 1 / np.maximum(axis.own.slowness, TINY), 1 / np.maximum(axis.own.ramp, TINY)
    found = u.copy()
    found[0] = pick(slow, q + load / np.maximum(axis.own.gain, TINY), u[0])
    # No faster than it could brake.
    begin, reach = (u[1] - u[0]) / step[0], np.sqrt(2 * most * np.abs(u[0] - found[0]))
    pace = begin + within(v - begin, reach)
    for k in range(len(step)):
        behind, gained, rate = u[k] - found[k], most * step[k], (u[k + 1] - u[k]) / step[k]
        # From the speed at the end of this step it comes to rest just there.
        room = np.square(0.5 * gained) + 2 * most * np.abs(behind) - gained * (pace - rate) * np.sign(behind)
        braking = np.sqrt(np.maximum(room, 0.0)) - 0.5 * gained
        asked = rate + np.sign(behind) * pick(
            ramped, np.minimum(np.abs(behind) / step[k], braking), np.abs(behind) / step[k]
        )
        asked = within(asked, fastest)
        able = pick(ramped, np.minimum(np.maximum(asked, pace - gained), pace + gained), asked)
        moved = step[k] * pick(able == asked, asked, 0.5 * (pace + able))
        found[k + 1], pace = pick(slow, found[k] + moved, u[k + 1]), able
    return found


@compilable
def _led(axis: Axis, step: Array, u: Array, bent: Array) -> Array:
    """Commands with what a derivative gain adds to them; less what the integral action would make of that, which but
    in a cascade integrates the commands alone."""
    found, last = u.copy(), len(step) - 1
    lead = before = fed = 0.0 * u[0]
    alone = (axis.own.integral > 0) & (axis.own.cascade == 0)
    for k in range(len(u)):
        a, b = max(k - 1, 0), min(k, last)
        between = step[b] if a == b else step[a] + step[b]
        rate = u[b + 1] - u[a]
        if 1 < k < last:
            # Of fourth order, where samples were left out of a command that is smooth there.
            rate = rate - bent * (u[k + 2] - u[k - 2] - 2 * rate) / 6
        share = step[a] / (step[a] + axis.own.forward_lag)
        fed = pick(k > 0, fed + share * (rate / between - fed), rate / between)
        now = axis.own.derivative * axis.own.forward * fed
        fades = 0.5 * axis.own.integral * step[a]
        faded = (lead * (1 - fades) + now - before) / (1 + fades)
        lead = pick(alone & (k > 0), faded, now)
        before = now
        found[k] = u[k] + lead
    return found


@compilable
def _bend(u: Array, k: int) -> Array:
    """Four times what a parabola through the samples is above the middle of a straight line, from one sample to the
    next; 0 at a jump or corner."""
    last = len(u) - 3
    i, j = min(max(k - 1, 0), last), min(k, last)
    return curved((u[i + 2] - u[i + 1]) - (u[i + 1] - u[i]), (u[j + 2] - u[j + 1]) - (u[j + 1] - u[j]))


@compilable
def curved(a: Array, b: Array) -> Array:
    """As `_bend`, of the second differences about both ends of a step."""
    # The mean of both curvatures, at most twice the smaller one (van Leer 1977).
    least = np.minimum(np.abs(a), np.abs(b))
    found: Array = pick(a * b > 0, -0.5 * np.sign(a) * np.minimum(np.abs(a + b) / 2, 2 * least), 0.0 * a)
    return found


@compilable
def _played(axis: Axis, q: Array) -> Array:
    """The driven side of a play, which rests in the middle at first."""
    found, half = q.copy(), 0.5 * axis.own.play
    for k in range(1, len(q)):
        found[k] = np.maximum(np.minimum(found[k - 1], q[k] + half), q[k] - half)
    return found


@compilable
def _hung(axis: Axis, step: Array, q: Array, push: Array) -> Array:
    """The driven side of a play, which is free between its ends but for its friction, and does not bounce there."""
    found, half, fall = q.copy(), 0.5 * axis.own.play, axis.weight * axis.light
    x = q[0] - half * np.sign(fall * np.sin(q[0] + axis.hang) + push[0] * axis.light)
    v = 0.0 * x
    found[0] = x
    for k in range(len(step)):
        h = step[k]
        v = v - h * (fall * np.sin(x + axis.hang) + push[min(k, len(push) - 1)] * axis.light)
        # Its bearing brakes it, up to standstill.
        v = np.sign(v) * np.maximum(np.abs(v) - h * axis.own.play_friction, 0.0)
        free = x + h * v
        x = np.minimum(np.maximum(free, q[k + 1] - half), q[k + 1] + half)
        v = pick(x == free, v, (q[k + 1] - q[k]) / h)
        found[k + 1] = x
    return found


_PARAMETERS = len(Given._fields)


@loop
def courses(
    given: Array,
    has: NDArray[np.bool_],
    own: NDArray[np.int64],
    run: NDArray[np.int64],
    time: Array,
    command: Array,
    start: Array,
    bent: Array,
    push: Array,
    supply: Array,
    warm: Array,
    parts: NDArray[np.int64],
) -> Array:
    """Courses of `c` axes, one after the other, `c x s`.

    Args:
        given, has: parameters of axes, a row each as `Given`.
        own: which of these each has, `c`.
        run: and which row of those below, which are repeated where there are fewer, `c`.
        time, command: `b x s`.
        start: `b x len(START)`.
        bent: `b`.
        push, supply, warm: `b x s`, or `1 x 1` where there is nothing.
        parts: into how many the steps are divided, `c`.
    """
    count = time.shape[1]
    # Loops in the place of numpy's functions of arrays, which take half as long to compile as all the rest.
    found, u, step = np.empty((len(run), count)), np.empty(count), np.empty(count - 1)
    for j in range(len(run)):
        b, axis = run[j], axis_of(Given(*fixed_tuple(given[own[j]], _PARAMETERS)))
        times, asked, i = time[b % len(time)], command[b], 0
        for k in range(count):
            t = times[k] - axis.own.delay
            while i < count - 1 and times[i + 1] <= t:
                i += 1
            late = asked[i]
            if times[i] < t and i < count - 1:
                share = (t - times[i]) / (times[i + 1] - times[i])
                late += share * (asked[i + 1] - asked[i])
                if bent[b % len(bent)] > 0:
                    late += bent[b % len(bent)] * share * (1 - share) * _bend(asked, i)
            u[k] = late * (1 + axis.own.ratio) + axis.own.offset
            if k > 0:
                step[k - 1] = times[k] - times[k - 1]
        pushed, volts, heat = push[b % len(push)], supply[b % len(supply)], warm[b % len(warm)]
        some = Given(*fixed_tuple(has[own[j]], _PARAMETERS))
        shown = course(axis, some, step, u, start[b], bent[b % len(bent)], pushed, volts, heat, parts[j])
        for k in range(count):
            found[j, k] = shown[k]
    return found
