"""A hexapod whose legs are rolled screws that grow with two temperatures, judged on the true machine on another day.

`python -m ccnn_validation.hexapod --seed N [--machines N] [--rows N]`. A tracker finds three reflectors on the
platform, and so its pose; beside it stand the temperatures of the hall and of the nut of leg 1. The true machine has
joints beside their places (150 µm), universal joints whose axes do not meet (20 µm), legs that are too long (300 µm),
screws of grade T7 (ISO 3408-3: 52 µm over 300 mm) with a wobble at each turn of 5 mm, and warm screws, each its own
share of what the nut shows. Ours (`ccnn run` and `ccnn identify` with the machine file of a hexapod, `ccnn run` with
the mechanism `stewart`, each by the written file) stands beside a SciPy fit of all that but the axes that do not meet,
alone and with scikit-learn's Gaussian process on what it leaves. Judged are the three reflectors at poses not measured,
in the frames of base and platform that suit what is reached best.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.drawn import commanded, judge_machines

Array = NDArray[np.float64]
Pose = tuple[Array, Rotation]
# Joints on circles about the axes of base and platform [m], half the angle of a pair, height of the platform.
BASE_RADIUS, PLATFORM_RADIUS, SPREAD, HEIGHT = 0.28, 0.16, np.radians(12.0), 0.42
PITCH, GROWTH = 5e-3, 11.5e-6
# Of a coordinate of a reflector [m]; poses judged; the reflectors on the platform [m].
NOISE, NEW = 7e-6, 300
NESTS = np.array([[0.14, 0.0, 0.03], [-0.07, 0.12, 0.03], [-0.07, -0.12, 0.06]])
# Workspace: half travels of x, y, z [m] and of a rotation vector [rad].
TRAVEL = np.array([0.05, 0.05, 0.025, 0.17, 0.17, 0.25])
MACHINE = """machine: hexapod
numbers: {base_radius: 280 mm, platform_radius: 160 mm, base_spread: 12 deg, platform_spread: 12 deg, height: 420 mm,
  L: 0 mm +- 0.3 mm, lead: 1 +- 0.0003, base_x: +- 0.15 mm, base_y: +- 0.15 mm, base_z: +- 0.15 mm,
  platform_x: +- 0.15 mm, platform_y: +- 0.15 mm, platform_z: +- 0.15 mm}
"""
CONFIG = "mechanism: framed\nmechanism_keys: {base: true, tool: true, mechanism: "
DRAWING = "{base_radius: 0.28, platform_radius: 0.16, base_spread: 0.2094395, platform_spread: 0.2094395, height: 0.42}"
# Called, and named, by the command that is used and the machine as its file has it.
WAYS = {
    "ours, run": ("run", f"{CONFIG}machine.yaml}}\n"),
    "ours, identify": ("identify", f"{CONFIG}machine.yaml}}\n"),
    "ours, run of stewart": ("run", f"{CONFIG}stewart, keys: {DRAWING}}}\n"),
}


def ring(radius: float, angles: Array) -> Array:
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), 0 * angles], -1)


_TURNS = np.radians([0, 120, 120, 240, 240, 360])
_SIDES = SPREAD * np.array([1, -1, 1, -1, 1, -1])
BASE = ring(BASE_RADIUS, _TURNS + _SIDES)
PLATFORM = ring(PLATFORM_RADIUS, np.radians([60, 60, 180, 180, 300, 300]) - _SIDES)
MIDDLE = float(np.linalg.norm(PLATFORM - BASE + np.array([0, 0, HEIGHT]), axis=1).mean())


def between(pose: Pose, base: Array, platform: Array) -> Array:
    """From the joints on the base to those on the platform, `s x 6 x 3` [m]."""
    place, turn = pose
    return np.asarray(place[:, None] + np.einsum("sij,kj->ski", turn.as_matrix(), platform) - base)


def legs(pose: Pose) -> Array:
    """Lengths of the machine as drawn, `s x 6` [m]: what its controller commands for a pose."""
    return np.asarray(np.linalg.norm(between(pose, BASE, PLATFORM), axis=-1))


class Hexapod:
    """The true machine: its controller knows the drawing alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.base, self.platform = BASE + rng.normal(0, 1.5e-4, (6, 3)), PLATFORM + rng.normal(0, 1.5e-4, (6, 3))
        self.long, self.screw = rng.normal(0, 3e-4, 6), rng.normal(0, [15e-6, 6e-6, 4e-6], (6, 3))
        self.wobble = rng.uniform([4e-6, 0], [10e-6, 2e-6], (6, 2))
        self.phase = rng.uniform(0, 2 * np.pi, (6, 2))
        # Of the nut's warmth over the hall, what the screw of each leg has; the frame of the base is of steel, too.
        self.share, self.apart = rng.uniform(0.4, 0.9, 6), rng.normal(0, 2e-5, (2, 6))
        self.nests = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).apply(NESTS) + rng.normal(0, 1e-4, 3)
        self.turn, self.stand = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)), rng.normal(0, 1.5, 3)

    def offsets(self, command: Array, warmth: Array) -> Array:
        """How much longer a leg is than commanded, `s x 6` [m]; `warmth`: hall and nut [deg C], `s x 2`."""
        u, turns = (command - MIDDLE) / 0.06, 2 * np.pi * command / PITCH
        screw = sum(self.screw[:, k] * u ** (k + 1) for k in range(3))
        wave = sum(self.wobble[:, k] * np.sin((k + 1) * turns + self.phase[:, k]) for k in range(2))
        hall, nut = warmth[:, :1] - 20, warmth[:, 1:] - warmth[:, :1]
        # The screw is two thirds of a leg.
        return np.asarray(self.long + screw + wave + GROWTH * command * (hall + 0.67 * self.share * nut))

    def lengths(self, pose: Pose, hall: Array) -> Array:
        """Legs between their universal joints, whose second axis passes beside the first, `s x 6` [m]."""
        place, turn = pose
        grown = 1 + GROWTH * (hall - 20)[:, None, None]
        base = np.broadcast_to(self.base, (len(place), 6, 3)) * grown
        arm = np.einsum("sij,kj->ski", turn.as_matrix(), self.platform) * grown
        leg = place[:, None] + arm - base
        ends = []
        for axes, apart in ((self._across(BASE), self.apart[0]), (self._across(PLATFORM), self.apart[1])):
            axis = np.broadcast_to(axes, leg.shape)
            if apart is self.apart[1]:
                axis = np.einsum("sij,kj->ski", turn.as_matrix(), axes)
            beside = np.cross(axis, leg)
            ends.append(apart[:, None] * beside / np.linalg.norm(beside, axis=-1, keepdims=True))
        return np.asarray(np.linalg.norm(leg + ends[1] - ends[0], axis=-1))

    @staticmethod
    def _across(joints: Array) -> Array:
        """First axes of universal joints: tangents of their circle, `6 x 3`."""
        tangent = np.cross([0, 0, 1.0], joints)
        return np.asarray(tangent / np.linalg.norm(tangent, axis=1, keepdims=True))

    def reached(self, command: Array, warmth: Array, near: Pose) -> Pose:
        """Pose at commanded lengths, by Newton's method with the drawing's Jacobian."""
        goal, (place, turn) = command + self.offsets(command, warmth), near
        for _ in range(15):
            leg = between((place, turn), BASE, PLATFORM)
            along = leg / np.linalg.norm(leg, axis=-1, keepdims=True)
            arm = np.einsum("sij,kj->ski", turn.as_matrix(), PLATFORM)
            jacobian = np.concatenate([along, np.cross(arm, along)], -1)
            step = np.linalg.solve(jacobian, (goal - self.lengths((place, turn), warmth[:, 0]))[..., None])[..., 0]
            place, turn = place + step[:, :3], Rotation.from_rotvec(step[:, 3:]) * turn
        assert np.abs(step).max() < 1e-12
        return place, turn

    def measured(self, command: Array, warmth: Array, near: Pose, rng: np.random.Generator) -> Pose:
        """Pose of the nests as drawn in the tracker's frame."""
        # Of the temperature of a leg that neither thermometer shows.
        seen = warmth + rng.normal(0, 0.1, warmth.shape)
        points = spots(self.reached(command, seen, near), self.nests)
        points = self.turn.apply(points.reshape(-1, 3)).reshape(points.shape) + self.stand
        points = points + rng.normal(0, NOISE, points.shape)
        turn = Rotation.concatenate([Rotation.align_vectors(p - p.mean(0), NESTS - NESTS.mean(0))[0] for p in points])
        return points.mean(1) - turn.apply(NESTS.mean(0)), turn


def spots(pose: Pose, nests: Array) -> Array:
    """Reflectors in space, `s x 3 x 3` [m]."""
    return np.asarray(pose[0][:, None] + np.einsum("sij,kj->ski", pose[1].as_matrix(), nests))


def day(rows: int, rng: np.random.Generator) -> Array:
    """Hall and nut [deg C] over a shift of six hours with busy and idle spells, `s x 2`."""
    hours = np.linspace(0, 6, rows)
    hall = 21.5 + rng.normal(0, 0.5) + 1.5 * np.sin(2 * np.pi * hours / 12 - 1 + rng.normal(0, 0.3))
    # Busy for an hour or so at a time; the nut follows within half an hour.
    fine = np.linspace(0, 6, 2000)
    busy, warm, at = rng.uniform(0, 14, 8)[(fine / 0.8).astype(int)], np.zeros(2000), 0.0
    for k in range(2000):
        at += (busy[k] - at) * (6 / 2000) / 0.5
        warm[k] = at
    return np.stack([hall, hall + np.interp(hours, fine, warm)], -1)


def drawn_poses(rows: int, rng: np.random.Generator, part: float = 1.0) -> Pose:
    at = rng.uniform(-part, part, (rows, 6)) * TRAVEL
    return at[:, :3] + [0, 0, HEIGHT], Rotation.from_rotvec(at[:, 3:])


def missed(wanted: Array, reached: Array) -> float:
    """Root mean square of a reflector's miss [m], in the best frame of the base and with the best nests.

    Args:
        wanted, reached: reflectors, `s x 3 x 3`.
    """
    turn, flat = Rotation, wanted.reshape(-1, 3)
    held = [Rotation.align_vectors(p - p.mean(0), NESTS - NESTS.mean(0))[0] for p in wanted]
    frames, middle = Rotation.concatenate(held), wanted.mean(1)

    def left(x: Array) -> Array:
        moved = turn.from_rotvec(x[6:9]).apply(NESTS - NESTS.mean(0)) + x[9:]
        suited = middle[:, None] + np.einsum("sij,kj->ski", frames.as_matrix(), moved)
        return np.asarray(
            (turn.from_rotvec(x[:3]).apply(reached.reshape(-1, 3)) + x[3:6] - suited.reshape(-1, 3)).ravel()
        )

    found = least_squares(left, np.zeros(12), x_scale=1e-4)
    return float(np.sqrt((found.fun**2).sum() / len(flat)))


# Plausible sizes of the plain script's numbers: joints, lengths, leads, wobbles, growth by hall and nut, of the rings.
PRIOR = np.r_[np.full(36, 1.5e-4), np.full(6, 5e-4), np.full(6, 3e-4), np.full(12, 1e-5), np.full(12, 1.2e-5), 1.2e-5]


def script_offsets(x: Array, command: Array, warmth: Array) -> Array:
    turns = 2 * np.pi * command / PITCH
    hall, nut = warmth[:, :1] - 20, warmth[:, 1:] - warmth[:, :1]
    wave = x[48:54] * np.sin(turns) + x[54:60] * np.cos(turns)
    return np.asarray(x[36:42] + x[42:48] * (command - MIDDLE) + wave + command * (x[60:66] * hall + x[66:72] * nut))


def script_lengths(x: Array, pose: Pose, hall: Array) -> Array:
    grown = 1 + x[72] * (hall - 20)[:, None, None]
    base, platform = BASE + x[:18].reshape(6, 3), PLATFORM + x[18:36].reshape(6, 3)
    arm = np.einsum("sij,kj->ski", pose[1].as_matrix(), platform)
    return np.asarray(np.linalg.norm(pose[0][:, None] + (arm - base) * grown, axis=-1))


def script_fit(command: Array, warmth: Array, plan: Pose, pose: Pose) -> tuple[Array, Array]:
    """Numbers of the plain script by least squares of leg lengths, and what is left of each leg, `s x 6` [m].

    Args:
        command, warmth: of the rows.
        plan, pose: as drawn and as measured.
    """
    points, there = spots(pose, NESTS).reshape(-1, 3), spots(plan, NESTS).reshape(-1, 3)
    turn, _ = Rotation.align_vectors(there - there.mean(0), points - points.mean(0))
    shift = there.mean(0) - turn.apply(points.mean(0))

    def legs_left(u: Array) -> Array:
        x, frames = u[:73] * PRIOR, u[73:] * 1e-3
        base = Rotation.from_rotvec(frames[:3]) * turn
        place, facing = base.apply(pose[0]) + shift + frames[3:6], base * pose[1]
        held = place + facing.apply(frames[6:9]), facing * Rotation.from_rotvec(frames[9:])
        return np.asarray(script_lengths(x, held, warmth[:, 0]) - command - script_offsets(x, command, warmth))

    found = least_squares(lambda u: np.r_[legs_left(u).ravel() / 1e-5, u[:73], 0.01 * u[73:]], np.zeros(85))
    return found.x[:73] * PRIOR, legs_left(found.x)


def script_commands(x: Array, pose: Pose, warmth: Array, more: Array | float = 0.0) -> Array:
    length = script_lengths(x, pose, warmth[:, 0]) - more
    command = length
    for _ in range(8):
        command = length - script_offsets(x, command, warmth)
    return np.asarray(command)


def inputs(command: Array, warmth: Array) -> Array:
    return np.asarray(np.c_[(command - MIDDLE) / 0.04, (warmth - 24) / 4])


def process(command: Array, warmth: Array, left: Array) -> list[GaussianProcessRegressor]:
    """Scikit-learn: what a leg is off, over lengths and temperatures."""
    kernel, make = ConstantKernel(1.0) * RBF(2.0) + WhiteKernel(0.5), GaussianProcessRegressor
    return [make(kernel, normalize_y=True, random_state=0).fit(inputs(command, warmth), each) for each in left.T]


def records(machine: Hexapod, rows: int, rng: np.random.Generator) -> tuple[Array, Array, Pose, Pose]:
    """Commands, temperatures, and poses as planned and as measured of a day."""
    pose, warmth = drawn_poses(rows, rng), day(rows, rng)
    return legs(pose), warmth, pose, machine.measured(legs(pose), warmth, pose, rng)


def table(command: Array, warmth: Array, pose: Pose | None = None) -> tuple[str, Array]:
    """Header and rows of a file in mm, rad and deg C."""
    names = [*(f"q{k}[mm]" for k in range(1, 7)), "temperature[degC]", "temperature_nut[degC]"]
    columns = [1e3 * command, warmth]
    if pose is not None:
        names += ["x[mm]", "y[mm]", "z[mm]", "rx[rad]", "ry[rad]", "rz[rad]"]
        columns += [1e3 * pose[0], pose[1].as_rotvec()]
    return ",".join(names), np.concatenate(columns, 1)


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Hexapod(seed), np.random.default_rng([seed, 1])
    command, warmth, plan, pose = records(machine, rows, rng)
    wanted, then = drawn_poses(NEW, rng, 0.95), day(NEW, rng)
    goal = spots(wanted, NESTS)
    numbers, left = script_fit(command, warmth, plan, pose)
    sent = {"as drawn": legs(wanted), "plain script": script_commands(numbers, wanted, then)}
    fits = process(command, warmth, left)
    more = np.stack([fit.predict(inputs(sent["plain script"], then)) for fit in fits], -1)
    sent["script and process"] = script_commands(numbers, wanted, then, more)
    found = {}
    with TemporaryDirectory() as folder:
        files = table(command, warmth, pose), table(legs(wanted), then)
        for name, (way, config) in WAYS.items():
            (Path(folder) / name).mkdir()
            commands = commanded(Path(folder) / name, MACHINE, *files, way, config)
            sent[name] = np.full_like(command[:1], np.nan) if commands is None else commands
    for who, legs_sent in sent.items():
        lost = np.isnan(legs_sent).any()
        found[who] = np.nan if lost else missed(goal, spots(machine.reached(legs_sent, then, wanted), machine.nests))
    return found


if __name__ == "__main__":
    judge_machines(__doc__, judged, 300)
