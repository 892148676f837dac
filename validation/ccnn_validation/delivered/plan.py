"""Measured rows and test rows of a machine: joints, covariates, and what the tracker reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ccnn_validation.delivered.machine import Covariates, Machine, Pose, finite, resting
from ccnn_validation.delivered.rotation import Array

SETS = ("inside", "edge", "outside", "wrist")
_BEYOND = 0.3
"""How far `outside` goes beyond the box, as a share of its half range."""
_TRIES = 50


@dataclass(frozen=True)
class Rows:
    """Rows of a set: joints `s x n` [rad or m] and covariates, the columns that a file gets named in `columns`."""

    joints: Array
    covariates: Covariates
    columns: tuple[str, ...]


def joined(sets: Mapping[str, Rows]) -> Rows:
    """The rows of all sets, one set after the other."""
    rows = list(sets.values())
    covariates = {name: np.concatenate([r.covariates[name] for r in rows]) for name in rows[0].covariates}
    return Rows(np.concatenate([r.joints for r in rows]), covariates, rows[0].columns)


def measured_rows(machine: Machine, count: int) -> Rows:
    """Rows in the box."""
    return _rows(machine, count, 1, lambda rng, rows: rng.uniform(machine.low, machine.high, (rows, len(machine.low))))


def test_rows(machine: Machine, count: int) -> dict[str, Rows]:
    """Rows of each of `SETS` that the measurement has not seen."""
    low, high = machine.low, machine.high
    middle, half = (low + high) / 2, (high - low) / 2
    joints = len(low)

    def inside(rng: np.random.Generator, rows: int) -> Array:
        return rng.uniform(low, high, (rows, joints))

    def edge(rng: np.random.Generator, rows: int) -> Array:
        found, at = inside(rng, rows), np.arange(rows)
        which, end = rng.integers(0, joints, rows), rng.integers(0, 2, rows)
        found[at, which] = np.where(end == 0, low[which], high[which])
        return found

    def outside(rng: np.random.Generator, rows: int) -> Array:
        found = rng.uniform(middle - (1 + _BEYOND) * half, middle + (1 + _BEYOND) * half, (rows, joints))
        which = rng.integers(0, joints, rows)
        share = rng.uniform(1, 1 + _BEYOND, rows) * rng.choice([-1, 1], rows)
        found[np.arange(rows), which] = middle[which] + share * half[which]
        return found

    drawn = {"inside": inside, "edge": edge, "outside": outside}
    sets = {name: _rows(machine, count, 2 + i, make) for i, (name, make) in enumerate(drawn.items())}
    return {**sets, "wrist": _line(machine, count)}


def _line(machine: Machine, count: int) -> Rows:
    """A straight line of joints on which the wrist's joint goes through 0, or to the end of the box nearest to it."""
    rng = np.random.default_rng([machine.seed, 9])
    low, high = machine.low, machine.high
    middle, half = (low + high) / 2, (high - low) / 2
    for _ in range(_TRIES):
        first, last = middle + rng.uniform(-0.6, 0.6, (2, len(low))) * half
        if machine.wrist is not None:
            at = machine.wrist
            across = min(0.3, 0.4 * half[at])
            near = float(np.clip(0.0, low[at], high[at]))
            first[at], last[at] = np.clip([near - across, near + across], low[at], high[at])
        joints = first + np.linspace(0, 1, count)[:, None] * (last - first)
        rows = Rows(joints, _covariates(machine, rng, joints, constant=True), _columns(machine))
        if _reached(machine, rows).all():
            return rows
    raise ValueError(f"{machine.kind} {machine.seed}: no line in its box is reached all along")


def _rows(machine: Machine, count: int, stream: int, make: Callable[[np.random.Generator, int], Array]) -> Rows:
    rng = np.random.default_rng([machine.seed, stream])
    joints = np.zeros((0, len(machine.low)))
    for _ in range(_TRIES):
        more = make(rng, count)
        kept = _reached(machine, Rows(more, resting(more), ()))
        joints = np.concatenate([joints, more[kept]])[:count]
        if len(joints) == count:
            return Rows(joints, _covariates(machine, rng, joints), _columns(machine))
    raise ValueError(f"{machine.kind} {machine.seed}: hardly any row of its box is reached")


def _reached(machine: Machine, rows: Rows) -> NDArray[np.bool_]:
    frames = machine.vector("true")[: machine.frames]
    nominal = machine.nominal_pose(frames, rows.joints)
    return np.asarray(finite(machine.true_pose(rows.joints, rows.covariates)) & finite(nominal))


def _columns(machine: Machine) -> tuple[str, ...]:
    columns: tuple[str, ...] = ()
    if "payload" in machine.extras:
        columns += ("load_z",)
    if "thermal" in machine.extras:
        columns += ("temperature",)
    if "backlash" in machine.extras:
        columns += tuple(f"direction{i + 1}" for i in range(len(machine.units)))
    return columns


def _covariates(machine: Machine, rng: np.random.Generator, joints: Array, constant: bool = False) -> dict[str, Array]:
    """Temperature 18 to 30 °C, a payload of 0 to 8 kg, directions at random; one value for all rows of a line."""
    rows = 1 if constant else len(joints)
    drawn = {
        "temperature": rng.uniform(18, 30, rows),
        "load_z": -9.81 * rng.choice([0.0, 2.0, 5.0, 8.0], rows),
        **{f"direction{i + 1}": rng.choice([-1.0, 1.0], rows) for i in range(joints.shape[1])},
    }
    return {name: np.broadcast_to(values, len(joints)) for name, values in drawn.items()}


def measured_pose(machine: Machine, rows: Rows) -> Pose:
    """What the tracker reads: the true pose with white noise."""
    rng = np.random.default_rng([machine.seed, 8])
    true = machine.true_pose(rows.joints, rows.covariates)
    position = true.position + rng.normal(0, machine.noise[0], true.position.shape)
    if true.rotation is None:
        return Pose(position, None)
    turn = Rotation.from_rotvec(rng.normal(0, machine.noise[1], (len(position), 3))).as_matrix()
    return Pose(position, turn @ true.rotation)
