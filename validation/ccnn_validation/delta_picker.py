"""A rotary delta robot of a packing line, calibrated in a day with a laser tracker, judged on another day.

`python -m ccnn_validation.delta_picker --seed N [--machines N] [--rows N]`. A reflector sits where the gripper does,
60 mm below the platform; beside x, y, z stand the payload, the temperature of the plate, and each motor's direction of
approach. The true machine has six rods of carbon (Vischer and Clavel 1998, "model 54"): motors, arms and ball joints
beside the drawing, rods of a pair that differ (80 µm) and are not parallel (60 µm), so that the platform turns;
gearboxes (planetary, 28:1, as catalogues have them: an arcminute of play, 0.5 arcminutes of eccentricity, 15 kN m/rad)
whose play the weight holds on one flank, arms that bend, and a plate and a platform of aluminium that grow from a cold
morning on. Sizes are those of a picker of 3 kg (as ABB IRB 360). Ours (`ccnn run` and `ccnn identify` with the
mechanism `delta`, by the written file) stands beside a SciPy fit of three legs, zeros, two harmonics of each gear,
springs, play and growth, alone and with scikit-learn's Gaussian process on what it leaves. Judged is the reflector at
other places with other payloads, in the frame that suits what is reached best.
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
# Radius of the motors' axes, arm, radius of the platform's joints, rod, distance of a pair's rods [m].
BASE, ARM, PLATFORM, ROD, APART = 0.2, 0.35, 0.06, 0.8, 0.1
TURNS = np.radians([0.0, 120.0, 240.0])
# Masses of platform with gripper, of an arm and of a rod [kg], place of an arm's own along it [m].
PLATE, CRANK, CARBON, MIDDLE = 1.2, 1.4, 0.12, 0.13
RATIO, TEETH, GROWTH, G = 28, 84, 23e-6, 9.81
# Of a measured coordinate [m] and of a motor's stop [rad]; places judged; the reflector below the platform [m].
NOISE, STOP, NEW = 7e-6, 12e-6, 300
NEST = np.array([0.0, 0.0, -0.06])
MOST = 3.0
WAYS = {"ours, run": "run", "ours, identify": "identify"}
CONFIG = """mechanism: framed
mechanism_keys: {mechanism: delta, keys: {base: 0.2, crank: 0.35, platform: 0.06, rod: 0.8}}
"""


def leg_axes(turns: Array) -> tuple[Array, Array]:
    """Outward and along the motor's axis, for each leg, `3 x 3`."""
    c, s, o = np.cos(turns), np.sin(turns), np.zeros(3)
    return np.stack([c, s, o], -1), np.stack([-s, c, o], -1)


OUT, ACROSS = leg_axes(TURNS)
UP = np.array([0, 0, 1.0])
SIDE = np.array([0.5, -0.5])


def arm_axes(joints: Array) -> tuple[Array, Array]:
    """Along an arm and where its end moves with its angle, in the machine's frame, `s x 3 x 3`."""
    c, s = np.cos(joints)[..., None], np.sin(joints)[..., None]
    return c * OUT - s * UP, -s * OUT - c * UP


def joints_of(place: Array, x: Array | None = None, plate: Array | float = 1.0) -> Array:
    """Angles of the arms at which three rods hold the platform's middle, `s x 3`; as drawn, or by the script's numbers.

    Args:
        place: `s x 3` [m].
        x: rows of radius, height, azimuth, arm and rod of each leg beside the drawing, `5 x 3`.
        plate: by how much plate and platform have grown, `s x 1`.
    """
    radius, height, turn, arm, rod = np.zeros((5, 3)) if x is None else x
    out, across = leg_axes(TURNS + turn)
    along = place @ out.T - (BASE - PLATFORM + radius) * plate
    beside, below = place @ across.T, height - place[:, 2:]
    reach = (ROD + rod) ** 2 - beside**2
    # Rods meet arms where along cos q + below sin q is this:
    meet = (along**2 + below**2 + (ARM + arm) ** 2 - reach) / (2 * (ARM + arm))
    return np.asarray(np.arctan2(below, along) - np.arccos(meet / np.hypot(along, below)))


def place_of(joints: Array, x: Array, plate: Array | float = 1.0) -> Array:
    """Platform's middle below three balls of the rods' lengths, `s x 3` [m]; arguments as in `joints_of`."""
    radius, height, turn, arm, rod = x
    out, _ = leg_axes(TURNS + turn)
    far = (BASE - PLATFORM + radius) * plate + (ARM + arm) * np.cos(joints)
    balls = far[..., None] * out + (height - (ARM + arm) * np.sin(joints))[..., None] * UP
    first, to_second, to_third = balls[:, 0], balls[:, 1] - balls[:, 0], balls[:, 2] - balls[:, 0]
    wide = np.linalg.norm(to_second, axis=-1, keepdims=True)
    ex = to_second / wide
    share = (ex * to_third).sum(-1, keepdims=True)
    ey = to_third - share * ex
    deep = np.linalg.norm(ey, axis=-1, keepdims=True)
    ey, r = ey / deep, (ROD + rod) ** 2
    a = (r[0] - r[1] + wide**2) / (2 * wide)
    b = (r[0] - r[2] + share**2 + deep**2 - 2 * share * a) / (2 * deep)
    return np.asarray(first + a * ex + b * ey - np.sqrt(r[0] - a**2 - b**2) * np.cross(ex, ey))


def elbow_forces(joints: Array, place: Array, payload: Array, masses: Array) -> Array:
    """Force of rods on the end of each arm as drawn, `s x 3 x 3` [N].

    Args:
        joints, place, payload: of the rows.
        masses: of platform, arm and rod [kg].
    """
    along, _ = arm_axes(joints)
    elbow = BASE * OUT + ARM * along
    rod = place[:, None] + PLATFORM * OUT - elbow
    rod = np.repeat(rod / np.linalg.norm(rod, axis=-1, keepdims=True), 2, axis=1)
    held = (PLATFORM * OUT[:, None] + APART * SIDE[:, None] * ACROSS[:, None]).reshape(6, 3)
    pulls = np.concatenate([rod, np.cross(held, rod)], -1).swapaxes(-1, -2)
    weight = np.zeros((len(place), 6, 1))
    weight[:, 2, 0] = -G * (masses[0] + payload + 3 * masses[2])
    force = np.linalg.solve(pulls, weight) * rod
    return np.asarray(force.reshape(-1, 3, 2, 3).sum(2) - G * masses[2] * UP)


def torques(joints: Array, place: Array, payload: Array, masses: Array) -> Array:
    """Of all weight on each gear, positive where it turns the arm downwards, `s x 3` [N m]."""
    _, moves = arm_axes(joints)
    force = elbow_forces(joints, place, payload, masses)
    return np.asarray(ARM * (moves * force).sum(-1) - G * masses[1] * MIDDLE * moves[..., 2])


MASSES = np.array([PLATE, CRANK, CARBON])


class Picker:
    """The true machine: its controller knows the drawing alone."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.radius, self.height = BASE + rng.normal(0, 1.5e-4, 3), rng.normal(0, 1.0e-4, 3)
        # Of a motor's axis about the vertical and about the outward direction; a stop for the zero.
        self.azimuth, self.lean, self.zero = rng.normal(0, [[5e-4], [4e-4], [2e-3]], (3, 3))
        self.arm, self.rods = ARM + rng.normal(0, 1e-4, 3), ROD + rng.normal(0, 8e-5, (3, 2))
        self.balls, self.sockets = rng.normal(0, 6e-5, (2, 3, 2, 3))
        self.masses = MASSES * rng.normal(1, 0.05, 3)
        self.wave = rng.uniform([7e-5, 3e-5, 5e-6], [1.8e-4, 7e-5, 2e-5], (3, 3))
        self.phase = rng.uniform(0, 2 * np.pi, (3, 3))
        self.twist, self.play = rng.uniform(5e-5, 8.5e-5, 3), rng.uniform(1.5e-4, 3e-4, 3)
        # Friction of a gear [N m], how sharply play ends [N m], what friction winds up [rad].
        self.friction, self.soft, self.wind = rng.uniform(0.8, 2.5, 3), 1.5, rng.uniform(1e-5, 4e-5, 3)
        self.bend = rng.uniform(0.8e-6, 1.4e-6, (2, 3))
        self.nest = NEST + rng.normal(0, 1e-3, 3)
        lean, turn = rng.normal(0, [2e-3, 2e-3, 0]), rng.uniform(-3, 3)
        self.turn, self.stand = Rotation.from_euler("z", turn) * Rotation.from_rotvec(lean), rng.normal(0, 1.5, 3)

    def angles(self, command: Array, torque: Array, direction: Array) -> Array:
        """Of the arms at their gears, `s x 3` [rad]."""
        periods = np.array([1, RATIO, TEETH])
        waves = (self.wave * np.sin(command[..., None] * periods + self.phase)).sum(-1)
        flank = self.play / 2 * np.tanh((torque - direction * self.friction) / self.soft)
        return np.asarray(command + self.zero + waves + self.twist * torque + flank - self.wind * direction)

    def ends(self, angles: Array, force: Array, warmth: Array) -> Array:
        """Ball joints at the ends of the arms, `s x 3 x 2 x 3` [m]."""
        along, moves = arm_axes(angles)
        grown = (1 + GROWTH * (warmth - 20))[:, None, None, None]
        drop, aside = self.bend[0] * (force * moves).sum(-1), self.bend[1] * (force * ACROSS).sum(-1)
        # A cantilever's end turns by 3/2 of its shift over its length.
        swing = (1.5 * aside / self.arm)[..., None]
        joint = self.balls + SIDE[:, None] * np.array([0, APART, 0])
        a, b, c = (joint[..., k] for k in range(3))
        shift = (self.arm[:, None] + a - swing * b)[..., None] * along[:, :, None]
        shift = shift + (b + aside[..., None] + swing * a)[..., None] * ACROSS[:, None]
        shift = shift + (c + drop[..., None])[..., None] * moves[:, :, None]
        tilts = [
            Rotation.from_rotvec(turn * UP) * Rotation.from_rotvec(lean * out)
            for turn, lean, out in zip(self.azimuth, self.lean, OUT, strict=True)
        ]
        tilted = np.stack([turn.apply(shift[:, k].reshape(-1, 3)).reshape(-1, 2, 3) for k, turn in enumerate(tilts)], 1)
        foot = Rotation.from_rotvec(self.azimuth[:, None] * UP).apply(OUT) * self.radius[:, None]
        return np.asarray((foot[:, None] * grown) + self.height[:, None, None] * UP + tilted)

    def reached(self, command: Array, told: Array, near: Array) -> Array:
        """The reflector in the machine's frame, `s x 3` [m]: six rods are closed by Newton's method.

        Args:
            command: `s x 3` [rad].
            told: payload [kg], temperature of the plate [deg C] and directions of approach, `s x 5`.
            near: middle of the platform as it was wanted, `s x 3`.
        """
        payload, warmth, direction = told[:, 0], told[:, 1], told[:, 2:]
        force = elbow_forces(command, near, payload, self.masses)
        angles = self.angles(command, torques(command, near, payload, self.masses), direction)
        ends = self.ends(angles, force, warmth).reshape(-1, 6, 3)
        sockets = PLATFORM * OUT[:, None] + APART * SIDE[:, None] * ACROSS[:, None] + self.sockets
        held = sockets.reshape(6, 3) * (1 + GROWTH * (warmth - 20))[:, None, None]
        place, turn = near.copy(), Rotation.from_rotvec(np.zeros_like(near))
        for _ in range(12):
            arm = np.einsum("sij,skj->ski", turn.as_matrix(), held)
            rod = place[:, None] + arm - ends
            length = np.linalg.norm(rod, axis=-1)
            rod = rod / length[..., None]
            jacobian = np.concatenate([rod, np.cross(arm, rod)], -1)
            step = np.linalg.solve(jacobian, (self.rods.ravel() - length)[..., None])[..., 0]
            place, turn = place + step[:, :3], Rotation.from_rotvec(step[:, 3:]) * turn
        assert np.abs(step).max() < 1e-12
        return np.asarray(place + turn.apply(self.nest))

    def measured(self, command: Array, told: Array, near: Array, rng: np.random.Generator) -> Array:
        """The reflector in the tracker's frame, which is level, `s x 3` [m]."""
        stopped = command + rng.normal(0, STOP, command.shape)
        # Of the plate's temperature that one thermometer does not show.
        really = told + rng.normal(0, [0, 0.15, 0, 0, 0], told.shape)
        seen = self.turn.apply(self.reached(stopped, really, near)) + self.stand
        return np.asarray(seen + rng.normal(0, NOISE, seen.shape))


def day(rows: int, rng: np.random.Generator, payloads: Array | None) -> tuple[Array, Array]:
    """Places wanted of the platform, `s x 3`, and payload, temperature and directions of a shift, `s x 5`."""
    far, turn = 0.3 * np.sqrt(rng.uniform(0, 1, rows)), rng.uniform(0, 2 * np.pi, rows)
    place = np.stack([far * np.cos(turn), far * np.sin(turn), rng.uniform(-0.95, -0.75, rows)], -1)
    hours = np.linspace(0, 7, rows)
    warmth = 15 + rng.normal(0, 1.0) + rng.uniform(7, 10) * (1 - np.exp(-hours / 2.5)) + 0.3 * np.sin(5 * hours)
    payload = rng.uniform(0, MOST, rows) if payloads is None else np.sort(rng.choice(payloads, rows))
    joints = joints_of(place)
    directions = np.sign(np.diff(joints, axis=0, prepend=np.zeros((1, 3))))
    return place, np.c_[payload[rng.permutation(rows)] if payloads is None else payload, warmth, directions]


def missed(wanted: Array, reached: Array) -> float:
    """Root mean square of a miss [m] in the best frame."""
    a, b = wanted - wanted.mean(0), reached - reached.mean(0)
    turn, _ = Rotation.align_vectors(a, b)
    return float(np.sqrt(((turn.apply(b) - a) ** 2).sum(-1).mean()))


# Plausible sizes of the plain script's numbers: five of each leg, zeros, sines and cosines, springs, play, growth.
PRIOR = np.r_[
    np.repeat([1.5e-4, 1.5e-4, 5e-4, 1e-4, 1e-4, 2e-3, 1.5e-4, 1.5e-4, 5e-5, 5e-5, 3e-5, 5e-5], 3), 5e-6
]  # fmt: skip
EXPECTED = np.r_[np.zeros(30), np.full(3, 6e-5), np.zeros(3), GROWTH]


def script_plate(x: Array, told: Array) -> Array:
    return np.asarray(1 + x[36] * (told[:, 1:2] - 20))


def script_offsets(x: Array, command: Array, told: Array, place: Array) -> Array:
    """What arms turn beyond their commands, `s x 3` [rad]."""
    zero, *waves, spring, play = x[15:36].reshape(7, 3)
    wave = sum(
        waves[2 * k] * np.sin(n * command) + waves[2 * k + 1] * np.cos(n * command) for k, n in enumerate((1, RATIO))
    )
    return np.asarray(zero + wave + spring * torques(command, place, told[:, 0], MASSES) - play * told[:, 2:])


def script_fit(command: Array, told: Array, plan: Array, seen: Array) -> tuple[Array, Array]:
    """Numbers of the plain script by robust least squares, and what it leaves in the machine's frame, `s x 3` [m]."""
    turn, _ = Rotation.align_vectors(plan - plan.mean(0), seen - seen.mean(0))
    shift = plan.mean(0) - turn.apply(seen.mean(0))

    def left(u: Array) -> Array:
        x, frame = EXPECTED + u[:37] * PRIOR, u[37:] * 1e-3
        there = (Rotation.from_rotvec(frame[:3]) * turn).apply(seen) + shift + frame[3:]
        angles = command + script_offsets(x, command, told, plan)
        return np.asarray(there - place_of(angles, x[:15].reshape(5, 3), script_plate(x, told)))

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[left(u).ravel() / 2e-5, u[:37], 0.01 * u[37:]])

    found = least_squares(residuals, np.zeros(43), loss="soft_l1", f_scale=3.0)
    return EXPECTED + found.x[:37] * PRIOR, left(found.x)


def script_commands(x: Array, place: Array, told: Array) -> Array:
    angles = joints_of(place, x[:15].reshape(5, 3), script_plate(x, told))
    command = angles
    for _ in range(8):
        command = angles - script_offsets(x, command, told, place)
    return command


def inputs(command: Array, told: Array) -> Array:
    return np.asarray(np.c_[(command - 0.4) / 0.5, told[:, 0] / MOST, (told[:, 1] - 20) / 3, told[:, 2:]])


def process(command: Array, told: Array, left: Array) -> list[GaussianProcessRegressor]:
    """Scikit-learn: what is left of each coordinate, over joints and what is told."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(8, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    return [make(kernel, normalize_y=True, random_state=0).fit(inputs(command, told), each) for each in left.T]


def table(command: Array, told: Array, seen: Array | None = None) -> tuple[str, Array]:
    """Header and rows of a file in rad, kg, deg C and mm."""
    names = ["q1[rad]", "q2[rad]", "q3[rad]", "payload[kg]", "temperature[degC]"]
    names += [f"direction{k}[1]" for k in (1, 2, 3)]
    columns = [command, told]
    if seen is not None:
        names, columns = [*names, "x[mm]", "y[mm]", "z[mm]"], [*columns, 1e3 * seen]
    return ",".join(names), np.concatenate(columns, 1)


def drawn(seed: int, rows: int) -> tuple[Picker, tuple[Array, Array, Array, Array], Array, Array]:
    """The machine; commands, what is told, plan and measured places of the first day; plan and told of the other."""
    machine, rng = Picker(seed), np.random.default_rng([seed, 1])
    plan, told = day(rows, rng, np.array([0.0, 1.5, MOST]))
    command = joints_of(plan)
    seen = machine.measured(command, told, plan, rng)
    return machine, (command, told, plan, seen), *day(NEW, rng, None)


def judged(seed: int, rows: int) -> dict[str, float]:
    """Root mean square of what one machine misses [m], by who calibrated it; NaN where there were no commands."""
    machine, (command, told, plan, seen), wanted, then = drawn(seed, rows)
    numbers, left = script_fit(command, told, plan, seen)
    sent = {"as drawn": joints_of(wanted), "plain script": script_commands(numbers, wanted, then)}
    fits = process(command, told, left)
    more = np.stack([fit.predict(inputs(sent["plain script"], then)) for fit in fits], -1)
    sent["script and process"] = script_commands(numbers, wanted - more, then)
    with TemporaryDirectory() as folder:
        files = table(command, told, seen), table(joints_of(wanted), then)
        for name, way in WAYS.items():
            (Path(folder) / way).mkdir()
            commands = commanded(Path(folder) / way, "", *files, way, CONFIG)
            sent[name] = np.full((NEW, 3), np.nan) if commands is None else commands
    found = {}
    for who, joints in sent.items():
        lost = np.isnan(joints).any()
        found[who] = np.nan if lost else missed(wanted + machine.nest, machine.reached(joints, then, wanted))
    return found


if __name__ == "__main__":
    judge_machines(__doc__, judged, 150)
