"""A palletizing robot as true as the judge `palletizer.py` makes it, and what its controller and tables know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
# By the drawing [m]: shoulder from the base's axis and up, upper arm, forearm, wrist to flange out and down, crank of
# the forearm, links of the levelling bars, reflector on the flange; ratios; masses [kg]: upper arm, forearm, triangle
# with rods, wrist with gripper; the forearm's centre from the elbow, the wrist's before its pivot [m].
A1, D1, L2, L3, A4, D4, CRANK, LEVEL = 0.26, 0.75, 0.945, 1.025, 0.22, 0.25, 0.3, 0.2
POINT, RATIO, G = np.array([0.2, 0.1, -0.15]), np.array([153.0, 171.0, 185.0, 81.0]), 9.81
MASS, C3, CW, SPRING = np.array([90.0, 60.0, 25.0, 45.0]), 0.35, 0.12, (-0.3 - 0.1j, 0.35)
LOW, HIGH = np.radians([-100.0, 50.0, -50.0, -170.0]), np.radians([100.0, 120.0, 15.0, 170.0])
LOADS, NEW, IRON, ALUMINIUM = np.array([0.0, 60.0]), 400, 11.5e-6, 23e-6
CAUSES = ("lengths", "bars", "zeros", "leans", "sag", "spring", "rods", "base", "gears", "turns", "play", "warmth")


def swung(pivot: Array, link: Array | float, far: Array, rod: Array | float, way: Array) -> Array:
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
        """The reflector, `s x 3` [m]; `told`: motors' temperatures, directions, payload, `s x 9`; `inside`: links."""
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
        about_x, about_y = (self.plate * moment).T
        lean = turned(about_x, about_y, 0.0, count)
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
    """Root mean square and maximum of a miss [m] in the best frame, with the best point on the drawing's flange."""
    at, frame = drawn(joints)
    if np.isnan(reached).any():
        return np.nan, np.nan
    near, _ = Rotation.align_vectors(at - at.mean(0), reached - reached.mean(0))

    def off(x: Array) -> Array:
        moved = Rotation.from_rotvec(x[:3]).apply(near.apply(reached)) + x[3:6]
        return np.asarray((moved - at - frame.apply(POINT + x[6:9])).ravel())

    far = np.linalg.norm(least_squares(off, np.zeros(9), x_scale=1e-3).fun.reshape(-1, 3), axis=1)
    return float(np.sqrt((far**2).mean())), float(far.max())
