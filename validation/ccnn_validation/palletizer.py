"""A palletizing robot of four axes whose bars keep the wrist level: who brings the gripper to new places?

`python -W ignore -m ccnn_validation.palletizer --seed N --machines K [--rows R] [--without CAUSE ...] [--ours NAME ...]`.

Base, two main arms (0.945 and 1.025 m), wrist about the vertical. The motor of the forearm sits at the shoulder: it
turns a crank, a rod along the upper arm turns the forearm's tail (the motor's angle is that of the forearm to the base).
Two further parallelograms over a triangle at the elbow keep the wrist level. As true as one machine is in 120 lines:
lengths (0.1 to 0.5 mm), bars that are no exact pairs (0.1 to 0.3 mm: loops are closed as they are, the wrist tilts by
mrad), zeros (0.3 to 1.5 mrad), leans of all axes (0.1 to 0.4 mrad), reducers that give under weight and payload less a
spring's torque, rods that stretch (more where loops are flat), a base plate that tilts, gears that err once and twice a
motor's turn (20 to 50 urad, ratios on the data sheet) and once and twice a joint's turn, play that weight closes where
it beats friction, links that warm behind the motors and grow while rods stay cool. A tracker reads a reflector on the
gripper (U = 10 um + 6 um/m, k = 2) at 80 poses in four hours, with 0 and 60 kg, base and gripper unknown to some mm.
Told are commands, payload, the motors' thermometers, directions of the last motion.

Judged: 400 new poses of another day, in the frame and with the point of the gripper that fit best, RMS (and maximum).
"plain script" is least squares over lengths, zeros, leans, level, sag by the data sheet's masses, gears, play, growth;
"fuller script" closes the loops of the bars and adds all the causes that its author guessed; each also with a Gaussian
process on what is left. Ours: `ccnn run` with a class of one's own (palletizer_arm.py): ideal parallelograms, or bars.
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

from ccnn_validation.drawn import commanded

Array = NDArray[np.float64]
# By the drawing [m]: shoulder from the base's axis and up, upper arm, forearm, wrist to flange out and down, crank of
# the forearm, links of the levelling bars, reflector on the flange; ratios; masses [kg]: upper arm, forearm, triangle
# with rods, wrist with gripper; the forearm's centre from the elbow, the wrist's before its pivot [m].
A1, D1, L2, L3, A4, D4, CRANK, LEVEL = 0.26, 0.75, 0.945, 1.025, 0.22, 0.25, 0.3, 0.2
POINT, RATIO, G = np.array([0.2, 0.1, -0.15]), np.array([153.0, 171.0, 185.0, 81.0]), 9.81
MASS, C3, CW, SPRING = np.array([90.0, 60.0, 25.0, 45.0]), 0.35, 0.12, (-0.3 - 0.1j, 0.35)
LOW, HIGH = np.radians([-100.0, 50.0, -50.0, -170.0]), np.radians([100.0, 120.0, 15.0, 170.0])
LOADS, NEW, IRON, ALUMINIUM = np.array([0.0, 60.0]), 400, 11.5e-6, 23e-6
WHERE = "{mechanism: framed, keys: {mechanism: palletizer_arm.py:Palletizer, base: true, allow_code: true%s}, "
RATIOS = ", keys: {gears: [153, 171, 185, 81]%s}"
OWN = "mechanism: palletizer_arm.py:Palletizer\nmechanism_keys: {stand: true, allow_code: true%s}\n"
SEEN = f"mechanism: instrument\nmechanism_keys: {WHERE}kind: pose, pose: [x, y, z]}}\n"
# Of ours: config. `SEEN` fits the tracker's frame; `OWN` has rows in a frame that was fitted to the drawing before.
OURS = {
    "ideal": OWN % "",
    "bars": OWN % ", bars: true",
    "seen, ideal": SEEN % (RATIOS % ""),
    "seen, bars": SEEN % (RATIOS % ", bars: true"),
}
CAUSES = ("lengths", "bars", "zeros", "leans", "sag", "spring", "rods", "base", "gears", "turns", "play", "warmth")


def swung(pivot: Array, link: Array, far: Array, rod: Array, way: Array) -> Array:
    """Angle from the direction `way` to a link at a pivot whose end a rod holds from afar, in the complex plane."""
    apart = far - pivot
    span = np.abs(apart)
    along = (span**2 + link**2 - rod**2) / (2 * span)
    aside = np.sqrt(link**2 - along**2) * np.sign((way * apart.conj()).imag)
    return np.asarray(np.angle((along + 1j * aside) * apart / span / way))


def spring_lever(q2: Array) -> Array:
    """How much the spring shortens as the upper arm rises [m/rad], and its length [m]."""
    end = SPRING[1] * np.exp(1j * q2)
    apart = end - SPRING[0]
    return np.stack([-(1j * end * apart.conj()).real / np.abs(apart), np.abs(apart)])


def turned(x: Array | float, y: Array | float, z: Array | float, count: int) -> Rotation:
    """Turns by rotation vectors of these coordinates."""
    return Rotation.from_rotvec(np.stack([np.broadcast_to(v, count) for v in (x, y, z)], -1))


def carried(planar: Array, aside: float = 0.0) -> Array:
    """Vectors `s x 3` of complex numbers in the plane of the arms."""
    return np.stack([planar.real, np.full(len(planar), aside), planar.imag], -1)


class Robot:
    """The true machine; its controller knows the drawing alone. `without`: the causes that are switched off."""

    def __init__(self, seed: int, without: tuple[str, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        on = {cause: float(cause not in without) for cause in CAUSES}

        def size(cause: str, low: float, high: float, *shape: int) -> Array:
            return np.asarray(on[cause] * rng.uniform(low, high, shape) * rng.choice([-1, 1], shape))

        self.long = np.array([A1, D1, L2, L3, A4, D4]) + size("lengths", 1e-4, 5e-4, 6)
        self.aside = size("lengths", 1e-4, 4e-4, 3)
        # Crank, tail, rod; link at the base, rod, links of the triangle, rod, link at the wrist; the triangle's angle.
        upper, fore = self.long[2:4]
        bars = [CRANK, CRANK, upper, LEVEL, upper, LEVEL, LEVEL, fore, LEVEL]
        self.bars, self.angle = np.array(bars) + size("bars", 1e-4, 3e-4, 9), size("bars", 3e-4, 1e-3)
        self.zeros, self.leans = size("zeros", 3e-4, 1.5e-3, 4), size("leans", 1e-4, 4e-4, 4, 2)
        self.gives = on["sag"] / rng.uniform(2e6, 4e6, 2)
        self.spring = on["spring"] * np.array([rng.uniform(3000, 4500), rng.uniform(5e3, 9e3)])
        self.rods = on["rods"] / rng.uniform([4e7, 2e7], [8e7, 4e7])
        self.plate = on["base"] * rng.uniform(4e-9, 1.2e-8, 2)
        self.mass = MASS * rng.uniform(0.93, 1.07, 4)
        self.wave, self.phase = on["gears"] * rng.uniform(2e-5, 5e-5, 4), rng.uniform(0, 6.28, (4, 4))
        self.turns = on["turns"] * rng.uniform(1e-5, 3e-5, (2, 4))
        self.gap, self.holds = on["play"] * rng.uniform(4e-5, 1e-4, 4), rng.uniform(60, 130, 4)
        # Growth by column, upper arm, forearm and rods; share of the motors' warmth in each, time behind them [s].
        self.growth = on["warmth"] * np.array([IRON, IRON, ALUMINIUM, IRON]) * rng.uniform(0.93, 1.07, 4)
        share = [[0.25, 0.05, 0.05, 0], [0.03, 0.18, 0.12, 0], [0, 0, 0.03, 0.25], [0, 0.03, 0.03, 0.02]]
        self.share, self.late = np.array(share) * rng.uniform(0.8, 1.2, (4, 4)), rng.uniform(1800, 3600, 4)
        self.point = POINT + rng.normal(0, 3e-3, 3)
        self.turn = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]) * Rotation.from_rotvec(rng.normal(0, 1e-3, 3))
        self.stand = rng.normal([3, 1.5, -0.8], 0.4)

    def warmed(self, times: Array, hall: Array, motors: Array) -> Array:
        """Temperatures of column, upper arm, forearm, rods `s x 4`, each behind hall and motors."""
        aims, out = hall[:, None] + (motors - hall[:, None]) @ self.share.T, np.empty((len(times), 4))
        out[0] = aims[0]
        for i, step in enumerate(np.diff(times), 1):
            out[i] = out[i - 1] + (aims[i] - out[i - 1]) * (1 - np.exp(-step / self.late))
        return out

    def reached(self, joints: Array, told: Array, inside: Array) -> Array:
        """The reflector, `s x 3` [m]; `told`: motors' temperatures, directions, payload, `s x 9`; links' temperatures."""
        load, count, q = told[:, 8], len(joints), joints + self.zeros
        q = q + self.wave * (np.sin(RATIO * q + self.phase[0]) + 0.3 * np.sin(2 * RATIO * q + self.phase[1]))
        q = q + self.turns[0] * np.sin(q + self.phase[2]) + self.turns[1] * np.sin(2 * q + self.phase[3])
        m2, m3, mt, mw = self.mass
        lever, length = spring_lever(q[:, 1])
        pull = -G * np.cos(q[:, 1]) * L2 * (m2 / 2 + m3 + mt + mw + load)
        pull = pull + lever * (self.spring[0] * (self.spring[0] > 0) + self.spring[1] * (length - 0.4))
        lift = -G * np.cos(q[:, 2]) * (m3 * C3 + (mw + load) * L3)
        torque = np.stack([0 * load, pull, lift, 0 * load], -1)
        q = q + self.gap / 2 * np.tanh((torque - self.holds * told[:, 4:8]) / 30)
        slant = CRANK * np.sin(q[:, 1] - q[:, 2])
        q2, q3 = q[:, 1] + self.gives[0] * pull, q[:, 2] + self.gives[1] * lift + self.rods[0] * lift / slant**2
        # What the wrist's weight pulls at the levelling rods: along the forearm, then along the upper arm.
        tip = G * (mw * CW + load * A4) / LEVEL * self.rods[1]
        column, upper, fore, rods = (1 + self.growth * (inside - 20)).T
        a1, d1, l2, l3, a4, d4 = self.long
        crank, tail, rod, low, rise, back, top, along, end = self.bars
        arm, aim = l2 * upper * np.exp(1j * q2), np.exp(1j * q3)
        q3 = q3 + swung(arm, tail * fore, -crank * column * aim, rod * rods, -aim)
        first = swung(arm, back, -low * column + 0 * arm, rise * rods + tip / np.sin(q2), -1 + 0 * arm)
        reach = l3 * fore * np.exp(1j * q3)
        hook = arm + top * np.exp(1j * (np.pi / 2 + self.angle + first))
        tilt = swung(arm + reach, end, hook, along * rods + tip / np.cos(q3), 1j + 0 * arm)
        at, frame = self.spread(q, arm, reach, tilt, np.array([a1, d1, a4, d4]), column, q2)
        weight = np.stack([m2 / 2 + 0 * load, m3 * C3 / L3 + 0 * load, mw + load], -1)
        far = A1 * weight.sum(1) + arm.real * (weight.sum(1) + m3) + reach.real * weight[:, 1:].sum(1)
        moment = G * far[:, None] * np.stack([-np.sin(q[:, 0]), np.cos(q[:, 0])], -1)
        lean = turned(*(self.plate * moment).T, 0.0, count)
        return np.asarray(lean.apply(at + frame.apply(self.point)))

    def spread(
        self, q: Array, arm: Array, reach: Array, tilt: Array, out: Array, column: Array, q2: Array
    ) -> tuple[Array, Rotation]:
        """The flange in space: arms in planes that lean, `s x 3` [m], and its frame."""
        count, (lean, elbow, wrist, last) = len(q), self.leans
        base = turned(0, 0, q[:, 0], count)
        at = base.apply(np.stack([out[0] * column, np.full(count, self.aside[0]), out[1] * column], -1))
        plane = base * turned(lean[0], 0, lean[1], count)
        at = at + plane.apply(carried(arm, self.aside[1]))
        leans = (elbow[0] + 1j * elbow[1]) * np.exp(1j * q2)
        plane = plane * turned(leans.real, 0, leans.imag, count)
        at = at + plane.apply(carried(reach, self.aside[2]))
        plane = plane * turned(wrist[0], 0, wrist[1], count) * turned(0, -tilt, 0, count)
        at = at + plane.apply(np.tile([out[2], 0, -out[3]], (count, 1)))
        return at, plane * turned(last[0], last[1], 0, count) * turned(0, 0, q[:, 3], count)

    def measured(self, joints: Array, told: Array, inside: Array, rng: np.random.Generator) -> Array:
        """As the tracker reads it, `s x 3` [m]; drives stop with scatter."""
        seen = self.reached(joints + rng.normal(0, 5e-6, joints.shape), told, inside)
        seen = self.turn.apply(seen) + self.stand
        sd = 5e-6 + 3e-6 * np.linalg.norm(seen, axis=1, keepdims=True)
        return np.asarray(seen + rng.normal(0, 1, seen.shape) * sd)


def drawn(joints: Array) -> tuple[Array, Rotation]:
    """The flange by the drawing, `s x 3` [m], and its frame."""
    q1, q2, q3, q4 = joints.T
    out = A1 + L2 * np.cos(q2) + L3 * np.cos(q3) + A4
    at = np.stack([out * np.cos(q1), out * np.sin(q1), D1 + L2 * np.sin(q2) + L3 * np.sin(q3) - D4], -1)
    return at, turned(0, 0, q1 + q4, len(joints))


def day(robot: Robot, rows: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Commands in no order over the workspace, what is told (thermometers err a little), links' temperatures."""
    joints = rng.uniform(LOW, HIGH, (20 * rows, 4))
    bent = np.degrees(joints[:, 1] - joints[:, 2])
    joints = joints[(bent > 45) & (bent < 145)][:rows]
    times = np.linspace(0, 4 * 3600, rows)
    hall = 20.5 + rng.normal(0, 0.7) + rng.uniform(0.3, 2) * times / times[-1]
    rise, load = rng.uniform([12, 15, 15, 8], [18, 25, 25, 15]), LOADS[(np.arange(rows) * 8 // rows) % 2]
    motors = hall[:, None] + rise * (1 - np.exp(-times / 2400))[:, None]
    told = np.c_[motors, np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1)), load]
    inside = robot.warmed(times, hall, motors)
    told[:, :4] += rng.normal(0, 0.3, (rows, 4))
    return joints, told, inside


def missed(joints: Array, reached: Array) -> tuple[float, float]:
    """Root mean square and maximum of a miss [m] in the best frame, with the best point on the flange of the drawing."""
    at, frame = drawn(joints)
    if np.isnan(reached).any():
        return np.nan, np.nan
    near, _ = Rotation.align_vectors(at - at.mean(0), reached - reached.mean(0))

    if np.isnan(reached).any():
        return np.nan, np.nan

    def off(x: Array) -> Array:
        moved = Rotation.from_rotvec(x[:3]).apply(near.apply(reached)) + x[3:6]
        return np.asarray((moved - at - frame.apply(POINT + x[6:9])).ravel())

    far = np.linalg.norm(least_squares(off, np.zeros(9), x_scale=1e-3).fun.reshape(-1, 3), axis=1)
    return float(np.sqrt((far**2).mean())), float(far.max())


# Of the scripts: numbers and how far each may be off; those behind the bar are of the fuller one alone.
PLAIN = {"long": (4, 5e-4), "zero": (2, 1.5e-3), "tilt": (1, 2e-3), "lean": (6, 5e-4), "soft": (2, 4e-7)}
PLAIN |= {"spring": (1, 4e3), "wave": (8, 4e-5), "gap": (4, 8e-5), "grow": (3, 4e-6), "base": (6, 0.0), "tool": (3, 0.0)}
FULL = {"bars": (7, 4e-4), "stretch": (2, 3e-8), "cool": (2, 4e-6), "plate": (2, 1e-8), "turn": (8, 2e-5), "rate": (1, 6e3)}
FREE, NOISE = 1e-2, 4e-5


class Script:
    """An engineer's model, fitted to the rows: numbers of the data sheet that may be wrong, all with priors."""

    def __init__(self, full: bool, joints: Array, told: Array, seen: Array) -> None:
        self.full, start = full, 0
        self.parts: dict[str, slice] = {}
        sizes = []
        for name, (count, size) in {**PLAIN, **(FULL if full else {})}.items():
            self.parts[name], start = slice(start, start + count), start + count
            sizes += [size or FREE] * count
        self.sizes, at = np.array(sizes), drawn(joints)
        place = at[0] + at[1].apply(POINT)
        self.turn, _ = Rotation.align_vectors(seen - seen.mean(0), place - place.mean(0))
        self.stand = seen.mean(0) - self.turn.apply(place.mean(0))
        weight = np.where(self.sizes == FREE, 0.1, 1.0)

        def residuals(u: Array) -> Array:
            return np.r_[(self.place(u * self.sizes, joints, told) - seen).ravel() / NOISE, weight * u]

        found = least_squares(residuals, np.zeros(len(sizes)), x_scale="jac")
        self.x, self.left = found.x * self.sizes, -found.fun[: seen.size].reshape(-1, 3) * NOISE

    def flange(self, x: Array, joints: Array, told: Array) -> tuple[Array, Rotation]:
        """The flange in the robot's base, `s x 3` [m], and its frame."""
        n = {name: x[part] for name, part in self.parts.items()}
        load, count, q = told[:, 8], len(joints), joints + np.r_[0, n["zero"], 0]
        q = q + n["wave"][:4] * np.sin(RATIO * joints) + n["wave"][4:] * np.cos(RATIO * joints)
        a1, l2, l3, a4 = np.array([A1, L2, L3, A4]) + n["long"]
        lever, length = spring_lever(joints[:, 1])
        push = n["spring"] + (n["rate"] * (length - 0.5) if self.full else 0)
        pull = -G * np.cos(q[:, 1]) * L2 * (MASS[0] / 2 + MASS[1:].sum() + load) + lever * push
        lift = -G * np.cos(q[:, 2]) * (MASS[1] * C3 + (MASS[3] + load) * L3)
        flank = -told[:, 4:8]
        if self.full:
            torque = np.stack([0 * load, pull, lift, 0 * load], -1)
            flank = np.tanh((torque - 90 * told[:, 4:8]) / 40)
            for k, angle in ((0, 1), (2, 1), (1, 2), (3, 2)):
                wave = (np.sin, np.cos)[k // 2]((1 + k % 2) * joints)
                q = q + np.where(np.arange(4) == 1, n["turn"][k], 0) * wave * (angle > 0)
                q = q + np.where(np.arange(4) == 2, n["turn"][k + 4], 0) * wave
        q = q + n["gap"] / 2 * flank
        warm = told[:, :4] - 20
        l2, l3 = l2 * (1 + n["grow"][1] * warm[:, 1]), l3 * (1 + n["grow"][2] * warm[:, 3])
        column = 1 + n["grow"][0] * warm[:, 0]
        q2, q3 = q[:, 1] + n["soft"][0] * pull, q[:, 2] + n["soft"][1] * lift
        tilt = n["tilt"] + 0 * load
        arm = l2 * np.exp(1j * q2)
        if self.full:
            # Rods as much longer than the arms beside them as found, growing as the arms grow less than these.
            b, rods = n["bars"], n["cool"]
            q3 = q3 + n["stretch"][0] * lift / (CRANK * np.sin(q2 - q3)) ** 2
            aim, tip = np.exp(1j * q3), G * (MASS[3] * CW + load * A4) / LEVEL * n["stretch"][1]
            rod = L2 + n["long"][1] + b[1] + L2 * rods[0] * warm[:, 1]
            q3 = q3 + swung(arm, CRANK + b[0], -CRANK * aim, rod, -aim)
            rise = L2 + n["long"][1] + b[2] + L2 * rods[0] * warm[:, 1] + tip / np.sin(q2)
            first = swung(arm, LEVEL + b[3], -LEVEL + 0 * arm, rise, -1 + 0 * arm)
            hook = arm + (LEVEL + b[4]) * np.exp(1j * (np.pi / 2 + first + n["tilt"]))
            along = L3 + n["long"][2] + b[5] + L3 * rods[1] * warm[:, 3] + tip / np.cos(q3)
            tilt = swung(arm + l3 * np.exp(1j * q3), LEVEL, hook, along, 1j + 0 * arm) + b[6]
        reach = l3 * np.exp(1j * q3)
        base = turned(0, 0, q[:, 0], count)
        at = base.apply(np.stack([a1 * column, 0 * load, D1 * column], -1))
        plane = base * turned(n["lean"][0], 0, n["lean"][1], count)
        at = at + plane.apply(carried(arm))
        leans = (n["lean"][2] + 1j * n["lean"][3]) * np.exp(1j * q2)
        plane = plane * turned(leans.real, 0, leans.imag, count)
        at = at + plane.apply(carried(reach))
        plane = plane * turned(n["lean"][4], -tilt, 0, count)
        at = at + plane.apply(np.tile([a4[0] if np.ndim(a4) else a4, 0, -D4], (count, 1)))
        frame = plane * turned(n["lean"][5], 0, 0, count) * turned(0, 0, q[:, 3], count)
        if self.full:
            far = (MASS[1:].sum() + load) * (a1 + arm.real) + (MASS[3] + load) * reach.real
            moment = n["plate"] * G * far[:, None] * np.stack([-np.sin(q[:, 0]), np.cos(q[:, 0])], -1)
            tip_over = turned(*moment.T, 0.0, count)
            at, frame = tip_over.apply(at), tip_over * frame
        return at, frame

    def place(self, x: Array, joints: Array, told: Array) -> Array:
        """The reflector as the tracker sees it, `s x 3` [m]."""
        at, frame = self.flange(x, joints, told)
        return self.stood(x, at + frame.apply(POINT + x[self.parts["tool"]]))

    def stood(self, x: Array, at: Array) -> Array:
        """Places in the robot's base as the tracker sees them."""
        b = x[self.parts["base"]]
        return np.asarray(self.turn.apply(Rotation.from_rotvec(b[:3]).apply(at) + b[3:]) + self.stand)

    def commands(self, wanted: Array, told: Array, more: Array | float = 0.0) -> Array:
        """Joints at which the model has the places of the drawing, and its turn about the vertical, `s x 4` [rad]."""
        at, frame = drawn(wanted)
        goal = self.stood(self.x, at + frame.apply(POINT + self.x[self.parts["tool"]])) - more
        aim = wanted[:, 0] + wanted[:, 3]
        joints = wanted.copy()
        for _ in range(4):
            here = self.place(self.x, joints, told)
            steps = [(self.place(self.x, joints + step, told) - here) / 1e-7 for step in 1e-7 * np.eye(4)]
            slope = np.concatenate([np.stack(steps, -1), np.tile([1.0, 0, 0, 1], (len(joints), 1, 1))], 1)
            lack = np.c_[goal - here, aim - joints[:, 0] - joints[:, 3]]
            joints = joints + np.linalg.solve(slope, lack[..., None])[..., 0]
        return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints, temperature and payload, `s x 3`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(6, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    rows, new = (np.c_[q, t[:, 1] / 10, t[:, 8] / 60] for q, t in ((joints, told), (wanted, then)))
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, seen: Array) -> tuple[str, Array]:
    """Header and rows of a file; `seen` has no columns where nothing was measured."""
    names = [f"q{k}[deg]" for k in (1, 2, 3, 4)] + [f"temperature_motor{k}[degC]" for k in (1, 2, 3, 4)]
    names += [f"direction{k}[1]" for k in (1, 2, 3, 4)] + ["payload[kg]", "x[mm]", "y[mm]", "z[mm]"]
    return ",".join(names[: 13 + seen.shape[1]]), np.c_[np.degrees(joints), told, 1e3 * seen]


def judged(seed: int, rows: int, without: tuple[str, ...], names: list[str], kept: Path | None) -> dict[str, tuple]:
    """Root mean square and maximum of what one machine misses [m], by who calibrated it."""
    robot, rng = Robot(seed, without), np.random.default_rng([seed, 1])
    joints, told, inside = day(robot, rows, rng)
    seen = robot.measured(joints, told, inside, rng)
    wanted, then, warm = day(robot, NEW, rng)
    sent = {"as drawn": wanted}
    for full, who in ((False, "plain script"), (True, "fuller script")):
        script = Script(full, joints, told, seen)
        sent[who] = script.commands(wanted, then)
        more = by_process(joints, told, script.left, wanted, then)
        sent[f"{who} and process"] = script.commands(wanted, then, more)
        print(f"  {who}: leaves {1e6 * np.sqrt((script.left**2).sum(1).mean()):.0f} um", file=sys.stderr)
    text = (Path(__file__).parent / "palletizer_arm.py").read_text()
    for name in names:
        own = "instrument" not in OURS[name]
        fitted = script.turn.inv().apply(seen - script.stand) if own else seen
        records, targets = table(joints, told, fitted), table(wanted, then, np.empty((NEW, 0)))
        with TemporaryDirectory() as folder:
            place = Path(folder) if kept is None else kept / f"{seed}_{name}".replace(", ", "_").replace(" ", "_")
            place.mkdir(parents=True, exist_ok=True)
            file = "palletizer_arm.py"
            found = commanded(place, text, records, targets, "run", OURS[name], file, "--allow-code")
        sent[f"ours, {name}"] = np.full_like(wanted, np.nan) if found is None else found
    none = np.full((NEW, 3), np.nan)
    went = {who: none if np.isnan(q).any() else robot.reached(q, then, warm) for who, q in sent.items()}
    return {who: missed(wanted, places) for who, places in went.items()}


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--rows", type=int, default=80)
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[])
    options.add_argument("--ours", nargs="*", choices=list(OURS), default=list(OURS))
    options.add_argument("--keep", type=Path)
    asked = options.parse_args()
    for number in range(asked.seed, asked.seed + asked.machines):
        result = judged(number, asked.rows, tuple(asked.without), asked.ours, asked.keep)
        print(f"{number} [µm]: " + "   ".join(f"{w} {1e6 * a:.1f} ({1e6 * b:.0f})" for w, (a, b) in result.items()))
