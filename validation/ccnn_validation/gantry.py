"""A gantry with the 21 errors of ISO 230-1, judged on the true machine.

`python -m ccnn_validation.gantry --seed N [--machines N] [--rows N]`. Each axis has its positioning error, two
straightnesses and three angles as polynomials of its travel, and a wave of its screw; three squarenesses. A tracker
measures random places. Ours (`ccnn run`, by the written file) stands beside cubic polynomials of the place, a linear
least-squares fit of the 21 functions, and scikit-learn's Gaussian process, each written in a few lines. Judged are
random places not measured, in the frame that suits what each one's commands reach.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.drawn import commanded, judge_machines

Array = NDArray[np.float64]
Map = Callable[[Array], Array]
SIZE, TOOL, PITCH = np.array([1.0, 0.8, 0.3]), np.array([0.0, 0.0, -0.15]), 0.01
# Of a measured coordinate [m]; places judged; degree of the polynomials that are fitted.
NOISE, NEW, DEGREE = 4e-6, 300, 3
MACHINE = """machine: gantry
base_frame: unknown
tool_frame: unknown
limits: {q1: [0 mm, 1000 mm], q2: [0 mm, 800 mm], q3: [0 mm, 300 mm]}
"""


class Gantry:
    """The true machine: x carries y, y carries z, z carries the tool."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.errors = []
        for axis in range(3):
            shifts = rng.normal(0, [0, 12e-6, 7e-6, 4e-6], (3, 4))
            shifts[axis] = rng.normal(0, [60e-6 * SIZE[axis], 10e-6, 6e-6, 3e-6])
            self.errors.append(np.vstack([shifts, rng.normal(0, [25e-6, 12e-6, 6e-6, 4e-6], (3, 4))]))
        self.square, self.screw = rng.normal(0, 80e-6, 3), rng.normal(0, 2e-6, 3)
        self.phase, self.tool = rng.uniform(0, 2 * np.pi, 3), TOOL + rng.normal(0, 0.02, 3)
        self.turn, self.stand = Rotation.from_rotvec(rng.normal(0, 1, 3)), rng.normal(0, 1, 3)

    def reached(self, joints: Array) -> Array:
        """Tip of the tool, `s x 3` [m]."""
        tip = np.tile(self.tool, (len(joints), 1))
        lean = np.array([[0, 0, 0], [-self.square[0], 0, 0], [-self.square[1], -self.square[2], 0]])
        for axis in (2, 1, 0):
            u = 2 * joints[:, axis] / SIZE[axis] - 1
            error = np.stack([u, u**2, u**3, u**4], -1) @ self.errors[axis].T
            wave = self.screw[axis] * np.sin(2 * np.pi * joints[:, axis] / PITCH + self.phase[axis])
            slid = (np.eye(3)[axis] + lean[axis]) * joints[:, axis, None] + wave[:, None] * np.eye(3)[axis]
            tip = slid + error[:, :3] + Rotation.from_rotvec(error[:, 3:]).apply(tip)
        return np.asarray(tip)

    def measured(self, joints: Array, rng: np.random.Generator) -> Array:
        """As the tracker reads it, `s x 3` [m]."""
        return np.asarray(self.turn.apply(self.reached(joints)) + self.stand + rng.normal(0, NOISE, joints.shape))


def beside(wanted: Array, reached: Array) -> Array:
    """What is reached, in the frame that suits the wanted places best, less these, `s x 3` [m]."""
    turn, _ = Rotation.align_vectors(wanted - wanted.mean(0), reached - reached.mean(0))
    return np.asarray(turn.apply(reached - reached.mean(0)) + wanted.mean(0) - wanted)


def of_place(joints: Array) -> Array:
    """Products of Legendre polynomials of the place up to a degree, `s x m`."""
    x, y, z = (legvander(2 * joints[:, k] / SIZE[k] - 1, DEGREE) for k in range(3))
    every = [d for d in product(range(DEGREE + 1), repeat=3) if sum(d) <= DEGREE]
    return np.stack([x[:, i] * y[:, j] * z[:, k] for i, j, k in every], -1)


def of_axes(joints: Array) -> Array:
    """What each of the 21 functions does to the tip, by Legendre polynomials, `3 s x m`; the tool as drawn."""
    columns = []
    for axis in range(3):
        arm = joints * (np.arange(3) > axis) + TOOL
        for form in legvander(2 * joints[:, axis] / SIZE[axis] - 1, DEGREE + 1).T[1:]:
            columns += [form[:, None] * np.broadcast_to(e, joints.shape) for e in np.eye(3)]
            columns += [form[:, None] * np.cross(e, arm) for e in np.eye(3)]
    columns += [joints[:, [by]] * np.eye(3)[to] for to, by in ((0, 1), (0, 2), (1, 2))]
    return np.stack([c.ravel() for c in columns], -1)


def by_polynomials(joints: Array, error: Array) -> Map:
    weights = np.linalg.lstsq(of_place(joints), error, rcond=None)[0]
    return lambda q: np.asarray(of_place(q) @ weights)


def by_functions(joints: Array, error: Array) -> Map:
    weights = np.linalg.lstsq(of_axes(joints), error.ravel(), rcond=1e-9)[0]
    return lambda q: np.asarray((of_axes(q) @ weights).reshape(-1, 3))


def by_process(joints: Array, error: Array) -> Map:
    kernel = ConstantKernel(1.0) * RBF([1.0] * 3) + WhiteKernel(0.01)
    make = GaussianProcessRegressor
    fits = [make(kernel, normalize_y=True, random_state=0).fit(joints / SIZE, each) for each in error.T]
    return lambda q: np.stack([fit.predict(q / SIZE) for fit in fits], -1)


SCRIPTS = {"polynomials": by_polynomials, "21 functions": by_functions, "scikit-learn": by_process}


def by_package(joints: Array, places: Array, targets: Array, folder: Path) -> Array | None:
    """Commands to ideal joints by the written file."""
    names = "q1[m],q2[m],q3[m]"
    return commanded(folder, MACHINE, (f"{names},x[m],y[m],z[m]", np.c_[joints, places]), (names, targets))


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Gantry(seed), np.random.default_rng([seed, 1])
    joints = rng.uniform(0, 1, (rows, 3)) * SIZE
    places, wanted = machine.measured(joints, rng), rng.uniform(0.03, 0.97, (NEW, 3)) * SIZE

    def missed(commands: Array) -> float:
        return float(np.sqrt((beside(wanted, machine.reached(commands)) ** 2).sum(1).mean()))

    found = {"as drawn": missed(wanted)}
    for name, fit in SCRIPTS.items():
        map_of, sent = fit(joints, beside(joints, places)), wanted
        for _ in range(4):
            sent = wanted - map_of(sent)
        found[name] = missed(sent)
    with TemporaryDirectory() as folder:
        commands = by_package(joints, places, wanted, Path(folder))
    found["ours"] = np.nan if commands is None else missed(commands)
    return found


if __name__ == "__main__":
    judge_machines(__doc__, judged, 250)
