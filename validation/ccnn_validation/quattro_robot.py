"""A four-legged picker (Par4, Adept Quattro) as built: eight rods of their own, an elastic closure, a geared plate.

The plate is a parallelogram: half A carries legs 1 and 2, half B legs 3 and 4, bars join them and turn by theta. The
flange sits in the middle of a bar, and a belt makes its turn from that of the bar, `GEAR` times as large.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["AZIMUTH", "BAR", "CRANK", "GEAR", "MOTOR", "PLATE", "POINT", "RADIUS", "ROD", "Conditions", "Quattro"]

Array = NDArray[np.float64]
# Of the drawing [m, rad]: axes of the motors, upper arms, rods, plate's ball pairs less half the bar, reflector.
RADIUS, CRANK, ROD, BAR, WIDTH, PIVOTS = 0.275, 0.375, 0.825, 0.05, 0.08, 0.1
AZIMUTH = np.radians([45.0, 135.0, 225.0, 315.0])
PLATE = np.array([[0.07, 0.02, 0], [-0.07, 0.02, 0], [-0.07, -0.02, 0], [0.07, -0.02, 0]])
POINT = np.array([0.06, 0.0, -0.03])
# Turns of the flange for one of the bar, and of a motor for one of its arm.
GEAR, MOTOR, G = 4.0, 33.0, 9.81
# Stiffness of a rod with its balls [N/m]; masses of half a plate, flange, rod, and arm [kg].
ROD_STIFF, HALF, FLANGE, ROD_MASS, ARM_MASS = 2.5e6, 0.9, 0.6, 0.12, 1.1
# Scatter of an arm's stop, of the flange's turn [rad], and of a coordinate that the tracker reads [m].
STOP, TURN, NOISE = 12e-6, 1e-4, 15e-6


def about_z(angle: Array) -> Array:
    """Matrices of turns about z, `s x 3 x 3`."""
    c, s, o = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.moveaxis(np.array([[c, -s, o], [s, c, o], [o, o, o + 1]]), -1, 0)


class Conditions:
    """What acts while rows are measured or places are reached: temperatures, payload, ways of approach."""

    def __init__(self, joints: Array, turn: Array, payload: Array, hours: float, rng: np.random.Generator) -> None:
        """joints, turn: as they are commanded, in order; payload [kg]; hours: how long it takes."""
        time = np.linspace(0, hours, len(joints))
        start, rise = rng.uniform(18, 23), rng.uniform(2, 6)
        self.hall = start + rise * (1 - np.exp(-time / 4)) + 0.4 * np.sin(2 * np.pi * time / 1.3 + rng.uniform(0, 6))
        # The drives warm the base; breaks between lots let it cool.
        duty = 1 - 0.35 * np.sin(2 * np.pi * time / 3 + rng.uniform(0, 6)) ** 2
        self.base = self.hall + rng.uniform(9, 13) * (1 - np.exp(-(time + 0.1) / 0.7)) * duty
        self.payload = payload
        self.way = np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1))
        self.turned = np.sign(np.diff(turn, prepend=turn[0] - 1))
        self.read = np.stack([self.hall, self.base], -1) + rng.normal(0, 0.1, (len(joints), 2))

    def columns(self) -> tuple[str, Array]:
        """What the user records beside joints and places."""
        names = "temperature[degC],temperature_base[degC],load_z[N]," + ",".join(
            f"direction{i}[1]" for i in range(1, 5)
        )
        known = [self.read, -G * self.payload[:, None], self.way, self.turned[:, None]]
        return names + ",direction_phi[1]", np.concatenate(known, 1)


class Quattro:
    """The true machine; its controller knows the drawing alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 90])

        def n(size: float, *shape: int) -> Array:
            return np.asarray(rng.normal(0, size, shape))

        outward = np.stack([np.cos(AZIMUTH), np.sin(AZIMUTH), 0 * AZIMUTH], -1)
        across = np.stack([-outward[:, 1], outward[:, 0], 0 * AZIMUTH], -1)
        self.feet = RADIUS * outward + n(1.5e-4, 4, 3)
        # Columns of a leg: outward, along the motor's axis, up.
        upright = np.stack([outward, across, np.tile([0.0, 0, 1], (4, 1))], -1)
        self.legs = Rotation.from_rotvec(n(6e-4, 4, 3)).as_matrix() @ upright
        side = np.array([-0.5, 0.5])[None, :, None] * WIDTH
        self.elbows = np.array([CRANK, 0, 0]) + side * np.array([0, 1, 0]) + n(1e-4, 4, 1, 3) + n(3e-5, 4, 2, 3)
        self.balls = PLATE[:, None] + side * across[:, None] + n(6e-5, 4, 1, 3) + n(3e-5, 4, 2, 3)
        self.rods = ROD + n(1.2e-4, 4, 1) + n(2.5e-5, 4, 2)
        self.bars, self.spacing, self.tilt = 2 * BAR + n(4e-5, 2), n(4e-5, 1)[0], n(3e-4, 3) * [1, 1, 0]
        self.seat, self.lean, self.point = n(1e-4, 3), n(5e-4, 2), POINT + n(3e-4, 3)
        self.zero, self.wind = n(1.5e-3, 4), rng.uniform(2e-5, 6e-5, 4)
        self.soft = rng.uniform(4e-5, 9e-5, 4)
        self.ripple = np.array([rng.uniform(5e-5, 1.5e-4, 4), rng.uniform(1e-5, 5e-5, 4), rng.uniform(2e-5, 1e-4, 4)])
        self.phase = rng.uniform(0, 2 * np.pi, (5, 4))
        self.geared, self.index, self.play = GEAR * (1 + n(8e-4, 1)[0]), n(3e-3, 1)[0], rng.uniform(1e-3, 3e-3)
        self.belt = np.array([rng.uniform(3e-4, 1e-3), rng.uniform(1e-4, 3e-4), rng.uniform(5e-5, 2e-4)])
        # Growth of base, arms, rods [1/K], of the portal that it hangs from [m/K], of the motors' seats [rad/K].
        self.grow = np.array([2.2e-5, 6e-6, 2e-6]) * rng.uniform(0.85, 1.15, 3)
        self.portal, self.seats = 1.2e-5 * rng.uniform(0.8, 1.6), n(8e-6, 4)
        # Where the payload's weight acts below the flange, as grippers hold it.
        self.hangs = np.array([0.0, 0.0, -0.09]) + n(0.012, 3)
        self.stand, self.place = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * [0.1, 0.1, 3]), n(2.0, 3)

    def drives(self, joints: Array, at: Conditions) -> Array:
        """Angles of the arms without what they give, `s x 4`."""
        moved = joints + self.zero + self.wind / 2 * at.way + self.seats * (at.base - 20)[:, None]
        for wave, size, phase in zip((MOTOR, 2 * MOTOR, 1.0), self.ripple, self.phase, strict=False):
            moved = moved + size * np.sin(wave * joints + phase)
        return np.asarray(moved)

    def bodies(self, x: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Turn and place of half A, of half B, and the middle of the bar, of unknowns `s x 11`."""
        turn, theta = Rotation.from_rotvec(x[:, 3:6]).as_matrix(), x[:, 6]
        # Bars that are not alike, and pivots not as far apart on both halves, turn half B a little against half A.
        yaw = (self.bars[1] - self.bars[0] - self.spacing * np.sin(theta)) / (PIVOTS * np.cos(theta))
        bar = np.stack([-np.sin(theta), np.cos(theta), 0 * theta], -1) * self.bars.mean()
        tilted = Rotation.from_rotvec(self.tilt).as_matrix()
        first = x[:, :3]
        second = first - np.einsum("sij,sj->si", turn, bar)
        middle = (first + second) / 2 + np.einsum("sij,sj->si", turn @ about_z(theta), np.tile(self.seat, (len(x), 1)))
        return turn, first, turn @ about_z(yaw) @ tilted, second, middle

    def flange(self, x: Array, at: Conditions) -> tuple[Array, Array]:
        """Turn and place of the flange, `s x 3 x 3` and `s x 3`."""
        turn, _, _, _, middle = self.bodies(x)
        theta = x[:, 6]
        angle = self.geared * theta + self.index + self.play / 2 * at.turned
        angle = angle + self.belt[0] * np.sin(GEAR * theta + self.phase[3, 0])
        angle = angle + self.belt[1] * np.sin(3 * theta + self.phase[3, 1])
        angle = angle + self.belt[2] * np.sin(24 * GEAR * theta + self.phase[3, 2])
        axis = turn @ about_z(theta) @ Rotation.from_rotvec([*self.lean, 0]).as_matrix()
        return axis @ about_z(angle - theta), middle

    def strains(self, x: Array, drives: Array, at: Conditions) -> tuple[Array, Array]:
        """Of each row: what is strained, roots of energies `s x 12`, and the energy of all weights `s`."""
        turn_a, first, turn_b, second, middle = self.bodies(x)
        hall, base = at.hall - 20, at.base - 20
        arms = (1 + self.grow[1] * (0.7 * hall + 0.3 * base))[:, None, None, None]
        q = (drives + x[:, 7:])[:, :, None]
        own = np.broadcast_to(self.elbows, (len(x), 4, 2, 3)) * arms
        c, s = np.cos(q), np.sin(q)
        turned = [c * own[..., 0] + s * own[..., 2], own[..., 1], c * own[..., 2] - s * own[..., 0]]
        feet = self.feet * (1 + self.grow[0] * base)[:, None, None]
        elbows = feet[:, :, None] + np.einsum("lij,slbj->slbi", self.legs, np.stack(turned, -1))
        half_a = first[:, None, None] + np.einsum("sij,lbj->slbi", turn_a, self.balls[:2])
        half_b = second[:, None, None] + np.einsum("sij,lbj->slbi", turn_b, self.balls[2:])
        balls = np.concatenate([half_a, half_b], 1)
        rods = self.rods * (1 + self.grow[2] * hall)[:, None, None]
        longer = (np.linalg.norm(balls - elbows, axis=-1) - rods).reshape(len(x), 8)
        flange, _ = self.flange(x, at)
        hung = middle[:, 2] + np.einsum("sj,j->s", flange[:, 2], self.hangs)
        weights = HALF * (first[:, 2] + second[:, 2]) + FLANGE * middle[:, 2] + at.payload * hung
        weights = weights + ROD_MASS / 2 * (elbows[..., 2] + balls[..., 2]).sum((1, 2))
        weights = weights + ARM_MASS * 0.45 * elbows[..., 2].mean(2).sum(1)
        strained = np.concatenate([longer * np.sqrt(ROD_STIFF), x[:, 7:] / np.sqrt(self.soft)], 1)
        return strained, G * weights

    def rest(self, joints: Array, at: Conditions) -> Array:
        """Unknowns at rest, `s x 11`: place and turn of half A, turn of the bar, what each arm gives."""
        x = np.zeros((len(joints), 11))
        x[:, 1], x[:, 2] = BAR, -0.85
        drives = self.drives(joints, at)
        for _ in range(25):
            strained, _ = self.strains(x, drives, at)
            slopes, pull = [], []
            for k in range(11):
                step = np.zeros(11)
                step[k] = 1e-6
                up, down = self.strains(x + step, drives, at), self.strains(x - step, drives, at)
                slopes.append((up[0] - down[0]) / 2e-6)
                pull.append((up[1] - down[1]) / 2e-6)
            jacobian = np.stack(slopes, -1)
            across = jacobian.swapaxes(1, 2)
            force = (across @ strained[..., None])[..., 0] + np.stack(pull, -1)
            move = np.linalg.solve(across @ jacobian, -force[..., None])[..., 0]
            x = x + np.clip(move, -0.15, 0.15)
            if np.abs(move).max() < 1e-9:
                return np.asarray(x)
        raise ArithmeticError(f"the closure does not settle: {np.abs(move).max():.1e}")

    def reached(self, joints: Array, at: Conditions) -> tuple[Array, Array]:
        """Reflector in the machine's own frame `s x 3` [m], and how far the flange is turned `s` [rad]."""
        turn, place = self.flange(self.rest(joints, at), at)
        place = place + turn @ self.point
        place[:, 2] -= self.portal * (at.hall - 20)
        return place, np.arctan2(turn[:, 1, 0], turn[:, 0, 0])

    def measured(self, joints: Array, at: Conditions, rng: np.random.Generator) -> Array:
        """As a tracker reads the reflector, in its own frame, `s x 3` [m]."""
        place, phi = self.reached(joints + rng.normal(0, STOP, joints.shape), at)
        scatter = rng.normal(0, TURN, len(joints))
        arm = np.linalg.norm(self.point[:2]) * np.stack([-np.sin(phi), np.cos(phi), 0 * phi], -1)
        seen = self.stand.apply(place + arm * scatter[:, None]) + self.place
        return np.asarray(seen + rng.normal(0, NOISE, place.shape))
