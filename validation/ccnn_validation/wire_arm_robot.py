"""A true welding arm of 1.4 m reach, and two draw-wire sensors that look at it; it shares nothing with the library."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = [
    "CENTRES",
    "DRAWN",
    "GEARS",
    "HIGH",
    "HOOK",
    "LOW",
    "Arm",
    "Array",
    "G",
    "Visit",
    "both",
    "chain",
    "session",
    "tip",
    "torque",
    "visited",
]

Array = NDArray[np.float64]
# Of the drawing, a row a joint: a [m], alpha [rad], d [m], theta [rad], lean about y [rad].
DRAWN = np.zeros((6, 5))
DRAWN[:3, 0], DRAWN[[0, 3, 5], 2] = [0.15, 0.60, -0.02], [0.45, 0.64, 0.10]
DRAWN[:, 1] = np.pi / 2 * np.array([-1, 0, -1, 1, -1, 0])
DRAWN[1, 3] = -np.pi / 2
# Where the hook should be on the flange [m]; turns of the motors for one of the joint, as the manual has them.
HOOK = np.array([0.08, 0.0, 0.30])
GEARS = np.array([125.0, 160.0, 125.0, 100.0, 80.0, 50.0])
LOW, HIGH = np.radians([-60, -25, -65, -120, -100, -150]), np.radians([60, 70, 35, 120, 100, 150])
# Centres of mass of what is carried, on the flange, as the sheets of torch, gripper and the third tool have them [m].
CENTRES = {2.0: np.array([0.02, 0.0, 0.14]), 8.0: np.array([0.0, 0.01, 0.10]), 5.0: np.array([0.01, -0.01, 0.12])}
G, COLD = 9.81, 20.0
# What a joint stops to [rad]; where the eyes stand [m], to 5 cm, and how far aside of its axis a wire may leave one.
STOP = 6e-6
EYES, ASIDE = np.array([[1.25, -1.15, 0.15], [1.35, 1.05, 0.25]]), np.radians(60)
FIRST = np.array([0.9, 0.0, 0.8])


def chain(joints: Array, links: Array) -> tuple[Array, Array, Array]:
    """Axes and places of the joints, `s x 6 x 3`, and the flange, `s x 4 x 4`; `links`: `6 x 5`, or of each row."""
    rows = len(joints)
    links = np.broadcast_to(links, (rows, 6, 5))
    turn, place = np.tile(np.eye(3), (rows, 1, 1)), np.zeros((rows, 3))
    axes, places = np.empty((rows, 6, 3)), np.empty((rows, 6, 3))
    for k in range(6):
        a, alpha, d, theta, lean = links[:, k].T
        axes[:, k], places[:, k] = turn[:, :, 2], place
        c, s, ca, sa = np.cos(joints[:, k] + theta), np.sin(joints[:, k] + theta), np.cos(alpha), np.sin(alpha)
        step = np.array([[c, -s * ca, s * sa], [s, c * ca, -c * sa], [np.zeros(rows), sa, ca]])
        place = place + np.einsum("sij,js->si", turn, np.array([a * c, a * s, d]))
        turn = turn @ np.moveaxis(step, -1, 0)
        if np.any(lean):
            turn = turn @ Rotation.from_rotvec(np.outer(lean, [0, 1, 0])).as_matrix()
    flange = np.tile(np.eye(4), (rows, 1, 1))
    flange[:, :3, :3], flange[:, :3, 3] = turn, place
    return axes, places, flange


def tip(flange: Array, point: Array) -> Array:
    """A point on the flange, or one of each row, in the base, `s x 3`."""
    turned = np.einsum("sij,sj->si", flange[:, :3, :3], np.broadcast_to(point, (len(flange), 3)))
    return np.asarray(turned + flange[:, :3, 3])


def torque(axes: Array, places: Array, at: Array, force: Array, joints: int = 6) -> Array:
    """Of a force [N] at a point on the first joints, which carry it, `s x 6` [N m]."""
    lever = at[:, None] - places
    return np.asarray(np.einsum("ski,ski->sk", axes, np.cross(lever, force[:, None])) * (np.arange(6) < joints))


@dataclass
class Visit:
    """Rows as they are known to the user, beside what was read.

    Attributes:
        joints: commanded, `s x 6` [rad].
        direction: of each joint's last motion, `s x 6`.
        mass: what is carried [kg].
        centre: of it on the flange as its sheet has it, `s x 3` [m].
        temperature: that a thermometer on the upper arm shows [degC].
        warmth: that it truly has.
    """

    joints: Array
    direction: Array
    mass: Array
    centre: Array
    temperature: Array
    warmth: Array


class Arm:
    """The true arm and the true wires: the controller knows the drawing alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 77])
        self.links = DRAWN + rng.normal(0, [3e-4, 3e-4, 3e-4, 7e-4, 0], (6, 5))
        self.links[1, 4] = rng.normal(0, 3e-4)
        self.hook = HOOK + rng.normal(0, 1e-3, 3)
        self.offsets = {mass: rng.normal(0, 0.01, 3) for mass in CENTRES}
        # Joints that give [rad/(N m)], and a pedestal that tilts.
        self.give = np.array([2.5, 2.5, 4.0, 20, 25, 35]) * 1e-6 * rng.uniform(0.7, 1.4, 6)
        self.tilt = rng.uniform(1e-7, 4e-7, 2)
        self.mass, self.share = np.array([32.0, 24.0, 6.0]) * rng.uniform(0.9, 1.1, 3), rng.uniform(0.3, 0.5, 3)
        # Once a turn of the joint; once and twice one of its motor, most in the small gears of the wrist.
        self.output = rng.uniform(10e-6, 60e-6, 6)
        self.once = rng.uniform(5e-6, 35e-6, 6) * [1, 1, 1, 2, 2, 2]
        self.twice = rng.uniform(2e-6, 20e-6, 6) * [1, 1, 1, 2, 2, 2]
        self.phase = rng.uniform(0, 2 * np.pi, (3, 6))
        # The whole play, and the torque by which a load holds one flank against friction.
        self.play, self.hold = rng.uniform(20e-6, 60e-6, 6) * [1, 1, 1, 2, 2.5, 2.5], np.array([60, 50, 30, 8, 6, 4])
        self.warm = rng.uniform(0.6, 1.4, 6)
        self.creep = rng.normal(0, 3e-6, 6) * [0.5, 1, 1, 0.7, 0.7, 0]
        self._wires(rng)

    def _wires(self, rng: np.random.Generator) -> None:
        """Two eyes with a rounded rim, whose drums were told a start to half a millimetre."""
        self.eye = EYES + rng.normal(0, 0.05, (2, 3))
        self.axis = FIRST - EYES
        self.axis /= np.linalg.norm(self.axis, axis=-1, keepdims=True)
        self.zero, self.scale = rng.normal(0, 0.5e-3, 2), rng.normal(0, 3e-5, 2)
        self.noise, self.rim, self.pull = rng.uniform(30e-6, 60e-6, 2), rng.uniform(0.3e-3, 0.8e-3, 2), 6.0

    def reached(self, visit: Visit, drawn: Array | None = None) -> Array:
        """The hook in the arm's base at rest, `s x 3` [m]; `drawn`: pull of the wires on it, `s x 3` [N]."""
        heat = (visit.warmth - COLD)[:, None]
        links = np.tile(self.links, (len(heat), 1, 1))
        grown = 1 + np.array([12, 23, 23, 23, 23, 23]) * 1e-6 * self.warm * heat
        links[:, :, 0] *= grown
        links[:, :, 2] *= grown
        joints = visit.joints + self.creep * heat + self.output * np.sin(visit.joints + self.phase[0])
        motor = GEARS * visit.joints
        joints = joints + self.once * np.sin(motor + self.phase[1]) + self.twice * np.sin(2 * motor + self.phase[2])
        axes, places, flange = chain(joints, links)
        down = np.array([0.0, 0.0, -G])
        load = np.zeros_like(joints)
        lean = np.zeros((len(joints), 3))
        # Upper arm, forearm and wrist, each carried by the joints before it.
        spans = (places[:, 1], places[:, 2], 2), (places[:, 2], places[:, 4], 3), (places[:, 4], flange[:, :3, 3], 5)
        parts = [
            (mass, begin + share * (end - begin), count)
            for mass, share, (begin, end, count) in zip(self.mass, self.share, spans, strict=True)
        ]
        carried = tip(flange, visit.centre + np.array([self.offsets[float(m)] for m in visit.mass]))
        for mass, at, count in [*parts, (visit.mass, carried, 6)]:
            weight = np.multiply.outer(np.broadcast_to(mass, len(joints)), down)
            load += torque(axes, places, at, weight, count)
            lean += np.cross(at, weight)
        if drawn is not None:
            load += torque(axes, places, tip(flange, self.hook), drawn)
        # Play: friction holds a joint on the flank of its last motion, unless weight pushes it to the other.
        flank = np.tanh((load / self.hold - visit.direction) * 2)
        joints = joints + self.give * load + self.play / 2 * flank
        tilt = Rotation.from_rotvec(lean * [self.tilt[0], self.tilt[1], 0])
        return np.asarray(tilt.apply(tip(chain(joints, links)[2], self.hook)))

    def seen(self, joints: Array) -> NDArray[np.bool_]:
        """Whether both wires leave their eyes well at these joints, with the hook above the floor's clutter."""
        flange = chain(joints, DRAWN)[2]
        at = tip(flange, HOOK)
        good = (at[:, 2] > 0.15) & (np.hypot(at[:, 0], at[:, 1]) > 0.4) & (flange[:, 2, 3] > 0.15)
        for eye, axis in zip(self.eye, self.axis, strict=True):
            way = at - eye
            long = np.linalg.norm(way, axis=-1)
            good &= (long > 0.3) & (way @ axis > np.cos(ASIDE) * long)
        return good

    def _pull(self, at: Array, hooked: list[int]) -> Array:
        """Pull of the hooked wires, `s x 3` [N]."""
        ways = [self.eye[k] - at for k in hooked]
        return np.asarray(sum(self.pull * way / np.linalg.norm(way, axis=-1, keepdims=True) for way in ways))

    def measured(self, visit: Visit, rng: np.random.Generator, hooked: tuple[int, ...] = (0, 1)) -> Array:
        """What the hooked wires show, all at once, `s x len(hooked)` [m]."""
        at = self._settled(visit, rng, list(hooked))
        shown = []
        for k in hooked:
            way = at - self.eye[k]
            long = np.linalg.norm(way, axis=-1)
            aside = np.arccos(np.clip(way @ self.axis[k] / long, -1, 1))
            # Bent over a rounded rim a wire is shorter than over an edge.
            short = self.rim[k] * (2 * np.tan(aside / 2) - aside)
            shown.append((long - short) * (1 + self.scale[k]) + self.zero[k] + rng.normal(0, self.noise[k], len(at)))
        return np.stack(shown, -1)

    def tracked(self, visit: Visit, rng: np.random.Generator) -> Array:
        """The hook as a tracker with the wires' noise would see it, in a frame laid on the drawing, `s x 3` [m]."""
        at = self._settled(visit, rng, [])
        at = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).apply(at) + rng.normal(0, 2e-3, 3)
        return np.asarray(at + rng.normal(0, self.noise.mean(), at.shape))

    def _settled(self, visit: Visit, rng: np.random.Generator, hooked: list[int]) -> Array:
        stopped = Visit(**{**vars(visit), "joints": visit.joints + rng.normal(0, STOP, visit.joints.shape)})
        if not hooked:
            return self.reached(stopped)
        return self.reached(stopped, self._pull(tip(chain(visit.joints, DRAWN)[2], HOOK), hooked))


def session(arm: Arm, mass: float, rows: int, ends: tuple[float, float], rng: np.random.Generator) -> Visit:
    """Random poses that both wires see, one after the other, while the arm warms from one temperature to another."""
    poses = np.empty((0, 6))
    while len(poses) < rows:
        drawn = rng.uniform(LOW, HIGH, (4 * rows, 6))
        poses = np.concatenate([poses, drawn[arm.seen(drawn)]])
    poses = poses[:rows]
    warmth = ends[1] + (ends[0] - ends[1]) * np.exp(-2.5 * np.arange(rows) / rows)
    return visited(poses, np.full(rows, mass), warmth, rng)


def visited(joints: Array, mass: Array, warmth: Array, rng: np.random.Generator) -> Visit:
    """Joints in their order, from the home position on; a stuck-on thermometer is off by 0.2 K."""
    direction = np.sign(np.diff(joints, axis=0, prepend=np.zeros((1, 6))))
    centre = np.array([CENTRES[float(m)] for m in mass])
    return Visit(joints, direction, mass, centre, warmth + rng.normal(0, 0.2, len(mass)), warmth)


def both(first: Visit, second: Visit) -> Visit:
    """One after the other."""
    return Visit(*(np.concatenate(pair) for pair in zip(vars(first).values(), vars(second).values(), strict=True)))
