"""The driven side of a play: held by friction, or free between its ends."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.motion.stage import TINY, load_inertia, wave_of

Array = NDArray[np.float64]


def played(q: Array, half: Array) -> Array:
    """The driven side of a play, which rests in the middle at first."""
    found = q.copy()
    for k in range(1, len(q)):
        found[k] = np.maximum(np.minimum(found[k - 1], q[k] + half), q[k] - half)
    return found


def hung(steps: Array, q: Array, push: Array | None, a: Mapping[str, Array]) -> Array:
    """The driven side of a play, which is free between its ends but for its friction, and does not bounce there."""
    fall, hang = _falling(a)
    inertia, half = load_inertia(a), a["play"] / 2
    light = np.where(inertia > 0, 1 / np.maximum(inertia, TINY), 0.0)
    found = q.copy()

    def pulled(x: Array, k: int) -> Array:
        return np.asarray(fall * np.sin(x + hang) + (0.0 if push is None else push[k] * light))

    x, v = q[0] - half * np.sign(pulled(q[0], 0)), np.zeros_like(q[0])
    found[0] = x
    for k in range(len(steps)):
        h = steps[k]
        v = v - h * pulled(x, k)
        # Its bearing brakes it, up to standstill.
        v = np.sign(v) * np.maximum(np.abs(v) - h * a["play_friction"], 0.0)
        free = x + h * v
        low, high = q[k + 1] - half, q[k + 1] + half
        held = np.minimum(np.maximum(free, low), high)
        v = np.where(held == free, v, (q[k + 1] - q[k]) / h)
        x = held
        found[k + 1] = x
    return found


def _falling(a: Mapping[str, Array]) -> tuple[Array, Array]:
    """Size and phase of the acceleration by which the weight turns the far side of a joint back [rad/s^2]."""
    weight, hang = wave_of(a["gravity_sin"], a["gravity_cos"])
    inertia = load_inertia(a)
    return np.where(inertia > 0, weight / np.maximum(inertia, TINY), 0.0), hang
