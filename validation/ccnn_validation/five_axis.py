"""A five-axis machine tool with a trunnion (A, on it C), of which an R-test device in the spindle sees spheres.

`python -m ccnn_validation.five_axis --seed N [--machines N] [--rows N]`. Four spheres on a certified plate on the
table (0.5 µm); the device tells where a sphere is in the tool's axes, 1 µm of noise in each. Which sphere, and the
device's reading, give the tool's place seen from the plate. Told beside it: temperatures of bed, spindle and
screws, and direction of approach. The true machine: errors of place and direction of A and C, squarenesses, leads and
what they leave, screws of 10 mm lead, guides that are not straight and pitch, yaw and roll over Abbe arms, a worm of
90 teeth with ripple and play at A, an encoder on C that is not central, growth of spindle, bed and screws, and a
trunnion that gives under table and workpiece as A tilts. Ours (`ccnn run`, by the written file) has the machine file
that `ccnn new` writes; "gears" also knows leads and teeth, "sheet" also tolerances and travel by the data sheet, "no
bed" lacks the bed's temperature, "named" is told in `effects` which act.
The plain SciPy script has the errors of the axes' places, leads, growth and the worm's play; "fuller script" all causes
with a polynomial or wave for each. Both correct X, Y, Z. Judged in the workpiece's frame and at the tool point that
suit best: RMS, and largest. `--without NAME` of `CAUSES` switches a true error off, `--keep FOLDER` keeps the files,
`--heads 2` measures half of the rows with a device that is 80 mm longer, `--ours NAME` runs these configs alone.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.drawn import commanded, judge_machines

Array = NDArray[np.float64]
NOISE, NEW, LEAD, TEETH, STEEL, G = 1e-6, 400, 0.01, 90, 11.5e-6, 9.81
# Spheres on the plate [m]; travel of A; from the guides of X to those of Y, of Z, and to the device's centre.
SPHERES = np.array([[0.14, 0.02, 0.06], [-0.06, 0.13, 0.19], [-0.08, -0.12, 0.11], [0.03, -0.04, 0.22]])
SWIVEL, ARMS = np.radians([-90.0, 20.0]), np.array([[0, 0.3, 0.55], [0, -0.3, 0.05], [0, 0, -0.6]])
FIXED, LONGER = np.array([-0.35, -0.35, 0.4]), 0.08  # bearings of the screws that hold; the longer device [m]
CAUSES = ["places", "square", "leads", "curve", "screw", "straight", "angular", "worm", "play", "encoder", "spindle"]
CAUSES += ["growth", "bed", "weight", "runout"]
CONFIG = "mechanism: machine.yaml\n"
NUMBERS = """numbers:
  offset_CA: 0 mm +- 0.2 mm
  BOC: 0 um/m +- 200 um/m
  zero_A: 0 um/m +- 500 um/m
  BOA: 0 um/m +- 200 um/m
  COA: 0 um/m +- 200 um/m
  lead_x: 0 um/m +- 100 um/m
  lead_y: 0 um/m +- 100 um/m
  lead_z: 0 um/m +- 100 um/m
  squareness_xy: 0 um/m +- 200 um/m
  squareness_xz: 0 um/m +- 200 um/m
  squareness_yz: 0 um/m +- 200 um/m
"""
LIMITS = "limits: {q1: [-180 deg, 180 deg], q2: [-100 deg, 30 deg], q3: [%s], q4: [%s], q5: [%s]}\n"
FILE = "machine: five_axis_table_table\nbase_frame: unknown\ntool_frame: unknown\n"
FILE += LIMITS % ("-250 mm, 250 mm", "-250 mm, 250 mm", "-200 mm, 200 mm")
GEARS = "gears: {q2: 90, q3: 10 mm, q4: 10 mm, q5: 10 mm}\n"
SHEET = FILE.replace("-200 mm, 200 mm", "-300 mm, 300 mm").replace("-250 mm, 250 mm", "-300 mm, 300 mm") + GEARS
TIGHT = NUMBERS.replace("0.2 mm", "0.03 mm").replace(" 100 um", " 30 um").replace("200 um", "60 um")
OURS = {"ours": FILE + NUMBERS, "ours, gears": FILE + GEARS + NUMBERS, "ours, sheet": SHEET + TIGHT}
OURS |= {"ours, no bed": SHEET + TIGHT, "ours, named": SHEET + TIGHT}
NAMED = "effects: [backlash, transmission, thermal, error_motion, gravity]\n"


def turn(*parts: Array | float) -> Array:
    """Matrices of small or large turns, by the parts of their rotation vectors, `s x 3 x 3`."""
    vectors = np.stack(np.broadcast_arrays(*parts), -1)
    return np.asarray(Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix())


def times(matrices: Array, vectors: Array) -> Array:
    """Matrices on vectors, row by row."""
    return np.asarray(np.einsum("sij,sj->si", matrices, np.broadcast_to(vectors, (len(matrices), 3))))


class Machine:
    """The true machine; its controller knows the drawing alone. `without`: the causes that are switched off."""

    def __init__(self, seed: int, without: tuple[str, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        on = {cause: float(cause not in without) for cause in CAUSES}

        def size(cause: str, low: float, high: float, *shape: int) -> Array:
            return np.asarray(on[cause] * rng.uniform(low, high, shape) * rng.choice([-1, 1], shape))

        # Lines of A and C: where they are [m], directions and zero of A [rad]; the spindle's direction.
        self.at_a, self.at_c = size("places", 1e-5, 5e-5, 3), size("places", 1e-5, 5e-5, 3)
        self.lean_a, self.lean_c = size("places", 2e-5, 1e-4, 3), size("places", 2e-5, 8e-5, 2)
        self.spindle = size("places", 1e-5, 5e-5, 2)
        self.square, self.leads = size("square", 1e-5, 5e-5, 3), size("leads", 1e-5, 4e-5, 3)
        self.screw, self.screw_at = size("screw", 6e-7, 2.5e-6, 3, 2) * [1, 0.3], rng.uniform(0, 6.3, (3, 2))
        # Of each slide, smooth over its travel: where it is along itself, beside, and its three turns.
        self.curve, self.bow = size("curve", 1e-6, 3e-6, 3), size("straight", 1.5e-6, 5e-6, 3, 3)
        self.pitch = size("angular", 6e-6, 2e-5, 3, 3)
        self.shape = rng.normal(size=(3, 7, 5)) / np.arange(1, 6) ** 1.5
        self.worm, self.worm_at = size("worm", 1e-5, 3e-5, 2) * [1, 0.4], rng.uniform(0, 6.3, 2)
        self.play = size("play", 0.8, 1.2, 5) * [1e-6, rng.uniform(2e-5, 5e-5), 1e-6, 1e-6, 1.5e-6]
        self.play = np.abs(self.play)
        self.encoder, self.encoder_at = size("encoder", 5e-6, 1.5e-5, 2) * [1, 0.3], rng.uniform(0, 6.3, 2)
        # Growth: spindle along its axis and to the column, tilt of its head; screws; bed [m/K, rad/K, 1/K].
        self.grows, self.tilts = on["spindle"] * rng.uniform(8e-7, 1.4e-6), size("spindle", 2e-7, 7e-7, 2)
        self.screws = on["growth"] * STEEL * rng.uniform(0.8, 1.0, 3)
        self.bed = size("bed", 1e-6, 4e-6, 3)
        # Fixture and workpiece, and the table itself [kg, m]; what cradle and bearings give [rad/N/m, m/N].
        self.masses = on["weight"] * np.array([rng.uniform(60, 120), rng.uniform(120, 180)])
        self.centre = np.array([*rng.normal(0, 0.04, 2), rng.uniform(0.02, 0.1)])
        self.twists = 1 / np.array([rng.uniform(3e6, 6e6), rng.uniform(1e7, 2e7), rng.uniform(1e7, 2e7)])
        self.gives = 1 / rng.uniform(3e8, 7e8, 3)
        # Run-out of C, once and twice a turn: shifts and tilts.
        self.runout = size("runout", 3e-7, 1e-6, 3, 2) * [1, 0.5]
        self.wobble, self.wobble_at = size("runout", 1e-6, 5e-6, 2, 2) * [1, 0.5], rng.uniform(0, 6.3, (5, 2))
        self.stand = np.array([0, 0, -0.03]) + rng.normal(0, 5e-5, 3)
        self.placed = Rotation.from_rotvec(rng.normal(0, 5e-4, 3)).as_matrix()
        self.plate = SPHERES + rng.normal(0, 5e-7, SPHERES.shape)
        self.device = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix()

    def slide(self, k: int, q: Array) -> Array:
        """Smooth errors of a slide, `s x 6`: three shifts [m], three turns [rad]."""
        waves = np.cos(np.pi * np.arange(1, 6) * (q[:, None] / 0.6 + 0.5)) @ self.shape[k].T
        sizes = np.r_[np.where(np.arange(3) == k, self.curve[k], self.bow[k]), self.pitch[k]]
        return np.asarray(waves[:, :6] * sizes)

    def reached(self, joints: Array, told: Array, long: Array | float = 0.0) -> tuple[Array, Array]:
        """The tool's place seen from the plate, `s x 3` [m], and its axes there; `told`: 5 temperatures, 5 signs."""
        warm, signs = told[:, :5] - 20, told[:, 5:]
        rows, q = len(joints), joints[:, 2:]
        shifts, turns = [], []
        for k in range(3):
            errors = self.slide(k, q[:, k])
            turned = 2 * np.pi * q[:, [k]] / LEAD * [1, 2] + self.screw_at[k]
            along = q[:, k] * (1 + self.leads[k]) + np.sin(turned) @ self.screw[k]
            along = along + self.play[k + 2] / 2 * signs[:, k + 2]
            errors[:, k] += along + self.screws[k] * warm[:, k + 2] * (q[:, k] - FIXED[k])
            shifts.append(errors[:, :3])
            turns.append(turn(*errors[:, 3:].T))
        shifts[1][:, 0] += self.square[0] * q[:, 1]
        shifts[2][:, :2] += self.square[1:] * q[:, [2]]
        head = turn(self.tilts[0] * warm[:, 1], 0 * q[:, 0], 0 * q[:, 0]) @ turn(*self.spindle, 0.0)
        nose = np.stack([0 * q[:, 0], self.tilts[1] * warm[:, 1], -self.grows * warm[:, 1] - long], -1)
        tool = ARMS[1] + shifts[2] + times(turns[2] @ head, ARMS[2] + nose)
        tool = shifts[0] + times(turns[0], ARMS[0] + shifts[1] + times(turns[1], tool)) + self.bed * warm[:, [0]]
        axes = turns[0] @ turns[1] @ turns[2] @ head
        # The table: weight in the cradle's axes, what it turns and shifts there, then the axes themselves.
        c, a = joints[:, 0], joints[:, 1]
        down = times(turn(a, 0.0, 0.0).swapaxes(1, 2), np.array([0, 0, -G]))
        moment = np.cross(times(turn(0.0, 0.0, c), self.centre), self.masses[0] * down)
        moment = moment + np.cross([0, 0, -0.06], self.masses[1] * down)
        a = a + self.lean_a[0] + np.sin(TEETH * a[:, None] * [1, 2] + self.worm_at) @ self.worm
        a = a + self.play[1] / 2 * signs[:, 1]
        c = c + np.sin(c[:, None] * [1, 2] + self.encoder_at) @ self.encoder + self.play[0] / 2 * signs[:, 0]
        once = np.sin(joints[:, [0], None] * [1, 2] + self.wobble_at)
        run, tilt = (once[:, :3] * self.runout).sum(-1), (once[:, 3:] * self.wobble).sum(-1)
        cradle = turn(0.0, *self.lean_a[1:]) @ turn(a, np.zeros(rows), np.zeros(rows))
        table = turn(*(moment * self.twists).T) @ turn(tilt[:, 0] + self.lean_c[0], tilt[:, 1] + self.lean_c[1], 0.0)
        table = cradle @ table @ turn(0.0, 0.0, c)
        centre = self.at_a + times(cradle, self.at_c + run + self.masses.sum() * down * self.gives)
        back = (table @ self.placed).swapaxes(1, 2)
        return times(back, tool - centre) - self.placed.T @ self.stand, back @ axes

    def measured(self, joints: Array, told: Array, which: Array, long: Array, rng: np.random.Generator) -> Array:
        """As the user makes it of the device's readings, `s x 3` [m]: sphere by certificate less reading, turned."""
        really = told + np.c_[rng.normal(0, 0.15, (len(told), 5)), np.zeros((len(told), 5))]
        scatter = rng.normal(0, [5e-7, 2e-6, 3e-7, 3e-7, 3e-7], joints.shape)
        at, axes = self.reached(joints + scatter, really, long)
        seen = times(axes.swapaxes(1, 2), self.plate[which] - at) @ self.device + rng.normal(0, NOISE, at.shape)
        return np.asarray(SPHERES[which] - times(drawn_table(joints).swapaxes(1, 2), seen))


def drawn_table(joints: Array) -> Array:
    """Axes of the table by the drawing."""
    return turn(joints[:, 1], 0.0, 0.0) @ turn(0.0, 0.0, joints[:, 0])


def day(rows: int, rng: np.random.Generator, ends: Array | None = None) -> tuple[Array, Array, Array, Array]:
    """Joints, places on the plate, which sphere, what is told; `ends` of temperatures: of new targets, in no order."""
    angles = np.stack([rng.uniform(-np.pi, np.pi, rows), rng.uniform(SWIVEL[0], SWIVEL[1], rows)], -1)
    which = rng.permutation(np.arange(rows) % len(SPHERES))
    scatter = rng.normal(0, [0.1, 0.5, 0.3, 0.3, 0.3], (rows, 5))
    if ends is None:
        at, time = SPHERES[which], np.linspace(0, 3, rows)[:, None]
        rise = np.array([0.8, 14, 5, 6, 4]) * rng.uniform(0.7, 1.3, 5)
        speed = np.array([0.4, 1.5, 0.8, 0.8, 0.8])
        temperature = 20.5 + rise * (1 - np.exp(-time * speed)) + scatter
        temperature[:, 1] -= 5 * (np.sin(4 * time[:, 0]) > 0.5)  # its chiller wins between
    else:
        at = rng.dirichlet(np.full(4, 0.7), rows) @ SPHERES
        temperature = ends[0] + (ends[1] - ends[0]) * np.clip(rng.uniform(0, 1, (rows, 1)) + scatter / 5, 0, 1)
    joints = np.c_[angles, np.zeros((rows, 3))]
    joints[:, 2:] = times(drawn_table(joints), at + np.array([0, 0, -0.03]))
    return joints, at, which, np.c_[temperature, np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1))]


def missed(at: Array, joints: Array, reached: Array) -> tuple[float, float]:
    """RMS and largest miss [m] in the best workpiece frame, at the best tool point."""
    frame = drawn_table(joints).swapaxes(1, 2)

    def off(x: Array) -> Array:
        return np.asarray((reached @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6] - at - frame @ x[6:9]).ravel())

    distance = np.linalg.norm(least_squares(off, np.zeros(9), x_scale=1e-4).fun.reshape(-1, 3), axis=1)
    return float(np.sqrt((distance**2).mean())), float(distance.max())


# Numbers of the scripts with their sizes; those from "wave" on are of the fuller one alone.
PARTS = {"plate_turn": (3, 1e-3), "plate": (3, 1e-3), "tool": (3, 1e-4), "offset": (1, 1e-4), "lean": (4, 1e-4)}
PARTS |= {"lead": (3, 5e-5), "square": (3, 5e-5), "growth": (3, 3e-6), "spindle": (1, 2e-6), "play": (1, 4e-5)}
PLAIN = sum(count for count, _ in PARTS.values())
PARTS |= {"wave": (6, 2e-6), "worm": (4, 2e-5), "encoder": (4, 1e-5), "plays": (4, 1e-6), "fixed": (3, 3e-6)}
PARTS |= {"bed": (3, 3e-6), "side": (2, 5e-7), "sag": (3, 2e-5), "cradle": (6, 5e-6), "eccentric": (2, 1e-5)}
PARTS |= {"bow": (27, 2e-6), "turns": (27, 1e-5), "run": (12, 1e-6), "tilt": (8, 5e-6)}
SIZES = np.concatenate([np.full(count, size) for count, size in PARTS.values()])


def script(x: Array, joints: Array, told: Array, tools: Array) -> Array:
    """Places that the script's machine reaches, seen from the plate, `s x 3` [m]."""
    ends = np.cumsum([count for count, _ in PARTS.values()])[:-1]
    v = dict(zip(PARTS, np.split(x, ends), strict=True))
    warm, signs, q, c, a = told[:, :5] - 20, told[:, 5:], joints[:, 2:], joints[:, 0], joints[:, 1]
    zero, turned = 0 * c, 2 * np.pi * q / LEAD
    moves = q * (1 + v["lead"]) + (STEEL + v["growth"]) * warm[:, 2:] * (q - FIXED) + v["fixed"] * warm[:, 2:]
    moves = moves + v["wave"][:3] * np.sin(turned) + v["wave"][3:] * np.cos(turned) + v["plays"][1:] / 2 * signs[:, 2:]
    bows, turns = v["bow"].reshape(3, 3, 3), v["turns"].reshape(3, 3, 3)
    across, spins = [], []
    for k in range(3):
        high = legendre.legvander(q[:, k] / 0.3, 4)
        across.append(high[:, 2:] @ bows[k] + moves[:, [k]] * np.eye(3)[k])
        spins.append(turn(*(high[:, 1:4] @ turns[k]).T))
    across[1][:, 0] += v["square"][0] * q[:, 1]
    across[2][:, :2] += v["square"][1:] * q[:, [2]]
    nose = ARMS[2] + v["tool"] + np.c_[warm[:, [1]] * v["side"], -v["spindle"] * warm[:, 1]] - tools
    tool = ARMS[0] + across[1] + times(spins[1], ARMS[1] + across[2] + times(spins[2], nose))
    tool = across[0] + times(spins[0], tool) + v["bed"] * warm[:, [0]]
    waves = np.stack([np.sin(TEETH * a), np.cos(TEETH * a), np.sin(2 * TEETH * a), np.cos(2 * TEETH * a)], -1)
    once = np.stack([np.sin(c), np.cos(c), np.sin(2 * c), np.cos(2 * c)], -1)
    tilt = np.stack([np.sin(a), np.cos(a)], -1)
    swivel = a + v["lean"][0] + waves @ v["worm"] + v["play"] / 2 * signs[:, 1] + tilt @ v["sag"][:2]
    swivel = swivel + (once[:, :2] @ v["eccentric"]) * np.cos(a)
    lean = once @ v["tilt"].reshape(4, 2)
    cradle = turn(0.0, v["lean"][1] + zero, v["lean"][2] + zero) @ turn(swivel, zero, zero)
    table = turn(lean[:, 0], v["lean"][3] + v["sag"][2] * np.sin(a) + lean[:, 1], zero)
    table = cradle @ table @ turn(zero, zero, c + once @ v["encoder"] + v["plays"][0] / 2 * signs[:, 0])
    centre = np.stack([zero, v["offset"] + zero, zero], -1) + tilt @ v["cradle"].reshape(2, 3)
    centre = times(cradle, centre + once @ v["run"].reshape(4, 3))
    plate = turn(*v["plate_turn"])
    off = plate[0].T @ (v["plate"] + [0, 0, -0.03])
    return np.asarray(times((table @ plate).swapaxes(1, 2), tool - centre) - off)


def script_fit(joints: Array, told: Array, seen: Array, long: Array, full: bool) -> tuple[Array, Array]:
    """Numbers of the script, and what it leaves in the machine's axes, `s x 3` [m]."""
    free = len(SIZES) if full else PLAIN

    def left(u: Array) -> Array:
        x = np.r_[u[:free], np.zeros(len(SIZES) - free)] * SIZES
        return seen - script(x, joints, told, long[:, None] / LONGER * (u[free:] * 1e-3 + [0, 0, LONGER]))

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[left(u).ravel() / (1.5e-6 if full else 5e-6), u])

    found = least_squares(residuals, np.zeros(free + 3)).x
    return np.r_[found[:free], np.zeros(len(SIZES) - free)] * SIZES, times(drawn_table(joints), left(found))


def corrected(goal: Array, wanted: Array, told: Array, x: Array) -> Array:
    """Joints at which the script's tool is at a goal, `s x 5`."""
    joints = wanted.copy()
    for _ in range(4):
        joints[:, 2:] += times(drawn_table(wanted), goal - script(x, joints, told, np.zeros((1, 3))))
    return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left in the machine's axes over joints and temperatures, at those wanted, `s x 3`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(11, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor

    def inputs(q: Array, some: Array) -> Array:
        parts = [np.sin(q[:, 0]), np.cos(q[:, 0]), q[:, 1], *(q[:, 2:] / 0.1).T, *((some[:, :5] - 20) / 3).T]
        return np.stack(parts, -1)

    rows, new = inputs(joints, told), inputs(wanted, then)
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, seen: Array, head: Array | None, bed: bool) -> tuple[str, Array]:
    """Header and rows of a file in degrees, mm and deg C; `seen` has no columns where nothing was measured."""
    names = ["q1[deg]", "q2[deg]", "q3[mm]", "q4[mm]", "q5[mm]"] + ["temperature[degC]"] * bed
    names += [f"temperature_{part}[degC]" for part in ("spindle", "x", "y", "z")]
    names += [f"direction{k}[1]" for k in range(1, 6)] + ["x[mm]", "y[mm]", "z[mm]"][: seen.shape[1]]
    parts = [np.degrees(joints[:, :2]), 1e3 * joints[:, 2:], told[:, not bed :], 1e3 * seen]
    if head is not None:
        names, parts = [*names, "head[1]"], [*parts, head[:, None]]
    return ",".join(names), np.hstack(parts)


def judged(
    seed: int, rows: int, without: tuple[str, ...], kept: Path | None, heads: int, ours: list[str]
) -> dict[str, float]:
    """RMS and largest of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Machine(seed, without), np.random.default_rng([seed, 1])
    joints, _, which, told = day(rows, rng)
    head = np.asarray(np.arange(rows) % heads, float)
    long = head * LONGER
    joints[:, 4] += long
    seen = machine.measured(joints, told, which, long, rng)
    wanted, goal, _, then = day(NEW, rng, np.stack([told[:, :5].min(0), told[:, :5].max(0)]))
    sent = {"as drawn": wanted}
    for full, who in ((False, "plain script"), (True, "fuller script")):
        numbers, left = script_fit(joints, told, seen, long, full)
        sent[who] = corrected(goal, wanted, then, numbers)
        more = by_process(joints, told, left, wanted, then)
        more = times(drawn_table(wanted).swapaxes(1, 2), more)
        sent[f"{who} and process"] = corrected(goal - more, wanted, then, numbers)
    for who in ours:
        told_per = "tool_frame: unknown\n" + "tool_per: [head]\n" * (heads > 1)
        text = OURS[who].replace("tool_frame: unknown\n", told_per)
        bed = who != "ours, no bed"
        records = table(joints, told, seen, head if heads > 1 else None, bed)
        targets = table(wanted, then, np.empty((NEW, 0)), None, bed)
        config = CONFIG + NAMED * (who == "ours, named")
        with TemporaryDirectory() as folder:
            place = Path(folder) if kept is None else kept / f"{seed}" / who.replace(", ", "_").replace(" ", "_")
            place.mkdir(parents=True, exist_ok=True)
            commands = commanded(place, text, records, targets, "run", config)
        sent[who] = np.full_like(wanted, np.nan) if commands is None else commands
    found: dict[str, float] = {}
    for who, q in sent.items():
        off = (np.nan, np.nan) if np.isnan(q).any() else missed(goal, wanted, machine.reached(q, then)[0])
        found[who], found[f"{who}, largest"] = off
    return found | {"a reading": NOISE * 3**0.5}


if __name__ == "__main__":
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[])
    options.add_argument("--keep", type=Path)
    options.add_argument("--heads", type=int, choices=(1, 2), default=1)
    options.add_argument("--ours", nargs="*", choices=OURS, default=list(OURS))
    asked, sys.argv[1:] = options.parse_known_args()
    given = tuple(asked.without), asked.keep, asked.heads, asked.ours
    judge_machines(__doc__, lambda seed, rows: judged(seed, rows, *given), 150)
