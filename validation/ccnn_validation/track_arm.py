"""A six-axis arm on the carriage of a floor track of 4 m, judged at other places all over its workspace.

`python -m ccnn_validation.track_arm --seed N [--machines N] [--rows N]`. A tracker measures positions alone. The rails
are bowed, the carriage rolls, pitches and yaws along them, rack and pinion have a scale, a wave and a step; the arm has
other links than drawn, gives under its own weight and has eccentric encoders. Ours (`ccnn run`, by the written file)
stands beside a plain SciPy fit of all of that, told the pinion's period, without and with scikit-learn's Gaussian
process on what it leaves. The file of "ours" has the base's axis z along the track, that of "ours upright" upward.
Judged in the frame and at the tool point that suit what is reached best.
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
from ccnn_validation.payload_arm import DRAWN, HIGH, LOW, START, TOOL, chain, missed, off, tip, torque

Array = NDArray[np.float64]
# The track, in the axes of the arm's foot: where it leads, its length and a turn of its pinion [m].
ALONG, LENGTH, TURN = np.array([0.0, -1.0, 0.0]), 4.0, 0.25
# Of a measured coordinate; places judged.
NOISE, NEW = 15e-6, 300
LEAST, MOST = np.r_[0, LOW], np.r_[LENGTH, HIGH]
# Of the arm's links by the drawing: mass [kg] and centre in the frame at the link's end [m].
MASSES = np.array([110.0, 70, 55, 30, 9, 3])
CENTRES = np.array([[-0.15, 0.2, 0], [-0.36, 0, 0.06], [0.02, 0, 0.1], [0, -0.32, 0], [0, 0, 0.03], [0, 0, -0.03]])
FILE = """{robot: arm on a track, dof: 7, convention: standard Denavit-Hartenberg, units: {length: m, angle: deg},
joint_types: [prismatic, revolute, revolute, revolute, revolute, revolute, revolute],
a: [0, 0.26, 0.68, -0.035, 0, 0, 0], alpha: [-90, -90, 0, -90, 90, -90, 0], d: [0, 0.675, 0, 0, 0.67, 0, 0.115],
theta: [0, 0, 0, 0, 0, 0, 0], masses: [400, 110, 70, 55, 30, 9, 3],
centres: [[0, 0, 0], [-0.15, 0.2, 0], [-0.36, 0, 0.06], [0.02, 0, 0.1], [0, -0.32, 0], [0, 0, 0.03], [0, 0, -0.03]],
base_frame: unknown, tool_offset: unknown, limits: [[0, 4], [-90, 90], [-100, -30], [-60, 50], [-150, 150], [-100, 100],
[-150, 150]], gears: [0.25, null, null, null, null, null, null]}
"""
# The same machine with the axis z of its base upward, not along the track: a modified table.
UPRIGHT = """{robot: arm on a track, dof: 7, convention: modified Denavit-Hartenberg, units: {length: m, angle: deg},
joint_types: [prismatic, revolute, revolute, revolute, revolute, revolute, revolute],
a: [0, 0, 0.26, 0.68, -0.035, 0, 0], alpha: [90, -90, -90, 0, -90, 90, -90], d: [0, 0.675, 0, 0, 0.67, 0, 0.115],
theta: [0, 0, 0, 0, 0, 0, 0], masses: [400, 110, 70, 55, 30, 9, 3],
centres: [[0, 0, 0], [0.11, 0, -0.2], [0.32, 0, 0.06], [-0.015, 0.1, 0], [0, 0, -0.32], [0, 0.03, 0], [0, 0, -0.03]],
base_frame: unknown, tool_offset: unknown, limits: [[0, 4], [-90, 90], [-100, -30], [-60, 50], [-150, 150], [-100, 100],
[-150, 150]], gears: [0.25, null, null, null, null, null, null]}
"""


def weight(joints: Array, links: Array, masses: Array, centres: Array) -> Array:
    """What the weight of the links does to the arm's joints, `s x 6` [N m]."""
    axes, places, _ = chain(joints, links)
    twist = np.zeros_like(joints)
    for k, (mass, centre) in enumerate(zip(masses, centres, strict=True), 1):
        end = chain(joints[:, :k], links[:k])[2]
        twist += torque(axes, places, tip(end, centre), mass, k)
    return twist


def carried(along: Array, shift: Array, turn: Array, flange: Array) -> Array:
    """The flange in the frame of the track, `s x 4 x 4`, of an arm whose carriage is shifted and turned, `s x 3`."""
    foot = np.tile(np.eye(4), (len(along), 1, 1))
    foot[:, :3, 3], foot[:, :3, :3] = along[:, None] * ALONG + shift, Rotation.from_rotvec(turn).as_matrix()
    return np.asarray(foot @ flange)


def drawn(joints: Array) -> Array:
    """The flange by the drawing, `s x 4 x 4`."""
    still = np.zeros((len(joints), 3))
    return carried(joints[:, 0], still, still, chain(joints[:, 1:], DRAWN)[2])


class TrackArm:
    """The true machine: its controller knows the drawing alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.links = DRAWN + rng.normal(0, [3e-4, 5e-4, 3e-4, 1e-3, 0], (6, 5))
        self.links[1, 4], self.tool = rng.normal(0, 5e-4), TOOL + rng.normal(0, 5e-4, 3)
        self.give = np.array([1.0, 1.4, 2.2, 9, 11, 16]) * 1e-6 * rng.uniform(0.7, 1.4, 6)
        self.masses = MASSES * rng.normal(1, 0.03, 6)
        self.centres = CENTRES + rng.normal(0, 0.01, (6, 3))
        self.eccentric, self.phase = 50e-6 * rng.uniform(0.6, 1.4, 6), rng.uniform(0, 2 * np.pi, 6)
        # Rails: bows across and upward; smaller and shorter ones of these and of three angles.
        self.bow = rng.choice([-1, 1], 2) * rng.uniform(2e-4, 3e-4, 2)
        self.waves = rng.normal(0, 1, (3, 5)) * np.array([3e-5, 3e-5, 1e-4, 1e-4, 1e-4]) / np.arange(1, 4)[:, None]
        self.places = rng.uniform(0, 2 * np.pi, (3, 5))
        self.scale, self.pinion = rng.choice([-1, 1]) * 50e-6, rng.uniform(0, 2 * np.pi)
        self.joint, self.step = rng.uniform(1.2, 2.8), rng.choice([-1, 1]) * 40e-6
        self.turn, self.stand = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]), rng.normal(0, 2, 3)

    def reached(self, joints: Array) -> Array:
        """The reflector in the frame of the track, `s x 3` [m]."""
        track, arm = joints[:, 0], joints[:, 1:]
        arm = arm + self.eccentric * np.sin(arm + self.phase)
        arm = arm + self.give * weight(arm, self.links, self.masses, self.centres)
        number = np.arange(1, 4)[:, None]
        rails = (self.waves * np.sin(np.pi * number * track[:, None, None] / LENGTH + self.places)).sum(1)
        rails[:, :2] += self.bow * np.sin(np.pi * track / LENGTH)[:, None]
        went = track * (1 + self.scale) + 30e-6 * np.sin(2 * np.pi * track / TURN + self.pinion)
        went += self.step * (track > self.joint)
        shift = np.stack([rails[:, 0], np.zeros_like(track), rails[:, 1]], -1)
        return tip(carried(went, shift, rails[:, 2:], chain(arm, self.links)[2]), self.tool)

    def measured(self, joints: Array, rng: np.random.Generator) -> Array:
        """As a tracker that stands upright reads it, `s x 3` [m]."""
        place = self.reached(joints)
        return np.asarray(self.turn.apply(place) + self.stand + rng.normal(0, NOISE, place.shape))


# Of the plain script: links, sines and cosines, springs, six motions of the track by three powers, the pinion.
MOTIONS = np.tile([2e-4, 2e-4, 2e-4, 1e-4, 1e-4, 1e-4], 3)
PRIOR = np.r_[np.tile([3e-4, 5e-4, 3e-4, 1e-3, 0], 6), np.full(12, 5e-5), np.array([1, 1, 2, 10, 10, 10]) * 2e-6]
PRIOR = np.r_[PRIOR, MOTIONS, np.full(2, 3e-5)]
PRIOR[9] = 5e-4


def model(x: Array, joints: Array) -> Array:
    """The plain script's flange, `s x 4 x 4`."""
    track, arm, links = joints[:, 0], joints[:, 1:], DRAWN + x[:30].reshape(6, 5)
    arm = arm + x[30:36] * np.sin(arm) + x[36:42] * (np.cos(arm) - 1)
    arm = arm + x[42:48] * weight(arm, links, MASSES, CENTRES)
    middle, angle = 2 * track / LENGTH - 1, 2 * np.pi * track / TURN
    rails = np.stack([middle, middle**2, middle**3], -1) @ x[48:66].reshape(3, 6)
    went = track + x[66] * np.sin(angle) + x[67] * np.cos(angle)
    return carried(went, rails[:, :3], rails[:, 3:], chain(arm, links)[2])


def in_frame(joints: Array, places: Array) -> Array:
    """Measured places in the frame that suits the drawing best, `s x 3` [m]."""
    wanted = tip(drawn(joints), TOOL)
    turn, _ = Rotation.align_vectors(wanted - wanted.mean(0), places - places.mean(0))
    return np.asarray(turn.apply(places - places.mean(0)) + wanted.mean(0))


def by_script(joints: Array, places: Array) -> tuple[Array, Array]:
    """Numbers of the plain script and what it leaves, `s x 3` [m]; ridge of plausible sizes, free frame and tool."""
    at, count = in_frame(joints, places), len(PRIOR)

    def missing(u: Array) -> Array:
        return off(START + u[count:] * 1e-3, model(u[:count] * PRIOR, joints), at)

    def left(u: Array) -> Array:
        return np.asarray(np.r_[missing(u) / 3e-5, u[:count], 0.1 * u[count:]])

    found = least_squares(left, np.zeros(count + 9)).x
    return np.asarray(found[:count] * PRIOR), missing(found).reshape(-1, 3)


def by_process(joints: Array, rest: Array) -> list[GaussianProcessRegressor]:
    """Scikit-learn: what the script leaves, over the joints."""
    kernel = ConstantKernel(1.0) * RBF([1.0] * 7) + WhiteKernel(0.1)
    return [GaussianProcessRegressor(kernel, normalize_y=True, random_state=0).fit(joints, e) for e in rest.T]


def corrected(wanted: Array, flange: Array, joints: Array) -> Array:
    """Joints moved by what the flange is off, `s x 7`; a damped Jacobian of the drawing."""
    axes, places, end = chain(joints[:, 1:], DRAWN)
    arm = np.concatenate([np.cross(axes, end[:, None, :3, 3] - places), axes], -1).swapaxes(1, 2)
    jacobian = np.concatenate([np.tile(np.r_[ALONG, 0, 0, 0][:, None], (len(joints), 1, 1)), arm], -1)
    turn = Rotation.from_matrix(wanted[:, :3, :3]) * Rotation.from_matrix(flange[:, :3, :3]).inv()
    miss = np.concatenate([wanted[:, :3, 3] - flange[:, :3, 3], turn.as_rotvec()], -1)[..., None]
    across = jacobian.swapaxes(1, 2)
    return np.asarray(joints + np.linalg.solve(across @ jacobian + 1e-6 * np.eye(7), across @ miss)[..., 0])


def by_package(file: str, joints: Array, places: Array, target: Array) -> Array | None:
    """Commands to the joints wanted, by the written file."""
    names = ",".join(["q1[m]", *(f"q{k}[rad]" for k in range(2, 8))])
    records = f"{names},x[m],y[m],z[m]", np.c_[joints, places]
    with TemporaryDirectory() as folder:
        return commanded(Path(folder), file, records, (names, target))


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = TrackArm(seed), np.random.default_rng([seed, 1])
    joints = rng.uniform(LEAST, MOST, (rows, 7))
    places = machine.measured(joints, rng)
    target = rng.uniform(LEAST + 0.1, MOST - 0.1, (NEW, 7))
    # As a planner does it: not near the wrist's singular place.
    target[:, 5] = rng.choice([-1, 1], NEW) * rng.uniform(0.3, 1.6, NEW)
    wanted = drawn(target)
    numbers, rest = by_script(joints, places)
    learned = np.stack([fit.predict(target) for fit in by_process(joints, rest)], -1)
    sent = {"as drawn": target}
    for who, more in (("plain script", 0 * learned), ("script and scikit-learn", learned)):
        sent[who] = target
        for _ in range(8):
            flange = model(numbers, sent[who])
            flange[:, :3, 3] += more
            sent[who] = corrected(wanted, flange, sent[who])
    for who, file in (("ours", FILE), ("ours upright", UPRIGHT)):
        commands = by_package(file, joints, places, target)
        sent[who] = np.full_like(target, np.nan) if commands is None else commands
    lost = {who: bool(np.isnan(joint).any()) for who, joint in sent.items()}
    return {who: np.nan if lost[who] else missed(wanted, machine.reached(joint)) for who, joint in sent.items()}


if __name__ == "__main__":
    judge_machines(__doc__, judged, 150)
