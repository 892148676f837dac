"""A servo that is integrated by scipy from its equation of motion, for tests: no formula of `ccnn_torch.motion`."""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import odeint

Array = NDArray[np.float64]
GAIN, INERTIA, VISCOUS = 2.0, 0.004, 0.09
# What of the inertia is behind the gear.
MASS, LENGTH = 0.3, 0.1
LOAD = MASS * LENGTH**2


def command(kind: int, time: Array) -> Array:
    """Two sines, a triangle, or a chirp."""
    soft = np.clip(time / 0.5, 0, 1)
    if kind == 0:
        return soft * (0.6 * np.sin(2.2 * time) + 0.3 * np.sin(7.0 * time))
    if kind == 1:
        return 0.8 * np.arcsin(np.sin(2 * time)) * 2 / np.pi
    return soft * 0.4 * np.sin(2 * np.pi * (0.2 * time + 0.2 * time**2))


def between(time: Array, values: Array) -> Callable[[float], float]:
    """Values on straight lines between samples: of one number numpy.interp takes many times as long."""
    times: list[float] = time.tolist()
    known: list[float] = values.tolist()

    def value(t: float) -> float:
        k = min(max(bisect(times, t), 1), len(times) - 1)
        share = min(max((t - times[k - 1]) / (times[k] - times[k - 1]), 0.0), 1.0)
        return known[k - 1] + share * (known[k] - known[k - 1])

    return value


def integrated(rate: Callable[[float, Array], list[float]], begin: list[float], time: Array) -> Array:
    """States at the times: LSODA as of `solve_ivp`, whose steps in Python take longer than the equation."""
    return np.asarray(odeint(rate, begin, time, rtol=1e-6, atol=1e-8, hmax=0.01, tfirst=True))


def moved(
    time: Array,
    asked: Array,
    dry: float = 0.0,
    delay: float = 0.0,
    weight: float = 0.0,
    viscous: float = VISCOUS,
    limit: float = np.inf,
    drive: float = 0.0,
    integral: float = 0.0,
    derivative: float = 0.0,
    teeth: float = 0.0,
    band: float = 0.0,
    cube: float = 0.0,
) -> Array:
    """Position of `INERTIA q'' = motor - (viscous - drive) q' - weight sin q - cube q^3 - teeth sin 84 q - dry
    tanh(q' / 0.002)`, where the motor makes
    `GAIN (u - q + integral * integral of u - q + derivative * (u' - q')) - drive q'`
    within its limit, and within the band takes u - q for 0."""
    wanted, fast = between(time, asked), between(time, np.gradient(asked, time))

    def rate(t: float, state: Array) -> list[float]:
        q, v, held = state.tolist()
        u = wanted(t - delay)
        lead = derivative and derivative * (fast(t - delay) - v)
        error = u - q - min(max(u - q, -band), band)
        motor = min(max(GAIN * (error + integral * held + lead) - drive * v, -limit), limit)
        torque = motor - (viscous - drive) * v - weight * math.sin(q) - cube * q**3 - dry * math.tanh(v / 0.002)
        return [v, (torque - teeth * math.sin(84 * q)) / INERTIA, error]

    return integrated(rate, [asked[0], 0.0, 0.0], time)[:, 0]


def moved_on_a_spring(time: Array, asked: Array, spring: float, damping: float, at_motor: bool) -> Array:
    """Position of the motor, or of the load behind the spring, `LOAD x'' = spring (q - x) + damping (q' - x')`."""
    wanted = between(time, asked)

    def rate(t: float, state: Array) -> list[float]:
        q, v, x, w = state.tolist()
        pull = spring * (q - x) + damping * (v - w)
        torque = GAIN * (wanted(t) - q) - VISCOUS * v - pull
        return [v, torque / (INERTIA - LOAD), w, (pull - MASS * 9.80665 * LENGTH * math.sin(x)) / LOAD]

    return integrated(rate, [asked[0], 0.0, asked[0], 0.0], time)[:, 0 if at_motor else 2]


def write_log(
    path: Path,
    kinds: tuple[int, ...] = (0, 1, 2),
    seconds: float = 5.0,
    motion: Callable[..., Array] = moved,
    **real: float,
) -> Path:
    """A log of several runs with an encoder of 16384 steps."""
    generator = np.random.default_rng(3)
    lines = ["time[s],run[1],command1[rad],q1[rad]"]
    for run, kind in enumerate(kinds):
        time = np.arange(0, seconds, 0.01) + generator.uniform(0, 1e-4, round(seconds / 0.01))
        asked = command(kind, time)
        step = 2 * np.pi / 16384
        q = np.round(motion(time, asked, **real) / step + 0.3 * generator.standard_normal(len(time))) * step
        lines += [f"{t:.17g},{run},{u:.17g},{x:.17g}" for t, u, x in zip(time, asked, q, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return path


KEYS = {"gain": GAIN, "inertia": INERTIA, "viscous": VISCOUS}
