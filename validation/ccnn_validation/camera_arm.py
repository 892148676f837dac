"""A small arm of belts and planetary gears on a table that gives, seen by a camera, judged on the true machine.

`python -m ccnn_validation.camera_arm --seed N [--machines N] [--rows N]`. Drawn after the AR4 of Annin Robotics (six
joints, 0.6 m, stepper motors). A camera reads a cube of markers on the hand in the frame of markers on the table, mean
of ten images: 0.06 mm and 0.4 mrad across and about its axis, 0.2 mm and 1 mrad along and across it, and 2 % of the
rows are wrong by millimetres. The drawing tells the links' masses. Of each row the payload and the joints' directions
of approach are known. The true machine has links of a workshop (0.4 mm, 2 mrad), zeros of stops (6 mrad), eccentric
pulleys (50 µm on 40 to 150 mm) and planets (four a turn), backlash of planetary gears behind belts, which weight holds
on one flank where it exceeds friction, joints that give under links and payload, and a table that tilts with the arm's
moment about axes of its own.
Ours (`ccnn run`, by the written file) stands beside a robust SciPy fit of links, pulleys, backlash by direction, joint
springs and table, alone and with scikit-learn's Gaussian process on what it leaves. Judged are places not measured, in
the frame and at the point on the hand that suit what is reached best.
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
from ccnn_validation.payload_arm import chain, tip, torque

Array = NDArray[np.float64]
Pose = tuple[Array, Rotation]
# Of the drawing, a row a joint: a [m], alpha [rad], d [m], theta, lean about y [rad].
DRAWN = np.zeros((6, 5))
DRAWN[:2, 0], DRAWN[[0, 3, 5], 2] = [0.0642, 0.305], [0.16977, 0.22263, 0.03625]
DRAWN[:, 1] = np.pi / 2 * np.array([-1, 0, -1, 1, -1, 0])
LOW, HIGH = np.radians([-100, -130, -45, -150, -95, -150]), np.radians([100, -45, 45, 150, 95, 150])
CUBE = np.array([0.02, 0.0, 0.06])
# A joint's stop [rad]; places judged; gravity; payloads [kg]; the camera's axis, in the frame of the table's markers.
STOP, NEW, G, PAYLOADS = 1e-4, 300, 9.81, (0.0, 0.5, 1.0, 1.5)
# Upper arm, forearm, wrist [kg], each in the middle between two joints.
MASSES = (3.0, 2.0, 0.8)
FILE = """{robot: arm, dof: 6, convention: standard Denavit-Hartenberg, units: {length: mm, angle: deg},
a: [64.2, 305, 0, 0, 0, 0], alpha: [-90, 0, -90, 90, -90, 0], d: [169.77, 0, 0, 222.63, 0, 36.25],
theta: [0, 0, 0, 0, 0, 0], base_frame: unknown, tool_frame: unknown,
masses: [0, 3, 2, 0, 0.8, 0], centres: [[], [], [0, 0, 111.315], [], [], []]}
"""


def weights(places: Array, payload: Array, tool: Array) -> list[tuple[Array, Array | float, int]]:
    """Place [m], mass [kg] and number of joints that carry it, of upper arm, forearm, wrist and payload."""
    links = zip(((1, 2), (2, 4), (4, 5)), MASSES, strict=True)
    return [*(((places[:, a] + places[:, b]) / 2, mass, a + 1) for (a, b), mass in links), (tool, payload, 6)]


class Arm:
    """The true arm: its controller knows the drawing alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.links = DRAWN + rng.normal(0, [4e-4, 2e-3, 4e-4, 6e-3, 0], (6, 5))
        self.links[1, 4], self.tool = rng.normal(0, 2e-3), CUBE + rng.normal(0, 1e-3, 3)
        self.pulley, self.planet = rng.uniform(3e-4, 1.2e-3, 6), rng.uniform(0, 3e-4, 6)
        self.phase = rng.uniform(0, 2 * np.pi, (2, 6))
        self.play = rng.uniform([0.3e-3] * 3 + [0.6e-3] * 3, [1.0e-3] * 3 + [2.0e-3] * 3)
        self.friction = np.array([2.0, 2.5, 1.5, 0.5, 0.4, 0.3]) * rng.uniform(0.7, 1.3, 6)
        self.give = rng.uniform(0.7, 1.4, 6) / np.array([5e3, 6e3, 4e3, 1.5e3, 1.2e3, 1e3])
        self.table, self.lie = rng.uniform(0.7, 1.4, 2) / np.array([12e3, 25e3]), rng.uniform(0, np.pi)
        self.turn = Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)]) * Rotation.from_rotvec(rng.normal(0, 3e-3, 3))
        self.stand, self.held = rng.normal(0, 0.3, 3), Rotation.from_rotvec(rng.normal(0, 0.5, 3))
        self.look = Rotation.align_vectors([[1, 0, -0.4]], [[0, 0, 1]])[0]

    def flange(self, joints: Array, direction: Array, payload: Array) -> Array:
        """Flange in the frame that the unloaded table has, `s x 4 x 4`."""
        wave = self.pulley * np.sin(joints + self.phase[0]) + self.planet * np.sin(4 * joints + self.phase[1])
        axes, places, end = chain(joints + wave, self.links)
        twist, moment = np.zeros_like(joints), np.zeros((len(joints), 3))
        for at, mass, carry in weights(places, payload, tip(end, CUBE)):
            twist += torque(axes, places, at, mass, carry)
            moment += np.cross(at, np.array([0, 0, -G])) * np.asarray(mass)[..., None]
        # The gear rests on the flank that weight pushes to, or trails behind the motor where friction is larger.
        flank = np.where(np.abs(twist) > self.friction, np.sign(twist), -direction)
        end = chain(joints + wave + self.give * twist + self.play / 2 * flank, self.links)[2]
        own = Rotation.from_rotvec([0, 0, self.lie])
        tilt = own.apply(own.inv().apply(moment) * np.r_[self.table, 0])
        end[:, :3] = Rotation.from_rotvec(tilt).as_matrix() @ end[:, :3]
        return end

    def measured(self, joints: Array, direction: Array, payload: Array, rng: np.random.Generator) -> Pose:
        """Place [m] and orientation of the cube in the frame of the table's markers."""
        end = self.flange(joints + rng.normal(0, STOP, joints.shape), direction, payload)
        place = self.turn.apply(tip(end, self.tool)) + self.stand
        turn = self.turn * Rotation.from_matrix(end[:, :3, :3]) * self.held
        wrong = rng.random(len(joints)) < 0.02
        blur = rng.normal(0, [6e-5, 6e-5, 2e-4], place.shape) + wrong[:, None] * rng.normal(0, 8e-3, place.shape)
        twist = rng.normal(0, [1e-3, 1e-3, 4e-4], place.shape) + wrong[:, None] * rng.normal(0, 0.15, place.shape)
        return place + self.look.apply(blur), Rotation.from_rotvec(self.look.apply(twist)) * turn


def missed(wanted: Array, reached: Array) -> float:
    """Root mean square of what is missed in the best frame, with the best point on the hand [m]."""

    def left(x: Array) -> Array:
        return np.asarray((Rotation.from_rotvec(x[:3]).apply(reached) + x[3:6] - tip(wanted, CUBE + x[6:])).ravel())

    found = least_squares(left, np.zeros(9), x_scale=1e-3)
    return float(np.sqrt((found.fun**2).sum() / len(wanted)))


# Plausible sizes of the plain script's numbers: links, waves, backlash, springs under payload and links, table.
PRIOR = np.r_[np.tile([5e-4, 3e-3, 5e-4, 1e-2, 0], 6), np.full(18, 1e-3), np.full(6, 5e-4), np.full(2, 1e-4)]
PRIOR[9] = 3e-3


def model(x: Array, joints: Array, direction: Array, payload: Array) -> Array:
    """The plain script's flange, `s x 4 x 4`; backlash by direction alone, the links' masses from the drawing."""
    links, shift = DRAWN + x[:30].reshape(6, 5), joints + x[30:36] * np.sin(joints) + x[36:42] * (np.cos(joints) - 1)
    axes, places, end = chain(shift, links)
    twist, moment = np.zeros_like(joints), np.zeros((len(joints), 3))
    for at, mass, carry in weights(places, payload, tip(end, CUBE)):
        twist += torque(axes, places, at, mass, carry)
        moment += np.cross(at, np.array([0, 0, -G])) * np.asarray(mass)[..., None]
    end = chain(shift - x[42:48] / 2 * direction + x[48:54] * twist, links)[2]
    end[:, :3] = Rotation.from_rotvec(moment * np.r_[x[54:56], 0]).as_matrix() @ end[:, :3]
    return end


def by_script(joints: Array, direction: Array, payload: Array, place: Array, turn: Rotation) -> tuple[Array, Array]:
    """Numbers of the plain script, and what it leaves of each place in its base, `s x 3` [m]: robust least squares."""
    drawn = chain(joints, DRAWN)[2]
    # The hand's turn against the cube's, and the frame: medians over the rows.
    facing = Rotation.from_matrix(drawn[:, :3, :3])
    there = tip(drawn, CUBE)
    good = np.ones(len(joints), bool)
    for _ in range(3):
        base, _ = Rotation.align_vectors((there - there[good].mean(0))[good], (place - place[good].mean(0))[good])
        shift = there[good].mean(0) - base.apply(place[good].mean(0))
        far = np.linalg.norm(base.apply(place) + shift - there, axis=1)
        good = far < 3 * np.median(far)
    cube = (facing.inv() * base * turn)[good].mean()

    def off(u: Array) -> tuple[Array, Array]:
        x, frame = u[:56] * PRIOR, u[56:] * 1e-2
        end, first = model(x, joints, direction, payload), Rotation.from_rotvec(frame[:3]) * base
        far = first.apply(place) + shift + frame[3:6] - tip(end, CUBE + frame[6:9])
        turned = first * turn * (Rotation.from_matrix(end[:, :3, :3]) * cube * Rotation.from_rotvec(frame[9:])).inv()
        return far, turned.as_rotvec()

    def left(u: Array) -> Array:
        far, turned = off(u)
        rows = np.c_[far / 2e-4, turned / 1.2e-3]
        size = np.linalg.norm(rows, axis=1, keepdims=True)
        # Huber's loss of a row, as a residual.
        rows = rows * np.sqrt(np.where(size < 4, 1, (8 * size - 16) / np.maximum(size, 1e-9) ** 2))
        return np.asarray(np.r_[rows.ravel(), u[:56], 0.01 * u[56:]])

    found = least_squares(left, np.zeros(68)).x
    return found[:56] * PRIOR, off(found)[0]


def corrected(wanted: Array, flange: Array, joints: Array) -> Array:
    """Joints moved by what the flange is off, `s x 6`; a damped Jacobian of the drawing, at the cube."""
    axes, places, _ = chain(joints, DRAWN)
    end = tip(flange, CUBE)
    jacobian = np.concatenate([np.cross(axes, end[:, None] - places), axes], -1).swapaxes(1, 2)
    turn = Rotation.from_matrix(wanted[:, :3, :3]) * Rotation.from_matrix(flange[:, :3, :3]).inv()
    miss = np.concatenate([tip(wanted, CUBE) - end, turn.as_rotvec()], -1)[..., None]
    across = jacobian.swapaxes(1, 2)
    return np.asarray(joints + np.linalg.solve(across @ jacobian + 1e-6 * np.eye(6), across @ miss)[..., 0])


def process(joints: Array, payload: Array, left: Array) -> list[GaussianProcessRegressor]:
    """Scikit-learn: what a place is off in the script's base, over joints and payload; outliers left out."""
    far = np.linalg.norm(left, axis=1)
    good = far < 5 * np.median(far)
    kernel, make = ConstantKernel(1.0) * RBF(2.0) + WhiteKernel(0.5), GaussianProcessRegressor
    return [make(kernel, normalize_y=True, random_state=0).fit(np.c_[joints, payload][good], e[good]) for e in left.T]


def drawn_rows(rows: int, rng: np.random.Generator, part: float = 1.0) -> tuple[Array, Array, Array]:
    """Joints away from the wrist's singular place, directions of approach, payloads."""
    joints = rng.uniform(LOW * part, HIGH * part, (rows, 6))
    joints[:, 4] = rng.choice([-1, 1], rows) * rng.uniform(0.3, 1.6, rows)
    return joints, rng.choice([-1.0, 1.0], (rows, 6)), rng.choice(PAYLOADS, rows)


def table(joints: Array, direction: Array, payload: Array, pose: Pose | None = None) -> tuple[str, Array]:
    """Header and rows of a file in deg, mm and N, the orientation as a quaternion."""
    names = [*(f"q{k}[deg]" for k in range(1, 7)), *(f"direction{k}[1]" for k in range(1, 7)), "load_z[N]"]
    columns = [np.degrees(joints), direction, -G * payload[:, None]]
    if pose is not None:
        names += ["x[mm]", "y[mm]", "z[mm]", "qx[1]", "qy[1]", "qz[1]", "qw[1]"]
        columns += [1e3 * pose[0], pose[1].as_quat()]
    return ",".join(names), np.concatenate(columns, 1)


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one arm misses [m], by who calibrated it; NaN where there were no commands."""
    arm, rng = Arm(seed), np.random.default_rng([seed, 1])
    joints, direction, payload = drawn_rows(rows, rng)
    place, turn = arm.measured(joints, direction, payload, rng)
    target, approach, after = drawn_rows(NEW, rng, 0.95)
    wanted = chain(target, DRAWN)[2]
    numbers, left = by_script(joints, direction, payload, place, turn)
    script = target
    for _ in range(8):
        script = corrected(wanted, model(numbers, script, approach, after), script)
    moved, fits = wanted.copy(), process(joints, payload, left)
    moved[:, :3, 3] -= np.stack([fit.predict(np.c_[target, after]) for fit in fits], -1)
    both = script
    for _ in range(8):
        both = corrected(moved, model(numbers, both, approach, after), both)
    sent = {"as drawn": target, "plain script": script, "script and process": both}
    with TemporaryDirectory() as folder:
        files = table(joints, direction, payload, (place, turn)), table(target, approach, after)
        commands = commanded(Path(folder), FILE, *files)
    sent["ours"] = np.full_like(target, np.nan) if commands is None else commands
    found = {}
    for who, joint in sent.items():
        lost = np.isnan(joint).any()
        found[who] = np.nan if lost else missed(wanted, tip(arm.flange(joint, approach, after), arm.tool))
    return found


if __name__ == "__main__":
    judge_machines(__doc__, judged, 300)
