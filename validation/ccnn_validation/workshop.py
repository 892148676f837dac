"""Does `ccnn diagnose` name what is wrong with two machines of a workshop, from files as a workshop writes them?

`python -W ignore -m ccnn_validation.workshop --seed N --out DIR [--only NAME,NAME] [--dry]`. Two machines that share no
code with ours: `rails`, three carriages on parallel rails that carry a platform by rods of equal length (the user's own
class), and `arm`, a six-axis arm by its DH table; a levelled laser tracker at an unknown place reads x, y, z of a
reflector. Forty cases, each 60 to 300 rows: single causes of the library in another form than the simplest one, pairs
of them, causes that no library has, nothing but noise of several laws, and causes whose column was not recorded. The
truth of all cases is written (`truth.json`) before the first is diagnosed; a folder of a case has its files, the screen
and `diagnosis.json`. A case that has been diagnosed is not diagnosed again.

right: the names are the true causes and no others, a name of its class counting as the name; for a cause outside the
library: told as outside, or its caution given, without a wrong name; for nothing: none. partly: some of it. Else wrong.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
G, STEEL, ALUMINIUM = 9.81, 11.5e-6, 23e-6

RAILS_CLASS = '''"""Three carriages on parallel rails along x, a platform on rods of 0.9 m; it does not turn."""

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


class Rails(Mechanism):
    """Joints q1..q3 [m] along x, pose x, y, z [m]; y, z, place: of a rail less those of the platform's joint."""

    def __init__(self, rod: float = 0.9) -> None:
        geometry = []
        for leg, (y, z) in enumerate([(-0.4, 0.85), (0.0, 0.85), (0.4, 0.85)], start=1):
            places = {"rod": (rod, "m"), "y": (y, "m"), "z": (z, "m"), "place": (0.0, "m")}
            angles = {"yaw": (0.0, "rad"), "pitch": (0.0, "rad")}
            geometry += [Parameter(f"{name}{leg}", unit, value, leg) for name, (value, unit) in {**places, **angles}.items()]
        super().__init__(
            name="rails",
            joints=[Coordinate(q, "m") for q in ("q1", "q2", "q3")],
            pose=[Coordinate(c, "m") for c in "xyz"],
            geometry=geometry,
            low=(-0.25, -0.2, 0.25),
            high=(0.25, 0.2, 0.5),
            home_joints=[-0.65, 0.75, -0.65],
        )

    def closure(self, pose, joints, parameters=None):
        """Length of each rod as posed, less its length; `... x 3` [m]."""
        values = self.resolve(parameters)
        rod, y, z, place, yaw, pitch = values.reshape(*values.shape[:-1], 3, 6).unbind(-1)
        px, py, pz = (c[..., None] for c in pose.unbind(-1))
        along, across, up = px - joints - place, py - y - yaw * joints, pz - z - pitch * joints
        return (along**2 + across**2 + up**2).sqrt() - rod
'''
RAILS_CONFIG = """records: rows.csv
mechanism: framed
mechanism_keys: {mechanism: rails.py:Rails, base: true, keys: {gears: [20 mm, 20 mm, 20 mm]}}
"""
ARM_FILE = """robot: six-axis arm, 10 kg
dof: 6
convention: standard Denavit-Hartenberg
units: {length: mm, angle: deg}
a:     [160, 680, 110, 0, 0, 0]
alpha: [-90, 0, -90, 90, -90, 0]
d:     [480, 0, 0, 700, 0, 95]
theta: [0, -90, 0, 0, 0, 180]
limits: [[-170, 170], [-80, 120], [-150, 80], [-180, 180], [-120, 120], [-350, 350]]
parallel_axes: [[2, 3]]
base_frame: unknown
tool_offset: unknown
"""
ARM_CONFIG = "records: rows.csv\nmechanism: arm.yaml\n"


class Rails:
    """The true machine on rails."""

    joints, unit, noise = 3, ("mm", 1e3), 8e-6
    files = {"rails.py": RAILS_CLASS}
    config = RAILS_CONFIG
    middle = np.array([-0.65, 0.75, -0.65])

    def __init__(self) -> None:
        self.nominal = {"rod": np.full(3, 0.9), "y": np.array([-0.4, 0.0, 0.4]), "z": np.full(3, 0.85)}
        self.nominal |= {name: np.zeros(3) for name in ("place", "yaw", "pitch")}

    def commands(self, rng: np.random.Generator, rows: int) -> Array:
        pose = rng.uniform([-0.25, -0.2, 0.25], [0.25, 0.2, 0.5], (rows, 3))
        way = np.sqrt(0.81 - (pose[:, 1:2] - self.nominal["y"]) ** 2 - (pose[:, 2:] - 0.85) ** 2)
        return np.round(pose[:, :1] + np.array([-1.0, 1.0, -1.0]) * way, 7)

    def reach(self, q: Array, dims: dict[str, Array]) -> Array:
        """Newton's method for the point at rod's length from all three carriages."""
        d = {name: value + dims.get(name, 0.0) for name, value in self.nominal.items()}
        carriage = np.stack([q + d["place"], d["y"] + d["yaw"] * q, d["z"] + d["pitch"] * q], -1)
        point = np.tile([0.0, 0.0, 0.37], (len(q), 1))
        for _ in range(12):
            way = point[:, None] - carriage
            length = np.linalg.norm(way, axis=-1)
            point = point - np.linalg.solve(way / length[..., None], (length - d["rod"])[..., None])[..., 0]
        return point

    def load_torque(self, q: Array, force: Array) -> Array:
        step = 1e-6 * np.eye(3)
        columns = [(self.reach(q + s, {}) - self.reach(q - s, {})) / 2e-6 for s in step]
        return np.stack([(column * force).sum(-1) for column in columns], -1)

    def weight_torque(self, q: Array) -> Array:
        return self.load_torque(q, np.tile([0.0, 0.0, -35.0 * G], (len(q), 1)))


class Arm:
    """The true arm."""

    joints, unit, noise = 6, ("deg", 180 / np.pi), 18e-6
    files = {"arm.yaml": ARM_FILE}
    config = ARM_CONFIG
    middle = np.zeros(6)
    tool = np.array([0.06, -0.02, 0.13])
    mass = np.array([70.0, 38.0, 42.0, 18.0, 7.0, 3.0])

    def __init__(self) -> None:
        half = np.pi / 2
        self.nominal = {
            "a": np.array([0.16, 0.68, 0.11, 0, 0, 0]),
            "alpha": np.array([-half, 0, -half, half, -half, 0]),
            "d": np.array([0.48, 0, 0, 0.7, 0, 0.095]),
            "theta": np.array([0, -half, 0, 0, 0, np.pi]),
        }

    def commands(self, rng: np.random.Generator, rows: int) -> Array:
        low, high = np.radians([[-70, -30, -45, -100, 20, -150], [70, 55, 45, 100, 95, 150]])
        q = rng.uniform(low, high, (20 * rows, 6))
        q[:, 4] *= rng.choice([-1, 1], len(q))
        return np.round(np.degrees(q[self.reach(q, {})[:, 2] > 0.15][:rows]), 4) * np.pi / 180

    def frames(self, q: Array, dims: dict[str, Array]) -> list[Array]:
        d = {name: np.broadcast_to(value + dims.get(name, 0.0), q.shape) for name, value in self.nominal.items()}
        at = [np.tile(np.eye(4), (len(q), 1, 1))]
        for i in range(6):
            t, al, a = q[:, i] + d["theta"][:, i], d["alpha"][:, i], d["a"][:, i]
            c, s, ca, sa, o = np.cos(t), np.sin(t), np.cos(al), np.sin(al), 0 * t
            rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [o, sa, ca, d["d"][:, i]], [o, o, o, o + 1]]
            at.append(at[-1] @ np.stack([np.stack(row, -1) for row in rows], -2))
        return at

    def reach(self, q: Array, dims: dict[str, Array]) -> Array:
        end = self.frames(q, dims)[-1]
        return end[:, :3, 3] + (end[:, :3, :3] @ (self.tool + dims.get("tool", 0 * q[:, :3]))[..., None])[..., 0]

    def _torque(self, at: list[Array], points: list[Array], forces: list[Array]) -> Array:
        """Of forces at points, the j-th behind joint j."""
        torque = np.zeros((len(at[0]), 6))
        for i in range(6):
            for j in range(i, 6):
                moment = np.cross(points[j] - at[i][:, :3, 3], forces[j])
                torque[:, i] += (at[i][:, :3, 2] * moment).sum(-1)
        return torque

    def load_torque(self, q: Array, force: Array) -> Array:
        at = self.frames(q, {})
        return self._torque(at, [self.reach(q, {})] * 6, [0 * force] * 5 + [force])

    def weight_torque(self, q: Array) -> Array:
        at = self.frames(q, {})
        points = [(0.45 * at[i] + 0.55 * at[i + 1])[:, :3, 3] for i in range(6)]
        return self._torque(at, points, [np.tile([0.0, 0.0, -m * G], (len(q), 1)) for m in self.mass])


STIFF = {3: 1 / np.array([9e-8, 11e-8, 8e-8]), 6: np.array([6e5, 4e5, 2.5e5, 6e4, 5e4, 3e4])}


class Case:
    """One measurement: commands, what stands beside them, and what acts."""

    def __init__(self, machine: Any, rng: np.random.Generator, rows: int) -> None:
        self.m, self.rng, self.n, k = machine, rng, rows, machine.joints
        self.q = machine.commands(rng, rows)
        self.arm = k == 6
        self.dq, self.dims, self.moved = np.zeros((rows, k)), {}, np.zeros((rows, 3))
        self.time = np.cumsum(rng.uniform(60, 110, rows) if rows < 200 else rng.uniform(45, 75, rows))
        s = self.time / self.time[-1]
        door = np.where((s > 0.55) & (s < 0.65), -1.5, 0.0)
        rise, wave = rng.uniform(4, 7), rng.uniform(0.3, 0.8)
        self.hall = 19.5 + rise * s**0.7 + door + wave * np.sin(9 * s + rng.uniform(0, 6))
        self.direction = np.sign(self.q - np.vstack([machine.middle, self.q[:-1]]))
        self.load: Array | None = None
        self.drop: set[str] = set()
        self.wrong: Callable[[dict[str, Array]], dict[str, Array]] = lambda columns: columns
        self.reading: Callable[[Array], Array] = lambda p: p + rng.normal(0, machine.noise, p.shape)
        self.about, self.jitter = rng.uniform(0, 6), 0.0

    def weights(self) -> Array:
        """Payload in kg, changed by hand after some twelve rows."""
        if self.load is None:
            steps = [0, 5, 10, 2.5, 7.5, 0, 10, 5] if self.arm else [0, 20, 40, 10, 30, 0, 40, 20]
            self.load = np.resize(np.repeat(np.array(steps, float), max(8, self.n // 16)), self.n)
        return self.load

    def lagged(self, lag: float) -> Array:
        body, value = [], self.hall[0]
        for step, hall in zip(np.diff(self.time, prepend=0.0), self.hall, strict=True):
            value += (hall - value) * (1 - np.exp(-step / lag))
            body.append(value)
        return np.array(body) - 20.0

    def dim(self, name: str, change: Array) -> None:
        self.dims[name] = self.dims.get(name, 0.0) + change

    def columns(self) -> dict[str, Array]:
        """The file's columns."""
        q = self.q + self.dq + self.rng.normal(0, 1, self.q.shape) * self.jitter
        p = self.m.reach(q, self.dims)
        c, s = np.cos(self.about), np.sin(self.about)
        p = p @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + np.array([2.3, 1.1, -0.7])
        p = self.reading(p + self.moved)
        unit, factor = self.m.unit
        made = {f"q{i + 1}[{unit}]": self.q[:, i] * factor for i in range(self.m.joints)}
        made |= {f"{name}[mm]": np.round(1e3 * p[:, i], 4) for i, name in enumerate("xyz")}
        made["time[s]"] = np.round(self.time, 1)
        made["temperature[degC]"] = np.round(self.hall + self.rng.normal(0, 0.05, self.n), 1)
        if self.load is not None:
            made["payload[kg]"] = self.load
        made |= {f"direction{i + 1}[1]": self.direction[:, i] for i in range(self.m.joints)}
        made = {name: value for name, value in made.items() if name.split("[")[0].rstrip("123456") not in self.drop}
        return self.wrong(made)


# --- causes that the library names, none in its simplest form ---------------------------------------------------------
def geometry(c: Case) -> None:
    sizes = {"a": 1.5e-4, "alpha": 2e-4, "d": 1.5e-4} if c.arm else {"rod": 8e-5, "y": 1.2e-4, "z": 1.2e-4, "yaw": 1e-4}
    for name, size in sizes.items():
        c.dim(name, c.rng.normal(0, size, c.m.joints))
    c.dim("a" if c.arm else "rod", np.eye(c.m.joints)[1] * (6e-4 if c.arm else 2.5e-4))


def joint_offset(c: Case) -> None:
    c.dq[:, 1:5] += c.rng.choice([-1, 1], 4) * c.rng.uniform(4e-4, 1.2e-3, 4)


def joint_gain(c: Case) -> None:
    """Rolled screws: their lead is off, and changes along the screw."""
    u = c.q - c.m.middle
    c.dq += c.rng.choice([-1, 1], 3) * c.rng.uniform(1.2e-4, 2.5e-4, 3) * (u + 0.25 * u * np.abs(u) / 0.3)


def transmission(c: Case) -> None:
    """Gears or screws; the amplitude changes once along the way, and there is a second harmonic."""
    for i, turns in ((1, 121.0), (2, 102.0)) if c.arm else ((0, 2 * np.pi / 0.02), (2, 2 * np.pi / 0.02)):
        size, f = c.rng.uniform(0.8, 1.3) * (9e-5 if c.arm else 1.5e-5), turns * c.q[:, i] + c.rng.uniform(0, 6)
        c.dq[:, i] += size * (1 + 0.2 * np.sin(c.q[:, i] * (1 if c.arm else 5))) * (np.sin(f) + 0.25 * np.sin(2 * f + 1))


def backlash(c: Case) -> None:
    """Wear in the middle of the travel: wider there."""
    for i in (0, 3) if c.arm else (0, 1):
        u = (c.q[:, i] - c.m.middle[i]) / (1.2 if c.arm else 0.25)
        wide = c.rng.uniform(0.8, 1.2) * (3e-4 if c.arm else 4.5e-5) * (0.7 + 0.6 * np.exp(-(u**2)))
        c.dq[:, i] -= wide / 2 * c.direction[:, i]


def friction(c: Case) -> None:
    """The drives wind up by a tenth of what they carry and a little more."""
    torque = c.m.weight_torque(c.q)
    c.dq -= c.direction * (0.12 * np.abs(torque) ** 0.95 + 0.01 * np.max(np.abs(torque), 0)) / STIFF[c.m.joints]


def compliance(c: Case) -> None:
    """Springs that harden by a sixth up to the largest load."""
    torque = c.m.load_torque(c.q, np.stack([0 * c.weights(), 0 * c.weights(), -G * c.weights()], -1))
    c.dq += torque * (1 - 0.16 * np.abs(torque) / np.abs(torque).max(0).clip(1e-9)) / STIFF[c.m.joints]


def gravity(c: Case) -> None:
    c.dq += c.m.weight_torque(c.q) / STIFF[c.m.joints] * c.rng.uniform(0.8, 1.2, c.m.joints)


def thermal(c: Case) -> None:
    """Thick parts follow later than thin ones."""
    late, later = c.lagged(c.rng.uniform(1500, 2400)), c.lagged(c.rng.uniform(3600, 5400))
    if c.arm:
        c.dim("a", c.m.nominal["a"] * ALUMINIUM * late[:, None])
        c.dim("d", np.stack([(STEEL if i == 0 else ALUMINIUM) * c.m.nominal["d"][i] * later for i in range(6)], -1))
    else:
        c.dim("rod", 0.9 * STEEL * np.stack([late, late, 1.15 * late], -1))
        c.dq += (c.q + 0.9) * STEEL * later[:, None]


def frame_drift(c: Case) -> None:
    """A stand that settles after it was set up, and breathes a little with the hall."""
    s = 1 - np.exp(-c.time / (0.25 * c.time[-1]))
    way = c.rng.normal(0, 1, 3)
    size = 1.2e-4 if c.arm else 6e-5
    c.moved += size * (s + 0.05 * np.sin(12 * c.time / c.time[-1]))[:, None] * way / np.linalg.norm(way)


def homing(c: Case) -> None:
    """Switched off three times; each reference run finds another zero."""
    part = np.searchsorted(np.sort(c.rng.uniform(0.15, 0.85, 3)), np.arange(c.n) / c.n)
    c.time = c.time + 2400.0 * part
    c.dq += c.rng.normal(0, 2.5e-4 if c.arm else 3e-5, (4, c.m.joints))[part]


def coupling(c: Case) -> None:
    """Bevel gears of a wrist whose ratio in the controller is a little off, and that run a little out of true."""
    c.dq[:, 4] += 8e-4 * c.q[:, 3]
    c.dq[:, 5] += -1.5e-3 * c.q[:, 4] + 4e-5 * np.sin(c.q[:, 4] * 3)


def instrument(c: Case) -> None:
    """A tracker whose distances are too long, and whose elevation is a little off."""
    read = c.reading
    c.reading = lambda p: read(p * (1 + 9e-5) * np.array([1, 1, 1 + 2e-5]))


# --- causes that we believe no library names --------------------------------------------------------------------------
def loose_bolt(c: Case) -> None:
    """A tool plate that shifts when joint 1 reverses after a long way, and stays there."""
    state, states, last = 0, [], 0.0
    for way in np.diff(c.q[:, 0], prepend=0.0):
        if abs(way) > 0.6 and way * last < 0:
            state = 1 - state
        last = way if abs(way) > 0.6 else last
        states.append(state)
    c.dim("tool", 1.6e-4 * np.array(states)[:, None] * np.array([0.5, 0.2, 0.85]))


def cable_chain(c: Case) -> None:
    """The chain's pull on carriage 1 grows beyond a place, more so on the way out."""
    beyond = np.maximum(c.q[:, 0] + 0.7, 0.0)
    c.dq[:, 0] -= 7e-5 * (beyond / 0.2) ** 1.5 * (1 + 0.45 * c.direction[:, 0])


def encoder_swap(c: Case) -> None:
    """An eccentric disc on joint 2, whose reader was replaced midway by one at another place."""
    late = np.arange(c.n) > 0.48 * c.n
    c.dq[:, 1] += np.where(late, 3e-4 * np.sin(c.q[:, 1] + 2.6), 3e-4 * np.sin(c.q[:, 1] + 0.4))
    c.dq[:, 1] += np.where(late, 1e-4 * np.sin(2 * c.q[:, 1] + 1), 0)


def nest(c: Case) -> None:
    """The reflector is taken off every six rows or so and sits on the rim of its nest sometimes."""
    seat = np.cumsum(c.rng.random(c.n) < 1 / 6)
    c.dim("tool", 1.2e-4 * (c.rng.random(c.n) < 0.4)[seat][:, None] * np.array([0.3, -0.6, 0.7]))


def fahrenheit(c: Case) -> None:
    thermal(c)
    key = "temperature[degC]"
    c.wrong = lambda made: made | {key: np.round(made[key] * 1.8 + 32, 1)}


def swapped(c: Case) -> None:
    """Backlash of carriage 1, and the headers of two direction columns exchanged."""
    c.dq[:, 0] -= 2.5e-5 * (1 + 0.3 * (c.q[:, 0] + 0.65)) * c.direction[:, 0]
    one, two = "direction1[1]", "direction2[1]"
    c.wrong = lambda made: made | {one: made[two], two: made[one]}


def sorted_rows(c: Case) -> None:
    """A stand that settles, but the table was sorted by q1 before it was saved, and times were left out."""
    frame_drift(c)
    c.drop |= {"time", "temperature", "direction"}
    c.wrong = lambda made: {name: value[np.argsort(c.q[:, 0])] for name, value in made.items()}


def stick_slip(c: Case) -> None:
    """A fixture that slides in five jerks of different size and way, never back."""
    rows = np.sort(c.rng.choice(np.arange(5, c.n - 5), 5, replace=False))
    jerks = c.rng.normal([2.5e-5, -1e-5, 0], [1.2e-5, 1.5e-5, 4e-6], (5, 3)) * (2.0 if c.arm else 1.4)
    c.moved += np.vstack([np.zeros(3), np.cumsum(jerks, 0)])[np.searchsorted(rows, np.arange(c.n), side="right")]


def rail_joint(c: Case) -> None:
    """Rail 2 is made of two pieces: a step in height, and the carriage of 80 mm rides over it."""
    c.dim("z", np.eye(3)[1] * 8e-5 / (1 + np.exp(-(c.q[:, 1:2] - 0.77) / 0.012)))


# --- noise ------------------------------------------------------------------------------------------------------------
def gaussian(c: Case) -> None:
    pass


def heavy(c: Case) -> None:
    c.reading = lambda p: p + c.m.noise * 0.7 * c.rng.standard_t(3, p.shape)


def slow_air(c: Case) -> None:
    def reading(p: Array) -> Array:
        e = c.rng.normal(0, c.m.noise, p.shape)
        for i in range(1, len(e)):
            e[i] = 0.6 * e[i - 1] + 0.8 * e[i]
        return p + e

    c.reading = reading


def far(c: Case) -> None:
    """Angles scatter with the distance, the distance does not."""

    def reading(p: Array) -> Array:
        reach = np.linalg.norm(p, axis=-1, keepdims=True)
        along = p / reach
        e = c.rng.normal(0, 1, p.shape) * c.m.noise * 0.45 * reach
        return p + e - along * (e * along).sum(-1, keepdims=True) * 0.8

    c.reading = reading


def gross(c: Case) -> None:
    """The beam was touched in three of a hundred rows."""
    bad = c.rng.random(c.n) < 0.03
    bad[c.rng.integers(c.n)] = True
    c.reading = lambda p: p + c.rng.normal(0, c.m.noise, p.shape) + bad[:, None] * c.rng.normal(0, 8e-4, p.shape)


def rounded(c: Case) -> None:
    c.reading = lambda p: np.round(p + c.rng.normal(0, c.m.noise, p.shape), 5)


def unsteady(c: Case) -> None:
    """The drives themselves stop elsewhere each time."""
    c.jitter = 2e-5 if c.arm else 1e-5


def neighbour(c: Case) -> None:
    """A press next door works in the afternoon."""
    loud = np.where(c.time > 0.6 * c.time[-1], 2.5, 0.8)[:, None]
    c.reading = lambda p: p + loud * c.rng.normal(0, c.m.noise, p.shape)


# --- the cases: kind, machine, rows, causes, whether noise is told, and columns left out -------------------------------
SAME = {
    "joint_offset": ["joint_offset", "geometry"],
    "gravity": ["gravity", "bending", "compliance"],
    "compliance": ["compliance", "bending"],
    "instrument": ["instrument", "geometry", "joint_gain"],
    "fahrenheit": ["thermal"],
    "swapped": ["backlash"],
    "stick_slip": ["frame_drift"],
    "encoder_swap": ["transmission", "homing"],
    "cable_chain": [],
}
CASES: list[tuple[str, str, int, str, bool, str]] = [
    ("single", "arm", 150, "geometry", False, ""),
    ("single", "arm", 80, "joint_offset", True, ""),
    ("single", "rails", 120, "joint_gain", True, ""),
    ("single", "arm", 260, "transmission", True, ""),
    ("single", "rails", 100, "backlash", False, ""),
    ("single", "arm", 160, "friction", False, ""),
    ("single", "arm", 140, "compliance", True, ""),
    ("single", "rails", 180, "thermal", True, ""),
    ("single", "arm", 120, "gravity", False, ""),
    ("single", "rails", 90, "frame_drift", False, ""),
    ("single", "arm", 160, "homing", True, ""),
    ("single", "arm", 130, "coupling", False, ""),
    ("single", "rails", 150, "instrument", True, ""),
    ("pair", "arm", 200, "geometry,thermal", True, ""),
    ("pair", "rails", 150, "joint_gain,backlash", True, ""),
    ("pair", "arm", 280, "compliance,transmission", True, ""),
    ("pair", "rails", 220, "thermal,backlash", False, ""),
    ("pair", "arm", 150, "gravity,backlash", False, ""),
    ("pair", "rails", 120, "geometry,frame_drift", False, ""),
    ("pair", "arm", 240, "friction,joint_offset", True, ""),
    ("pair", "rails", 260, "compliance,transmission", True, ""),
    ("outside", "arm", 160, "loose_bolt", True, ""),
    ("outside", "rails", 140, "cable_chain", True, ""),
    ("outside", "arm", 180, "encoder_swap", True, ""),
    ("outside", "arm", 150, "nest", False, ""),
    ("outside", "rails", 180, "fahrenheit", True, "temperature"),
    ("outside", "rails", 120, "swapped", True, "direction"),
    ("outside", "rails", 110, "sorted_rows", True, ""),
    ("outside", "rails", 160, "stick_slip", True, ""),
    ("outside", "rails", 200, "rail_joint", False, ""),
    ("nothing", "rails", 60, "gaussian", True, ""),
    ("nothing", "arm", 120, "heavy", False, ""),
    ("nothing", "rails", 150, "slow_air", False, ""),
    ("nothing", "arm", 200, "far", False, ""),
    ("nothing", "rails", 130, "gross", True, ""),
    ("nothing", "arm", 80, "rounded", True, ""),
    ("nothing", "arm", 150, "unsteady", False, ""),
    ("nothing", "rails", 300, "neighbour", False, ""),
    ("withheld", "rails", 160, "thermal", True, "temperature"),
    ("withheld", "rails", 120, "backlash", False, "direction"),
    ("withheld", "arm", 140, "compliance", True, "payload"),
    ("withheld", "arm", 140, "friction", True, "direction"),
]
CAUTION = {"fahrenheit": r"temperature", "swapped": r"exchang|swap|direction1.*direction2", "sorted_rows": r"order|sorted"}


def written(folder: Path, seed: int, number: int) -> dict[str, Any]:
    """Write the files of a case; its truth."""
    kind, machine, rows, causes, told, left = CASES[number]
    m: Any = Arm() if machine == "arm" else Rails()
    c = Case(m, np.random.default_rng([seed, number]), rows)
    if left == "payload" or "compliance" in causes or kind == "nothing":
        c.weights()
    if m.joints == 6:
        c.jitter = 8e-6
    still = m.reach(c.q, {})
    for cause in causes.split(","):
        globals()[cause](c)
    if kind == "withheld":
        c.drop |= {left} | ({"time"} if left == "direction" and machine == "arm" else set())
        if left == "direction" and machine == "arm":
            shuffled = c.rng.permutation(c.n)
            c.wrong = lambda made: {name: value[shuffled] for name, value in made.items()}
    off = np.sqrt(((m.reach(c.q + c.dq, c.dims) + c.moved - still) ** 2).sum(-1).mean())
    columns = c.columns()
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "rows.csv", np.stack(list(columns.values()), -1), "%.9g", ",", header=",".join(columns), comments="")
    for name, text in m.files.items():
        (folder / name).write_text(text)
    noise = f"noise: {25 if machine == 'arm' else 9} um\n" if told else ""
    (folder / "case.yaml").write_text(m.config + noise)
    same = [SAME.get(cause, [cause]) for cause in causes.split(",")]
    return {"kind": kind, "machine": machine, "rows": rows, "causes": causes, "noise_told": told, "left_out": left,
            "accepted": [] if kind == "nothing" else same, "caution": CAUTION.get(causes, ""), "rms_um": 1e6 * off}


def judged(truth: dict[str, Any], found: dict[str, Any]) -> tuple[str, str, list[str]]:
    """Mark, what was told, and names that are wrong."""
    verdict, kind = found["verdict"], truth["kind"]
    classes = [[e["name"], *e.get("indistinguishable_from", [])] for e in verdict["effects"] if e["name"] != "outlier"]
    outside, text = bool(verdict["outside_library"]), " ".join(map(str, found["cautions"]))
    hits, wrong, open_ = 0, [], list(truth["accepted"])
    for names in classes:
        match = next((a for a in open_ if any(name.split(" ")[0] in a for name in names)), None)
        if match is not None:
            hits += 1
            if kind not in ("outside", "withheld"):
                open_.remove(match)
        elif not any(name.split(" ")[0] in a for name in names for a in truth["accepted"]):
            wrong.append(names[0])
    drivers = verdict.get("drivers") or [verdict.get("driver")]
    told = " + ".join("/".join(names) for names in classes) or ("nothing" if not outside else "")
    told += f" outside({', '.join(map(str, drivers))})" if outside else ""
    caution = bool(truth["caution"]) and re.search(truth["caution"], text) is not None
    named = caution or (outside and kind == "outside")
    match kind:
        case "single" | "pair":
            every = hits == len(truth["accepted"])
            mark = "right" if every and not wrong and not outside else "partly" if hits or (outside and not wrong) else "wrong"
        case "nothing":
            mark = "right" if not classes and not outside else "wrong" if classes else "partly"
        case "outside":
            mark = "right" if named and not wrong else "partly" if named or (hits and not wrong) else "wrong"
        case _:
            asked = any(truth["left_out"].replace("payload", "load") in json.dumps(one) for one in found["missing_covariates"])
            mark = "wrong" if wrong and not outside else "right" if not wrong and (hits or asked) else "partly"
    if mark == "wrong" and kind in ("outside", "withheld") and verdict["probability"] < 0.6:
        mark = "partly"
    return mark, told, wrong


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--out", type=Path, required=True)
    options.add_argument("--only", default="", help="causes of cases, between commas")
    options.add_argument("--dry", action="store_true", help="write the cases and their truth alone")
    given = options.parse_args()
    name = "{:02d}_{}_{}".format
    folders = [given.out / name(i, case[0], case[3].replace(",", "+")) for i, case in enumerate(CASES)]
    truths = {folder.name: written(folder, given.seed, i) for i, folder in enumerate(folders)}
    (given.out / "truth.json").write_text(json.dumps(truths, indent=1))
    marks: list[tuple[str, str, float, bool]] = []
    for folder in folders if not given.dry else []:
        truth = truths[folder.name]
        if given.only and truth["causes"] not in given.only.split(";"):
            continue
        if not (folder / "d" / "diagnosis.json").is_file() and not (folder / "refused.txt").is_file():
            command = [sys.executable, "-W", "ignore", "-m", "ccnn_torch", "diagnose", "--config", "case.yaml", "--out", "d"]
            done = subprocess.run([*command, "--no-network"], cwd=folder, capture_output=True, text=True, check=False)
            (folder / "screen.txt").write_text(done.stdout + done.stderr)
            if done.returncode:
                (folder / "refused.txt").write_text(done.stderr)
        if (folder / "refused.txt").is_file():
            text = (folder / "refused.txt").read_text()
            said = bool(truth["caution"]) and re.search(truth["caution"], text) is not None
            mark, told, wrong, sure = ("right" if said else "wrong"), "refused: " + text.strip()[:90], [], float("nan")
        else:
            found = json.loads((folder / "d" / "diagnosis.json").read_text())
            mark, told, wrong = judged(truth, found)
            sure = float(found["verdict"]["probability"])
        marks.append((truth["kind"], mark, sure, bool(wrong)))
        print(f"{folder.name:42s} {truth['machine']:5s} {truth['rms_um']:6.0f} um  {mark:6s} {sure:.2f}  {told}", flush=True)
    for kind in dict.fromkeys(mark[0] for mark in marks):
        counts = [sum(m[:2] == (kind, how) for m in marks) for how in ("right", "partly", "wrong")]
        print(f"{kind:9s} right {counts[0]:2d}  partly {counts[1]:2d}  wrong {counts[2]:2d}")
    surely = [mark for mark in marks if mark[2] >= 0.95]
    print(f"verdicts of 0.95 and more: {sum(m[1] == 'right' for m in surely)} of {len(surely)} right; "
          f"wrong names above 0.9: {sum(m[3] and m[2] > 0.9 for m in marks)}")


if __name__ == "__main__":
    main()
