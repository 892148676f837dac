"""What a case starts from: a machine, commanded joints, and the conditions of each row."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccnn_validation.sources.adversarial.machine import ARM, PARALLEL, Array, Machine, machine_of

__all__ = ["ALL", "Rig", "draw_rig", "hours", "last_directions"]

ALL = (*PARALLEL, ARM)
_HOUR = 3600.0
_GROUPS = ("time", "temperature", "load", "direction")


@dataclass
class Rig:
    """A machine on the test bench, `s` rows.

    Attributes:
        machine: the machine.
        rng: draws all that follows.
        joints: commanded, `s x n` [SI].
        pose: nominal pose, `s x p` [SI].
        time: `s` [s].
        temperature: `s` [degC].
        load: forces and moments along the pose coordinates, `s x p` [N, N*m].
        direction: sign of each joint's last motion, `s x n`.
        sigma: standard deviation of the measurement by pose coordinate, `p` [m, rad].
        shown: groups of covariates that the user has recorded: time, temperature, load, direction.
    """

    machine: Machine
    rng: np.random.Generator
    joints: Array
    pose: Array
    time: Array
    temperature: Array
    load: Array
    direction: Array
    sigma: Array
    shown: set[str]

    @functools.cached_property
    def jacobian(self) -> Array:
        """Twist by each joint at the nominal poses, `s x p x n`."""
        return self.machine.jacobian(self.joints, self.pose)

    @property
    def rows(self) -> int:
        """Number of rows, s."""
        return len(self.joints)

    def show(self, *groups: str) -> None:
        """Record these covariates in any case."""
        self.shown |= set(groups)


def draw_rig(
    rng: np.random.Generator,
    machines: Sequence[str] = ALL,
    rows: tuple[int, int] = (80, 400),
    design: str = "spread",
    days: int = 1,
) -> Rig:
    """Draw a rig.

    Args:
        rng: the generator.
        machines: names to choose from.
        rows: least and largest number of rows.
        design: `spread`, `line`, `cube` (nine places with repeats), `cluster`, or `repeats` (each place five times).
        days: working days, with nights between them.
    """
    machine = machine_of(machines[int(rng.integers(len(machines)))])
    count = int(rng.integers(rows[0], rows[1] + 1))
    joints, pose = _places(machine, rng, count, design)
    time = hours(rng, count, days)
    forces = np.where(np.array(machine.pose_units) == "m", 60.0, 6.0)
    # A laser tracker or a ball bar: a few micrometres on a small machine, tens on an arm.
    small = 10 ** rng.uniform(-5.3, -4.7) * (4.0 if machine.name == ARM else 1.0)
    repeated = design in ("cube", "repeats")
    return Rig(
        machine=machine,
        rng=rng,
        joints=joints,
        pose=pose,
        time=time,
        temperature=_temperature(rng, time, days),
        load=rng.normal(size=(count, len(forces))) * forces,
        direction=rng.choice([-1.0, 1.0], size=joints.shape) if repeated else last_directions(rng, joints),
        sigma=np.where(np.array(machine.pose_units) == "m", small, 3.0 * small),
        shown={g for g in _GROUPS if rng.random() < 0.5},
    )


def last_directions(rng: np.random.Generator, joints: Array) -> Array:
    """Sign of each joint's way from the row before, `s x n`; drawn in the first row and where nothing moved."""
    drawn = rng.choice([-1.0, 1.0], size=joints.shape)
    signs = np.sign(np.diff(joints, axis=0, prepend=joints[:1]))
    return np.where(signs == 0, drawn, signs)


def hours(rng: np.random.Generator, count: int, days: int = 1) -> Array:
    """Times of the rows [s], one after the other over shifts of 5 to 9 hours; a night between two days."""
    steps = rng.uniform(0.5, 1.5, count)
    at_work = np.cumsum(steps) / steps.sum() * rng.uniform(5.0, 9.0) * _HOUR * days
    day = np.minimum((np.arange(count) * days) // count, days - 1)
    return np.asarray(at_work - at_work[0] + day * rng.uniform(14.0, 18.0) * _HOUR)


def _places(machine: Machine, rng: np.random.Generator, count: int, design: str) -> tuple[Array, Array]:
    """Commanded joints and nominal poses of a design, `count x n` and `count x p` [SI]."""
    size = len(machine.pose_names)
    if design == "cube":
        corners = np.stack(np.meshgrid([0.3, 0.7], [0.3, 0.7], [0.3, 0.7], indexing="ij"), -1).reshape(-1, 3)
        places = np.full((9, max(size, 3)), 0.5)
        places[:8, :3] = corners
        joints, pose, good = machine.place(places[:, :size])
        turn = np.flatnonzero(good)[np.arange(count) % good.sum()]
        return joints[turn], pose[turn]
    excess = 6 * count + 50
    cube = rng.random((excess, size))
    if design == "line":
        first, last = rng.uniform(0.0, 0.15, size), rng.uniform(0.85, 1.0, size)
        flip = rng.random(size) < 0.5
        ends = np.where(flip, last, first), np.where(flip, first, last)
        cube = ends[0] + rng.random((excess, 1)) * (ends[1] - ends[0])
    elif design == "cluster":
        cube = rng.uniform(0.35, 0.6, size) + 0.06 * cube
    joints, pose, good = machine.place(cube)
    if good.sum() < count:
        raise ValueError(f"{machine.name}: {good.sum()} of {count} rows of the design '{design}' can be reached")
    found = np.flatnonzero(good)
    found = np.repeat(found, 5)[:count] if design == "repeats" else found[:count]
    return joints[found], pose[found]


def _temperature(rng: np.random.Generator, time: Array, days: int) -> Array:
    """Temperature of the hall [degC]: warming up, a slow swing, and another level on each day."""
    level = rng.uniform(-3.0, 3.0, days)[(np.arange(len(time)) * days) // len(time)] if days > 1 else 0.0
    warm = rng.uniform(3.0, 6.0) * (1 - np.exp(-time / (rng.uniform(0.8, 2.0) * _HOUR)))
    swing = rng.uniform(1.5, 3.0) * np.sin(2 * np.pi * time / (rng.uniform(2.5, 4.5) * _HOUR) + rng.uniform(0, 6.0))
    return np.asarray(19.0 + rng.uniform(-1.0, 1.0) + warm + swing + level)
