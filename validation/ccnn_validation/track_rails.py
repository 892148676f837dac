"""A six-axis arm of 2 m reach on a linear track of 4 m, calibrated in a shift by a laser tracker, judged another day.

`python -m ccnn_validation.track_rails --seed N [--machines N] [--rows N]`. Beside the reflector's x, y, z (12 µm and
3 µm/m of noise) stand the payload, the temperatures of arm and hall, and each axis' direction of approach. The arm has
the dimensions of a KUKA KR 60, and gears as stiff as such arms' (after Dumas et al. 2011). The true machine: two rails,
levelled every 0.6 m, with bows and bends where pieces meet; a carriage on four shoes, whose straightnesses, roll, pitch
and yaw follow from the rails, and which tilts under the arm; racks of 1 m and a pinion of 20 teeth with errors of gain,
rack, joint, turn and tooth, and play; an arm whose places, axes and zeros are off, whose gears and bearings give under
its own weight, tool and payload, run out once and twice a turn and with their pins, and have play; links that grow,
zeros that drift. Ours (`ccnn run` and `ccnn identify`, by the written file) stands beside a SciPy fit of
Denavit-Hartenberg numbers, springs, harmonics, growth, splines of the carriage's six error motions, waves, steps and
play of the drive, alone and with scikit-learn's Gaussian process on what it leaves. Judged are other places, payloads
and temperatures, in the frame and at the tool point that suit best.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from ccnn_validation.drawn import commanded, judge_machines

Array = NDArray[np.float64]
# The drawing, z up, track along y, arm stretched along x: places of the axes and of the flange from the one before, the
# first from the rails [m], the axes, masses of what each carries [kg] and their centres from it [m].
STEP = np.zeros((7, 3))
STEP[[1, 2, 3, 6], 0], STEP[[0, 1, 3], 2] = [0.35, 0.85, 0.82, 0.17], [0.45, 0.815, 0.145]
AXES = np.array([2, 1, 1, 0, 1, 0])
MASSES = np.array([160.0, 110, 130, 40, 12, 22])
CENTRES = np.array([[0.15, 0, 0.55], [0.4, 0.08, 0], [0.15, 0, 0.1], [-0.35, 0, 0], [0.03, 0, 0], [0.29, 0, 0.03]])
# From the flange the reflector, from the wrist a payload [m].
REFLECTOR, PAYLOAD = np.array([0.3, 0.05, 0.08]), np.array([0.39, 0, 0.03])
LIMITS = np.radians([[-130, 130], [-110, -10], [20, 130], [-150, 150], [-100, 100], [-150, 150]])
LOW, HIGH = np.r_[[[0, 4]], LIMITS].T
# Half a carriage, distance of the rails, pitch of the rack, turn of the pinion [m]; gravity; places judged.
HALF, GAUGE, TOOTH, TURN, G, NEW = 0.4, 0.7, 40 / 3e3, 20 * 40 / 3e3, 9.81, 300
RACKS = np.array([1.0, 2.0, 3.0])
FILE = """{robot: track, dof: 7, convention: modified Denavit-Hartenberg (Craig), units: {length: m, angle: deg},
joint_types: [prismatic, revolute, revolute, revolute, revolute, revolute, revolute],
a: [0, 0, 0.35, 0.85, 0.145, 0, 0], alpha: [-90, 90, -90, 0, -90, 90, -90], d: [0, 0.815, 0, 0, 0.82, 0, 0.17],
theta: [0, 0, 0, -90, 0, 0, 0], base_frame: unknown, tool_offset: unknown, masses: [400, 160, 110, 130, 40, 12, 22],
centres: [[], [0.15, 0, -0.265], [0.4, 0, 0.08], [0.1, 0.15, 0], [0, 0, -0.35], [0, 0.03, 0], [0.03, 0, 0.12]],
limits: [[0, 4], [-130, 130], [-110, -10], [20, 130], [-150, 150], [-100, 100], [-150, 150]],
gears: [0.2666667, null, null, null, null, null, null]}
"""
ERRORS = "rails bends gain racks pinion play tilt geometry springs bearings waves pins heat"


def chain(angles: Array, track: Array, turn: Array, step: Array, lean: Array, give: Array) -> tuple[Array, Array]:
    """Frames of carriage, arm's axes and flange, `s x 8 x 3 x 3`, and their places, `s x 8 x 3`.

    Args:
        angles: of the arm, `s x 6`.
        track, turn: place and rotation vector of the carriage, `s x 3`.
        step, lean, give: as `STEP`; rotation vectors of the axes, built, `6 x 3`, and under weight, `s x 6 x 3`.
    """
    turned, place, step = Rotation.from_rotvec(turn), track, step + np.zeros((len(track), 1, 1))
    frames, places = [turned.as_matrix()], [track]
    for k, axis in enumerate(AXES):
        place = place + turned.apply(step[:, k])
        turned = turned * Rotation.from_rotvec(lean[k]) * Rotation.from_rotvec(angles[:, [k]] * np.eye(3)[axis])
        turned = turned * Rotation.from_rotvec(give[:, k])
        frames, places = [*frames, turned.as_matrix()], [*places, place]
    end = place + turned.apply(step[:, 6])
    return np.stack([*frames, frames[-1]], 1), np.stack([*places, end], 1)


def moments(frames: Array, places: Array, payload: Array, masses: Array, centres: Array) -> Array:
    """Of all weight beyond on the carriage and on the arm's axes, in their frames, `s x 7 x 3` [N m]."""
    at = places[:, 1:7] + np.einsum("skij,kj->ski", frames[:, 1:7], centres)
    at = np.concatenate([at, (places[:, 6] + frames[:, 6] @ PAYLOAD)[:, None]], 1)
    weight = np.concatenate([np.broadcast_to(masses, (len(at), 6)), payload[:, None]], 1)
    pull = np.cross(at[:, None] - places[:, :7, None], [0, 0, -G]) * weight[:, None, :, None]
    carried = np.arange(7) >= np.arange(7)[:, None] - 1
    return np.asarray(np.einsum("skji,skbj,kb->ski", frames[:, :7], pull, carried, optimize=True))


def drawn(joints: Array) -> tuple[Array, Array]:
    """Frames and places of the drawing, as `chain` has them."""
    track, none = joints[:, [0]] * np.eye(3)[1], np.zeros((len(joints), 6, 3))
    return chain(joints[:, 1:], track, np.zeros_like(track), STEP, none[0], none)


class Machine:
    """The true machine: its controller knows the drawing alone; it lacks one of `ERRORS`, `without`."""

    def __init__(self, seed: int, without: str = "") -> None:
        rng = np.random.default_rng(seed)
        on = {name: float(name != without) for name in ERRORS.split()}
        # Of the rails, sideways and up: bow, screws of levelling, and where pieces of 2 m meet.
        self.bow = on["rails"] * (rng.normal(0, 1.5e-4, 2)[:, None] + rng.normal(0, 5e-5, (2, 2)))
        self.level = on["rails"] * rng.normal(0, 6e-5, (2, 2, 10))
        self.pieces, self.bend = np.array([[1.3, 3.3], [0.6, 2.6]]), on["bends"] * rng.normal(0, 8e-5, (2, 2, 2))
        self.gain = on["gain"] * rng.normal(0, 1e-4)
        self.rack = on["racks"] * rng.normal(0, [[2.5e-5], [1.5e-5]], (2, 4))
        self.pinion = on["pinion"] * rng.uniform([8e-6, 2e-6], [18e-6, 5e-6])
        self.phase, self.play = rng.uniform(0, 2 * np.pi, 2), on["play"] * rng.uniform(3e-5, 8e-5)
        # Of the carriage's shoes and the bed [rad / N m]: they pitch about x, roll about y.
        self.tilt = on["tilt"] * np.array([1.2e-8, 2.5e-8, 0.8e-8]) * rng.uniform(0.7, 1.4, 3)
        self.step = STEP + on["geometry"] * rng.normal(0, 3e-4, (7, 3))
        self.lean = on["geometry"] * rng.normal(0, 3e-4, (6, 3))
        self.lean[range(6), AXES] = on["geometry"] * rng.normal(0, 6e-4, 6)
        gear = np.array([0.35, 0.4, 0.55, 3.3, 3.3, 5.0]) * 1e-6 * rng.uniform(0.7, 1.4, 6)
        self.give = on["bearings"] * gear[:, None] * rng.uniform(0.15, 0.3, (6, 1)) * np.ones(3)
        self.give[range(6), AXES] = on["springs"] * gear
        self.masses, self.centres = MASSES * rng.normal(1, 0.06, 6), CENTRES + rng.normal(0, 0.02, (6, 3))
        # A joint's error once and twice a turn, by its gear's pins, and by its play.
        self.times = np.stack([np.ones(6), np.full(6, 2), rng.integers(30, 60, 6)])
        self.wave = rng.uniform([[3e-5], [1e-5], [8e-6]], [[1.2e-4], [4e-5], [2e-5]], (3, 6))
        self.wave *= np.array([on["waves"], on["waves"], on["pins"]])[:, None]
        self.waves, self.slack = rng.uniform(0, 2 * np.pi, (3, 6)), on["play"] * rng.uniform(1e-5, 4e-5, 6)
        # Growth of each part for what thermometers show, drift of the zeros [1 / K, rad / K].
        self.growth, self.warm = on["heat"] * 11.5e-6 * rng.uniform(0.7, 1.3, 8), on["heat"] * rng.normal(0, 4e-6, 6)
        self.point = REFLECTOR + rng.normal(0, 1e-3, 3)
        self.stand, lean = rng.normal([3, 2, 1], 0.7), Rotation.from_rotvec(rng.normal(0, 1e-3, 3))
        self.turn = Rotation.from_euler("z", rng.uniform(-3, 3)) * lean

    def rail(self, number: int, along: Array) -> Array:
        """One rail beside its line, sideways and up, `s x 2` [m]."""
        screws, piece = CubicSpline(np.arange(10) * 0.6 - 0.7, self.level[number], axis=1), self.pieces[number][:, None]
        bends = self.bend[number] @ (np.maximum(along - piece, 0) - along * (1 - piece / 4))
        return np.asarray((screws(along) + self.bow[number][:, None] * ((along - 2) ** 2 / 4 - 1) + bends).T)

    def carriage(self, track: Array, hall: Array, direction: Array) -> tuple[Array, Array]:
        """Place and rotation vector of the carriage, `s x 3`."""
        piece = np.searchsorted(RACKS, track)
        along = track * (1 + self.gain + self.growth[7] * (hall - 20)) + self.play / 2 * direction
        along += self.rack[0][piece] * (track - piece) + np.r_[0, np.cumsum(self.rack[:, :3].sum(0))][piece]
        along += (self.pinion * np.sin(2 * np.pi * track[:, None] / [TURN, TOOTH] + self.phase)).sum(-1)
        # Rail 1 is at -x.
        shoes = np.stack([[self.rail(n, along + end) for end in (-HALF, HALF)] for n in (0, 1)])
        (x, z), ends, sides = shoes.mean((0, 1)).T, np.diff(shoes.mean(0), axis=0)[0], np.diff(shoes.mean(1), axis=0)[0]
        turn = np.stack([ends[:, 1] / (2 * HALF), sides[:, 1] / GAUGE, -ends[:, 0] / (2 * HALF)], -1)
        return np.stack([x, along, z], -1), turn

    def reached(self, joints: Array, told: Array) -> Array:
        """The reflector, `s x 3` [m]; `told`: payload [kg], warmth of arm and hall [deg C], directions, `s x 10`."""
        payload, arm, hall, direction = told[:, 0], told[:, 1] - 20, told[:, 2], told[:, 3:]
        track, turn = self.carriage(joints[:, 0], hall, direction[:, 0])
        wave = (self.wave * np.sin(joints[:, None, 1:] * self.times + self.waves)).sum(1)
        angles = joints[:, 1:] + wave + self.slack * direction[:, 1:] + arm[:, None] * self.warm
        step, give = self.step * (1 + self.growth[:7] * arm[:, None])[..., None], np.zeros((len(joints), 6, 3))
        tilt = np.zeros_like(turn)
        for _ in range(3):
            frames, places = chain(angles, track, turn + tilt, step, self.lean, give)
            moment = moments(frames, places, payload, self.masses, self.centres)
            tilt, give = self.tilt * moment[:, 0], self.give * moment[:, 1:]
        return np.asarray(places[:, 7] + frames[:, 7] @ self.point)

    def measured(self, joints: Array, told: Array, rng: np.random.Generator) -> Array:
        """As the tracker reads it, `s x 3` [m]; axes stop with scatter, thermometers do not show all."""
        stopped = joints + rng.normal(0, np.r_[6e-6, np.full(6, 8e-6)], joints.shape)
        really = told + rng.normal(0, np.r_[0, 0.3, 0.3, np.zeros(7)], told.shape)
        seen = self.turn.apply(self.reached(stopped, really) - self.stand)
        far = np.linalg.norm(seen, axis=-1, keepdims=True)
        return np.asarray(seen + rng.normal(0, 1, seen.shape) * (12e-6 + 3e-6 * far))


def day(rows: int, rng: np.random.Generator, payloads: Array) -> tuple[Array, Array]:
    """Joints of a shift, `s x 7`, not near the wrist's singular place, and what is told, `s x 10`."""
    joints = rng.uniform(LOW, HIGH, (rows, 7))
    joints[:, 5] = rng.choice([-1, 1], rows) * rng.uniform(0.3, HIGH[5], rows)
    hours, morning = np.linspace(0, 8, rows), rng.normal(18, 1)
    hall = morning + rng.uniform(2, 5) * np.sin(np.pi * hours / 12)
    arm = hall + rng.uniform(7, 11) * (1 - np.exp(-hours / 2.2))
    direction = np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1))
    return joints, np.c_[rng.choice(payloads, rows), arm, hall, direction]


def off(x: Array, frames: Array, places: Array, seen: Array) -> Array:
    """Measured places in another frame less those of a point on the flange, flat [m]; `x`: turn, shift, point."""
    return np.asarray((Rotation.from_rotvec(x[:3]).apply(seen) + x[3:6] - places - frames @ x[6:]).ravel())


def missed(joints: Array, reached: Array) -> float:
    """Root mean square of a miss [m] in the best frame, with the best point on the drawing's flange."""
    frames, places = (each[:, 7] for each in drawn(joints))
    found = least_squares(off, np.r_[np.zeros(6), REFLECTOR], x_scale=1e-3, args=(frames, places, reached))
    return float(np.sqrt((found.fun**2).sum() / len(joints)))


# The plain script: the drawing as modified Denavit-Hartenberg numbers a, alpha, d, theta of the arm.
DH = np.zeros((6, 4))
DH[[1, 2, 3], 0], DH[[0, 3, 5], 2], DH[2, 3] = [0.35, 0.85, 0.145], [0.815 + 0.45, 0.82, 0.17], -np.pi / 2
DH[1:, 1] = np.pi / 2 * np.array([-1, 0, -1, 1, -1])
TO_DH = np.array([[0, 0, 1.0], [0, -1, 0], [1, 0, 0]])
KNOTS = np.r_[[-0.001] * 3, np.linspace(-0.001, 4.001, 9), [4.001] * 3]
# Its numbers and their plausible sizes.
SIZES = {
    "links": np.tile([4e-4, 4e-4, 4e-4, 8e-4], 6), "lean": np.full(1, 4e-4), "motions": np.full(66, 2e-4),
    "track": np.r_[1e-4, np.full(3, 2e-5), np.full(4, 1e-5), 3e-5], "tilt": np.full(3, 2e-8),
    "gears": np.array([1, 1, 1, 6, 6, 8]) * 5e-7, "waves": np.repeat([7e-5, 3e-5], 12), "play": np.full(6, 3e-5),
    "heat": np.r_[6e-6, 6e-6, np.full(6, 4e-6)],
}  # fmt: skip
PRIOR, ENDS = np.concatenate(list(SIZES.values())), np.cumsum([len(size) for size in SIZES.values()])


def script(x: Array, joints: Array, told: Array, moment: Array) -> tuple[Array, Array]:
    """The plain script's flange, `s x 3 x 3` and `s x 3`; `moment`: of all weight as drawn, by `moments`."""
    part = dict(zip(SIZES, np.split(x, ENDS[:-1]), strict=True))
    q, track, arm = joints[:, 1:], joints[:, 0], told[:, 1] - 20
    spline = BSpline.design_matrix(track, KNOTS, 3) @ part["motions"].reshape(6, 11).T
    phase = 2 * np.pi * track[:, None] / [TURN, TOOTH]
    base = np.c_[track, np.heaviside(track[:, None] - RACKS, 0), np.sin(phase), np.cos(phase), told[:, 3] / 2]
    growth = (11.5e-6 + part["heat"][0]) * (told[:, 2] - 20)
    place = spline[:, :3] + (track * (1 + growth) + base @ part["track"])[:, None] * np.eye(3)[1]
    frame = Rotation.from_rotvec(spline[:, 3:] + part["tilt"] * moment[:, 0]).as_matrix()
    waves = np.stack([np.sin(q), np.cos(q), np.sin(2 * q), np.cos(2 * q)])
    angles = q + (part["waves"].reshape(4, 1, 6) * waves).sum(0)
    angles += (
        part["gears"] * moment[:, range(1, 7), AXES] + part["play"] * told[:, 4:] + part["heat"][2:] * arm[:, None]
    )
    grown = 1 + (11.5e-6 + part["heat"][1]) * arm[:, None]
    for k, (a, alpha, d, theta) in enumerate(DH + part["links"].reshape(6, 4)):
        place = place + a * grown * frame[:, :, 0]
        frame = frame @ Rotation.from_euler("xy", [alpha, part["lean"][0] if k == 2 else 0.0]).as_matrix()
        frame = frame @ Rotation.from_rotvec((angles[:, [k]] + theta) * np.eye(3)[2]).as_matrix()
        place = place + d * grown * frame[:, :, 2]
    return frame @ TO_DH, place


def script_fit(joints: Array, told: Array, seen: Array) -> tuple[Array, Array]:
    """Numbers of the plain script by robust least squares, and what it leaves in the machine's frame, `s x 3` [m]."""
    frames, places = drawn(joints)
    moment = moments(frames, places, told[:, 0], MASSES, CENTRES)
    plan = places[:, 7] + frames[:, 7] @ REFLECTOR
    turn, _ = Rotation.align_vectors(plan - plan.mean(0), seen - seen.mean(0))
    at = turn.apply(seen - seen.mean(0)) + plan.mean(0)

    def left(u: Array) -> Array:
        frame, place = script(u[:-9] * PRIOR, joints, told, moment)
        return off(np.r_[u[-9:-3], 1e3 * REFLECTOR + u[-3:]] * 1e-3, frame, place, at)

    def residuals(u: Array) -> Array:
        # Of the splines also how they bend, a part of what they are.
        bends = np.diff(u[ENDS[1] : ENDS[2]].reshape(6, 11), 2, axis=1).ravel()
        return np.asarray(np.r_[left(u) / 4e-5, u[:-9], bends, 0.01 * u[-9:]])

    found = least_squares(residuals, np.zeros(len(PRIOR) + 9), loss="soft_l1", f_scale=3.0)
    return found.x[:-9] * PRIOR, left(found.x).reshape(-1, 3)


def corrected(wanted: Array, told: Array, numbers: Array, more: Array | float = 0.0) -> Array:
    """Joints at which the script's flange is where the drawing's is for those wanted, less `more`; the track stays."""
    frames, places = drawn(wanted)
    goal, joints = places[:, 7] - more, wanted
    for _ in range(6):
        now, at = drawn(joints)
        frame, place = script(numbers, joints, told, moments(now, at, told[:, 0], MASSES, CENTRES))
        axes = np.stack([now[:, k + 1, :, axis] for k, axis in enumerate(AXES)], 1)
        jacobian = np.concatenate([np.cross(axes, at[:, [7]] - at[:, 1:7]), axes], -1).swapaxes(1, 2)
        turn = Rotation.from_matrix(frames[:, 7]) * Rotation.from_matrix(frame).inv()
        miss, across = np.c_[goal - place, turn.as_rotvec()][..., None], jacobian.swapaxes(1, 2)
        step = np.linalg.solve(across @ jacobian + 1e-6 * np.eye(6), across @ miss)[..., 0]
        joints = joints + np.c_[np.zeros(len(step)), step]
    return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints, payload and temperatures, at those wanted, `s x 3`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(10, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    scale = np.r_[(HIGH - LOW) / 4, 20, 4, 4]
    rows, new = np.c_[joints, told[:, :3]] / scale, np.c_[wanted, then[:, :3]] / scale
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, seen: Array | None = None) -> tuple[str, Array]:
    """Header and rows of a file in mm, deg, kg and deg C."""
    names = ",".join(["q1[mm]", *(f"q{k}[deg]" for k in range(2, 8)), *(f"direction{k}[1]" for k in range(1, 8))])
    names += ",payload[kg],temperature[degC],temperature_hall[degC]" + ("" if seen is None else ",x[mm],y[mm],z[mm]")
    rows = np.c_[1e3 * joints[:, :1], np.degrees(joints[:, 1:]), told[:, 3:], told[:, :3]]
    return names, rows if seen is None else np.c_[rows, 1e3 * seen]


def judged(seed: int, rows: int, without: str = "") -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, rng = Machine(seed, without), np.random.default_rng([seed, 1])
    joints, told = day(rows, rng, np.array([0.0, 20.0, 40.0]))
    seen = machine.measured(joints, told, rng)
    wanted, then = day(NEW, rng, np.array([0.0, 10.0, 30.0, 40.0]))
    numbers, left = script_fit(joints, told, seen)
    sent = {"as drawn": wanted, "plain script": corrected(wanted, then, numbers)}
    sent["script and process"] = corrected(wanted, then, numbers, by_process(joints, told, left, wanted, then))
    with TemporaryDirectory() as folder:
        for way in ("run", "identify"):
            (Path(folder) / way).mkdir()
            commands = commanded(Path(folder) / way, FILE, table(joints, told, seen), table(wanted, then), way)
            sent[f"ours, {way}"] = np.full_like(wanted, np.nan) if commands is None else commands
    gone = {who: bool(np.isnan(q).any()) for who, q in sent.items()}
    return {who: np.nan if gone[who] else missed(wanted, machine.reached(q, then)) for who, q in sent.items()}


if __name__ == "__main__":
    judge_machines(__doc__, judged, 150)
