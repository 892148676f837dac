"""An arm that is led through waypoints, as its logs have it: a drive of its own, no formula of the package."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
JOINTS = ("shoulder_pan", "elbow_flex", "gripper")
# Of all joints [s], and of the bad one [s, deg].
LAG, DELAY, BACKLASH = 0.04, 0.1, 3.0
_FINE = 0.001


def asked(run: int, time: Array, joints: int = len(JOINTS)) -> Array:
    """Commands [deg], `s x n`: moves without a jerk between waypoints, as a person leads them."""
    places = np.random.default_rng(run).uniform(-60, 60, (joints, 8))
    places[-1] = 40 + 0.5 * places[-1]
    share = np.linspace(0, 7, len(time))
    k = np.minimum(share.astype(int), 6)
    s = share - k
    return (places[:, k] + (places[:, k + 1] - places[:, k]) * (10 * s**3 - 15 * s**4 + 6 * s**5)).T


def moved(time: Array, command: Array, bad: int | None) -> Array:
    """Positions [deg]: drives that lag; the joint `bad` acts late and has a play behind its drive."""
    fine = np.arange(time[0], time[-1] + _FINE, _FINE)
    wanted = np.stack([np.interp(fine, time, own) for own in command.T], -1)
    play = np.zeros(command.shape[1])
    if bad is not None:
        wanted[:, bad] = np.interp(fine - DELAY, fine, wanted[:, bad])
        play[bad] = BACKLASH
    x, y, found = wanted[0].copy(), wanted[0].copy(), np.empty_like(wanted)
    for k, u in enumerate(wanted):
        x += _FINE / LAG * (u - x)
        y = np.clip(y, x - play / 2, x + play / 2)
        found[k] = y
    return np.stack([np.interp(time, fine, own) for own in found.T], -1)


def run(number: int, seconds: float, rate: float, bad: int | None = 1) -> tuple[Array, Array, Array]:
    """Time [s], commands and positions [deg] of a run, as encoders of 4096 steps tell them."""
    time = np.arange(round(seconds * rate)) / rate
    command = asked(number, time)
    step = 360 / 4096
    noise = np.random.default_rng(100 + number).normal(0, 0.02, command.shape)
    return time, command, np.round((moved(time, command, bad) + noise) / step) * step
