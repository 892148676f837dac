"""A parallel ankle of a humanoid, which the package does not ship: two motors, cranks, rods, a foot on two axes.

`python -m ccnn_validation.ankle --seed N [--machines N] [--rows N]`. An inclinometer on the foot reads its pitch and
roll, 0.15 mrad of noise in each; weights hang on the foot, and their torques, each drive's temperature (to 0.5 K), and
each motor's direction of approach are recorded. A quarter of the places is measured from both sides. The true machine:
joints of the rods elsewhere, cranks and rods of other lengths, motors that lean, zeros, axes of the foot that neither
meet nor are square, an inclinometer and a stand that are askew, harmonic drives that err twice (and once) a turn of the
motor and once a turn of the crank, wind up (stiffer beyond a torque) and lag, the more the more torque, rods that
give, brackets, cranks and zeros that warm at once and a shin that warms late, and the foot's own weight.

Ours (`ccnn run`, by the written file) has the user's own class `ankle_user.Ankle`: anchors, lengths, zeros of the data
sheet; "axes" also how axes, motors and inclinometer stand, "gears" also the drives' ratio, "waves" twice this ratio,
"level" has the two axes of the inclinometer as `level` of `instrument`, "capture" a motion capture that sees rx, ry, rz
in its own frame (`pose` of `instrument`, over `framed`). The plain SciPy script fits the same anchors, lengths, zeros;
"fuller script" all causes but the shin's lag, the gear's bend and the error once a crank's turn; both also with a
Gaussian process on the rest.

Judged on new targets of another session: RMS over both angles [mrad], the largest error of one, and RMS in the best
frames of stand and inclinometer. `--without NAME` of `CAUSES` switches a true error off, `--keep FOLDER` keeps files.
"""

from __future__ import annotations

import argparse
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
Day = tuple[Array, Array, dict[str, Array]]
Found = dict[str, tuple[float, ...]]
# By the data sheet [m]: axes of the motors, joints of the rods on the foot, cranks; 1 turn of crank = RATIO of motor.
MOTOR, FOOT = np.array([[0, 0.04, 0.26], [0, -0.04, 0.19]]), np.array([[-0.05, 0.04, 0], [-0.05, -0.04, 0]])
CRANK, ROD, RATIO, G = 0.05, np.array([0.26, 0.19]), 50, 9.81
REACH, NOISE, NEW = np.radians([35.0, 18.0]), 1.5e-4, 300
# Weights that are hung on the foot: none, or kg at a place [m].
KG, AT = np.array([0, 5, 4, 5, 5, 2.5]), np.array([[0.2, 0], [0.2, 0], [-0.12, 0], [0, 0.12], [0, -0.12], [0.2, 0]])
AT = np.c_[AT, np.full(6, -0.03)]
CAUSES = ["anchors", "lengths", "leans", "zeros", "axes", "mount", "waves", "runout", "gears", "bend", "rods", "lag"]
CAUSES += ["friction", "warmth", "shin", "weight"]
# Geometry: of each leg motor 0:3, foot 3:6, crank, rod, zero, lean of the motor 9:11; then, from 22, apart and skew of
# the foot's axes, lean of the stand 24:26, turn of the inclinometer 26:29.
COUNT, SHEET = 29, np.zeros(29)


def turned(axis: int, angle: Array) -> Array:
    """Matrices of turns about a coordinate axis, `s x 3 x 3`."""
    return np.asarray(Rotation.from_rotvec(np.atleast_1d(angle)[:, None] * np.eye(3)[axis]).as_matrix())


def read(x: Array, state: Array) -> Array:
    """What an inclinometer shows, pitch and roll, `s x 2`."""
    stand, mount = Rotation.from_rotvec([*x[24:26], 0]).as_matrix(), Rotation.from_rotvec(x[26:29]).as_matrix()
    m = stand @ turned(1, state[:, 0]) @ turned(2, x[23]) @ turned(0, state[:, 1]) @ mount
    return np.stack([np.arctan2(-m[:, 2, 0], np.hypot(m[:, 2, 1], m[:, 2, 2])), np.arctan2(m[:, 2, 1], m[:, 2, 2])], -1)


def on_foot(x: Array, state: Array, places: Array) -> Array:
    """Places of the foot [m] seen from the shin, `s x k x 3`; `places` `k x 3` or `s x k x 3`."""
    inner = places @ (turned(2, x[23]) @ turned(0, state[:, 1])).swapaxes(1, 2) + [0, 0, x[22]]
    return np.asarray(inner @ turned(1, state[:, 0]).swapaxes(1, 2))


def spans(x: Array, state: Array, cranks: Array, grown: Array | float = 0.0) -> Array:
    """Distances between the ends of each rod, `s x 2` [m]; `grown`: how far each motor has moved, `s x 2 x 3`."""
    legs = x[:22].reshape(2, 11)
    lean = Rotation.from_rotvec(np.c_[legs[:, 9], 0 * legs[:, 9], legs[:, 10]]).as_matrix()
    out = np.stack([-np.cos(cranks), 0 * cranks, np.sin(cranks)], -1) * (CRANK + legs[:, 6:7])
    ends = MOTOR + legs[:, :3] + grown + np.einsum("lij,slj->sli", lean, out)
    return np.asarray(np.linalg.norm(on_foot(x, state, FOOT + legs[:, 3:6]) - ends, axis=-1))


def slopes(x: Array, state: Array, cranks: Array) -> tuple[Array, Array]:
    """Of the distances by the state, `s x 2 x 2`, and of each by its crank, `s x 2`."""
    ways = [spans(x, state + step, cranks) - spans(x, state - step, cranks) for step in 1e-5 * np.eye(2)]
    return np.stack(ways, -1) / 2e-5, (spans(x, state, cranks + 1e-5) - spans(x, state, cranks - 1e-5)) / 2e-5


def closed(x: Array, cranks: Array, stretch: Array | float = 0.0, grown: Array | float = 0.0) -> Array:
    """State in which rods fit between cranks and foot, `s x 2`."""
    state = np.stack([cranks.mean(1), (cranks[:, 0] - cranks[:, 1]) / 1.6], -1)
    for _ in range(5):
        slope = slopes(x, state, cranks)[0]
        lacks = ROD + x[[7, 18]] + stretch - spans(x, state, cranks, grown)
        state = state + np.linalg.solve(slope, lacks[..., None])[..., 0]
    return np.asarray(state)


def pulls(x: Array, cranks: Array, state: Array, torque: Array) -> tuple[Array, Array]:
    """Pull in each rod [N] and torque on each crank [N m], `s x 2`, of torques that act along the state."""
    by_state, by_crank = slopes(x, state, cranks)
    pull = np.linalg.solve(by_state.swapaxes(1, 2), torque[..., None])[..., 0]
    return np.asarray(pull), np.asarray(-pull * by_crank)


def falls(x: Array, state: Array, mass: Array, place: Array) -> Array:
    """Torques along the state of weights `s` [kg] at places of the foot `s x 3` [m], `s x 2`."""
    ways = [on_foot(x, state + s, place[:, None]) - on_foot(x, state - s, place[:, None]) for s in 1e-5 * np.eye(2)]
    return np.stack([-mass * G * way[:, 0, 2] / 2e-5 for way in ways], -1)


class Machine:
    """The true ankle; its controller knows the data sheet alone. `without`: the causes that are switched off."""

    def __init__(self, seed: int, without: tuple[str, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        on = {cause: float(cause not in without) for cause in CAUSES}

        def size(low: float, high: float, *shape: int) -> Array:
            return np.asarray(rng.uniform(low, high, shape) * rng.choice([-1, 1], shape))

        legs = np.zeros((2, 11))
        legs[:, :6] = on["anchors"] * size(5e-5, 4e-4, 2, 6)
        legs[:, 6:8] = on["lengths"] * np.c_[size(3e-5, 1.5e-4, 2), size(1e-4, 4e-4, 2)]
        legs[:, 8], legs[:, 9:] = on["zeros"] * size(3e-3, 15e-3, 2), on["leans"] * size(5e-4, 2e-3, 2, 2)
        joint = on["axes"] * np.r_[size(1e-4, 3e-4, 1), size(5e-4, 2e-3, 1)]
        mount = on["mount"] * np.r_[size(2e-4, 8e-4, 2), size(3e-4, 1.5e-3, 2), size(1e-3, 3e-3, 1)]
        self.x = np.r_[legs.ravel(), joint, mount]
        # Errors of the drives [rad]: twice and once a turn of the motor; once a turn of the crank.
        self.waves = on["waves"] * np.stack([rng.uniform(1e-4, 2.5e-4, 2), rng.uniform(2e-5, 7e-5, 2)])
        self.runout = on["runout"] * rng.uniform(5e-5, 1.5e-4, 2)
        self.phases = rng.uniform(0, 2 * np.pi, (3, 2))
        # A harmonic drive of size 17: softness [rad / N m] up to a torque [N m], and beyond; rods [m / N].
        self.soft, self.knee = on["gears"] / rng.uniform(7.5e3, 9e3, 2), rng.uniform(3.5, 4.3, 2)
        self.softer = self.soft * (1 - on["bend"] * rng.uniform(0.22, 0.3, 2))
        self.rods = on["rods"] / rng.uniform(2.5e6, 5e6, 2)
        self.lag, self.rubs = on["lag"] * rng.uniform(1e-4, 2.5e-4, 2), on["friction"] * rng.uniform(1e-5, 3e-5, 2)
        # A kelvin moves motors (bracket of 50 mm, aluminium), cranks, zeros; the shin as its own temperature.
        self.bracket = on["warmth"] * 23e-6 * 0.05 * rng.uniform(0.6, 1.2, 2)[:, None] * size(0.3, 1, 2, 3)
        self.creep = on["warmth"] * size(2e-6, 8e-6, 2)
        self.shin = on["shin"] * 23e-6 * MOTOR[:, 2]
        self.mass = on["weight"] * rng.uniform(1.0, 1.3)
        self.centre = np.array([0.03, 0, -0.04]) + rng.normal(0, 0.005, 3)
        # Weights as they are, by place: share of the mass, place [m]; how each drive warms [K, s], and the shin.
        self.heavy, self.placed = rng.normal(1, 0.005, len(KG)), rng.normal(0, 1.5e-3, (len(KG), 3))
        self.warms, self.slow = rng.uniform(12, 25, 2), rng.uniform(900, 1500, 2)

    def warmed(self, time: Array) -> Array:
        """Temperatures over 20 deg C of both drives and of the shin, which follows their mean late, `s x 3`."""
        fine = np.linspace(0, time.max() + 1, 2000)
        drives = 1.0 + self.warms * (1 - np.exp(-fine[:, None] / self.slow))
        shin = np.zeros(len(fine))
        for k in range(1, len(fine)):
            shin[k] = shin[k - 1] + (0.4 * drives[k].mean() - shin[k - 1]) * (fine[k] - fine[k - 1]) / 2400
        return np.stack([np.interp(time, fine, one) for one in (*drives.T, shin)], -1)

    def reached(self, q: Array, told: dict[str, Array]) -> Array:
        """Pitch and roll of the foot as an inclinometer without noise shows them, `s x 2`."""
        warm, to = told["warm"], told["direction"]
        grown = warm[:, :2, None] * self.bracket + (warm[:, 2:] * self.shin)[..., None] * [0, 0, 1]
        cranks = q + self.x[[8, 19]] + self.runout * np.sin(q + self.phases[2]) + self.creep * warm[:, :2]
        for k, often in enumerate((2, 1)):
            cranks = cranks + self.waves[k] * np.sin(often * RATIO * q + self.phases[k])
        stiff, stretch, state = cranks, 0 * cranks, closed(self.x, cranks, 0.0, grown)
        for _ in range(3):
            hung, place = (KG * self.heavy)[told["weight"]], (AT + self.placed)[told["weight"]]
            own = falls(self.x, state, np.full(len(q), self.mass), np.tile(self.centre, (len(q), 1)))
            pull, torque = pulls(self.x, cranks, state, own + falls(self.x, state, hung, place))
            size = np.abs(torque)
            wound = self.soft * np.minimum(size, self.knee) + self.softer * np.maximum(size - self.knee, 0)
            cranks = stiff + np.sign(torque) * wound - to * (self.lag + self.rubs * size)
            stretch = pull * self.rods
            state = closed(self.x, cranks, stretch, grown)
        return read(self.x, state)

    def measured(self, q: Array, told: dict[str, Array], rng: np.random.Generator) -> Array:
        """As the inclinometer reads it, `s x 2`; motors do not stop twice at the same place."""
        return self.reached(q + rng.normal(0, 4e-5, q.shape), told) + rng.normal(0, NOISE, q.shape)


def joints_of(x: Array, wanted: Array, told: dict[str, Array] | None = None) -> Array:
    """Motors to command for a pitch and roll, `s x 2`, by a model's numbers; `told`: what the script looks at."""
    q = np.stack([wanted[:, 0] + 0.8 * wanted[:, 1], wanted[:, 0] - 0.8 * wanted[:, 1]], -1)

    def model(q: Array) -> Array:
        return read(x, closed(x, q)) if told is None else script(x, q, told)

    for _ in range(4):
        slope = np.stack([(model(q + step) - model(q - step)) / 4e-4 for step in 2e-4 * np.eye(2)], -1)
        q = q + np.linalg.solve(slope, (wanted - model(q))[..., None])[..., 0]
    return np.asarray(q)


def day(machine: Machine, rows: int, rng: np.random.Generator, both: float = 0.0) -> Day:
    """Wanted pitch and roll all over the workspace, motors by the data sheet, and what is told of each row.

    `both`: share of places that are measured from both sides; else places are in no order of a session.
    """
    wanted = rng.uniform(-1, 1, (rows, 2)) * REACH
    twice = np.sort(rng.permutation(rows // 2)[: int(both * rows)]) * 2
    wanted[twice + 1] = wanted[twice]
    q = joints_of(SHEET, wanted)
    direction = np.sign(np.diff(q, axis=0, prepend=q[:1] - 1)) if both else rng.choice([-1.0, 1.0], (rows, 2))
    direction[twice + 1] = -direction[twice]
    weight = np.where(rng.uniform(size=rows) < 0.4, 0, rng.integers(1, len(KG), rows))
    weight[twice + 1] = weight[twice]
    time = np.linspace(60, 5400, rows) if both else rng.uniform(60, 5400, rows)
    warm = machine.warmed(time)
    shown = 20 + np.round(2 * (warm[:, :2] + rng.normal(0, 0.2, (rows, 2)))) / 2
    told = {"direction": direction, "weight": weight, "warm": warm, "shown": shown}
    return wanted, q, told | {"load": falls(SHEET, wanted, KG[weight], AT[weight])}


# Of the script: plausible sizes of geometry; then of waves (twice, once a turn), softness of drives and rods, lag and
# friction, motors that move along x and z and zeros that creep by a kelvin, the foot's weight times x, y, z.
LEG = [3e-4] * 6 + [1e-4, 3e-4, 1e-2] + [1.5e-3] * 2
SIZES = np.r_[LEG, LEG, 2e-4, 1.5e-3, [6e-4] * 2, 1e-3, 1e-3, 2e-3]
MORE = np.r_[[1.5e-4] * 4, [5e-5] * 4, [1.5e-4] * 2, [4e-7] * 2, [2e-4] * 2, [3e-5] * 2, [2e-6] * 4, [6e-6] * 2]
MORE = np.r_[MORE, 0.05, 0.02, 0.05]


def script(x: Array, q: Array, told: dict[str, Array]) -> Array:
    """Pitch and roll by the script's numbers, `s x 2`; the causes of the fuller one stand behind `COUNT`."""
    y, warm, turns = x[COUNT:], told["shown"] - 20, RATIO * q
    if not y.any():
        return read(x, closed(x, q + x[[8, 19]]))
    cranks = q + x[[8, 19]] + y[:2] * np.sin(2 * turns) + y[2:4] * np.cos(2 * turns) + y[4:6] * np.sin(turns)
    cranks = cranks + y[6:8] * np.cos(turns) + y[20:22] * warm
    grown = np.stack([y[16:18] * warm, 0 * warm, y[18:20] * warm], -1)
    state = closed(x, cranks, 0.0, grown)
    weight = falls(SHEET, state, np.ones(len(q)), np.tile(y[22:25], (len(q), 1)))
    pull, torque = pulls(SHEET, cranks, state, told["load"] + weight)
    cranks = cranks + y[8:10] * torque - told["direction"] * (y[12:14] + y[14:16] * np.abs(torque))
    return read(x, closed(x, cranks, pull * y[10:12], grown))


def script_fit(q: Array, seen: Array, told: dict[str, Array], full: bool) -> tuple[Array, Array]:
    """Numbers of the script, and what it leaves, `s x 2` [rad]."""
    sizes = np.r_[SIZES, MORE] if full else np.r_[[*LEG[:9], 0, 0] * 2, np.zeros(7), 0 * MORE]
    free, sigma = np.flatnonzero(sizes), NOISE if full else 1e-3

    def numbers(u: Array) -> Array:
        x = np.zeros(len(sizes))
        x[free] = u * sizes[free]
        return x

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[((seen - script(numbers(u), q, told)) / sigma).ravel(), u])

    found = numbers(least_squares(residuals, np.full(len(free), 1e-3), max_nfev=30).x)
    return found, seen - script(found, q, told)


def by_process(q: Array, told: dict[str, Array], left: Array, wanted: Array, then: dict[str, Array]) -> Array:
    """Scikit-learn: what is left of each angle over motors, loads, temperatures and directions, at those wanted."""
    kernel, make = ConstantKernel(1.0) * RBF(np.full(8, 2.0)) + WhiteKernel(0.5), GaussianProcessRegressor
    pairs = ((q, told), (wanted, then))
    rows, new = (np.c_[a / 0.5, b["load"] / 5, (b["shown"] - 30) / 8, b["direction"]] for a, b in pairs)
    return np.stack([make(kernel, normalize_y=True, random_state=0).fit(rows, one).predict(new) for one in left.T], -1)


def missed(wanted: Array, reached: Array) -> tuple[float, float, float]:
    """RMS over both angles and largest error [rad], and RMS in the best frames of stand and inclinometer."""
    off = reached - wanted
    rest = least_squares(lambda u: (read(np.r_[SHEET[:24], u], wanted) - reached).ravel(), np.zeros(5)).fun
    return float(np.sqrt((off**2).mean())), float(np.abs(off).max()), float(np.sqrt((rest**2).mean()))


INNER = "mechanism: ankle_user.py:Ankle\nmechanism_keys: {%sallow_code: true}\n"
LEVEL = "mechanism: instrument\nmechanism_keys: {mechanism: ankle_user.py:Ankle, kind: level, allow_code: true}\n"
CAPTURE = """mechanism: instrument
mechanism_keys: {mechanism: framed, keys: {mechanism: ankle_user.py:Ankle, base: true, tool: true},
  kind: pose, pose: [rx, ry, rz], allow_code: true}
"""
# Of ours: config, and what is measured.
OURS = {
    "ours": (INNER % "", "angles"),
    "ours, axes": (INNER % "axes: true, ", "angles"),
    "ours, gears": (INNER % "axes: true, gears: [50, 50], ", "angles"),
    "ours, waves": (INNER % "axes: true, gears: [100, 100], ", "angles"),
    "ours, level": (LEVEL, "level"),
    "ours, capture": (CAPTURE, "capture"),
}


def table(q: Array, told: dict[str, Array], seen: dict[str, Array], what: str) -> tuple[str, Array]:
    """Header and rows of a file; `seen`: what was measured, by header."""
    along = ("ry", "rx") if what == "capture" else ("pitch", "roll")
    names = ["q1[deg]", "q2[deg]", *(f"load_{name}[N*m]" for name in along), "temperature_motor1[degC]"]
    names += ["temperature_motor2[degC]", "direction1[1]", "direction2[1]", *seen]
    return ",".join(names), np.c_[np.degrees(q), told["load"], told["shown"], told["direction"], *seen.values()]


def shown(machine: Machine, seen: Array, rng: np.random.Generator) -> dict[str, dict[str, Array]]:
    """What others show where the inclinometer shows these angles: tilts of its axes, cameras that stand about so."""
    pitch, roll = seen.T
    tilts = np.degrees(np.stack([-pitch, np.arcsin(np.sin(roll) * np.cos(pitch))]))
    around = Rotation.from_rotvec(rng.normal(0, 3e-3, 3))
    skewed = Rotation.from_matrix(turned(1, pitch)) * Rotation.from_rotvec([0, 0, machine.x[23]])
    vectors = (around * skewed * Rotation.from_matrix(turned(0, roll))).as_rotvec()
    vectors = np.degrees(vectors + rng.normal(0, [0, 0, NOISE], vectors.shape))
    return {
        "angles": {"pitch[deg]": np.degrees(pitch), "roll[deg]": np.degrees(roll)},
        "level": dict(zip(("tilt_x[deg]", "tilt_y[deg]"), tilts, strict=True)),
        "capture": dict(zip(("rx[deg]", "ry[deg]", "rz[deg]"), vectors.T, strict=True)),
    }


def judged(seed: int, rows: int, without: tuple[str, ...], kept: Path | None, ours: list[str]) -> Found:
    """What one machine misses [rad], by who calibrated it; NaN where there were no commands."""
    machine, rng = Machine(seed, without), np.random.default_rng([seed, 1])
    _, q, told = day(machine, rows, rng, 0.25)
    seen = machine.measured(q, told, rng)
    goal, new, then = day(machine, NEW, rng)
    sent = {"data sheet": new}
    for full, who in ((False, "plain script"), (True, "fuller script")):
        numbers, left = script_fit(q, seen, told, full)
        sent[who] = joints_of(numbers, goal, then)
        sent[f"{who} and process"] = joints_of(numbers, goal - by_process(q, told, left, new, then), then)
    text, columns = (Path(__file__).parent / "ankle_user.py").read_text(), shown(machine, seen, rng)
    for who in ours:
        config, what = OURS[who]
        with TemporaryDirectory() as folder:
            place = Path(folder) if kept is None else kept / f"{seed}_{who.replace(', ', '_')}"
            place.mkdir(parents=True, exist_ok=True)
            files = (table(q, told, columns[what], what), table(new, then, {}, what))
            commands = commanded(place, text, *files, "run", config, "ankle_user.py", "--allow-code")
        sent[who] = np.full_like(new, np.nan) if commands is None else commands
    gone = (np.nan,) * 3
    return {who: gone if np.isnan(c).any() else missed(goal, machine.reached(c, then)) for who, c in sent.items()}


def tell(name: str, found: Found) -> None:
    """Print what each one misses: RMS, largest, RMS in the best frames [mrad]."""
    lines = [f"  {who}: " + " ".join(f"{1e3 * value:.3f}" for value in three) for who, three in found.items()]
    print(f"{name} [mrad]:", *lines, sep="\n", flush=True)


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--rows", type=int, default=120, help="an even number")
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[], help="causes that are switched off")
    options.add_argument("--keep", type=Path, help="folder of the files; by default a temporary one")
    options.add_argument("--ours", nargs="*", choices=OURS, default=list(OURS))
    given = options.parse_args()
    every: list[Found] = []
    for seed in range(given.seed, given.seed + given.machines):
        every.append(judged(seed, given.rows, tuple(given.without), given.keep, given.ours))
        tell(str(seed), every[-1])
    tell("median", {who: tuple(np.median([one[who] for one in every], 0)) for who in every[0]})
