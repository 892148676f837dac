"""The two machines that `workshop` judges by, in NumPy: what is true of them, what may be wrong, and the files of both.

`Rails`: three carriages on parallel rails and a platform on rods; `Arm`: six axes by a DH table. `reach` tells where
the reflector is at the true joints, with dimensions that differ by `dims` from the drawing, in the machine's base.
`Case` is one measurement of one of them; its other methods are what acts on it, each called once.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["Arm", "Case", "Rails"]

Array = NDArray[np.float64]
G, STEEL, ALUMINIUM = 9.81, 11.5e-6, 23e-6
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
    files: ClassVar = {"rails.py": Path(__file__).with_name("workshop_rails.py").read_text()}
    config = RAILS_CONFIG
    middle = np.array([-0.65, 0.75, -0.65])

    def __init__(self) -> None:
        self.nominal = {"rod": np.full(3, 0.9), "y": np.array([-0.4, 0.0, 0.4]), "z": np.full(3, 0.85)}
        self.nominal |= {name: np.zeros(3) for name in ("place", "yaw", "pitch")}

    def commands(self, rng: np.random.Generator, rows: int) -> Array:
        pose = rng.uniform([-0.25, -0.2, 0.25], [0.25, 0.2, 0.5], (rows, 3))
        way = np.sqrt(0.81 - (pose[:, 1:2] - self.nominal["y"]) ** 2 - (pose[:, 2:] - 0.85) ** 2)
        return np.asarray(np.round(pose[:, :1] + np.array([-1.0, 1.0, -1.0]) * way, 7))

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
    files: ClassVar = {"arm.yaml": ARM_FILE}
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
            rows = [
                [c, -s * ca, s * sa, a * c],
                [s, c * ca, -c * sa, a * s],
                [o, sa, ca, d["d"][:, i]],
                [o, o, o, o + 1],
            ]
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
        self.dq, self.moved = np.zeros((rows, k)), np.zeros((rows, 3))
        self.dims: dict[str, Array] = {}
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

    # --- causes that the library names, none in its simplest form
    def geometry(self) -> None:
        sizes = (
            {"a": 1.5e-4, "alpha": 2e-4, "d": 1.5e-4}
            if self.arm
            else {"rod": 8e-5, "y": 1.2e-4, "z": 1.2e-4, "yaw": 1e-4}
        )
        for name, size in sizes.items():
            self.dim(name, self.rng.normal(0, size, self.m.joints))
        self.dim("a" if self.arm else "rod", np.eye(self.m.joints)[1] * (6e-4 if self.arm else 2.5e-4))

    def joint_offset(self) -> None:
        self.dq[:, 1:5] += self.rng.choice([-1, 1], 4) * self.rng.uniform(4e-4, 1.2e-3, 4)

    def joint_gain(self) -> None:
        """Rolled screws: their lead is off, and changes along the screw."""
        u = self.q - self.m.middle
        self.dq += self.rng.choice([-1, 1], 3) * self.rng.uniform(1.2e-4, 2.5e-4, 3) * (u + 0.25 * u * np.abs(u) / 0.3)

    def transmission(self) -> None:
        """Gears or screws; the amplitude changes once along the way, and there is a second harmonic."""
        for i, turns in ((1, 121.0), (2, 102.0)) if self.arm else ((0, 2 * np.pi / 0.02), (2, 2 * np.pi / 0.02)):
            size, f = (
                self.rng.uniform(0.8, 1.3) * (9e-5 if self.arm else 1.5e-5),
                turns * self.q[:, i] + self.rng.uniform(0, 6),
            )
            self.dq[:, i] += (
                size
                * (1 + 0.2 * np.sin(self.q[:, i] * (1 if self.arm else 5)))
                * (np.sin(f) + 0.25 * np.sin(2 * f + 1))
            )

    def backlash(self) -> None:
        """Wear in the middle of the travel: wider there."""
        for i in (0, 3) if self.arm else (0, 1):
            u = (self.q[:, i] - self.m.middle[i]) / (1.2 if self.arm else 0.25)
            wide = self.rng.uniform(0.8, 1.2) * (3e-4 if self.arm else 4.5e-5) * (0.7 + 0.6 * np.exp(-(u**2)))
            self.dq[:, i] -= wide / 2 * self.direction[:, i]

    def friction(self) -> None:
        """The drives wind up by a tenth of what they carry and a little more."""
        torque = self.m.weight_torque(self.q)
        self.dq -= (
            self.direction * (0.12 * np.abs(torque) ** 0.95 + 0.01 * np.max(np.abs(torque), 0)) / STIFF[self.m.joints]
        )

    def compliance(self) -> None:
        """Springs that harden by a sixth up to the largest load."""
        torque = self.m.load_torque(self.q, np.stack([0 * self.weights(), 0 * self.weights(), -G * self.weights()], -1))
        self.dq += torque * (1 - 0.16 * np.abs(torque) / np.abs(torque).max(0).clip(1e-9)) / STIFF[self.m.joints]

    def gravity(self) -> None:
        self.dq += self.m.weight_torque(self.q) / STIFF[self.m.joints] * self.rng.uniform(0.8, 1.2, self.m.joints)

    def thermal(self) -> None:
        """Thick parts follow later than thin ones."""
        late, later = self.lagged(self.rng.uniform(1500, 2400)), self.lagged(self.rng.uniform(3600, 5400))
        if self.arm:
            self.dim("a", self.m.nominal["a"] * ALUMINIUM * late[:, None])
            self.dim(
                "d", np.stack([(STEEL if i == 0 else ALUMINIUM) * self.m.nominal["d"][i] * later for i in range(6)], -1)
            )
        else:
            self.dim("rod", 0.9 * STEEL * np.stack([late, late, 1.15 * late], -1))
            self.dq += (self.q + 0.9) * STEEL * later[:, None]

    def frame_drift(self) -> None:
        """A stand that settles after it was set up, and breathes a little with the hall."""
        s = 1 - np.exp(-self.time / (0.25 * self.time[-1]))
        way = self.rng.normal(0, 1, 3)
        size = 1.2e-4 if self.arm else 6e-5
        self.moved += size * (s + 0.05 * np.sin(12 * self.time / self.time[-1]))[:, None] * way / np.linalg.norm(way)

    def homing(self) -> None:
        """Switched off three times; each reference run finds another zero."""
        part = np.searchsorted(np.sort(self.rng.uniform(0.15, 0.85, 3)), np.arange(self.n) / self.n)
        self.time = self.time + 2400.0 * part
        self.dq += self.rng.normal(0, 2.5e-4 if self.arm else 3e-5, (4, self.m.joints))[part]

    def coupling(self) -> None:
        """Bevel gears of a wrist whose ratio in the controller is a little off, and that run a little out of true."""
        self.dq[:, 4] += 8e-4 * self.q[:, 3]
        self.dq[:, 5] += -1.5e-3 * self.q[:, 4] + 4e-5 * np.sin(self.q[:, 4] * 3)

    def instrument(self) -> None:
        """A tracker whose distances are too long, and whose elevation is a little off."""
        read = self.reading
        self.reading = lambda p: read(p * (1 + 9e-5) * np.array([1, 1, 1 + 2e-5]))

    # --- causes that we believe no library names
    def loose_bolt(self) -> None:
        """A tool plate that shifts when joint 1 reverses after a long way, and stays there."""
        state, states, last = 0, [], 0.0
        for way in np.diff(self.q[:, 0], prepend=0.0):
            if abs(way) > 0.6 and way * last < 0:
                state = 1 - state
            last = way if abs(way) > 0.6 else last
            states.append(state)
        self.dim("tool", 1.6e-4 * np.array(states)[:, None] * np.array([0.5, 0.2, 0.85]))

    def cable_chain(self) -> None:
        """The chain's pull on carriage 1 grows beyond a place, more so on the way out."""
        beyond = np.maximum(self.q[:, 0] + 0.7, 0.0)
        self.dq[:, 0] -= 7e-5 * (beyond / 0.2) ** 1.5 * (1 + 0.45 * self.direction[:, 0])

    def encoder_swap(self) -> None:
        """An eccentric disc on joint 2, whose reader was replaced midway by one at another place."""
        late = np.arange(self.n) > 0.48 * self.n
        self.dq[:, 1] += np.where(late, 3e-4 * np.sin(self.q[:, 1] + 2.6), 3e-4 * np.sin(self.q[:, 1] + 0.4))
        self.dq[:, 1] += np.where(late, 1e-4 * np.sin(2 * self.q[:, 1] + 1), 0)

    def nest(self) -> None:
        """The reflector is taken off every six rows or so and sits on the rim of its nest sometimes."""
        seat = np.cumsum(self.rng.random(self.n) < 1 / 6)
        self.dim("tool", 1.2e-4 * (self.rng.random(self.n) < 0.4)[seat][:, None] * np.array([0.3, -0.6, 0.7]))

    def fahrenheit(self) -> None:
        self.thermal()
        key = "temperature[degC]"
        self.wrong = lambda made: made | {key: np.round(made[key] * 1.8 + 32, 1)}

    def swapped(self) -> None:
        """Backlash of carriage 1, and the headers of two direction columns exchanged."""
        self.dq[:, 0] -= 2.5e-5 * (1 + 0.3 * (self.q[:, 0] + 0.65)) * self.direction[:, 0]
        one, two = "direction1[1]", "direction2[1]"
        self.wrong = lambda made: made | {one: made[two], two: made[one]}

    def sorted_rows(self) -> None:
        """A stand that settles, but the table was sorted by q1 before it was saved, and times were left out."""
        self.frame_drift()
        self.drop |= {"time", "temperature", "direction"}
        self.wrong = lambda made: {name: value[np.argsort(self.q[:, 0])] for name, value in made.items()}

    def stick_slip(self) -> None:
        """A fixture that slides in five jerks of different size and way, never back."""
        rows = np.sort(self.rng.choice(np.arange(5, self.n - 5), 5, replace=False))
        jerks = self.rng.normal([2.5e-5, -1e-5, 0], [1.2e-5, 1.5e-5, 4e-6], (5, 3)) * (2.0 if self.arm else 1.4)
        self.moved += np.vstack([np.zeros(3), np.cumsum(jerks, 0)])[
            np.searchsorted(rows, np.arange(self.n), side="right")
        ]

    def rail_joint(self) -> None:
        """Rail 2 is made of two pieces: a step in height, and the carriage of 80 mm rides over it."""
        self.dim("z", np.eye(3)[1] * 8e-5 / (1 + np.exp(-(self.q[:, 1:2] - 0.77) / 0.012)))

    # --- noise
    def gaussian(self) -> None:
        pass

    def heavy(self) -> None:
        self.reading = lambda p: p + self.m.noise * 0.7 * self.rng.standard_t(3, p.shape)

    def slow_air(self) -> None:
        def reading(p: Array) -> Array:
            e = self.rng.normal(0, self.m.noise, p.shape)
            for i in range(1, len(e)):
                e[i] = 0.6 * e[i - 1] + 0.8 * e[i]
            return p + e

        self.reading = reading

    def far(self) -> None:
        """Angles scatter with the distance, the distance does not."""

        def reading(p: Array) -> Array:
            reach = np.linalg.norm(p, axis=-1, keepdims=True)
            along = p / reach
            e = self.rng.normal(0, 1, p.shape) * self.m.noise * 0.45 * reach
            return np.asarray(p + e - along * (e * along).sum(-1, keepdims=True) * 0.8)

        self.reading = reading

    def gross(self) -> None:
        """The beam was touched in three of a hundred rows."""
        bad = self.rng.random(self.n) < 0.03
        bad[self.rng.integers(self.n)] = True
        self.reading = lambda p: (
            p + self.rng.normal(0, self.m.noise, p.shape) + bad[:, None] * self.rng.normal(0, 8e-4, p.shape)
        )

    def rounded(self) -> None:
        self.reading = lambda p: np.round(p + self.rng.normal(0, self.m.noise, p.shape), 5)

    def unsteady(self) -> None:
        """The drives themselves stop elsewhere each time."""
        self.jitter = 2e-5 if self.arm else 1e-5

    def neighbour(self) -> None:
        """A press next door works in the afternoon."""
        loud = np.where(self.time > 0.6 * self.time[-1], 2.5, 0.8)[:, None]
        self.reading = lambda p: p + loud * self.rng.normal(0, self.m.noise, p.shape)
