"""A planar five-bar, calibrated over a grid plate by a camera, judged at other places of another day.

`python -m ccnn_validation.five_bar --seed N [--machines N] [--rows N]`. Beside x and y (3 µm of noise in each) stand
the temperature, the pull of a spring that keeps play out of the links' pins, as computed by the drawing, and each
motor's direction of approach. The true machine: links and feet off their drawing, zeros, gears that are eccentric (once
a turn) and whose error returns twice a turn of the motor (ratio 50), motors that give under the pull, play, links and
base that grow unequally, zeros that drift. Each machine is measured twice: in its own frame, where places count as they
are, and in that of a plate which lies anywhere in the plane ("framed"), where the frame that suits best counts. Ours
(`ccnn run`, by the written file) stands beside a SciPy fit of all of that, without and with the ratio of the gears, and
with scikit-learn's Gaussian process on what it leaves. "A reading" is what a reading of the plate is off.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.drawn import commanded, judge_machines

Array = NDArray[np.float64]
# By the drawing [m]: cranks 1 and 2, rods 1 and 2, x and y of the feet.
LINKS = np.array([0.22, 0.22, 0.28, 0.28, -0.08, 0, 0.08, 0])
# Where measured and judged, lowest and highest x and y [m]; the spring's far end, its stiffness and pull at no length.
LOW, HIGH = np.array([-0.17, 0.24]), np.array([0.17, 0.42])
HOOK, SPRING, PULL = np.array([0.25, 0.05]), 40.0, 12.0
TIMES, NOISE, NEW, ALUMINIUM, STEEL = 100, 3e-6, 400, 23e-6, 11.5e-6
KEYS = "{l: 0.22, L: 0.28, a: 0.08, gears: [50, 50]}"
OWN = f"mechanism: five_bar\nmechanism_keys: {KEYS}\n"
FRAMED = f"mechanism: framed\nmechanism_keys: {{mechanism: five_bar, keys: {KEYS}}}\n"


def tool(joints: Array, links: Array) -> Array:
    """The pin that both rods share, above the line from elbow 1 to elbow 2, `s x 2` [m]; `links`: `8` or `s x 8`."""
    links = np.broadcast_to(links, (len(joints), 8))
    ways = np.stack([np.cos(joints), np.sin(joints)], -1)
    elbows = links[:, 4:].reshape(-1, 2, 2) + links[:, :2, None] * ways
    between = elbows[:, 1] - elbows[:, 0]
    far = np.linalg.norm(between, axis=-1, keepdims=True)
    along = (links[:, [2]] ** 2 - links[:, [3]] ** 2 + far**2) / (2 * far)
    across = np.sqrt(links[:, [2]] ** 2 - along**2)
    way = between / far
    return np.asarray(elbows[:, 0] + along * way + across * np.stack([-way[:, 1], way[:, 0]], -1))


def cranks(places: Array) -> Array:
    """Joints of places by the drawing, elbows outward, `s x 2` [rad]."""
    found = []
    for leg, side in ((0, 1), (1, -1)):
        step = places - LINKS[4 + 2 * leg : 6 + 2 * leg]
        far = np.linalg.norm(step, axis=-1)
        inner = np.arccos((LINKS[leg] ** 2 + far**2 - LINKS[2 + leg] ** 2) / (2 * LINKS[leg] * far))
        found.append(np.arctan2(step[:, 1], step[:, 0]) + side * inner)
    return np.stack(found, -1)


def slopes(joints: Array) -> Array:
    """Motion of the pin by each joint of the drawing, `s x 2 x 2` [m / rad], by differences."""
    steps = 1e-6 * np.eye(2)
    return np.stack([(tool(joints + h, LINKS) - tool(joints - h, LINKS)) / 2e-6 for h in steps], -1)


def pulled(places: Array, hook: Array, stiffness: float, pull: float) -> Array:
    """Force of the spring on the pin, `s x 2` [N]."""
    way = hook - places
    far = np.linalg.norm(way, axis=-1, keepdims=True)
    return np.asarray(way / far * (pull + stiffness * far))


class FiveBar:
    """The true machine; its controller knows the drawing alone, and `size` scales all its errors."""

    def __init__(self, seed: int, size: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.links = LINKS + size * rng.normal(0, [2e-4] * 4 + [3e-4, 1e-4, 3e-4, 1e-4])
        self.zeros = size * rng.normal(0, 2e-3, 2)
        # Gears: once and twice a turn of the joint, twice and once a turn of the motor.
        self.gear = size * rng.uniform([[6e-5], [1e-5], [1.5e-5], [3e-6]], [[2e-4], [3e-5], [6e-5], [1e-5]], (4, 2))
        self.phase = rng.uniform(0, 2 * np.pi, (4, 2))
        self.give = size * 3e-5 * rng.uniform(0.6, 1.5, 2)
        self.hook, self.spring = HOOK + rng.normal(0, 2e-3, 2), rng.normal([SPRING, PULL], [1.5, 0.5])
        self.growth = size * np.r_[ALUMINIUM * rng.uniform(0.8, 1.2, 4), STEEL * rng.uniform(0.8, 1.2, 4)]
        self.warm, self.play = size * rng.normal(0, 4e-6, 2), size * rng.uniform(1e-5, 5e-5, 2)
        turn = rng.uniform(-np.pi, np.pi)
        self.turn = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        self.stand, self.guess = rng.uniform(-0.2, 0.2, 2), rng.normal(0, 0.01)

    def reached(self, joints: Array, told: Array) -> Array:
        """The pin in the machine's own frame, `s x 2` [m]; `told`: temperature [deg C], directions, `s x 3`."""
        warm = told[:, [0]] - 20
        at = joints + self.zeros + self.warm * warm + self.play / 2 * told[:, 1:]
        angle = np.array([1, 2, TIMES, TIMES / 2])[:, None] * joints[:, None] + self.phase
        at += (self.gear * np.sin(angle)).sum(1)
        links = self.links * (1 + self.growth * warm)
        slope, start = slopes(joints), at
        for _ in range(3):
            force = pulled(tool(at, links), self.hook, self.spring[0], self.spring[1])
            at = start + self.give * (slope.swapaxes(1, 2) @ force[..., None])[..., 0]
        return tool(at, links)

    def measured(self, joints: Array, told: Array, rng: np.random.Generator) -> Array:
        """As the camera reads it in the machine's own frame, `s x 2` [m]; joints stop with scatter."""
        stopped = joints + rng.normal(0, 4e-6, joints.shape)
        really = told + rng.normal(0, [0.2, 0, 0], told.shape)
        return self.reached(stopped, really) + rng.normal(0, NOISE, joints.shape)

    def on_plate(self, places: Array) -> Array:
        """Places of the machine's own frame as the plate numbers them, `s x 2` [m]."""
        return np.asarray(places @ self.turn.T + self.stand)

    def load(self, joints: Array, framed: bool) -> Array:
        """The spring's pull by the drawing, in the frame of the records, `s x 2` [N]; the plate's turn is guessed."""
        force = pulled(tool(joints, LINKS), HOOK, SPRING, PULL)
        guess = np.array([[1, -self.guess], [self.guess, 1]])
        return np.asarray(force @ (self.turn @ guess).T if framed else force)


def day(rows: int, rng: np.random.Generator, ends: Array | None = None) -> tuple[Array, Array]:
    """Joints of places all over the plate, `s x 2`, and what is told, `s x 3`; `ends`: of the temperature."""
    joints = cranks(rng.uniform(LOW, HIGH, (rows, 2)))
    warm = 20.5 + rng.uniform(4, 8) * (1 - np.exp(-np.linspace(0, 6, rows) / 2)) if ends is None else None
    temperature = warm if ends is None else rng.uniform(ends[0], ends[1], rows)
    return joints, np.c_[temperature, np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1))]


def carried(x: Array, places: Array) -> Array:
    """Places turned by `x[0]` and shifted by `x[1:]`, `s x 2` [m]."""
    c, s = np.cos(x[0]), np.sin(x[0])
    return np.asarray(places @ np.array([[c, s], [-s, c]]) + x[1:])


def beside(wanted: Array, seen: Array) -> Array:
    """Turn [rad] and shift [m] that bring what is seen nearest to what is wanted, `3`."""
    a, b = wanted - wanted.mean(0), seen - seen.mean(0)
    turn = np.arctan2((b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]).sum(), (a * b).sum())
    start = np.r_[turn, 0, 0]
    return np.asarray(np.r_[turn, wanted.mean(0) - carried(start, seen.mean(0, keepdims=True))[0]])


# Of the plain script: links and feet, zeros, eccentricity, gears, springs, growth of links and base, drift, play.
SIZES = np.r_[
    [2e-4] * 4, [3e-4, 1e-4, 3e-4, 1e-4], [2e-3] * 2, [1e-4] * 4, [4e-5] * 4, [3e-5] * 2, [4e-6] * 2, [4e-6] * 2,
    [4e-5] * 2,
]  # fmt: skip
WAVES = slice(14, 18)


def script(x: Array, joints: Array, told: Array) -> Array:
    """The plain script's pin, `s x 2` [m]."""
    warm, force = told[:, [0]] - 20, pulled(tool(joints, LINKS), HOOK, SPRING, PULL)
    at = joints + x[8:10] + x[10:12] * np.sin(joints) + x[12:14] * np.cos(joints)
    at += x[14:16] * np.sin(TIMES * joints) + x[16:18] * np.cos(TIMES * joints)
    at += x[18:20] * (slopes(joints).swapaxes(1, 2) @ force[..., None])[..., 0]
    at += x[22:24] * warm + x[24:26] / 2 * told[:, 1:]
    growth = np.r_[[ALUMINIUM + x[20]] * 4, [STEEL + x[21]] * 4]
    return tool(at, (LINKS + x[:8]) * (1 + growth * warm))


def script_fit(joints: Array, told: Array, seen: Array, framed: bool, ratio: bool) -> tuple[Array, Array]:
    """Numbers of the plain script and what it leaves in the machine's frame, `s x 2` [m]; `ratio`: it knows it."""
    count, sizes = len(SIZES), SIZES.copy()
    sizes[WAVES] *= ratio
    at = carried(beside(tool(joints, LINKS), seen), seen) if framed else seen

    def left(u: Array) -> Array:
        place = carried(u[count:] * 1e-3, at) if framed else at
        return np.asarray(place - script(u[:count] * sizes, joints, told))

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[left(u).ravel() / 5e-6, u[:count], 0.1 * u[count:]])

    found = least_squares(residuals, np.zeros(count + 3)).x
    return found[:count] * sizes, left(found)


def corrected(wanted: Array, told: Array, numbers: Array, more: Array | float = 0.0) -> Array:
    """Joints at which the script's pin is where the drawing's is at those wanted, less `more`, `s x 2`."""
    goal, joints, slope = tool(wanted, LINKS) - more, wanted, slopes(wanted)
    for _ in range(8):
        joints = joints + np.linalg.solve(slope, (goal - script(numbers, joints, told))[..., None])[..., 0]
    return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints and temperature, at those wanted, `s x 2`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(3, 1.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    scale = np.array([0.4, 0.4, 3])
    rows, new = np.c_[joints, told[:, 0]] / scale, np.c_[wanted, then[:, 0]] / scale
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, load: Array, seen: Array | None, framed: bool) -> tuple[str, Array]:
    """Header and rows of a file in mm, deg, N and deg C; a plate's frame has a column z of zeros."""
    names = "q1[deg],q2[deg],temperature[degC],direction1[1],direction2[1],load_x[N],load_y[N]"
    rows = np.c_[np.degrees(joints), told, load]
    if seen is None:
        return names, rows
    names, rows = f"{names},x[mm],y[mm]", np.c_[rows, 1e3 * seen]
    return (f"{names},z[mm]", np.c_[rows, np.zeros(len(rows))]) if framed else (names, rows)


def by_package(machine: FiveBar, rows: tuple[Array, Array, Array], targets: tuple[Array, Array], framed: bool) -> Array:
    """Commands by the written file, `s x 2`; NaN where there are none."""
    joints, told, seen = rows
    records = table(joints, told, machine.load(joints, framed), seen, framed)
    wanted = table(*targets, machine.load(targets[0], framed), None, framed)
    with TemporaryDirectory() as folder:
        commands = commanded(Path(folder), "", records, wanted, config=FRAMED if framed else OWN)
    return np.full_like(targets[0], np.nan) if commands is None else commands


def missed(joints: Array, reached: Array, framed: bool) -> float:
    """Root mean square of a miss [m], in the best frame of the plane where none is given."""
    wanted = tool(joints, LINKS)
    at = carried(beside(wanted, reached), reached) if framed else reached
    return float(np.sqrt(((at - wanted) ** 2).sum(-1).mean()))


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = FiveBar(seed), np.random.default_rng([seed, 1])
    joints, told = day(rows, rng)
    own = machine.measured(joints, told, rng)
    wanted, then = day(NEW, rng, np.array([told[0, 0], told[-1, 0]]))
    found = {}
    for framed, ending in ((False, ""), (True, ", framed")):
        seen = machine.on_plate(own) if framed else own
        numbers, left = script_fit(joints, told, seen, framed, True)
        sent = {"as drawn": wanted, "plain script": corrected(wanted, then, numbers)}
        more = by_process(joints, told, left, wanted, then)
        sent["script and process"] = corrected(wanted, then, numbers, more)
        sent["script without ratio"] = corrected(wanted, then, script_fit(joints, told, seen, framed, False)[0])
        sent["ours"] = by_package(machine, (joints, told, seen), (wanted, then), framed)
        for who, q in sent.items():
            gone = bool(np.isnan(q).any())
            found[who + ending] = np.nan if gone else missed(wanted, machine.reached(q, then), framed)
    return found | {"a reading": NOISE * 2**0.5}


if __name__ == "__main__":
    judge_machines(__doc__, judged, 60)
