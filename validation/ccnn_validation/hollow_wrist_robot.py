"""A painting robot with a hollow wrist as it is built: axes 5 and 6 lean, and shafts in shafts drive them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
# By the data sheet: standard Denavit-Hartenberg [m, deg]; axis 5 leans 60 degrees from 4, and 6 from 5, 110 mm apart.
A, D = np.array([0.25, 0.85, 0.05, 0, 0, 0]), np.array([0.6, 0, 0, 0.95, 0.11, 0.1])
ALPHA, THETA = np.array([-90.0, 0, -90, 60, -60, 0]), np.array([0.0, -90, 0, 0, 0, 0])
# Turns of each motor for one of its own axis alone; turns of an axis' shaft by the axes before it (4, 5, 6).
GEARS = np.array([141.0, 161, 141, 90, 75, 60])
SHAFTS = np.array([[1, 0, 0], [2 / 3, 1, 0], [3 / 7, -4 / 9, 1]])
MASSES = np.array([160.0, 55, 75, 9, 5, 3])
# Centres of mass in the frame at each link's end [m].
CENTRES = np.array([[-0.1, 0.1, 0], [-0.4, 0, 0.05], [0, 0, 0.15], [0, 0.1, -0.15], [0, 0, -0.05], [0, 0, -0.05]])
# Tools: mass [kg], centre of mass and reflector in the flange [m]: light, heavy, and that of the other day.
TOOLS = {0: (3.0, (0, 0, 0.08)), 1: (13.0, (0.02, 0, 0.12)), 2: (8.0, (0.01, -0.01, 0.1))}
POINTS = np.array([[0.05, 0.02, 0.25], [-0.06, 0.03, 0.3], [0.03, -0.05, 0.27]])
LOW, HIGH = np.radians([-60.0, -20, -30, -150, -150, -170]), np.radians([60.0, 45, 40, 150, 150, 170])
G = 9.81
CAUSES = (
    "lengths", "twists", "zeros", "gears", "meshes", "coupling", "weight", "soft_bearing", "backlash", "growth",
    "stand", "tools",
)  # fmt: skip


def frames(joints: Array, a: Array, alpha: Array, d: Array, theta: Array, lean: float = 0.0) -> Array:
    """Frames of base and links, `s x 7 x 4 x 4`; lengths may be of each row; `lean`: of axis 3 against axis 2 [rad]."""
    count = len(joints)
    found = np.tile(np.eye(4), (count, 7, 1, 1))
    a, d = np.broadcast_to(a, joints.shape), np.broadcast_to(d, joints.shape)
    for k in range(6):
        turn, c, s = joints[:, k] + theta[k], np.cos(alpha[k]), np.sin(alpha[k])
        step = np.zeros((count, 4, 4))
        step[:, 0] = np.stack([np.cos(turn), -np.sin(turn) * c, np.sin(turn) * s, a[:, k] * np.cos(turn)], -1)
        step[:, 1] = np.stack([np.sin(turn), np.cos(turn) * c, -np.cos(turn) * s, a[:, k] * np.sin(turn)], -1)
        step[:, 2, 1:], step[:, 3, 3] = np.stack([0 * turn + s, 0 * turn + c, d[:, k]], -1), 1
        if k == 1:
            step[:, :3, :3] = step[:, :3, :3] @ Rotation.from_euler("y", lean).as_matrix()
        found[:, k + 1] = found[:, k] @ step
    return found


def sheet_frames(joints: Array) -> Array:
    """Frames by the data sheet, `s x 7 x 4 x 4`."""
    return frames(joints, A, np.radians(ALPHA), D, np.radians(THETA))


def torques(chain: Array, masses: Array, centres: Array, tool: Array, centre: Array, down: Array) -> Array:
    """What weight turns each joint with [Nm], `s x 6`; `tool`: its mass in each row, and its centre `s x 3`."""
    places = chain[:, 1:, :3, 3] + (chain[:, 1:, :3, :3] @ centres[..., None])[..., 0]
    places = np.concatenate(
        [places, (chain[:, 6, :3, 3] + (chain[:, 6, :3, :3] @ centre[..., None])[..., 0])[:, None]], 1
    )
    weights = np.c_[np.tile(masses, (len(chain), 1)), tool]
    found = np.zeros((len(chain), 6))
    for k in range(6):
        arm = np.cross(places[:, k:] - chain[:, None, k, :3, 3], G * down)
        found[:, k] = ((arm * weights[:, k:, None]).sum(1) * chain[:, k, :3, 2]).sum(-1)
    return found


class Robot:
    """The true machine; its controller knows the data sheet alone. `without`: the causes that are switched off."""

    def __init__(self, seed: int, without: tuple[str, ...] = ()) -> None:
        rng = np.random.default_rng([seed, 7])
        on = {cause: float(cause not in without) for cause in CAUSES}

        def size(low: float, high: float, *shape: int) -> Array:
            return np.asarray(rng.uniform(low, high, shape) * rng.choice([-1, 1], shape))

        self.a, self.d = A + on["lengths"] * size(5e-5, 5e-4, 6), D + on["lengths"] * size(5e-5, 5e-4, 6)
        self.alpha = np.radians(ALPHA) + on["twists"] * size(5e-5, 4e-4, 6)
        self.lean, self.theta = (
            on["twists"] * float(size(5e-5, 3e-4)),
            np.radians(THETA) + on["zeros"] * size(2e-4, 1.2e-3, 6),
        )
        # Reducers, at each motor's turn and twice: 15 to 40 arcsec from peak to peak, by phases of their own [rad].
        self.once, self.twice = on["gears"] * rng.uniform(3.5e-5, 1e-4, 6), on["gears"] * rng.uniform(1.5e-5, 5e-5, 6)
        # Bevel gears in the wrist, once a turn of the wheel and of its pinion: run-out of 10 to 20 µm on 60 mm.
        self.wheel, self.pinion = (
            on["meshes"] * rng.uniform(8e-5, 1.8e-4, 2),
            on["meshes"] * rng.uniform(5e-5, 1.2e-4, 2),
        )
        self.phase = rng.uniform(0, 2 * np.pi, (4, 6))
        self.shafts = SHAFTS.copy()
        self.shafts[[1, 2, 2], [0, 0, 1]] += on["coupling"] * size(1e-4, 4e-4, 3)
        stiff = np.array([8e5, 1.2e6, 6e5, 9e4, 6e4, 4e4]) * rng.uniform(0.8, 1.25, 6)
        self.soft = on["weight"] / stiff
        # The bearing of axis 4 gives about both axes across it [rad/Nm].
        self.tilt = on["weight"] * on["soft_bearing"] / (9e5 * rng.uniform(0.8, 1.25))
        self.masses = MASSES * rng.uniform(0.94, 1.06, 6)
        self.centres = CENTRES + rng.normal(0, 0.015, (6, 3))
        self.lost = on["backlash"] * np.r_[rng.uniform(5e-5, 1.5e-4, 3), rng.uniform(2e-4, 6e-4, 3)]
        self.holds = np.array([90.0, 110, 70, 9, 7, 5]) * rng.uniform(0.8, 1.25, 6)
        # Cast iron to the shoulder, aluminium behind; warmth of each link by the thermometer's, which sits on the arm.
        self.growth = on["growth"] * np.array([11e-6, 11e-6, 22e-6, 22e-6, 20e-6, 20e-6]) * rng.uniform(0.95, 1.05, 6)
        self.warms = np.array([0.9, 0.7, 1.1, 0.9, 0.7, 0.6]) * rng.uniform(0.85, 1.15, 6)
        self.bends = on["growth"] * size(3e-6, 1.2e-5, 6) * np.array([0.3, 1, 1, 0.5, 0.5, 0.5])
        # Without "tools" one reflector stays beside the flange, whatever is carried.
        self.points = POINTS + rng.normal(0, 5e-4, (3, 3))
        self.points = self.points if on["tools"] else self.points[[0, 0, 0]]
        self.turn = Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)])
        level = Rotation.from_rotvec(rng.normal(0, 7e-4, 3))
        self.turn, self.stand = self.turn * level, np.array([*rng.normal(0, 0.5, 2), 0.2]) + np.array([3.6, 0.8, 0])
        # The foot is not quite plumb.
        self.down = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).apply([0.0, 0, -1])
        self.drift = on["stand"] * size(1.5e-5, 6e-5, 3), on["stand"] * size(4e-6, 1.5e-5, 3)
        self.settles = rng.uniform(3000, 9000)

    def reached(self, joints: Array, kind: Array, warmth: Array, direction: Array) -> Array:
        """The reflector in the robot's base `s x 3` [m].

        Args:
            joints: as the controller has them.
            kind: number of the tool in each row.
            warmth: of the thermometer, beyond 20 deg C.
            direction: of each motor's last turn.
        """
        inverse, motors = np.linalg.inv(self.shafts), joints.copy()
        motors[:, 3:] = joints[:, 3:] @ SHAFTS.T
        own = self.warms * warmth[:, None]
        links = self.a * (1 + self.growth * own), self.alpha, self.d * (1 + self.growth * own), self.theta, self.lean
        mass = np.array([TOOLS[int(k)][0] for k in kind])
        centre = np.array([TOOLS[int(k)][1] for k in kind], dtype=float)
        load, tau, chain = np.zeros_like(joints), np.zeros_like(joints), np.empty(0)
        for _ in range(4):
            turned = motors + self.once * np.sin(GEARS * motors + self.phase[0])
            turned = turned + self.twice * np.sin(2 * GEARS * motors + self.phase[1])
            turned = (
                turned
                + self.soft * load
                + self.lost / 2 * np.tanh((load - self.holds * direction) / (0.3 * self.holds))
            )
            true = turned + self.bends * own
            true[:, 3:] = turned[:, 3:] @ inverse.T + self.bends[3:] * own[:, 3:]
            for k in (0, 1):
                # The pinion turns with its shaft against the link that carries it.
                rolled = motors[:, 4 + k] - motors[:, 3]
                true[:, 4 + k] += self.wheel[k] * np.sin(true[:, 4 + k] + self.phase[2, k])
                true[:, 4 + k] += self.pinion[k] * np.sin(rolled + self.phase[3, k])
            chain = frames(true, *links)
            tau = torques(chain, self.masses, self.centres, mass, centre, self.down)
            # On the shafts: virtual work through the gears that couple them.
            load = tau.copy()
            load[:, 3:] = tau[:, 3:] @ inverse
        point = (chain[:, 6, :3, :3] @ self.points[kind][..., None])[..., 0] + chain[:, 6, :3, 3]
        # The tilt of axis 4's bearing turns all behind it about its place.
        at, axis = chain[:, 3, :3, 3], chain[:, 3, :3, 2]
        weight = np.r_[self.masses[3:], 0] + np.c_[np.zeros((len(mass), 3)), mass]
        places = chain[:, 4:, :3, 3] + (chain[:, 4:, :3, :3] @ self.centres[3:, :, None])[..., 0]
        held = chain[:, 6, :3, 3] + (chain[:, 6, :3, :3] @ centre[..., None])[..., 0]
        places = np.concatenate([places, held[:, None]], 1)
        moment = (np.cross(places - at[:, None], G * self.down) * weight[..., None]).sum(1)
        across = moment - axis * (moment * axis).sum(-1, keepdims=True)
        return np.asarray(point + np.cross(self.tilt * across, point - at))

    def measured(
        self, joints: Array, kind: Array, warmth: Array, direction: Array, time: Array, rng: np.random.Generator
    ) -> Array:
        """As the tracker reads it [m]; the robot stops with scatter, the tracker's noise grows with its distance."""
        stopped = joints + rng.normal(0, [8e-6, 6e-6, 8e-6, 2e-5, 2e-5, 3e-5], joints.shape)
        seen = self.turn.apply(self.reached(stopped, kind, warmth, direction)) + self.stand
        gone = (1 - np.exp(-time / self.settles))[:, None]
        seen = seen + gone * (self.drift[0] + np.cross(self.drift[1], seen))
        far = np.linalg.norm(seen, axis=1, keepdims=True)
        along = seen / far
        noise = rng.normal(0, 1, seen.shape) * (7.5e-6 + 3e-6 * far)
        noise = noise - along * (noise * along).sum(-1, keepdims=True)
        return np.asarray(seen + noise + along * rng.normal(0, 1, far.shape) * (5e-6 + 4e-7 * far))
