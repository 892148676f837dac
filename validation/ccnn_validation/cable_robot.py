"""A robot on eight cables: a platform of six freedoms and eight winches, for which the package has no kind.

`python -W ignore -m ccnn_validation.cable_robot --seed N [--machines N] [--rows N]`. The controller draws straight
cables from the points where they leave the pulleys at home, and knows no force. A laser tracker reads three reflectors
on the platform, 60 µm of noise in each coordinate; temperature and payload (0, 2.5 or 5 kg) are recorded. The true
machine: inlets, cables' ends, zeros and drums that are off, pulleys of finite radius, homed in a fixture that stands
beside, elastic cables that may be slack, weight and payload, growth of cables and frame, scatter of the winches; its
pose is the balance of eight unstretched cables. The plain SciPy script fits straight cables leg by leg, the fuller one
pulleys, statics and growth; "by poses" has its poses sent to the controller, which cannot choose the tensions then.
Ours has the user's own class `cable_robot_class.py`: "winches" eight joints, the others the commanded pose as six, with
elastic cables ("statics", "diagnosed"; "slack": they cannot push) or straight ones ("lines"); "process" is a Gaussian
process alone. Judged absolutely, as the tracker would see it, on new targets. `--without NAME` of `CAUSES` switches a
true error off, `--keep FOLDER` keeps the files.
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

from ccnn_validation.delivered.product import Contestant
from ccnn_validation.delivered.tables import read_commands

Array = NDArray[np.float64]
# Data sheet: pulleys' inlets, cables' ends on the platform, radii of pulleys and drums, cable from drum to pulley [m];
# stiffness EA and tension when homed [N]; mass [kg]; growth of steel cables and of an aluminium frame [1/K].
CORNER = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
INLETS = np.r_[np.c_[2 * CORNER, np.full(4, 3.0)], np.c_[2 * CORNER, np.zeros(4)]]
ENDS = 0.25 * np.r_[np.c_[CORNER * [0.3, 1], np.full(4, -0.48)], np.c_[CORNER * [1, 0.3], np.full(4, 0.48)]]
SIDE = np.repeat([1.0, -1.0], 4)
PULLEY, DRUM, DEAD, EA, HOMED, MASS, G = 0.03, 0.05, 1.5, 120e3, 250.0, 14.0, 9.81
CABLE, FRAME, HOME = 11.5e-6, 23e-6, np.array([0, 0, 1.4, 0, 0, 0])
# Workspace of x, y, z [m] and rotation vector [rad]; payloads [kg]; reflectors on the platform [m], noise of each [m].
LOW, HIGH = np.array([[-0.8, -0.8, 0.9, -0.12, -0.12, -0.12], [0.8, 0.8, 2.0, 0.12, 0.12, 0.12]])
LOADS = np.array([0.0, 2.5, 5.0])
BALLS, NOISE, NEW = np.array([[0.2, 0, 0.2], [-0.15, 0.17, 0.2], [-0.15, -0.17, 0.2]]), 6e-5, 300
# Of ours: lines of the config, and which command.
AXES, CLASS = "x y z rx ry rz", "mechanism: cable.py:%s\nmechanism_keys: {allow_code: true%s}\n"
OURS = {
    "statics": (CLASS % ("Commanded", ""), "run"),
    "slack": (CLASS % ("Commanded", ", slack: true"), "run"),
    "diagnosed": (CLASS % ("Commanded", ""), "diagnose"),
    "lines": (CLASS % ("Commanded", ", elastic: false"), "run"),
    "process": (CLASS % ("Commanded", ", elastic: false") + "geometry: none\neffects: none\nmethods: [gp]\n", "run"),
    "winches": (CLASS % ("Winches", ""), "run"),
    "winches diagnosed": (CLASS % ("Winches", ""), "diagnose"),
}
CAUSES = ("anchors", "pulleys", "drums", "homing", "weight", "payload", "softness", "warmth", "scatter")


def around(away: Array, radius: Array | float) -> tuple[Array, Array]:
    """Length of cable from a swivelling pulley's inlet to its end, and direction of its free part, `s x 8` (`x 3`).

    `away`: from inlets to ends, `s x 8 x 3`. Cables come along the posts, up to the upper pulleys, down to the lower.
    """
    flat, rise = np.hypot(away[..., 0], away[..., 1]), SIDE * away[..., 2]
    free = np.sqrt((flat - radius) ** 2 + rise**2 - radius**2)
    leaves = np.arctan2(rise, flat - radius) + np.arctan2(free, radius)
    out = away[..., :2] / flat[..., None]
    way = np.concatenate([out * np.sin(leaves)[..., None], (-SIDE * np.cos(leaves))[..., None]], -1)
    return np.asarray(free + radius * (np.pi - leaves)), way


def arms(pose: Array, ends: Array) -> Array:
    """Cables' ends from the platform's origin, in the frame's axes, `s x 8 x 3`."""
    return np.asarray(ends @ Rotation.from_rotvec(pose[:, 3:]).as_matrix().swapaxes(1, 2))


def rows_of(way: Array, arm: Array) -> Array:
    """Change of each cable's length by shift and turn of the platform, `s x 8 x 6`."""
    return np.concatenate([way, np.cross(arm, way)], -1)


def hanging(pose: Array, masses: Array, centres: Array) -> Array:
    """Force and moment of weights at the platform's origin, `s x 6`; `masses`: `s x m`, `centres`: `m x 3`."""
    down = np.array([0, 0, -G]) * masses[..., None]
    return np.hstack([down.sum(1), np.cross(arms(pose, centres), down).sum(1)])


def turned(pose: Array, step: Array) -> Array:
    """A pose after a small shift and turn, `s x 6`."""
    turn = Rotation.from_rotvec(step[:, 3:]) * Rotation.from_rotvec(pose[:, 3:])
    return np.asarray(np.c_[pose[:, :3] + step[:, :3], turn.as_rotvec()])


class Robot:
    """The true machine; `without`: the causes that are switched off."""

    def __init__(self, seed: int, without: tuple[str, ...] = ()) -> None:
        rng = np.random.default_rng(seed)
        on = {cause: float(cause not in without) for cause in CAUSES}
        self.inlets = INLETS + on["anchors"] * rng.normal(0, 2e-3, (8, 3))
        self.ends = ENDS + on["anchors"] * rng.normal(0, 7e-4, (8, 3))
        self.radius = PULLEY + rng.normal(0, 2e-4, 8)
        self.drum = DRUM * (1 + on["drums"] * rng.normal(0, 1e-3, 8))
        self.dead = DEAD + rng.normal(0, 0.05, 8)
        self.ea = EA * rng.normal(1, 0.06, 8) * (1.0 if on["softness"] else 30.0)
        self.mass, self.centre = on["weight"] * rng.normal(MASS, 0.3), rng.normal(0, 0.01, 3)
        self.hook = np.array([0, 0, -0.15]) + rng.normal(0, 5e-3, 3)
        self.load, self.scatter = on["payload"], 3e-5 * on["scatter"]
        self.cable, self.frame = on["warmth"] * CABLE * rng.normal(1, 0.1), on["warmth"] * FRAME * rng.normal(1, 0.05)
        if "pulleys" in without:
            self.radius, self.inlets = np.full(8, 1e-7), self.inlets + LEAVE - INLETS
        # Homed in a fixture, which holds the platform a little beside, by tension, which is read to some percent.
        home = HOME + on["homing"] * rng.normal(0, [1.5e-3] * 3 + [2e-3] * 3)
        held, _ = around(home[:3] + arms(home[None], self.ends) - self.inlets, self.radius)
        pull, off = HOMED * rng.normal(1, 0.05 * on["homing"], 8), on["homing"] * rng.normal(0, 3e-4, 8)
        self.homed = off + (held[0] - pull * self.dead / self.ea) / (1 + pull / self.ea)
        # The tracker was aligned with marks on the frame.
        self.turn, self.stand = Rotation.from_rotvec(rng.normal(0, 2e-4, 3)), rng.normal(0, 3e-4, 3)

    def settled(self, angles: Array, told: Array) -> tuple[Array, Array]:
        """Pose at rest `s x 6`, and tension of the cables `s x 8` [N]; `told`: temperature [deg C], payload [kg]."""
        warm = told[:, :1] - 20
        slack = self.homed + self.drum * angles
        slack = slack + warm * (self.cable * (slack + self.dead) - self.frame * self.dead)
        stiff, masses = self.ea / (slack + self.dead), np.c_[np.full(len(told), self.mass), self.load * told[:, 1]]
        inlets = self.inlets * (1 + self.frame * warm[..., None])
        pose = np.tile(HOME, (len(angles), 1))
        for _ in range(80):
            arm = arms(pose, self.ends)
            length, way = around(pose[:, None, :3] + arm - inlets, self.radius)
            tension, rows = np.maximum(stiff * (length - slack), 0), rows_of(way, arm)
            held = np.where(tension > 0, stiff, 0.05 * stiff)
            push = hanging(pose, masses, np.stack([self.centre, self.hook])) - (tension[..., None] * rows).sum(1)
            step = np.linalg.solve(rows.swapaxes(1, 2) @ (held[..., None] * rows), push[..., None])[..., 0]
            pose = turned(pose, step / np.maximum(1, np.abs(step).max(1, keepdims=True) / 0.1))
        assert np.abs(step).max() < 1e-9
        return pose, tension

    def seen(self, pose: Array, rng: np.random.Generator | None = None) -> Array:
        """The platform as the tracker sees it, by three reflectors, with their noise where `rng` is given."""
        balls = self.turn.apply((pose[:, None, :3] + arms(pose, BALLS)).reshape(-1, 3)) + self.stand
        balls = (balls if rng is None else balls + rng.normal(0, NOISE, balls.shape)).reshape(-1, 3, 3)
        middle = balls.mean(1)
        mean = BALLS.mean(0)
        turns = Rotation.concatenate([Rotation.align_vectors(one - one.mean(0), BALLS - mean)[0] for one in balls])
        return np.asarray(np.c_[middle - turns.apply(mean), turns.as_rotvec()])

    def measured(self, angles: Array, told: Array, rng: np.random.Generator) -> Array:
        """As recorded, `s x 6`: winches stop with scatter, friction of the pulleys in it."""
        return self.seen(self.settled(angles + rng.normal(0, self.scatter / DRUM, angles.shape), told)[0], rng)


# Points where the cables leave the pulleys with the platform at home, by the drawing: what the controller has.
AWAY = HOME[:3] + ENDS - INLETS
LEFT, WAY = (one[0] for one in around(AWAY[None], PULLEY))
OUT, SINE = AWAY[:, :2] / np.hypot(AWAY[:, 0], AWAY[:, 1])[:, None], np.hypot(WAY[:, 0], WAY[:, 1])
LEAVE = INLETS + PULLEY * np.c_[OUT * (1 - SIDE * WAY[:, 2])[:, None], SIDE * SINE]
STRAIN = HOMED / EA
FULL_HOME = (LEFT - STRAIN * DEAD) / (1 + STRAIN)


def spans(pose: Array, points: Array = LEAVE, ends: Array = ENDS) -> tuple[Array, Array]:
    """Straight lengths of the cables from points to ends, and their directions, `s x 8` (`x 3`)."""
    away = pose[:, None, :3] + arms(pose, ends) - points
    length = np.linalg.norm(away, axis=-1)
    return np.asarray(length), np.asarray(away / length[..., None])


def drawn(pose: Array) -> Array:
    """Angles of the winches by the controller, `s x 8` [rad]: cables are straight lines from points."""
    return (spans(pose)[0] - spans(HOME[None])[0]) / DRUM


def places(rows: int, rng: np.random.Generator, warm: tuple[float, float] | None = None) -> tuple[Array, Array]:
    """Poses all over the workspace, and temperature and payload; the hall warms by the row, or is of a range."""
    pose, heat = rng.uniform(LOW, HIGH, (rows, 6)), rng.uniform(*(warm or (19.0, 26.0)), size=rows)
    return pose, np.c_[heat if warm else np.sort(heat), rng.choice(LOADS, rows)]


# How far may be off, of the plain script: points, ends, zeros, drums; of the fuller one also the pulleys' radius, EA,
# weight, where it and the payload hang, growth of cables and frame.
SIZES = np.r_[[2e-3] * 24, [1e-3] * 24, [3e-3] * 8, [1e-3] * 8, 5e-4, 0.1, 0.5, [0.01] * 6, 2e-6, 2e-6]


def plain_fit(angles: Array, seen: Array) -> Array:
    """Leg by leg: straight lengths at the measured poses against what the winches gave."""

    def residuals(u: Array) -> Array:
        return np.asarray(np.r_[(DRUM * (plain_angles(u * SIZES[:64], seen) - angles)).ravel() / 4e-4, u])

    return np.asarray(least_squares(residuals, np.zeros(64)).x * SIZES[:64])


def plain_angles(x: Array, pose: Array) -> Array:
    """Angles of the winches by the plain script, `s x 8`."""
    length, _ = spans(pose, LEAVE + x[:24].reshape(8, 3), ENDS + x[24:48].reshape(8, 3))
    return np.asarray((length - spans(HOME[None])[0] - x[48:56]) / (DRUM * (1 + x[56:])))


def full_parts(x: Array, pose: Array, told: Array) -> tuple[Array, ...]:
    """Of the fuller script at a pose: lengths, their rows, weight; and the same cables' change by warmth."""
    warm = told[:, :1] - 20
    inlets = (INLETS + x[:24].reshape(8, 3)) * (1 + x[74] * warm[..., None])
    arm = arms(pose, ENDS + x[24:48].reshape(8, 3))
    length, way = around(pose[:, None, :3] + arm - inlets, PULLEY + x[64])
    hung = hanging(pose, np.c_[np.full(len(pose), MASS + x[66]), told[:, 1]], x[67:73].reshape(2, 3))
    return length, rows_of(way, arm), hung, warm


def full_slack(x: Array, angles: Array, warm: Array) -> Array:
    """Unstretched cables outside the frame by the fuller script, `s x 8`."""
    cold = FULL_HOME + x[48:56] + DRUM * (1 + x[56:64]) * angles
    return np.asarray(cold + warm * (x[73] * (cold + DEAD) - x[74] * DEAD))


def full_off(x: Array, angles: Array, pose: Array, told: Array) -> Array:
    """How far poses are from where the fuller script's platform rests, by the force left there, `s x 6`."""
    length, rows, hung, warm = full_parts(x, pose, told)
    slack = full_slack(x, angles, warm)
    stiff = EA * np.exp(x[65]) / (slack + DEAD)
    push = hung - (np.maximum(stiff * (length - slack), 0)[..., None] * rows).sum(1)
    return np.asarray(-np.linalg.solve(rows.swapaxes(1, 2) @ (stiff[..., None] * rows), push[..., None])[..., 0])


def full_fit(angles: Array, seen: Array, told: Array) -> Array:
    """The fuller script: pulleys, elastic cables, weights, warmth; residuals are poses, by the force left at each."""
    start = np.r_[np.zeros(72), -0.15, CABLE, FRAME]

    def residuals(u: Array) -> Array:
        off = full_off(start + u * SIZES, angles, seen, told)
        return np.asarray(np.r_[(off / [*[1e-4] * 3, *[4e-4] * 3]).ravel(), u])

    return np.asarray(start + least_squares(residuals, np.zeros(75)).x * SIZES)


def full_angles(x: Array, pose: Array, told: Array) -> Array:
    """Angles at which the fuller script's platform rests at a pose, its tensions as even as can be, `s x 8`."""
    length, rows, hung, warm = full_parts(x, pose, told)
    across = rows.swapaxes(1, 2)
    lack = hung - HOMED * across.sum(-1)
    pull = HOMED + (np.linalg.pinv(across) @ lack[..., None])[..., 0]
    stretch = pull / (EA * np.exp(x[65]))
    slack = (length - stretch * DEAD) / (1 + stretch)
    cold = (slack - warm * (x[73] - x[74]) * DEAD) / (1 + warm * x[73])
    return np.asarray((cold - FULL_HOME - x[48:56]) / (DRUM * (1 + x[56:64])))


def by_process(goal: Array, told: Array, left: Array, wanted: Array, then: Array) -> Array:
    """Scikit-learn: what is left of each coordinate over pose and what is told, at those wanted, `s x 6`."""
    kernel = ConstantKernel(1.0) * RBF(np.full(8, 2.0)) + WhiteKernel(0.5)
    low, high = np.r_[LOW, 19, 0], np.r_[HIGH, 26, 5]
    rows, new = ((2 * some - low - high) / (high - low) for some in (np.c_[goal, told], np.c_[wanted, then]))
    fits = [GaussianProcessRegressor(kernel, normalize_y=True, random_state=0).fit(rows, one) for one in left.T]
    return np.stack([fit.predict(new) for fit in fits], -1)


def missed(goal: Array, reached: Array) -> tuple[float, float, float]:
    """RMS and largest miss of position [mm], RMS of rotation [mrad]."""
    far = np.linalg.norm(reached[:, :3] - goal[:, :3], axis=1)
    turn = (Rotation.from_rotvec(goal[:, 3:]).inv() * Rotation.from_rotvec(reached[:, 3:])).magnitude()
    return 1e3 * float(np.sqrt((far**2).mean())), 1e3 * float(far.max()), 1e3 * float(np.sqrt((turn**2).mean()))


def by_poses(x: Array, goal: Array, told: Array) -> Array:
    """Poses to command, with which the fuller script's platform rests at a goal, `s x 6`: tensions are as they come."""
    sent = goal.copy()
    for _ in range(6):
        sent = turned(sent, full_off(x, drawn(sent), goal, told))
    return sent


def table(pose: Array, names: str) -> tuple[str, Array]:
    """Header and cells of a pose in mm and rad."""
    header = [f"{name}[{'mm' if k < 3 else 'rad'}]" for k, name in enumerate(names.split())]
    return ",".join(header), pose * [1e3, 1e3, 1e3, 1, 1, 1]


def ours(place: Path, how: str, records: tuple[Array, ...], targets: tuple[Array, Array]) -> Array | None:
    """Angles of the winches by the file that the program writes, `s x 8`; None where it writes none."""
    config, command = OURS[how]
    goal, angles, seen, told = records
    by_pose, winches = "Winches" not in config, ",".join(f"q{k}[deg]" for k in range(1, 9))
    sent_by = table(goal, "q1 q2 q3 q4 q5 q6") if by_pose else (winches, np.degrees(angles))
    tell = "temperature[degC],payload[kg]"
    rows = (sent_by, table(seen, AXES), (tell, told))
    for name, parts in (("rows", rows), ("targets", (table(targets[0], AXES), (tell, targets[1])))):
        header, cells = ",".join(part[0] for part in parts), np.hstack([part[1] for part in parts])
        np.savetxt(place / f"{name}.csv", cells, "%.12g", ",", header=header, comments="")
    (place / "cable.py").write_text((Path(__file__).parent / "cable_robot_class.py").read_text())
    (place / "config.yaml").write_text(f"records: rows.csv\n{config}")
    contestant = Contestant(place, command)
    more = ("--out", command, "--no-network") if command == "diagnose" else (f"out={command}", "save_report=false")
    contestant.call(command, "config.yaml", *more)
    file = {"run": "model.safetensors", "diagnose": "diagnosis.json"}[command]
    contestant.call("compensate", f"{command}/{file}", "targets.csv", "sent.csv", "--pose", "--allow-code")
    if not (place / "sent.csv").is_file():
        return None
    sent = np.asarray(read_commands(place / "sent.csv", 6 if by_pose else 8).joints)
    return drawn(sent) if by_pose else sent


def judged(seed: int, given: argparse.Namespace) -> dict[str, tuple[float, ...] | None]:
    """What each contestant's platform misses on new targets, and lowest and highest tension; None: no commands."""
    robot, rng = Robot(seed, tuple(given.without)), np.random.default_rng([seed, 1])
    goal, told = places(given.rows, rng)
    angles = drawn(goal)
    seen = robot.measured(angles, told, rng)
    wanted, then = places(NEW, rng, (told[:, 0].min(), told[:, 0].max()))
    plain, full = plain_fit(angles, seen), full_fit(angles, seen, told)
    sent: dict[str, Array | None] = {
        "nominal": drawn(wanted),
        "plain script": plain_angles(plain, wanted),
        "process alone": drawn(wanted - by_process(goal, told, seen - goal, wanted, then)),
        "fuller script": full_angles(full, wanted, then),
        "fuller, by poses": drawn(by_poses(full, wanted, then)),
    }
    for how in given.ours.split(",") if given.ours else ():
        with TemporaryDirectory() as folder:
            place = Path(folder) if given.keep is None else given.keep / f"{seed}_{how.replace(' ', '_')}"
            place.mkdir(parents=True, exist_ok=True)
            sent[f"ours, {how}"] = ours(place, how, (goal, angles, seen, told), (wanted, then))
    found: dict[str, tuple[float, ...] | None] = dict.fromkeys(sent)
    for who, these in sent.items():
        if these is None or np.isnan(these).any() or len(these) != NEW:
            continue
        pose, tension = robot.settled(these, then)
        taut, at = tension.min(1) > 0, robot.seen(pose)
        rest = (*missed(wanted[taut], at[taut])[:2], 100 * float(1 - taut.mean()), float(tension.max()))
        found[who] = (*missed(wanted, at), *rest)
    return found


def main() -> None:
    """Judge machines and print what each contestant misses."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--rows", type=int, default=80)
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[], help="causes switched off")
    options.add_argument("--ours", default="statics,diagnosed,lines,process,winches", help=f"of {', '.join(OURS)}")
    options.add_argument("--keep", type=Path, help="folder of the files; by default a temporary one")
    given = options.parse_args()
    for seed in range(given.seed, given.seed + given.machines):
        print(f"seed {seed}: RMS / largest [mm], rotation RMS [mrad]; rows with taut cables; rows with slack; tension")
        for who, one in judged(seed, given).items():
            form = "{:.3f} / {:.2f}, {:.2f}; taut {:.3f} / {:.2f}; slack {:.1f} %; {:.0f} N"
            print(f"  {who}: {form.format(*one) if one else 'no commands'}", flush=True)


if __name__ == "__main__":
    main()
