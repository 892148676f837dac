"""A motion platform on six rotary cranks with rods (6-RSS), which the package does not ship, under changing payload.

`python -m ccnn_validation.rotary_hexapod --seed N [--machines N] [--rows N]`. A camera reads place and orientation of
a probe on the platform, 20 µm and 50 µrad of noise in each; beside them stand the payload, thermometers on base plate
and rods, and each crank's direction of approach. The true machine: joints, axes and lengths elsewhere, zeros, gears of
50:1 that lose motion, have play, rub under load and run unevenly (once and twice a turn of output and motor), gears and
rods that give under own weight and payload, a base plate and rods that grow, and ball joints with clearance. Ours
(`ccnn run`, by the written file) has the user's own class `rotary_cranks.RotaryHexapod` in `framed`: "ours" without
more, "told" with the drawing's tolerances, "gears" also with the gears' ratio, "loads" also with the payload's force
and moments in the place of its weight. "plain script" has the geometry, zeros and steel's growth; "fuller script" also
the rest. "process" adds scikit-learn's on what is left. Told: RMS / largest miss of place [µm] and turn [µrad] on new
targets in the best frame with the best tool. `--without NAME` of `CAUSES` switches a true error off, `--keep FOLDER`
keeps the files.
"""

from __future__ import annotations

import argparse
import sys
import time as clock
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
Pose = tuple[Array, Array]  # places and frames
# By the drawing: radii of the joints, crank, rod [m], turns of the motor for one of the crank, mass of platform [kg].
BASE, PLATFORM, CRANK, ROD, RATIO, MASS, G = 0.40, 0.30, 0.12, 0.45, 50.0, 30.0, 9.81
PAIR, SIDE = np.radians(120.0 * (np.arange(6) // 2)), np.tile([-1.0, 1.0], 3)
RING = [PAIR + SIDE * np.radians(angle) for angle in (25, 48)]
FEET = BASE * np.stack([np.cos(RING[0]), np.sin(RING[0]), 0 * PAIR], -1)
HEADS = PLATFORM * np.stack([np.cos(RING[1]), np.sin(RING[1]), 0 * PAIR], -1)
LEVEL, UP = np.stack([SIDE * np.sin(PAIR), -SIDE * np.cos(PAIR), 0 * PAIR], -1), np.tile([0.0, 0.0, 1.0], (6, 1))
AXES = np.cross(LEVEL, UP)
PROBE, HOME, STEEL, ALU = np.array([0.10, 0.05, 0.06]), 0.39, 11.5e-6, 23e-6
NOISE, TURN_NOISE, NEW = 20e-6, 50e-6, 300
WEIGHTS = 1 / np.repeat([NOISE, TURN_NOISE], 3)
CAUSES = ["places", "axes", "lengths", "zeros", "lost", "play", "friction", "output", "motor", "gear", "stiffening"]
CAUSES += ["stretch", "load", "warmth", "clearance"]
INNER = "{mechanism: rotary_cranks.py:RotaryHexapod, base: true, tool: true, allow_code: true"
CONFIG = f"mechanism: framed\nmechanism_keys: {INNER}}}\n"
TOLD = CONFIG.replace("allow_code: true", "allow_code: true, keys: {told: true}")
GEARS = CONFIG.replace("allow_code: true", "allow_code: true, keys: {told: true, gears: [50, 50, 50, 50, 50, 50]}")
OURS = {"ours": (CONFIG, 0), "ours, told": (TOLD, 0), "ours, gears": (GEARS, 0), "ours, loads": (GEARS, 1)}


def turned(vector: Array) -> Array:
    """Matrices of rotation vectors."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def centre(payload: Array) -> Array:
    """Centre of a stack of plates on the platform, in its frame, `s x 3` [m]."""
    return np.stack([0 * payload, 0 * payload, 0.05 + 8e-4 * payload], -1)


def cranks(spoke: Array, level: Array, up: Array, crank: Array, rod: Array) -> Array:
    """Angles of cranks whose joints on the platform are at `spoke` from their axes, `s x 6`."""
    forward, above = (spoke * level).sum(-1), (spoke * up).sum(-1)
    share = ((spoke**2).sum(-1) + crank**2 - rod**2) / (2 * crank * np.hypot(forward, above))
    return np.asarray(np.arctan2(above, forward) - np.arccos(share))


def drawn_joints(at: Array, frame: Array) -> Array:
    """Angles of the cranks by the drawing, `s x 6`."""
    spoke = at[:, None] + HEADS @ frame.swapaxes(1, 2) - FEET
    return cranks(spoke, LEVEL, UP, np.full(6, CRANK), np.full(6, ROD))


class Platform:
    """The true machine; its controller knows the drawing alone. `without`: the causes that are switched off."""

    def __init__(self, seed: int, without: tuple[str, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        on = {cause: float(cause not in without) for cause in CAUSES}

        def size(low: float, high: float, *shape: int) -> Array:
            return np.asarray(rng.uniform(low, high, shape) * rng.choice([-1, 1], shape))

        self.feet = FEET + on["places"] * size(2e-4, 1e-3, 6, 3)
        self.heads = HEADS + on["places"] * size(1e-4, 5e-4, 6, 3)
        lean = turned((LEVEL * size(1e-3, 4e-3, 6, 1) + UP * size(1e-3, 4e-3, 6, 1)) * on["axes"])
        self.level, self.up, self.axes = ((lean @ w[..., None])[..., 0] for w in (LEVEL, UP, AXES))
        self.crank, self.rod = CRANK + on["lengths"] * size(5e-5, 3e-4, 6), ROD + on["lengths"] * size(1e-4, 6e-4, 6)
        self.zeros = on["zeros"] * size(1e-3, 6e-3, 6)
        # Lost motion and play of a gear [rad], friction as a share of the torque.
        self.lost, self.play = on["lost"] * rng.uniform(1.5e-4, 3.5e-4, 6), on["play"] * rng.uniform(1e-4, 2e-4, 6)
        self.friction = on["friction"] * rng.uniform(0.02, 0.06, 6)
        # Uneven gears: once and twice a turn of the crank and of the motor [rad].
        self.rate = np.array([1.0, 2.0, RATIO, 2 * RATIO])[:, None]
        kinds = [on["output"], on["output"], on["motor"], on["motor"]]
        sizes = ((5e-5, 2e-4), (2e-5, 1e-4), (2e-5, 6e-5), (4e-5, 1.2e-4))
        self.wave = np.stack([k * rng.uniform(*s, 6) for k, s in zip(kinds, sizes, strict=True)])
        self.phase = rng.uniform(0, 2 * np.pi, (4, 6))
        # What gears give below and above a torque [N m / rad, N m]; rods with their ball joints [N / m].
        self.soft, self.stiffer, self.knee = rng.uniform(3.5e4, 5e4, 6), rng.uniform(1.25, 1.5, 6), 15.0
        self.stiffer = self.stiffer ** on["stiffening"]
        self.gives, self.rod_gives = on["gear"], on["stretch"] / rng.uniform(2e7, 3e7, 6)
        self.loaded, self.middle = on["load"], np.r_[rng.normal(0, 5e-3, 2), 0.01]
        self.aside = np.r_[rng.normal(0, 4e-3, 2), 0]
        # Growth [1 / K] of base plate about its bolt, rods, cranks, and platform, whose temperature nobody reads.
        self.growth = on["warmth"] * np.array([ALU, STEEL, ALU, STEEL]) * rng.uniform(0.85, 1.15, 4)
        self.bolt = np.r_[rng.uniform(-0.15, 0.15, 2), 0]
        self.clearance = on["clearance"] * rng.uniform(5e-6, 1.5e-5, 6)
        self.point, self.probe = PROBE + rng.normal(0, 5e-4, 3), turned(rng.normal(0, 2e-3, 3))
        self.yaw = rng.uniform(-2.5, 2.5)
        self.turn = turned(np.array([0, 0, self.yaw])) @ turned(rng.normal(0, 5e-4, 3))
        self.stand = rng.normal([2, 1, 1], 0.5)

    def closed(self, ends: Array, heads: Array, rods: Array) -> tuple[Array, Array, Array, Array]:
        """Pose that rods from the cranks' ends hold: place, frame, directions of the rods, and their Jacobian."""
        at, frame = np.tile([0.0, 0.0, HOME], (len(ends), 1)), np.tile(np.eye(3), (len(ends), 1, 1))
        for _ in range(9):
            arms = heads @ frame.swapaxes(1, 2)
            spans = at[:, None] + arms - ends
            lengths = np.linalg.norm(spans, axis=-1)
            ways = spans / lengths[..., None]
            slope = np.concatenate([ways, np.cross(arms, ways)], -1)
            step = np.linalg.solve(slope, (rods - lengths)[..., None])[..., 0]
            at, frame = at + step[:, :3], turned(step[:, 3:]) @ frame
        return at, frame, ways, slope

    def reached(self, joints: Array, told: Array, scatter: Array | float = 0.0) -> Pose:
        """Place and frame of the probe; `told`: temperatures of base and rods, payload [kg], directions, `s x 9`."""
        base, warm, payload, side = told[:, 0] - 20, told[:, 1] - 20, told[:, 2], told[:, 3:]
        waves = self.wave * np.sin(self.rate * joints[:, None] + self.phase)
        angles = joints + self.zeros + waves.sum(1) - side * self.lost / 2
        feet = self.feet + self.growth[0] * base[:, None, None] * (self.feet - self.bolt)
        heads = self.heads * (1 + self.growth[3] * (0.7 * warm)[:, None, None])
        rods = self.rod * (1 + np.outer(warm, [self.growth[1]])) + scatter
        crank = self.crank * (1 + np.outer(0.5 * (base + warm), [self.growth[2]]))
        wound, stretched = np.zeros_like(joints), np.zeros_like(joints)
        for _ in range(5):
            cos, sin = np.cos(angles + wound)[..., None], np.sin(angles + wound)[..., None]
            ends = feet + crank[..., None] * (cos * self.level + sin * self.up)
            at, frame, ways, slope = self.closed(ends, heads, rods + stretched)
            force, lever = np.array([0, 0, -G]), (frame @ self.middle) * MASS
            lever = lever + ((frame @ (centre(payload) + self.aside)[..., None])[..., 0]) * payload[:, None]
            wrench = np.concatenate([(MASS + payload)[:, None] * force, np.cross(lever, force)], -1) * self.loaded
            pull = np.linalg.solve(slope.swapaxes(1, 2), wrench[..., None])[..., 0]
            # Torque of the rods' pull, and of 1.2 kg of crank and rod at its end.
            across = crank[..., None] * (cos * self.up - sin * self.level)
            torque = (ways * across).sum(-1) * pull - 1.2 * G * across[..., 2] * self.loaded
            size = np.abs(torque)
            over = np.clip(size - self.knee, 0, None)
            bent = np.sign(torque) * (size - over + over / self.stiffer) / self.soft * self.gives
            wound = bent - side * self.friction * size / self.soft + self.play / 2 * np.tanh(torque / 3)
            stretched = pull * self.rod_gives + self.clearance * np.tanh(pull / 15)
        return at + frame @ self.point, frame @ self.probe

    def measured(self, joints: Array, told: Array, rng: np.random.Generator) -> Pose:
        """As the camera reads it: place `s x 3` [m], frame; cranks and ball joints rest with some scatter."""
        really = told + np.pad(rng.normal(0, 0.1, (len(told), 2)), ((0, 0), (0, 7)))
        scatter = rng.normal(0, 8e-6, joints.shape), rng.normal(0, 1.5e-6, joints.shape)
        place, frame = self.reached(joints + scatter[0], really, scatter[1])
        place = place @ self.turn.T + self.stand + rng.normal(0, NOISE, place.shape)
        return place, turned(rng.normal(0, TURN_NOISE, place.shape)) @ self.turn @ frame


def day(rows: int, rng: np.random.Generator, ends: Array | None = None) -> tuple[Array, Pose, Array]:
    """Joints, places and frames by the drawing, and what is told; `ends`: temperatures of those measured, `2 x 2`."""
    at = rng.uniform([-0.04, -0.04, HOME - 0.035], [0.04, 0.04, HOME + 0.035], (rows, 3))
    frame = turned(rng.uniform(-0.09, 0.09, (rows, 3)))
    if ends is None:
        rise = 1 - np.exp(-np.outer(np.linspace(0, 1, rows), [3.0, 1.5]))
        temperature = [20.5, 20.2] + rng.uniform([5, 2], [10, 5]) * rise + rng.normal(0, 0.3, (rows, 2))
    else:
        temperature = rng.uniform(ends[0], ends[1], (rows, 2))
    joints = drawn_joints(at, frame)
    direction = np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1))
    return joints, (at, frame), np.c_[temperature, 40.0 * rng.integers(0, 5, rows), direction]


def missed(at: Array, frame: Array, place: Array, turn: Array) -> Array:
    """RMS and largest miss [m, rad] in the best frame with the best tool: place, place, turn, turn."""

    def off(x: Array) -> Array:
        moved, own = turned(x[:3]), turned(x[6:9])
        far = place @ moved.T + x[3:6] - at - frame @ (PROBE + x[9:])
        return np.asarray(np.c_[far, Rotation.from_matrix(moved @ turn @ (frame @ own).swapaxes(1, 2)).as_rotvec()])

    found = off(least_squares(lambda x: (off(x) * WEIGHTS).ravel(), np.zeros(12), x_scale=1e-3).x)
    sizes = [np.linalg.norm(part, axis=1) for part in (found[:, :3], found[:, 3:])]
    return np.array([f(part) for part in sizes for f in (lambda s: np.sqrt((s**2).mean()), np.max)])


# Of the script, for each crank: joints, leans, lengths, zero, lost motion, waves, what gear [rad / N m] and rod [m / N]
# give; growth of both; frame and tool. Each number is free to about this.
SIZES = np.r_[[7e-4] * 18, [3e-4] * 18, [3e-3] * 12, [2e-4] * 6, [4e-4] * 6, [4e-3] * 6]
MORE = np.r_[[3e-4] * 6, [1.5e-4] * 24, [8e-5] * 24, [2e-5] * 6, [4e-8] * 6, [1e-5, 3e-6]]
SETUP = np.r_[[5e-3] * 3, [5e-3] * 3, [5e-3] * 3, [1e-3] * 3]


def forces(at: Array, frame: Array, payload: Array) -> tuple[Array, Array, Array]:
    """By the drawing: torque of each crank, pull of each rod, and change of the pose by the cranks."""
    joints, arms = drawn_joints(at, frame), HEADS @ frame.swapaxes(1, 2)
    cos, sin = np.cos(joints)[..., None], np.sin(joints)[..., None]
    ways = (at[:, None] + arms - FEET - CRANK * (cos * LEVEL + sin * UP)) / ROD
    slope, across = np.concatenate([ways, np.cross(arms, ways)], -1), CRANK * (cos * UP - sin * LEVEL)
    lever = (frame @ centre(payload)[..., None])[..., 0] * payload[:, None]
    weight = np.array([0, 0, -G])
    wrench = np.concatenate([(MASS + payload)[:, None] * weight, np.cross(lever, weight)], -1)
    pull = np.linalg.solve(slope.swapaxes(1, 2), wrench[..., None])[..., 0]
    moved = (ways * across).sum(-1)
    return moved * pull, pull, np.linalg.inv(slope) * moved[:, None, :]


def script(x: Array, pose: Pose, joints: Array, told: Array, held: tuple[Array, Array]) -> Array:
    """Angles to command for a pose, by the script, `s x 6`; `joints`: about where the cranks are; `held`: forces."""
    at, frame = pose
    feet, heads, lean = FEET + x[:18].reshape(6, 3), HEADS + x[18:36].reshape(6, 3), x[36:48].reshape(2, 6, 1)
    crank, rod, zero = CRANK + x[48:54], ROD + x[54:60], x[60:66]
    lost, slow, fast, soft, gives = x[66:72], x[72:96].reshape(4, 6), x[96:120].reshape(4, 6), x[120:126], x[126:132]
    base, warm = told[:, [0]] - 20, told[:, [1]] - 20
    feet = feet * (1 + (STEEL + x[132]) * base[..., None])
    spoke = at[:, None] + heads @ frame.swapaxes(1, 2) - feet
    rod = rod + ROD * (STEEL + x[133]) * warm + gives * held[1]
    angles = cranks(spoke, LEVEL - lean[1] * AXES, UP + lean[0] * AXES, crank, rod) - zero
    for k, part in zip((1.0, 2.0, RATIO, 2 * RATIO), (slow[:2], slow[2:], fast[:2], fast[2:]), strict=True):
        angles = angles - part[0] * np.sin(k * joints) - part[1] * np.cos(k * joints)
    return np.asarray(angles - told[:, 3:] * lost / 2 - soft * held[0])


def placed(x: Array, place: Array, turn: Array) -> Pose:
    """Pose of the platform from that of the probe as the camera reads it; `x`: turn and shift of base and probe."""
    moved, own = turned(x[:3]), turned(x[6:9])
    frame = moved @ turn @ own.T
    return place @ moved.T + x[3:6] - frame @ (PROBE + x[9:12]), frame


def script_fit(joints: Array, wanted: Pose, told: Array, seen: Pose, full: bool) -> tuple[Array, Array]:
    """Numbers of the script, and what it leaves of place and turn, `s x 6`."""
    scale = np.r_[SIZES, MORE * float(full), SETUP]
    first = Rotation.from_matrix(wanted[1] @ seen[1].swapaxes(1, 2)).mean()
    spot = wanted[0] + wanted[1] @ PROBE
    near = first.apply(seen[0] - seen[0].mean(0)) + spot.mean(0), first.as_matrix() @ seen[1]
    torque, pull, moves = forces(*wanted, told[:, 2])

    def left(u: Array) -> Array:
        x = u * scale
        lacks = script(x[:-12], placed(x[-12:], *near), joints, told, (torque, pull)) - joints
        return np.asarray((moves @ lacks[..., None])[..., 0])

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[(left(u) * WEIGHTS).ravel(), u * np.r_[np.ones(len(u) - 12), np.full(12, 0.1)]])

    found = least_squares(residuals, np.zeros(len(scale)), method="lm").x
    return (found * scale)[:-12], left(found)


def corrected(numbers: Array, pose: Pose, wanted: Array, told: Array) -> Array:
    """Angles at which the script's platform is at a pose, `s x 6`."""
    held, joints = forces(*pose, told[:, 2])[:2], wanted.copy()
    for _ in range(4):
        joints = script(numbers, pose, joints, told, held)
    return joints


def by_process(joints: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over joints, temperatures and payload, at those wanted, `s x 6`."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(9, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    scale = np.r_[[0.4] * 6, 3, 1.5, 60]
    rows, new = np.c_[joints, told[:, :3]] / scale, np.c_[wanted, then[:, :3]] / scale
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def table(joints: Array, told: Array, loads: Array | None, seen: Pose | None) -> tuple[str, Array]:
    """Header and rows of a file in degrees, mm and deg C; `loads`: force and moment in the place of the payload."""
    columns = {f"q{k + 1}[deg]": np.degrees(joints[:, k]) for k in range(6)}
    columns |= {"temperature_base[degC]": told[:, 0], "temperature_rods[degC]": told[:, 1]}
    if loads is None:
        columns["payload[kg]"] = told[:, 2]
    else:
        columns |= {f"load_{name}": loads[:, k] for k, name in enumerate(("z[N]", "rx[N*m]", "ry[N*m]"))}
    columns |= {f"direction{k + 1}[1]": told[:, 3 + k] for k in range(6)}
    if seen is not None:
        turns = Rotation.from_matrix(seen[1]).as_rotvec()
        columns |= {f"{a}[mm]": 1e3 * seen[0][:, k] for k, a in enumerate("xyz")}
        columns |= {f"r{a}[rad]": turns[:, k] for k, a in enumerate("xyz")}
    return ",".join(columns), np.stack(list(columns.values()), -1)


def judged(seed: int, rows: int, without: tuple[str, ...], names: list[str], kept: Path | None) -> dict[str, Array]:
    """What one machine misses, by who calibrated it; NaN where there were no commands."""
    machine, rng = Platform(seed, without), np.random.default_rng([seed, 1])
    joints, posed, told = day(rows, rng)
    seen = machine.measured(joints, told, rng)
    wanted, goal, then = day(NEW, rng, np.stack([told[:, :2].min(0), told[:, :2].max(0)]))
    sent = {"as drawn": wanted}
    for full, who in ((False, "plain script"), (True, "fuller script")):
        numbers, left = script_fit(joints, posed, told, seen, full)
        sent[who] = corrected(numbers, goal, wanted, then)
        more = by_process(joints, told, left, wanted, then)
        better = goal[0] - more[:, :3], turned(-more[:, 3:]) @ goal[1]
        sent[f"{who} and process"] = corrected(numbers, better, wanted, then)
    text = (Path(__file__).parent / "rotary_cranks.py").read_text()
    # Weight and moments about the probe, in the camera's frame, which is level; its yaw is known to a degree.
    yaw = turned(np.array([0, 0, machine.yaw + rng.normal(0, 0.01)]))
    loads = []
    for (_, frame), some in ((posed, told), (goal, then)):
        lever = (yaw @ frame @ (centre(some[:, 2]) - PROBE)[..., None])[..., 0]
        loads.append(-G * some[:, [2]] * np.c_[np.ones(len(some)), lever[:, 1], -lever[:, 0]])
    for who in names:
        config, moments = OURS[who]
        first, second = loads if moments else (None, None)
        tables = table(joints, told, first, seen), table(wanted, then, second, None)
        with TemporaryDirectory() as folder:
            place = Path(folder) if kept is None else kept / f"{seed}" / who.replace(", ", "_").replace(" ", "_")
            place.mkdir(parents=True, exist_ok=True)
            begin = clock.time()
            commands = commanded(place, text, *tables, "run", config, "rotary_cranks.py", "--allow-code")
            print(f"  {who}: {clock.time() - begin:.0f} s", file=sys.stderr)
        sent[who] = np.full_like(wanted, np.nan) if commands is None else commands
    found = {who: missed(*goal, *machine.reached(q, then)) for who, q in sent.items() if not np.isnan(q).any()}
    found["a reading"] = np.array([NOISE, np.nan, TURN_NOISE, np.nan]) * 3**0.5
    return dict.fromkeys(sent, np.full(4, np.nan)) | found


def main() -> None:
    """Judge machines, the seeds counted from `--seed`, and print what each contestant misses."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=4)
    options.add_argument("--rows", type=int, default=120)
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[])
    options.add_argument("--ours", default=";".join(OURS), help="contestants, between semicolons")
    options.add_argument("--keep", type=Path)
    given = options.parse_args()
    names, every = [name for name in given.ours.split(";") if name], []
    for seed in range(given.seed, given.seed + given.machines):
        every.append(judged(seed, given.rows, tuple(given.without), names, given.keep))
        print(f"{seed} [µm, µrad]:", *(f"  {who} {told_as(value)}" for who, value in every[-1].items()), sep="\n")
    print("median:", *(f"  {who} {told_as(np.median([one[who] for one in every], 0))}" for who in every[0]), sep="\n")


def told_as(value: Array) -> str:
    """RMS / largest of place and turn."""
    return "{:.1f} / {:.1f}   {:.0f} / {:.0f}".format(*(1e6 * value))


if __name__ == "__main__":
    main()
