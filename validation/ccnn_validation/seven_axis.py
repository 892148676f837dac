"""A collaborative seven-axis arm of 0.9 m reach, calibrated by a laser tracker, judged at other places and payloads.

`python -m ccnn_validation.seven_axis --seed N [--machines N] [--rows N]`. Beside x, y, z of a reflector (15 µm of noise
in each) stand the payload (0 or 6 kg), the temperature of the arm, which warms up in the session, and each joint's
direction of approach. Judged with 3 kg, at temperatures of the session. The true machine: places and leans of all axes,
zeros, harmonic drives that twist (softer under small torques), whose error returns twice a turn of the motor, and that
rest on another side by the direction of torque and friction, eccentric encoders, bearings and links that bend, links
that grow, masses that are not quite the maker's, a payload whose centre is not where the drawing has it. Ours
(`ccnn run`, by the written file) and the plain SciPy script know the drawing: Denavit-Hartenberg table, masses, centres
and gears. The script has links, zeros, joint stiffness and growth, with the tolerances as priors; "with gears" it has
harmonics of drives and encoders and a term of direction, too; "and bending" beside these softer drives and links that
bend, which takes its engineer some days more. Judged in the frame and at the tool point that suit best;
"a reading" is what a reading of the tracker is off.
"""

from __future__ import annotations

from collections.abc import Collection
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
# By the drawing: links along their axes [m], angles between axes, the reflector and the load's centre on the flange.
LENGTHS = np.array([0.36, 0, 0.4, 0, 0.38, 0, 0.12])
ALPHA = np.radians([-90, 90, 90, -90, -90, 90, 0])
REFLECTOR, LOAD = np.array([0.06, 0.02, 0.1]), np.array([0, 0, 0.06])
LIMITS, RATIOS = np.radians([170, 120, 170, 120, 170, 120, 175]), np.array([160, 160, 160, 160, 100, 160, 160])
# Masses of the links [kg]; their centres, in the frames at the links' ends [m].
MASSES, G = np.array([5.5, 5.5, 3.5, 3.5, 3.0, 1.8, 1.1]), 9.81
CENTRES = np.array(
    [[0, 0.06, 0.02], [0, 0.02, 0.08], [0, -0.09, 0.02], [0, -0.02, 0.08], [0, 0.12, 0.02], [0, 0.01, 0.02], [0, 0, 0]]
)
NOISE, NEW = 15e-6, 400
FILE = """robot: seven-axis arm
dof: 7
convention: standard Denavit-Hartenberg
units: {length: m, angle: deg}
a: [0, 0, 0, 0, 0, 0, 0]
alpha: [-90, 90, 90, -90, -90, 90, 0]
d: [0.36, 0, 0.4, 0, 0.38, 0, 0.12]
theta: [0, 0, 0, 0, 0, 0, 0]
limits: [[-170, 170], [-120, 120], [-170, 170], [-120, 120], [-170, 170], [-120, 120], [-175, 175]]
gears: [160, 160, 160, 160, 100, 160, 160]
masses: [5.5, 5.5, 3.5, 3.5, 3.0, 1.8, 1.1]
centres: [[0, 0.06, 0.02], [0, 0.02, 0.08], [0, -0.09, 0.02], [0, -0.02, 0.08], [0, 0.12, 0.02], [0, 0.01, 0.02],
  [0, 0, 0]]
base_frame: unknown
tool_offset: unknown
"""


def turned(vector: Array) -> Array:
    """Matrices of rotation vectors, `... x 3` to `... x 3 x 3`."""
    return np.asarray(Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape, 3))


def by(frame: Array, vector: Array) -> Array:
    """Vectors `s x 3` or `3` of a frame `s x 3 x 3`, as seen from outside."""
    return np.asarray((frame @ np.broadcast_to(vector, (len(frame), 3))[..., None])[..., 0])


class Arm:
    """The true machine; its controller knows the drawing alone.

    Args:
        seed: which machine.
        without: errors that it does not have: `geometry`, `zeros`, `gears`, `turns`, `hysteresis`, `twist`, `soft`
            (drives that are softer under small torques), `bending`, `thermal`, `masses`, `load`, `scatter`.
    """

    def __init__(self, seed: int, without: Collection[str] = ()) -> None:
        rng, signs = np.random.default_rng(seed), np.array([-1, 1])
        has = {name: float(name not in without) for name in (
            "geometry", "zeros", "gears", "turns", "hysteresis", "twist", "soft", "bending", "thermal", "masses",
            "load", "scatter")}  # fmt: skip
        self.shift = has["geometry"] * rng.uniform(1e-4, 5e-4, (7, 3)) * rng.choice(signs, (7, 3))
        self.lean = has["geometry"] * rng.uniform(2e-4, 1e-3, (7, 3)) * rng.choice(signs, (7, 3)) * [1, 1, 0]
        self.zeros = has["zeros"] * rng.uniform(2e-4, 1e-3, 7) * rng.choice(signs, 7)
        # Drives: twice a turn of the motor; encoders: once and twice a turn of the joint [rad].
        self.gear, self.phase = has["gears"] * rng.uniform(4, 14, 7) * np.pi / 648e3, rng.uniform(0, 2 * np.pi, (3, 7))
        self.turn = has["turns"] * rng.uniform([[2e-5], [1e-5]], [[8e-5], [4e-5]], (2, 7))
        # Torque at which each drive is rated [N m], its compliance [rad / N m], how much softer below which share.
        self.rated = np.array([140, 140, 80, 80, 50, 30, 30])
        stiff = np.array([3.3e4, 3.3e4, 2.2e4, 2.2e4, 1.3e4, 8e3, 6.5e3]) * rng.uniform(0.75, 1.2, 7)
        self.compliance = has["twist"] / np.clip(stiff, 5e3, 4e4)
        self.soft, self.small = has["soft"] * rng.uniform(0.15, 0.35, 7), self.rated * rng.uniform(0.1, 0.2, 7)
        # Where a drive rests by the direction of torque [rad], friction that adds to it, the torque that turns it over.
        self.rest = has["hysteresis"] * rng.uniform(1e-5, 4e-5, 7)
        self.friction, self.over = self.rated * rng.uniform(0.02, 0.05, 7), self.rated * rng.uniform(0.02, 0.04, 7)
        # Bearings [rad / N m], links as beams of an aluminium tube [1 / N m²].
        self.bearing = has["bending"] / (np.array([6, 6, 4, 4, 3, 2, 1.5]) * 1e5 * rng.uniform(0.7, 1.4, 7))
        self.beam = has["bending"] / (np.array([2.5, 2.5, 1.6, 1.6, 1.2, 1, 1]) * 1e5 * rng.uniform(0.7, 1.4, 7))
        self.growth = has["thermal"] * 23e-6 * rng.uniform(0.7, 1.2, 7)
        self.masses = MASSES * (1 + has["masses"] * rng.normal(0, 0.04, 7))
        self.centres = CENTRES + has["masses"] * rng.normal(0, 5e-3, (7, 3))
        self.load = LOAD + has["load"] * rng.uniform([-0.01, -0.01, -0.02], [0.01, 0.01, 0.02])
        self.point = REFLECTOR + rng.normal(0, 5e-4, 3)
        self.scatter = has["scatter"] * np.array([0.8, 0.8, 1, 1, 1, 1.5, 1.5]) * 1e-5
        self.stands = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * Rotation.from_rotvec(rng.normal(0, 3e-4, 3))
        self.away = rng.normal([2.5, 1, -0.3], 0.3)

    def pose(self, at: Array, warm: Array, bends: Array, drops: Array) -> tuple[Array, Array, Array]:
        """Places of the links' starts and of the flange, `8 x s x 3` [m]; frames at starts and ends."""
        place, frame, up = np.zeros((len(at), 3)), np.tile(np.eye(3), (len(at), 1, 1)), np.eye(3)[2]
        places, starts, ends = [place], [], []
        for k in range(7):
            frame = frame @ turned(at[:, [k]] * up)
            starts.append(frame)
            step = (LENGTHS[k] * (1 + self.growth[k] * warm))[:, None] * up + self.shift[k] + drops[k]
            place = place + by(frame, step)
            frame = frame @ turned(bends[k]) @ turned(np.array([ALPHA[k], 0, 0])) @ turned(self.lean[k])
            places.append(place)
            ends.append(frame)
        return np.stack(places), np.stack(starts), np.stack(ends)

    def loads(self, places: Array, starts: Array, ends: Array, payload: Array) -> tuple[Array, Array, Array]:
        """Moments at start and end of each link, forces at its end, `7 x s x 3`, in the frame of its start."""
        masses = np.r_[np.tile(self.masses[:, None], len(payload)), [payload]][..., None]
        centres = [places[k + 1] + by(ends[k], self.centres[k]) for k in range(7)]
        where, weight, found = np.stack([*centres, places[7] + by(ends[6], self.load)]), masses * [0, 0, -G], []
        for k in range(7):
            start = np.cross(where[k:] - places[k], weight[k:]).sum(0)
            end = np.cross(where[k + 1 :] - places[k + 1], weight[k + 1 :]).sum(0)
            # As much of a beam's own weight at its end bends it as all of it along the beam.
            force = weight[k + 1 :].sum(0) + 0.36 * weight[k]
            found.append([by(starts[k].swapaxes(1, 2), one) for one in (start, end, force)])
        start, end, force = np.stack([np.stack(one) for one in found], 1)
        return start, end, force

    def went(self, joints: Array, direction: Array, torque: Array) -> Array:
        """Where the drives bring the joints under a torque, `s x 7`."""
        at = joints + self.zeros + self.gear * np.sin(2 * RATIOS * joints + self.phase[0])
        at += self.turn[0] * np.sin(joints + self.phase[1]) + self.turn[1] * np.sin(2 * joints + self.phase[2])
        at += self.compliance * (torque + self.soft * self.small * np.tanh(torque / self.small))
        return np.asarray(at + self.rest * np.tanh((torque + direction * self.friction) / self.over))

    def bent(self, start: Array, end: Array, force: Array) -> tuple[Array, Array]:
        """Turns [rad] and shifts [m] of the links' ends, `7 x s x 3`: bearings, and beams clamped at their starts."""
        long, up = LENGTHS[:, None, None], np.eye(3)[2]
        soft, across = self.beam[:, None, None], np.array([1, 1, 0])
        tilt, slope = self.bearing[:, None, None] * start * across, soft * long * end * np.array([1, 1, 1.3])
        turns = tilt + slope + soft * long**2 / 2 * np.cross(up, force)
        shifts = np.cross(tilt * long + soft * long**2 / 2 * end, up) + soft * long**3 / 3 * force * across
        return turns, shifts

    def reached(self, joints: Array, told: Array) -> Array:
        """The reflector in equilibrium, `s x 3` [m]; `told`: payload [kg], temperature [deg C], directions, `s x 9`."""
        start, end, force = np.zeros((3, 7, len(joints), 3))
        for _ in range(5):
            at, turns = self.went(joints, told[:, 2:], start[..., 2].T), self.bent(start, end, force)
            places, starts, ends = self.pose(at, told[:, 1] - 20, *turns)
            start, end, force = self.loads(places, starts, ends, told[:, 0])
        return np.asarray(places[7] + by(ends[6], self.point))

    def measured(self, joints: Array, told: Array, rng: np.random.Generator) -> Array:
        """As the tracker reads it, `s x 3` [m]; joints stop with scatter, the thermometer does not show all."""
        really = told + rng.normal(0, [0, 0.2, *np.zeros(7)], told.shape)
        seen = self.stands.apply(self.reached(joints + rng.normal(0, self.scatter, joints.shape), really)) + self.away
        return np.asarray(seen + rng.normal(0, NOISE, seen.shape))


def day(rows: int, rng: np.random.Generator, payloads: Array, ends: Array | None = None) -> tuple[Array, ...]:
    """Joints of places all over the workspace, `s x 7`, and what is told, `s x 9`; `ends`: of the temperature."""
    joints = rng.uniform(-0.85, 0.85, (200 * rows, 7)) * LIMITS
    place, frame = plain(joints)
    tip = place + by(frame, REFLECTOR)
    free = (tip[:, 2] > 0.15) & (np.hypot(tip[:, 0], tip[:, 1]) > 0.25) & (place[:, 2] > 0.2)
    joints = joints[free & (np.abs(joints[:, 3]) > 0.3) & (np.abs(joints[:, 5]) > 0.2)][:rows]
    warm = 21 + rng.uniform(6, 8) * (1 - np.exp(-np.linspace(0, 3, rows)))
    temperature = warm if ends is None else rng.uniform(ends[0], ends[1], rows)
    direction = np.sign(np.diff(joints, axis=0, prepend=np.zeros((1, 7))))
    return joints, np.c_[rng.choice(payloads, rows), temperature, direction]


def plain(joints: Array) -> tuple[Array, Array]:
    """Place `s x 3` and frame `s x 3 x 3` of the flange by the drawing."""
    return chain(joints)[-1]


def chain(
    joints: Array, table: Array | None = None, warm: Array | None = None, tilts: Array | None = None
) -> list[tuple[Array, Array]]:
    """Places and frames of the base and of all links by a Denavit-Hartenberg table.

    Args:
        joints: `s x 7`.
        table: errors of a, alpha, d, theta, `4 x 7`.
        warm: growth, a share of the lengths.
        tilts: turns of the links behind their joints, `7 x s x 3`.
    """
    a, alpha, d, theta = np.array([0 * LENGTHS, ALPHA, LENGTHS, 0 * LENGTHS]) + (0 if table is None else table)
    long, up = 1 + (np.zeros(len(joints)) if warm is None else warm), np.eye(3)[2]
    place, frame = np.zeros((len(joints), 3)), np.tile(np.eye(3), (len(joints), 1, 1))
    found = [(place, frame)]
    for k in range(7):
        frame = frame @ turned((joints[:, [k]] + theta[k]) * up)
        if tilts is not None:
            frame = frame @ turned(tilts[k])
        place = place + by(frame, np.stack([a[k] * np.ones_like(long), 0 * long, d[k] * long], -1))
        frame = frame @ turned(np.array([alpha[k], 0, 0]))
        found.append((place, frame))
    return found


def moments(joints: Array, payload: Array) -> Array:
    """By the maker's masses, and a load at the drawing's place, in each joint's turned frame, `7 x s x 3` [N m]."""
    links, found, up = chain(joints), [], np.eye(3)[2]
    weights = G * np.r_[np.tile(MASSES[:, None], len(joints)), [payload]]
    ends = [links[k + 1][0] + by(links[k + 1][1], CENTRES[k]) for k in range(7)]
    where = np.stack([*ends, links[7][0] + by(links[7][1], LOAD)])
    for k, (place, frame) in enumerate(links[:7]):
        arm = (weights[k:, :, None] * (where[k:] - place)).sum(0)
        inside = (frame @ turned(joints[:, [k]] * up)).swapaxes(1, 2)
        found.append(by(inside, np.stack([-arm[:, 1], arm[:, 0], 0 * arm[:, 0]], -1)))
    return np.stack(found)


def off(x: Array, place: Array, frame: Array, seen: Array) -> Array:
    """Measured places in another frame less those of a point on the flange, flat [m]; `x`: turn, shift, point."""
    return np.asarray((Rotation.from_rotvec(x[:3]).apply(seen) + x[3:6] - place - frame @ x[6:9]).ravel())


def missed(joints: Array, reached: Array) -> float:
    """Root mean square of a miss [m] in the best frame, with the best point on the drawing's flange."""
    found = least_squares(off, np.r_[np.zeros(6), REFLECTOR], x_scale=1e-3, args=(*plain(joints), reached))
    return float(np.sqrt((found.fun**2).sum() / len(joints)))


# Of the plain script: a, alpha, d, theta of each link, compliance of its joints [rad / N m], growth; then of drives
# twice a turn of the motor, of encoders once and twice a turn of the joint, and by the direction of approach [rad];
# then of joints that are softer under small torques [rad], and of bearings and links that bend [rad / N m].
SIZES = np.r_[np.repeat([3e-4, 6e-4, 3e-4, 8e-4], 7), [1e-4] * 7, 5e-6, [4e-5] * 14, [5e-5] * 28, [2e-5] * 7]
SIZES = np.r_[SIZES, [1e-4] * 7, [4e-6] * 7]
PLAIN, GEARS = 36, 85
# Torque below which the catalogue has a drive softer [N m].
SMALL = np.array([20, 20, 12, 12, 8, 5, 5])


def script(x: Array, joints: Array, told: Array) -> tuple[Array, Array]:
    """The plain script's flange: place `s x 3` [m] and frame `s x 3 x 3`."""
    moment, tilts = moments(joints, told[:, 0]), None
    torque = moment[..., 2].T
    at = joints + x[28:35] * torque
    if len(x) > PLAIN:
        for k, times in enumerate(np.array([2 * RATIOS, 0 * RATIOS + 1, 0 * RATIOS + 2])):
            sine, cosine = x[36 + 14 * k : 50 + 14 * k].reshape(2, 7)
            at += sine * np.sin(times * joints) + cosine * np.cos(times * joints)
        at += x[78:85] * told[:, 2:]
    if len(x) > GEARS:
        at += x[85:92] * np.tanh(torque / SMALL)
        tilts = x[92:, None, None] * moment * [1, 1, 0]
    return chain(at, x[:28].reshape(4, 7), (23e-6 + x[35]) * (told[:, 1] - 20), tilts)[-1]


def script_fit(joints: Array, told: Array, seen: Array, count: int) -> tuple[Array, Array, Array]:
    """Numbers of the plain script, its point on the flange, and what it leaves in the machine's frame, `s x 3` [m].

    `count`: how many of its numbers it fits: `PLAIN`, `GEARS` or all.
    """
    place, frame = plain(joints)
    drawing = place + by(frame, REFLECTOR)
    turn, _ = Rotation.align_vectors(drawing - drawing.mean(0), seen - seen.mean(0))
    at, sizes, sigma = turn.apply(seen - seen.mean(0)) + drawing.mean(0), SIZES[:count], 5e-5

    def free(u: Array) -> Array:
        return np.asarray(np.r_[u[-9:-3] * 1e-3, REFLECTOR + u[-3:] * 1e-3])

    def left(u: Array) -> Array:
        return off(free(u), *script(u[:count] * sizes, joints, told), at)

    found = np.zeros(count + 9)
    for _ in range(3):
        fit = least_squares(lambda u: np.r_[left(u) / sigma, u[:count], 0.1 * u[count:]], found)  # noqa: B023
        found = fit.x
        # What is not modelled counts as noise: its size is that of what is left, by the freedom that the rows keep.
        spent = np.trace(np.linalg.pinv(fit.jac.T @ fit.jac) @ fit.jac[: seen.size].T @ fit.jac[: seen.size])
        sigma = max(1e-5, float(np.sqrt((left(found) ** 2).sum() / max(seen.size - spent, 20))))
    return found[:count] * sizes, free(found)[6:], left(found).reshape(-1, 3)


def corrected(wanted: Array, told: Array, numbers: Array, point: Array, more: Array | float = 0.0) -> Array:
    """Joints at which the script's point and heading are the drawing's at those wanted, less `more`, `s x 7`."""
    goal, heading = plain(wanted)
    goal, joints, step = goal + by(heading, point) - more, wanted.copy(), 1e-5

    def reached(q: Array) -> Array:
        place, frame = script(numbers, q, told)
        turn = Rotation.from_matrix(frame @ heading.swapaxes(1, 2)).as_rotvec()
        return np.asarray(np.c_[place + by(frame, point) - goal, 0.1 * turn])

    for _ in range(6):
        now = reached(joints)
        slope = np.stack([(reached(joints + step * one) - now) / step for one in np.eye(7)], -1)
        back = slope.swapaxes(1, 2) @ np.linalg.inv(slope @ slope.swapaxes(1, 2) + 1e-7 * np.eye(6))
        joints = joints - (back @ now[..., None])[..., 0]
    return np.asarray(joints)


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints, payload, temperature, at those wanted, `s x 3`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(9, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    scale = np.r_[LIMITS / 1.7, 3, 4]
    rows, new = np.c_[joints, told[:, :2]] / scale, np.c_[wanted, then[:, :2]] / scale
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, seen: Array | None = None) -> tuple[str, Array]:
    """Header and rows of a file in mm, deg, kg and deg C."""
    names = ",".join(f"q{k}[deg]" for k in range(1, 8)) + ",payload[kg],temperature[degC],"
    names += ",".join(f"direction{k}[1]" for k in range(1, 8)) + ("" if seen is None else ",x[mm],y[mm],z[mm]")
    rows = np.c_[np.degrees(joints), told]
    return names, rows if seen is None else np.c_[rows, 1e3 * seen]


def judged(seed: int, rows: int, without: Collection[str] = ()) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Arm(seed, without), np.random.default_rng([seed, 1])
    joints, told = day(rows, rng, np.array([0.0, 6.0]))
    seen = machine.measured(joints, told, rng)
    wanted, then = day(NEW, rng, np.array([3.0]), np.array([told[0, 1], told[-1, 1]]))
    numbers, point, left = script_fit(joints, told, seen, PLAIN)
    sent = {"as drawn": wanted, "plain script": corrected(wanted, then, numbers, point)}
    more = by_process(joints, told, left, wanted, then)
    sent["script and process"] = corrected(wanted, then, numbers, point, more)
    for who, count in (("script with gears", GEARS), ("and bending", len(SIZES))):
        sent[who] = corrected(wanted, then, *script_fit(joints, told, seen, count)[:2])
    with TemporaryDirectory() as folder:
        commands = commanded(Path(folder), FILE, table(joints, told, seen), table(wanted, then))
    sent["ours"] = np.full_like(wanted, np.nan) if commands is None else commands
    gone = {who: bool(np.isnan(q).any()) for who, q in sent.items()}
    found = {who: np.nan if gone[who] else missed(wanted, machine.reached(q, then)) for who, q in sent.items()}
    return found | {"a reading": NOISE * 3**0.5}


if __name__ == "__main__":
    judge_machines(__doc__, judged, 120)
