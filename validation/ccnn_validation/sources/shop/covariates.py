"""What is recorded beside joints and pose, as a case needs it or as it happens to be there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ccnn_validation.sources.shop.machine import Array, Machine, Rows

__all__ = ["in_motion", "measured_rows"]

_PERIOD = 0.02
"""Between two rows of a motion [s]."""


def measured_rows(machine: Machine, rows: int, plan: str, needs: Sequence[str], rng: np.random.Generator) -> Rows:
    """Rows measured at rest, about so many."""
    joints = machine.plan(rows, rng, plan)
    return Rows(joints, _covariates(machine, joints, needs, rng))


def in_motion(machine: Machine, rows: int, needs: Sequence[str], rng: np.random.Generator) -> Rows:
    """Rows on a smooth path, two sines for each joint about its middle; the controller knows the speed."""
    time = np.arange(rows) * _PERIOD
    places = machine.plan(200, rng, "random")
    low, high = np.percentile(places, 25, 0), np.percentile(places, 75, 0)
    shape = (2, machine.count)
    size = ((high - low) / 4 * rng.uniform(0.5, 1, shape))[:, None]
    rate = (rng.uniform(0.15, 0.5, shape) * 2 * np.pi)[:, None]
    phase = rng.uniform(0, 6.28, shape)[:, None]
    angle = rate * time[:, None] + phase
    joints = (low + high) / 2 + (size * np.sin(angle)).sum(0)
    speed = (size * rate * np.cos(angle)).sum(0)
    known = _covariates(machine, joints, needs, rng)
    columns = {name: values for name, values in known.items() if name.startswith("load")}
    columns |= {"time": time} | {f"speed{i + 1}": speed[:, i] for i in range(machine.count)}
    return Rows(joints, columns, -(size * rate**2 * np.sin(angle)).sum(0))


def _covariates(machine: Machine, joints: Array, needs: Sequence[str], rng: np.random.Generator) -> dict[str, Array]:
    """Time [s], temperature [degC], loads [N] and directions [1]: those needed, and others by chance."""
    rows, found = len(joints), dict[str, Array]()
    time = np.cumsum(rng.uniform(0.5, 1.5, rows)) * rng.uniform(15, 60)
    time -= time[0]
    if "speed" not in needs and ("time" in needs or rng.random() < 0.5):
        found["time"] = time
    if "temperature" in needs or rng.random() < 0.4:
        swing = rng.uniform(1.5, 3.5) * -np.cos(2 * np.pi * time / time[-1] * rng.uniform(0.4, 0.9))
        wander = rng.uniform(0, 2)
        found["temperature"] = 22 + swing + wander + 0.1 * rng.standard_normal(rows).cumsum() / np.sqrt(rows)
    if "load" in needs or rng.random() < 0.3:
        flat = machine.name in ("planar3r", "five_bar")
        for axis in "xy" if flat else "xyz":
            found[f"load_{axis}"] = rng.choice([-60, -30, 0, 30, 60], rows) + rng.normal(0, 3, rows)
        if not flat and rng.random() < 0.4 and machine.name != "scara":
            found["load_z"] = -rng.choice([0, 20, 50, 100], rows).astype(float)
    if "direction" in needs or rng.random() < 0.4:
        first = joints[:1] - rng.normal(0, 1, (1, machine.count))
        direction = np.sign(np.diff(joints, axis=0, prepend=first))
        direction[direction == 0] = 1
        found |= {f"direction{i + 1}": direction[:, i] for i in range(machine.count)}
    return found
