"""A SCARA of 0.7 m reach, calibrated by a laser tracker in a shift, judged at other places, payloads and temperatures.

`python -m ccnn_validation.scara --seed N [--machines N] [--rows N]`. Beside x, y, z of a reflector (10 µm of noise in
each) stand the payload, the temperature of the arm, and each joint's direction of approach. The true machine: arms of
other lengths, axes that are not parallel, zeros, harmonic drives of ratio 80 and 50 whose error returns twice a turn of
the motor, eccentric encoders, a quill on a ball screw spline (error of its lead that grows, bends and returns with each
turn, a nut that runs out, a twisted spline), play, arms and bearings that bend under weight and payload, arms that
grow, zeros that drift. Ours (`ccnn run`, by the written file) has a Denavit-Hartenberg table, or the machine file of a
SCARA ("own words"), both with the gears' ratios and the screw's lead, as the plain SciPy script knows them; another one
does not know the ratios. Judged in the frame and at the tool point that suit best; "a reading" is what a reading of the
tracker is off.
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
# By the drawing: the two arms, the height of the elbow, from the flange the reflector, the lead of the screw [m].
ARMS, HEIGHT, REFLECTOR, LEAD = np.array([0.4, 0.3]), 0.35, np.array([0.06, 0.015, -0.08]), 0.02
# Masses of upper arm, forearm, quill [kg]; centres of the first two from the axes that turn them [m].
MASSES, CENTRES, G = np.array([14.0, 9.0, 2.0]), np.array([0.17, 0.16]), 9.81
# Error of the drives of joints 1 and 2 by turn of the joint, and of a tracker's coordinate; places judged.
TIMES, NOISE, NEW = np.array([160, 100]), 10e-6, 400
TRAVEL = 0.18
LIMITS = "limits: {q1: [-160 deg, 160 deg], q2: [-145 deg, 145 deg], q3: [-190 mm, 10 mm], q4: [-185 deg, 185 deg]}\n"
FILE = """{robot: scara, dof: 4, convention: standard Denavit-Hartenberg, units: {length: m, angle: deg},
joint_types: [revolute, revolute, prismatic, revolute], a: [0.4, 0.3, 0, 0], alpha: [0, 0, 0, 0], d: [0.35, 0, 0, 0],
theta: [0, 0, 0, 0], masses: [14, 9, 1, 1], centres: [[-0.23, 0, 0], [-0.14, 0, 0], [0, 0, 0], [0, 0, 0]],
base_frame: unknown, tool_offset: unknown, limits: [[-160, 160], [-145, 145], [-0.19, 0.01], [-185, 185]],
gears: [80, 50, 0.02, null]}
"""
WORDS = f"""machine: scara
base_frame: unknown
tool_frame: unknown
gears: {{q1: 80, q2: 50, q3: 20 mm}}
{LIMITS}numbers: {{upper_arm: 400 mm +- 0.5 mm, forearm: 300 mm +- 0.5 mm, zero_2: 0 deg +- 0.1 deg,
  tilt_2x: 0 um/m +- 500 um/m, tilt_2y: 0 um/m +- 500 um/m, tilt_quill_x: 0 um/m +- 500 um/m,
  tilt_quill_y: 0 um/m +- 500 um/m, lead_z: 0 um/m +- 300 um/m, quill_coupling: 0 mm/turn +- 0.02 mm/turn}}
"""


def turned(vector: Array) -> Array:
    """Matrices of rotation vectors, `s x 3` to `s x 3 x 3`."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def chain(joints: Array, arms: Array, leans: Array, bends: Array, drops: Array) -> tuple[Array, Array]:
    """Place `s x 3` [m] and frame `s x 3 x 3` of the flange.

    Args:
        joints: where they really are, `s x 4`.
        arms: their lengths, `s x 2` [m].
        leans: of joint 2, slide and joint 4 against what carries them, `3 x 3` [rad].
        bends: turns of the foot, and of the ends of both arms in their frames, `3 x s x 3` [rad].
        drops: of the ends of both arms, `2 x s` [m].
    """
    up, none = np.eye(3)[2], np.zeros(len(joints))
    frame, place = turned(bends[0]) @ turned(joints[:, [0]] * up), np.tile([0, 0, HEIGHT], (len(joints), 1))
    for k in range(2):
        step = np.stack([arms[:, k], none, -drops[k]], -1)
        place = place + (frame @ step[..., None])[..., 0]
        frame = frame @ turned(bends[k + 1]) @ turned(leans[k])
        if k == 0:
            frame = frame @ turned(joints[:, [1]] * up)
    place = place + joints[:, [2]] * frame[:, :, 2]
    return place, frame @ turned(leans[2]) @ turned(joints[:, [3]] * up)


def weights(joints: Array, payload: Array, masses: Array) -> tuple[Array, Array, Array]:
    """Moments on foot and elbow, `2 x s x 3` [N m], the elbow's in the frame of the upper arm; forces at both ends [N].

    Those of the forearm's end have no lever: quill and payload hang there.
    """
    first, both = joints[:, 0], joints[:, 0] + joints[:, 1]
    ways = [np.stack([np.cos(a), np.sin(a)], -1) for a in (first, both, joints[:, 1])]
    end, lever = G * (masses[2] + payload), np.zeros((2, len(joints), 2))
    lever[1] = (G * masses[1] * CENTRES[1] + end * ARMS[1])[:, None] * ways[2]
    lever[0] = (G * masses[0] * CENTRES[0] + (G * masses[1] + end) * ARMS[0])[:, None] * ways[0]
    lever[0] += (G * masses[1] * CENTRES[1] + end * ARMS[1])[:, None] * ways[1]
    moment = np.stack([-lever[..., 1], lever[..., 0], 0 * lever[..., 0]], -1)
    return moment, G * masses[1] + end, end


def drawn(joints: Array) -> tuple[Array, Array]:
    """Place and frame of the flange by the drawing."""
    rows = len(joints)
    arms = np.tile(ARMS, (rows, 1))
    return chain(joints, arms, np.zeros((3, 3)), np.zeros((3, rows, 3)), np.zeros((2, rows)))


class Scara:
    """The true machine; its controller knows the drawing alone, and `size` scales all its errors."""

    def __init__(self, seed: int, size: float = 1.0) -> None:
        rng = np.random.default_rng(seed)
        self.arms = ARMS + size * rng.normal(0, 3e-4, 2)
        self.zeros = size * rng.normal(0, [1e-3, 1e-3, 3e-4, 1e-3])
        self.leans = size * rng.normal(0, [[4e-4], [4e-4], [1e-4]], (3, 3)) * [1, 1, 0]
        # Harmonic drives, twice and once a turn of the motor; encoders, once a turn of joints 1, 2 and 4.
        self.wave = size * rng.uniform(3, 20, 2) * np.pi / 648e3
        self.once, self.encoder = self.wave * rng.uniform(0.1, 0.3, 2), size * rng.uniform(1e-5, 5e-5, 3)
        self.phase = rng.uniform(0, 2 * np.pi, (4, 3))
        # The screw: growing error, its bend over the travel [m], wave of a turn, of the nut; twist of its spline.
        self.lead, self.bow = size * rng.normal(0, 8e-5), size * rng.normal(0, 6e-6)
        self.screw, self.nut = size * rng.uniform(3e-6, 9e-6), size * rng.uniform(1e-6, 3e-6)
        self.twist = size * rng.normal(0, 1e-3)
        self.play = size * rng.uniform([5e-6, 5e-6, 5e-7, 1e-5], [3e-5, 3e-5, 3e-6, 6e-5])
        # Bearings give [rad / N m], arms bend: length by stiffness [m / N m²].
        self.bearing = size * np.array([2e-7, 2.5e-7]) * rng.uniform(0.7, 1.4, 2)
        self.soft = size / np.array([1.2e5, 6e4]) * rng.uniform(0.7, 1.4, 2)
        self.masses = MASSES * rng.normal(1, 0.04, 3)
        self.growth = size * np.array([22e-6, 22e-6, 11.5e-6]) * rng.uniform(0.8, 1.2, 3)
        self.warm = size * rng.normal(0, 3e-6, 4)
        self.point = REFLECTOR + size * rng.normal(0, 5e-4, 3)
        self.turn, self.stand = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]), rng.normal([2, 1, 0], 0.5)
        self.turn = self.turn * Rotation.from_rotvec(rng.normal(0, 5e-4, 3))
        self.both = bool(rng.random() < 0.6)

    def went(self, joints: Array, told: Array) -> Array:
        """Where the drives bring the joints, `s x 4`."""
        warm, slide = told[:, 1] - 20, joints[:, 2]
        at = joints + self.zeros + self.play / 2 * told[:, 2:] + warm[:, None] * self.warm * [1, 1, 0.3, 1]
        at[:, :2] += self.wave * np.sin(TIMES * joints[:, :2] + self.phase[0, :2])
        at[:, :2] += self.once * np.sin(TIMES / 2 * joints[:, :2] + self.phase[1, :2])
        at[:, [0, 1, 3]] += self.encoder * np.sin(joints[:, [0, 1, 3]] + self.phase[2])
        turns = 2 * np.pi * slide / LEAD
        at[:, 2] += slide * (self.lead + self.growth[2] * warm) + self.screw * np.sin(turns + self.phase[3, 0])
        at[:, 2] += self.bow * (2 * slide / TRAVEL + 1) ** 2 + self.nut * np.sin(
            turns + joints[:, 3] + self.phase[3, 1]
        )
        at[:, 3] += self.twist * slide
        return np.asarray(at)

    def reached(self, joints: Array, told: Array) -> Array:
        """The reflector, `s x 3` [m]; `told`: payload [kg], temperature [deg C], directions, `s x 6`."""
        at, warm = self.went(joints, told), told[:, [1]] - 20
        moment, *force = weights(at, told[:, 0], self.masses)
        lengths = self.arms * (1 + self.growth[:2] * warm)
        end = np.stack([moment[1], 0 * moment[1]])
        bends, drops = np.zeros((3, len(at), 3)), np.zeros((2, len(at)))
        bends[0] = self.bearing[0] * moment[0]
        for k, (arm, soft) in enumerate(zip(ARMS, self.soft, strict=True)):
            slope = np.array([1.3, 1, 0]) * end[k] * soft * arm
            slope[:, 1] += force[k] * soft * arm**2 / 2
            bends[k + 1] = slope + (self.bearing[1] * moment[1] if k == 0 else 0)
            drops[k] = force[k] * soft * arm**3 / 3 + end[k, :, 1] * soft * arm**2 / 2
        place, frame = chain(at, lengths, self.leans, bends, drops)
        return np.asarray(place + frame @ self.point)

    def measured(self, joints: Array, told: Array, rng: np.random.Generator) -> Array:
        """As the tracker reads it, `s x 3` [m]; joints stop with scatter, the thermometer does not show all."""
        stopped = joints + rng.normal(0, [3e-6, 3e-6, 1e-6, 1e-5], joints.shape)
        really = told + rng.normal(0, [0, 0.2, 0, 0, 0, 0], told.shape)
        seen = self.turn.apply(self.reached(stopped, really)) + self.stand
        return np.asarray(seen + rng.normal(0, NOISE, seen.shape))

    def day(self, rows: int, rng: np.random.Generator, payloads: Array, ends: Array | None = None) -> tuple[Array, ...]:
        """Joints of places all over the workspace, `s x 4`, and what is told, `s x 6`; `ends`: of the temperature."""
        far, way = np.sqrt(rng.uniform(0.28**2, 0.66**2, rows)), rng.uniform(-1.8, 1.8, rows)
        elbow = rng.choice([-1, 1], rows) * np.arccos((far**2 - (ARMS**2).sum()) / (2 * ARMS.prod()))
        shoulder = way - np.arctan2(ARMS[1] * np.sin(elbow), ARMS[0] + ARMS[1] * np.cos(elbow))
        joints = np.stack([shoulder, elbow, rng.uniform(-TRAVEL, 0, rows), rng.uniform(-3.1, 3.1, rows)], -1)
        warm = 20.5 + rng.uniform(5, 9) * (1 - np.exp(-np.linspace(0, 6, rows) / 2)) if ends is None else None
        temperature = warm if ends is None else rng.uniform(ends[0], ends[1], rows)
        direction = np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1)) if self.both else np.ones_like(joints)
        return joints, np.c_[rng.choice(payloads, rows), temperature, direction]


def off(x: Array, place: Array, frame: Array, seen: Array) -> Array:
    """Measured places in another frame less those of a point on the flange, flat [m]; `x`: turn, shift, point."""
    return np.asarray((Rotation.from_rotvec(x[:3]).apply(seen) + x[3:6] - place - frame @ x[6:9]).ravel())


def missed(joints: Array, reached: Array) -> float:
    """Root mean square of a miss [m] in the best frame, with the best point on the drawing's flange."""
    start = np.r_[np.zeros(6), REFLECTOR]
    found = least_squares(off, start, x_scale=1e-3, args=(*drawn(joints), reached))
    return float(np.sqrt((found.fun**2).sum() / len(joints)))


# Of the plain script: arms, leans, zeros of 2 and 4, gears and encoders, screw, springs, growth, drift, play.
SIZES = np.r_[
    [3e-4] * 2, [4e-4] * 4, [1e-3] * 2, [5e-5] * 8, [1e-4, 6e-6, 6e-6, 6e-6, 1e-3], [2e-7] * 3, [4e-6] * 2, [3e-6] * 3,
    [2e-5, 2e-5, 2e-6, 4e-5],
]  # fmt: skip


def script(x: Array, joints: Array, told: Array) -> tuple[Array, Array]:
    """The plain script's flange: place `s x 3` [m] and frame `s x 3 x 3`."""
    warm, slide, at = told[:, 1] - 20, joints[:, 2], joints.copy()
    at[:, [1, 3]] += x[6:8]
    for k in range(2):
        angle = np.outer(joints[:, k], [TIMES[k], 1])
        at[:, k] += np.c_[np.sin(angle), np.cos(angle)] @ x[8 + 4 * k : 12 + 4 * k]
    turns = 2 * np.pi * slide / LEAD
    lead = np.c_[slide, np.sin(turns), np.cos(turns), (2 * slide / TRAVEL + 1) ** 2]
    at[:, 2] += lead @ x[16:20] + slide * (11.5e-6 * warm)
    at[:, 3] += x[20] * slide
    at[:, [0, 1, 3]] += np.outer(warm, x[26:29])
    at += x[29:33] / 2 * told[:, 2:]
    moment, *_ = weights(joints, told[:, 0], MASSES)
    bends = np.zeros((3, len(joints), 3))
    bends[0], bends[1] = x[21] * moment[0], x[22] * moment[1]
    bends[2, :, 1] = x[23] * G * (MASSES[2] + told[:, 0])
    lengths = (ARMS + x[:2]) * (1 + (22e-6 + x[24:26]) * warm[:, None])
    leans = np.r_[np.c_[x[2:6].reshape(2, 2), [0, 0]], [[0, 0, 0]]]
    return chain(at, lengths, leans, bends, np.zeros((2, len(joints))))


def script_fit(joints: Array, told: Array, seen: Array, ratios: bool = True) -> tuple[Array, Array, Array]:
    """Numbers of the plain script, its point on the flange, and what it leaves in the machine's frame, `s x 3` [m].

    `ratios`: whether it knows those of the gears.
    """
    place, frame = drawn(joints)
    plan, count, sizes = place + frame @ REFLECTOR, len(SIZES), SIZES.copy()
    sizes[[8, 10, 12, 14]] *= ratios
    turn, _ = Rotation.align_vectors(plan - plan.mean(0), seen - seen.mean(0))
    at = turn.apply(seen - seen.mean(0)) + plan.mean(0)

    def free(u: Array) -> Array:
        return np.asarray(np.r_[u[-9:-3] * 1e-3, REFLECTOR + u[-3:] * 1e-3])

    def left(u: Array) -> Array:
        return off(free(u), *script(u[:count] * sizes, joints, told), at)

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[left(u) / 1.5e-5, u[:count], 0.1 * u[count:]])

    found = least_squares(residuals, np.zeros(count + 9)).x
    return found[:count] * sizes, free(found)[6:], left(found).reshape(-1, 3)


def corrected(wanted: Array, told: Array, numbers: Array, point: Array, more: Array | float = 0.0) -> Array:
    """Joints at which the script's point and heading are the drawing's at those wanted, less `more`, `s x 4`."""
    place, frame = drawn(wanted)
    goal, joints, tall = place + frame @ point - more, wanted.copy(), np.zeros((len(wanted), 4, 4))
    for _ in range(8):
        now, turn = script(numbers, joints, told)
        tip = now + turn @ point
        angle = (frame.swapaxes(1, 2) @ turn)[:, 1, 0]
        elbow = ARMS[0] * np.stack([np.cos(joints[:, 0]), np.sin(joints[:, 0])], -1)
        for k, centre in ((0, 0 * elbow), (1, elbow), (3, now[:, :2])):
            tall[:, 0, k], tall[:, 1, k], tall[:, 3, k] = centre[:, 1] - tip[:, 1], tip[:, 0] - centre[:, 0], 1
        tall[:, 2, 2] = 1
        joints = joints + np.linalg.solve(tall, np.c_[goal - tip, -angle][..., None])[..., 0]
    return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints, payload, temperature, at those wanted, `s x 3`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(6, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    scale = np.array([1, 1, 0.06, 2, 2, 3])
    rows, new = np.c_[joints, told[:, :2]] / scale, np.c_[wanted, then[:, :2]] / scale
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, seen: Array | None = None) -> tuple[str, Array]:
    """Header and rows of a file in mm, deg, kg and deg C."""
    names = "q1[deg],q2[deg],q3[mm],q4[deg],payload[kg],temperature[degC],"
    names += ",".join(f"direction{k}[1]" for k in range(1, 5)) + ("" if seen is None else ",x[mm],y[mm],z[mm]")
    rows = np.c_[np.degrees(joints), told]
    rows[:, 2] = 1e3 * joints[:, 2]
    return names, rows if seen is None else np.c_[rows, 1e3 * seen]


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Scara(seed), np.random.default_rng([seed, 1])
    joints, told = machine.day(rows, rng, np.array([0.0, 2.0, 5.0]))
    seen = machine.measured(joints, told, rng)
    wanted, then = machine.day(NEW, rng, np.array([0.0, 1.0, 3.0, 5.0]), np.array([told[0, 1], told[-1, 1]]))
    numbers, point, left = script_fit(joints, told, seen)
    sent = {"as drawn": wanted, "plain script": corrected(wanted, then, numbers, point)}
    more = by_process(joints, told, left, wanted, then)
    sent["script and process"] = corrected(wanted, then, numbers, point, more)
    sent["script without ratios"] = corrected(wanted, then, *script_fit(joints, told, seen, False)[:2])
    for who, file in (("ours", FILE), ("ours, own words", WORDS)):
        with TemporaryDirectory() as folder:
            commands = commanded(Path(folder), file, table(joints, told, seen), table(wanted, then))
        sent[who] = np.full_like(wanted, np.nan) if commands is None else commands
    gone = {who: bool(np.isnan(q).any()) for who, q in sent.items()}
    found = {who: np.nan if gone[who] else missed(wanted, machine.reached(q, then)) for who, q in sent.items()}
    return found | {"a reading": NOISE * 3**0.5}


if __name__ == "__main__":
    judge_machines(__doc__, judged, 80)
