"""A head with three extensible legs and a central leg without a drive, which the package does not ship.

`python -m ccnn_validation.tricept --seed N [--machines N] [--rows N]`. A laser tracker reads x, y, z of a reflector in
the spindle, 8 µm of noise in each; beside them stand a thermometer of the hall, one on each leg, and each leg's
direction of approach. The true machine: joints of the legs elsewhere, zeros, screws of 10 mm lead whose error grows and
returns each turn, legs that grow as they warm and stretch under the head's weight (softer when long), play, and a
central joint whose axes neither meet nor are square. Ours (`ccnn run`, by the written file) has the user's own class
`tricept_head.Tricept`; "leads" also knows the screws' lead, "no hall" has the thermometers of the legs alone, "mean"
their mean in the place of the hall's, "one" their mean alone. The plain SciPy script has the same geometry, zeros,
leads and growth; "fuller script" also waves of the screws, play, and what the legs give, "fuller, one" with the mean
alone. Judged in the frame and at the tool point that suit best; "a reading" is what a reading of the tracker is off.
`--without NAME` of `CAUSES` switches a true error off, `--keep FOLDER` keeps the files.
"""

from __future__ import annotations

import argparse
import sys
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
# By the drawing: radii of the legs' joints, joints to tool, lead of the screws [m]; mass of the head [kg].
BASE, PLATFORM, TOOL, LEAD, MASS, G = 0.45, 0.2, 0.25, 0.01, 80.0, 9.81
WAYS = np.radians([90.0, 210.0, 330.0])
RING = np.stack([np.cos(WAYS), np.sin(WAYS), 0 * WAYS], -1)
NOISE, NEW, STEEL = 8e-6, 400, 11.5e-6
CAUSES = ("anchors", "zeros", "progress", "screw", "centre", "warmth", "weight", "play", "softness")
INNER = "{mechanism: tricept_head.py:Tricept, base: true, allow_code: true"
CONFIG = f"mechanism: framed\nmechanism_keys: {INNER}}}\n"
LEADS = CONFIG.replace("base: true", "base: true, keys: {gears: [10 mm, 10 mm, 10 mm]}")
# Of ours: config, and which thermometers it is told: of the hall, mean of the legs, each leg.
OURS = {
    "ours": (CONFIG, (0, 2)),
    "ours, leads": (LEADS, (0, 2)),
    "ours, no hall": (LEADS, (2,)),
    "ours, mean": (LEADS, (1, 2)),
    "ours, one": (LEADS, (1,)),
}


def about(axis: int, angle: Array) -> Array:
    """Matrices of turns about a coordinate axis, `s x 3 x 3`."""
    return np.asarray(Rotation.from_rotvec(angle[:, None] * np.eye(3)[axis]).as_matrix())


class Head:
    """The true machine; its controller knows the drawing alone. `without`: the causes that are switched off."""

    def __init__(self, seed: int, without: tuple[str, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        on = {cause: float(cause not in without) for cause in CAUSES}

        def size(low: float, high: float, *shape: int) -> Array:
            return np.asarray(rng.uniform(low, high, shape) * rng.choice([-1, 1], shape))

        self.base = BASE * RING + on["anchors"] * size(5e-5, 3e-4, 3, 3)
        self.platform = PLATFORM * RING + on["anchors"] * size(5e-5, 3e-4, 3, 3)
        self.zeros = on["zeros"] * size(1e-4, 5e-4, 3)
        self.progress = on["progress"] * size(2e-5, 5e-5, 3)
        self.wave, self.phase = on["screw"] * rng.uniform(3e-6, 8e-6, 3), rng.uniform(0, 2 * np.pi, 3)
        # Of the central joint: second axis from first, slide from second (two ways) [m]; skew of each pair [rad].
        self.apart, self.skew = on["centre"] * size(5e-5, 2e-4, 3), on["centre"] * size(1e-4, 3e-4, 2)
        self.growth = on["warmth"] * STEEL * rng.uniform(0.85, 1.15, 3)
        self.play = on["play"] * rng.uniform(4e-6, 6e-6, 3)
        # What a leg gives: its bearings and joints, and its screw by length [m / N, 1 / N]; 20 to 60 N / µm.
        self.gives, self.bends = rng.uniform(0.8e-8, 1.2e-8, 3), rng.uniform(1e-8, 2.2e-8, 3)
        if "softness" in without:
            self.gives, self.bends = self.gives + 1.2 * self.bends, 0 * self.bends
        self.mass = on["weight"] * MASS * rng.uniform(0.9, 1.1)
        self.centre = np.array([0, 0, -0.05]) + rng.normal(0, 0.02, 3)
        self.point = np.array([0, 0, -TOOL]) + rng.normal(0, 3e-4, 3)
        self.turn = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * Rotation.from_rotvec(rng.normal(0, 5e-4, 3))
        self.stand = rng.normal([2, 1, 1], 0.5)

    def place(self, state: Array) -> tuple[Array, Array]:
        """Centre of the platform's joints `s x 3` [m], and its frame; `state`: turns of both axes, slide."""
        first, slide = about(1, state[:, 0]), about(1, np.full(len(state), self.skew[1]))
        second = first @ about(2, np.full(len(state), self.skew[0])) @ about(0, state[:, 1])
        frame = second @ slide
        at = first[:, :, 2] * self.apart[0] + second[:, :, 0] * self.apart[1] + second[:, :, 1] * self.apart[2]
        return at - state[:, [2]] * frame[:, :, 2], frame

    def spans(self, state: Array) -> tuple[Array, Array]:
        """Distances between the joints of each leg, `s x 3` [m], and height of the head's centre of mass, `s` [m]."""
        at, frame = self.place(state)
        ends = at[:, None] + self.platform @ frame.swapaxes(1, 2)
        return np.asarray(np.linalg.norm(ends - self.base, axis=-1)), np.asarray((at + frame @ self.centre)[:, 2])

    def closed(self, lengths: Array) -> tuple[Array, Array]:
        """State in which the legs have these lengths, and the force that pulls each one [N], both `s x 3`."""
        state = np.tile([0.0, 0.0, 1.1], (len(lengths), 1))
        for _ in range(12):
            ways = [(self.spans(state + step), self.spans(state - step)) for step in 1e-6 * np.eye(3)]
            slope = np.stack([(up[0] - down[0]) / 2e-6 for up, down in ways], -1)
            state = state + np.linalg.solve(slope, (lengths - self.spans(state)[0])[..., None])[..., 0]
        rise = np.stack([(up[1] - down[1]) / 2e-6 for up, down in ways], -1)
        pull = -self.mass * G * np.linalg.solve(slope.swapaxes(1, 2), rise[..., None])[..., 0]
        return np.asarray(state), np.asarray(pull)

    def reached(self, joints: Array, told: Array) -> Array:
        """The reflector, `s x 3` [m]; `told`: temperatures of the legs [deg C], directions, `s x 6`."""
        lengths = joints + self.zeros + self.progress * (joints - 0.8) + self.play / 2 * told[:, 3:]
        lengths = lengths + self.wave * np.sin(2 * np.pi * joints / LEAD + self.phase)
        lengths = lengths + self.growth * (told[:, :3] - 20) * joints
        _, pull = self.closed(lengths)
        state, _ = self.closed(lengths + pull * (self.gives + self.bends * joints))
        at, frame = self.place(state)
        return np.asarray(at + frame @ self.point)

    def measured(self, joints: Array, told: Array, rng: np.random.Generator) -> Array:
        """As the tracker reads it, `s x 3` [m]; legs stop with scatter, thermometers do not show all."""
        really = told + rng.normal(0, [0.1] * 3 + [0] * 3, told.shape)
        seen = self.reached(joints + rng.normal(0, 1e-6, joints.shape), really)
        return np.asarray(self.turn.apply(seen) + self.stand + rng.normal(0, NOISE, seen.shape))


def drawn_joints(at: Array, tool: float = TOOL) -> Array:
    """Lengths of the legs by the drawing, the tool at a place, `s x 3` [m]."""
    a, b = np.arctan2(-at[:, 0], -at[:, 2]), np.arctan2(at[:, 1], np.hypot(at[:, 0], at[:, 2]))
    ends = at[:, None] + (PLATFORM * RING + [0, 0, tool]) @ (about(1, a) @ about(0, b)).swapaxes(1, 2)
    return np.asarray(np.linalg.norm(ends - BASE * RING, axis=-1))


def day(rows: int, rng: np.random.Generator, ends: Array | None = None) -> tuple[Array, ...]:
    """Joints of places all over the workspace, places and frames by the drawing, and what is told.

    `ends`: lowest and highest temperature of each leg, `2 x 3`, of places in no order; else the legs warm as they work.
    """
    far, way = 0.4 * np.sqrt(rng.uniform(0, 1, rows)), rng.uniform(-np.pi, np.pi, rows)
    at = np.stack([far * np.cos(way), far * np.sin(way), rng.uniform(-1.65, -1.15, rows)], -1)
    a, b = np.arctan2(-at[:, 0], -at[:, 2]), np.arctan2(at[:, 1], np.hypot(at[:, 0], at[:, 2]))
    joints, scatter = drawn_joints(at), rng.normal(0, 0.5, (rows, 3))
    if ends is None:
        temperature = 20.5 + rng.uniform(4, 9, 3) * (1 - np.exp(-np.linspace(0, 3, rows)))[:, None] + scatter
    else:
        low, high = ends
        temperature = np.clip(low + (high - low) * rng.uniform(0, 1, (rows, 1)) + scatter, low, high)
    direction = np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1))
    return joints, at, about(1, a) @ about(0, b), np.c_[temperature, direction]


def missed(at: Array, frame: Array, reached: Array) -> float:
    """Root mean square of a miss [m] in the best frame, with the best point on the drawing's platform."""

    def off(x: Array) -> Array:
        moved = Rotation.from_rotvec(x[:3]).apply(reached) + x[3:6]
        return np.asarray((moved - at - frame @ x[6:9]).ravel())

    found = least_squares(off, np.zeros(9), x_scale=1e-3)
    return float(np.sqrt((found.fun**2).sum() / len(at)))


# Of the plain script: legs' joints, zeros, leads, growth, tool; of the fuller one waves, play, and what legs give.
SIZES = np.r_[[2e-4] * 18, [4e-4] * 3, [4e-5] * 3, [2e-6] * 3, [5e-4] * 3, [6e-6] * 6, [5e-6] * 3, [1e-8] * 3]


def script(x: Array, at: Array, joints: Array, told: Array) -> Array:
    """Lengths to command for the tool at a place, by the script, `s x 3` [m]; `joints`: about where the legs are."""
    base, platform = BASE * RING + x[:9].reshape(3, 3), PLATFORM * RING + x[9:18].reshape(3, 3)
    # The central leg's turns and length: the tool beside its axis as it is, from the place of the tool.
    wide, deep = x[27], -np.sqrt(at[:, 0] ** 2 + at[:, 2] ** 2 - x[27] ** 2)
    a = np.arctan2(at[:, 0], at[:, 2]) - np.arctan2(wide, deep)
    long = np.sqrt(at[:, 1] ** 2 + deep**2 - x[28] ** 2)
    b = np.arctan2(deep, at[:, 1]) - np.arctan2(-long, x[28])
    frame = about(1, a) @ about(0, b)
    hang = np.c_[0 * long, 0 * long, TOOL + x[29] - long]
    spokes = (platform + hang[:, None]) @ frame.swapaxes(1, 2) - base
    lengths = np.linalg.norm(spokes, axis=-1)
    # Weight on the legs: they and the central one's push across hold the head; moments about its joint.
    lever = np.cross(base, spokes / lengths[..., None])
    turning = np.stack([np.zeros((len(at), 3)), np.zeros((len(at), 3))], 0)
    turning[0], turning[1] = lever[:, :, 1], (lever * frame[:, None, :, 0]).sum(-1)
    axial = (spokes / lengths[..., None] * frame[:, None, :, 2]).sum(-1)
    head = (hang - [0, 0, 0.05])[:, None] @ frame.swapaxes(1, 2)
    moment = np.cross(head[:, 0], [0, 0, -MASS * G])
    held = np.stack([moment[:, 1], (moment * frame[:, :, 0]).sum(-1), -MASS * G * frame[:, 2, 2]], -1)
    pull = np.linalg.solve(np.stack([*turning, axial], 1), held[..., None])[..., 0]
    turns = 2 * np.pi * joints / LEAD
    lengths = lengths - x[18:21] - x[21:24] * (joints - 1.2) - (STEEL + x[24:27]) * (told[:, :3] - 20) * joints
    lengths = lengths - x[30:33] * np.sin(turns) - x[33:36] * np.cos(turns) - x[36:39] / 2 * told[:, 3:]
    return np.asarray(lengths - x[39:42] * pull)


def script_fit(joints: Array, at: Array, told: Array, seen: Array, full: bool) -> tuple[Array, Array]:
    """Numbers of the script, and what it leaves in the machine's frame, `s x 3` [m]."""
    sizes, count = SIZES * np.r_[np.ones(30), np.full(12, float(full))], len(SIZES)
    turn, _ = Rotation.align_vectors(at - at.mean(0), seen - seen.mean(0))
    near = turn.apply(seen - seen.mean(0)) + at.mean(0)
    steps = [(drawn_joints(at + step) - drawn_joints(at - step)) / 2e-6 for step in 1e-6 * np.eye(3)]
    place_of = np.linalg.inv(np.stack(steps, -1))

    def left(u: Array) -> Array:
        moved = Rotation.from_rotvec(u[count : count + 3] * 1e-3).apply(near) + u[count + 3 :] * 1e-3
        lacks = script(u[:count] * sizes, moved, joints, told) - joints
        return np.asarray((place_of @ lacks[..., None])[..., 0])

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[left(u).ravel() / 1.2e-5, u[:count], 0.1 * u[count:]])

    found = least_squares(residuals, np.zeros(count + 6)).x
    return found[:count] * sizes, left(found)


def corrected(goal: Array, wanted: Array, told: Array, numbers: Array) -> Array:
    """Joints at which the script's tool is at a goal, `s x 3` [m]."""
    joints = wanted.copy()
    for _ in range(4):
        joints = script(numbers, goal, joints, told)
    return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints and temperatures, at those wanted, `s x 3`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(6, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    scale = np.array([0.2, 0.2, 0.2, 2, 2, 2])
    rows, new = np.c_[joints, told[:, :3]] / scale, np.c_[wanted, then[:, :3]] / scale
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, hall: Array, which: tuple[int, ...], seen: Array) -> tuple[str, Array]:
    """Header and rows of a file in mm and deg C; `seen` has no columns where nothing was measured."""
    warm = [("temperature", hall[:, None]), ("temperature", told[:, :3].mean(1)[:, None])]
    parts = [*(warm[k] for k in which if k < 2)]
    parts += [(f"temperature_leg{k + 1}", told[:, [k]]) for k in range(3) if 2 in which]
    names = [f"q{k}[mm]" for k in (1, 2, 3)] + [f"{name}[degC]" for name, _ in parts]
    names += [f"direction{k}[1]" for k in (1, 2, 3)] + ["x[mm]", "y[mm]", "z[mm]"][: seen.shape[1]]
    return ",".join(names), np.hstack([1e3 * joints, *(column for _, column in parts), told[:, 3:], 1e3 * seen])


def judged(seed: int, rows: int, without: tuple[str, ...] = (), kept: Path | None = None) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Head(seed, without), np.random.default_rng([seed, 1])
    joints, at, _, told = day(rows, rng)
    seen = machine.measured(joints, told, rng)
    wanted, goal, frame, then = day(NEW, rng, np.stack([told[:, :3].min(0), told[:, :3].max(0)]))
    halls = [20.3 + rng.normal(0, 0.3, len(some)) for some in (told, then)]
    sent = {"as drawn": wanted}
    for full, who in ((False, "plain script"), (True, "fuller script")):
        numbers, left = script_fit(joints, at, told, seen, full)
        sent[who] = corrected(goal, wanted, then, numbers)
        more = by_process(joints, told, left, wanted, then)
        sent[f"{who} and process"] = corrected(goal - more, wanted, then, numbers)
    ones = [np.c_[some[:, :3].mean(1, keepdims=True) * np.ones(3), some[:, 3:]] for some in (told, then)]
    sent["fuller, one"] = corrected(goal, wanted, ones[1], script_fit(joints, at, ones[0], seen, True)[0])
    text = (Path(__file__).parent / "tricept_head.py").read_text()
    for who, (config, which) in OURS.items():
        records = table(joints, told, halls[0], which, seen)
        targets = table(wanted, then, halls[1], which, np.empty((NEW, 0)))
        with TemporaryDirectory() as folder:
            place = Path(folder) if kept is None else kept / who.replace(", ", "_").replace(" ", "_")
            place.mkdir(parents=True, exist_ok=True)
            commands = commanded(place, text, records, targets, "run", config, "tricept_head.py", "--allow-code")
        sent[who] = np.full_like(wanted, np.nan) if commands is None else commands
    gone = {who: bool(np.isnan(q).any()) for who, q in sent.items()}
    found = {who: np.nan if gone[who] else missed(goal, frame, machine.reached(q, then)) for who, q in sent.items()}
    return found | {"a reading": NOISE * 3**0.5}


if __name__ == "__main__":
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[])
    options.add_argument("--keep", type=Path)
    asked, sys.argv[1:] = options.parse_known_args()
    judge_machines(__doc__, lambda seed, rows: judged(seed, rows, tuple(asked.without), asked.keep), 100)
