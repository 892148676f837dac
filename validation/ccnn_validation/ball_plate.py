"""A trunnion of five axes that probes a plate of balls from many table positions, judged on the true machine.

`python -m ccnn_validation.ball_plate --seed N [--machines N] [--rows N]`. Four balls of known places lie on the table.
At random angles of C and A a touch probe finds one: X, Y and Z are recorded, the place in the table's frame is that of
the plate. Errors are those of ISO 230-7: offsets and tilts of the rotary axes' lines, and small waves of their turn;
the linear axes have leads, squarenesses, bows and angles. Ours (`ccnn run` and `ccnn identify`, by the written files)
stand beside a SciPy fit of offsets, tilts, leads and squarenesses, and scikit-learn's Gaussian process. Judged are
other places over the table at other angles, in the frame and with the tool that suit what is reached best.
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
# Balls on the table and the probe's tip below the spindle [m]; of a probed coordinate [m]; places judged.
BALLS = np.array([[0.09, 0.02, 0.06], [-0.05, 0.08, 0.11], [-0.06, -0.08, 0.06], [0.05, -0.07, 0.14]])
TOOL, NOISE, NEW = np.array([0.0, 0.0, -0.12]), 1e-6, 300
LOW, HIGH = np.radians([-180, -90]), np.radians([180, 20])
MACHINE = """machine: five_axis_table_table
base_frame: unknown
tool_frame: unknown
limits: {q1: [-180 deg, 180 deg], q2: [-95 deg, 30 deg], q3: [-300 mm, 300 mm], q4: [-300 mm, 300 mm],
  q5: [-200 mm, 400 mm]}
"""


def turned(axis: str, angle: Array) -> Rotation:
    return Rotation.from_euler(axis, np.reshape(angle, (-1, 1)))


def of_table(joints: Array, tool: Array) -> Array:
    """The tool seen from the table as drawn, `s x 3` [m]: C and A turn the table, about one point."""
    return np.asarray(turned("z", -joints[:, 0]).apply(turned("x", -joints[:, 1]).apply(joints[:, 2:] + tool)))


def to_slides(place: Array, angles: Array, tool: Array) -> Array:
    """X, Y, Z as drawn of a place on the table, `s x 3` [m]."""
    return np.asarray(turned("x", angles[:, 1]).apply(turned("z", angles[:, 0]).apply(place)) - tool)


class Trunnion:
    """The true machine: X, Y and Z carry the tool, A carries C, C the plate."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.offset, self.pivot = rng.normal(0, 30e-6, 3), rng.normal(0, 50e-6, 3)
        self.tilt_c, self.tilt_a = rng.normal(0, 70e-6, 3) * [1, 1, 0], rng.normal(0, 70e-6, 3) * [0, 1, 1]
        self.zero, self.tool = rng.normal(0, 90e-6), TOOL + rng.normal(0, 5e-5, 3) * [1, 1, 0]
        self.lead, self.square = rng.normal(0, 20e-6, 3), rng.normal(0, 25e-6, 3)
        self.bow, self.angle = rng.normal(0, 2e-6, (3, 3)), rng.normal(0, 8e-6, (3, 3))
        # Waves of a turn: radial and axial motion [m], wobble and indexing [rad] of C and A, first and second order.
        self.run = rng.normal(0, 1.5e-6, (2, 3, 4)) / np.array([1, 1, 2, 2])
        self.wobble = rng.normal(0, 8e-6, (2, 3, 4)) / np.array([1, 1, 2, 2])
        self.turn, self.stand = Rotation.from_rotvec(rng.normal(0, [0.002, 0.002, 0.3])), rng.normal(0, 2e-3, 3)

    def turning(self, axis: int, angle: Array) -> tuple[Array, Array]:
        """Shift and small turn of a rotary axis that come with its angle, `s x 3` each."""
        wave = np.stack([np.sin(angle), np.cos(angle) - 1, np.sin(2 * angle), np.cos(2 * angle) - 1], -1)
        return wave @ self.run[axis].T, wave @ self.wobble[axis].T

    def reached(self, joints: Array) -> Array:
        """The tool's tip seen from the table, `s x 3` [m]."""
        u = joints[:, 2:] / 0.25
        slid = joints[:, 2:] * (1 + self.lead) + (u**2) @ self.bow
        slid[:, 0] += self.square[0] * joints[:, 3] + self.square[1] * joints[:, 4]
        slid[:, 1] += self.square[2] * joints[:, 4]
        at = slid + Rotation.from_rotvec(u @ self.angle).apply(self.tool)
        for axis, name, tilt, place in ((1, "x", self.tilt_a, self.pivot), (0, "z", self.tilt_c, self.offset)):
            shift, wobble = self.turning(axis, joints[:, axis])
            zero = self.zero * (axis == 1)
            line = Rotation.from_rotvec(tilt)
            at = line.inv().apply(at - place - shift)
            at = turned(name, -joints[:, axis] - zero).apply(Rotation.from_rotvec(-wobble).apply(at))
            at = line.apply(at)
        return np.asarray(at)

    def probed(self, ball: Array, angles: Array, rng: np.random.Generator) -> Array:
        """X, Y, Z at which the probe is in the ball, `s x 3` [m]; the plate lies somehow."""
        place = self.turn.apply(ball) + self.stand
        slides = to_slides(place, angles, TOOL)
        for _ in range(6):
            off = place - self.reached(np.c_[angles, slides])
            slides = slides + turned("x", angles[:, 1]).apply(turned("z", angles[:, 0]).apply(off))
        return np.asarray(slides + rng.normal(0, NOISE, slides.shape))


def missed(wanted: Array, reached: Array, angles: Array) -> float:
    """Root mean square of what is missed in the best frame of the table and with the best tool [m]."""

    def left(x: Array) -> Array:
        tool = turned("z", -angles[:, 0]).apply(turned("x", -angles[:, 1]).apply(np.tile(x[6:], (len(wanted), 1))))
        return np.asarray((Rotation.from_rotvec(x[:3]).apply(reached) + x[3:6] + tool - wanted).ravel())

    found = least_squares(left, np.zeros(9), x_scale=np.r_[np.full(3, 1e-4), np.full(6, 1e-5)])
    return float(np.sqrt((found.fun**2).sum() / len(wanted)))


def model(x: Array, joints: Array) -> Array:
    """The plain script's tool seen from the table: lines of A and C, leads, squarenesses, 16 numbers."""
    at = joints[:, 2:] * (1 + x[:3]) + TOOL
    at = at + np.stack([x[3] * joints[:, 3] + x[4] * joints[:, 4], x[5] * joints[:, 4], 0 * joints[:, 4]], -1)
    line_a, line_c = Rotation.from_rotvec([0, x[6], x[7]]), Rotation.from_rotvec([x[8], x[9], 0])
    at = line_a.apply(turned("x", -joints[:, 1] - x[10]).apply(line_a.inv().apply(at - x[11:14])))
    return np.asarray(line_c.apply(turned("z", -joints[:, 0]).apply(line_c.inv().apply(at - np.r_[x[14:16], 0]))))


def by_script(joints: Array, places: Array) -> Array:
    """Numbers of the plain script: least squares with a weak ridge."""
    drawn = of_table(joints, TOOL)
    turn, _ = Rotation.align_vectors(drawn - drawn.mean(0), places - places.mean(0))
    shift = drawn.mean(0) - turn.apply(places.mean(0))

    def left(u: Array) -> Array:
        at = (Rotation.from_rotvec(u[16:19] * 1e-3) * turn).apply(places) + shift + u[19:] * 1e-3
        return np.asarray(np.r_[((model(u[:16] * 1e-4, joints) - at) / 3e-6).ravel(), 0.1 * u])

    return np.asarray(least_squares(left, np.zeros(22)).x[:16] * 1e-4)


def by_process(joints: Array, places: Array) -> list[GaussianProcessRegressor]:
    """Scikit-learn: what the slides are off, over sine and cosine of the angles, and the slides."""
    drawn = of_table(joints, TOOL)
    turn, _ = Rotation.align_vectors(drawn - drawn.mean(0), places - places.mean(0))
    at = turn.apply(places - places.mean(0)) + drawn.mean(0)
    off = joints[:, 2:] - to_slides(at, joints[:, :2], TOOL)
    kernel = ConstantKernel(1.0) * RBF([1.0] * 7) + WhiteKernel(0.01)
    make = GaussianProcessRegressor
    return [make(kernel, normalize_y=True, random_state=0).fit(inputs(joints), e) for e in off.T]


def inputs(joints: Array) -> Array:
    a, c = joints[:, 1], joints[:, 0]
    return np.asarray(np.c_[np.cos(c), np.sin(c), np.cos(a), np.sin(a), joints[:, 2:] / 0.1])


def by_package(joints: Array, places: Array, targets: Array, folder: Path) -> dict[str, Array | None]:
    """Commands to ideal joints by the files of `ccnn run` and of `ccnn identify`."""
    names = "q1[rad],q2[rad],q3[m],q4[m],q5[m]"
    records = f"{names},x[m],y[m],z[m]", np.c_[joints, places]
    ways = ("run", "identify")
    return {f"ours, {way}": commanded(folder, MACHINE, records, (names, targets), way) for way in ways}


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Trunnion(seed), np.random.default_rng([seed, 1])
    ball, angles = BALLS[rng.integers(0, 4, rows)], rng.uniform(LOW, HIGH, (rows, 2))
    joints = np.c_[angles, machine.probed(ball, angles, rng)]
    new = rng.uniform(LOW * 0.95, HIGH * 0.95, (NEW, 2))
    spot = rng.uniform([-0.09, -0.09, 0.05], [0.09, 0.09, 0.15], (NEW, 3))
    target = np.c_[new, to_slides(spot, new, TOOL)]
    wanted = of_table(target, TOOL)
    found = {"as drawn": missed(wanted, machine.reached(target), new)}
    numbers, sent = by_script(joints, ball), target
    for _ in range(5):
        off = wanted - model(numbers, sent)
        sent = np.c_[new, sent[:, 2:] + turned("x", new[:, 1]).apply(turned("z", new[:, 0]).apply(off))]
    found["plain script"] = missed(wanted, machine.reached(sent), new)
    off = np.stack([fit.predict(inputs(target)) for fit in by_process(joints, ball)], -1)
    found["scikit-learn"] = missed(wanted, machine.reached(np.c_[new, target[:, 2:] + off]), new)
    with TemporaryDirectory() as folder:
        for name, commands in by_package(joints, ball, target, Path(folder)).items():
            found[name] = np.nan if commands is None else missed(wanted, machine.reached(commands), new)
    return found


if __name__ == "__main__":
    judge_machines(__doc__, judged, 120)
