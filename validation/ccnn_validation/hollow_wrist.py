"""A painting robot of 2 m reach with a hollow wrist, whose motors 4 to 6 are coupled by shafts within shafts.

`python -m ccnn_validation.hollow_wrist --seed N [--machines N] [--rows N]`. A laser tracker reads x, y, z of a mirror
over three hours while robot and stand warm: half of the rows with a tool of 3 kg, half with one of 13 kg. Beside them
stand the temperature of the arm, the payload and each axis' last direction. The true machine (`hollow_wrist_robot`):
lengths, twists, zeros, reducers once and twice a motor's turn and bevel gears in the wrist, each on the shafts it sits
on, ratios of coupling a little off, joints and a bearing that give under weight, lost motion, growth, a stand that
drifts. Ours (`ccnn run`, by the written file) has the Denavit-Hartenberg table; "sheet" also gears, masses and centres,
"loads" also the moments of the tools, "motors" also the ratios of the shafts, and directions of motors in the place of
axes'. The plain SciPy script (`hollow_wrist_script`) has lengths, twists, zeros and soft joints, the fuller one all
causes ("no shafts": each on its joint; "signs": lost motion by direction alone, whatever the weight); also with a
Gaussian process on what is left. Judged another day with a tool of 8 kg, in the frame and at the tool point that suit
best, RMS and largest [µm]; "of a reading" is what a reading is off. `--without NAME` of
`CAUSES` switches a true error off, `--keep FOLDER` keeps the files, `--ours NAMES` chooses of `OURS`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time as clock
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ccnn_validation.drawn import commanded
from ccnn_validation.hollow_wrist_robot import (
    ALPHA,
    CAUSES,
    CENTRES,
    GEARS,
    HIGH,
    LOW,
    MASSES,
    POINTS,
    SHAFTS,
    THETA,
    TOOLS,
    A,
    D,
    G,
    Robot,
    sheet_frames,
)  # fmt: skip
from ccnn_validation.hollow_wrist_script import Told, by_process, corrected, fit

Array = NDArray[np.float64]
NEW, HOURS = 400, 3.0


def listed(values: Array) -> str:
    """Of a YAML file."""
    return json.dumps(np.asarray(values).tolist())


ARM = f"""robot: painter
dof: 6
convention: standard Denavit-Hartenberg
units: {{length: m, angle: deg}}
a: {listed(A)}
alpha: {listed(ALPHA)}
d: {listed(D)}
theta: {listed(THETA)}
limits: {listed(np.degrees(np.stack([LOW - 0.1, HIGH + 0.1], -1)).round(2))}
base_frame: unknown
tool_offset: unknown
tool_per: [tool]
"""
SHEET = ARM + f"gears: {listed(GEARS)}\nmasses: {listed(MASSES)}\ncentres: {listed(CENTRES)}\n"
PLAIN = "mechanism: machine.yaml\n"
RATIOS = {"q5": {"q4": SHAFTS[1, 0]}, "q6": {"q4": SHAFTS[2, 0], "q5": SHAFTS[2, 1]}}
# Of ours: its machine file, columns of loads, and whether directions are those of the motors.
OURS = {
    "ours": (ARM, False, False),
    "ours, sheet": (SHEET, False, False),
    "ours, loads": (SHEET, True, False),
    "ours, motors": (f"{SHEET}motors: {json.dumps(RATIOS)}\n", False, True),
}
SCRIPTS = (
    (False, "plain script"),
    (True, "fuller, no shafts, signs"),
    (True, "fuller, no shafts"),
    (True, "fuller, signs"),
    (True, "fuller script"),
)


def day(rows: int, rng: np.random.Generator, share: float = 1.0) -> Array:
    """Joints all over the workspace, axis 5 bent by 15 degrees at least."""
    middle, half = (HIGH + LOW) / 2, (HIGH - LOW) / 2 * share
    joints = rng.uniform(middle - half, middle + half, (20 * rows, 6))
    low = sheet_frames(joints)[:, 5:, 2, 3].min(1)
    return np.asarray(joints[(np.abs(joints[:, 4]) > np.radians(15)) & (low > 0.2)][:rows])


def shafts(joints: Array) -> Array:
    """Turns of the motors, each over its gear."""
    return np.asarray(np.c_[joints[:, :3], joints[:, 3:] @ SHAFTS.T])


def ways(joints: Array) -> Array:
    """Signs of the last motion."""
    return np.sign(np.diff(joints, axis=0, prepend=joints[:1] - 1e-3))


def missed(wanted: Array, reached: Array) -> list[float]:
    """RMS and largest miss [m] in the best frame, with the best point on the data sheet's flange."""
    last = sheet_frames(wanted)[:, 6]

    def off(x: Array) -> Array:
        at = (last[:, :3, :3] @ (POINTS[2] + 1e-3 * x[:3])) + last[:, :3, 3]
        return np.asarray((Rotation.from_rotvec(1e-3 * x[3:6]).apply(at) + 1e-3 * x[6:] - reached) * 1e3)

    far = np.linalg.norm(off(least_squares(lambda x: off(x).ravel(), np.zeros(9)).x), axis=1) / 1e3
    return [float(np.sqrt((far**2).mean())), float(far.max())]


def table(
    joints: Array,
    kind: Array,
    warmth: Array,
    time: Array,
    way: Array,
    loads: bool,
    turn: Array,
    seen: Array | None,
) -> tuple[str, Array]:
    """Header and rows of a file; `turn`: of the robot in the tracker's frame, for loads by the data sheet."""
    names = [f"q{k}[deg]" for k in range(1, 7)] + [f"direction{k}[1]" for k in range(1, 7)] + ["temperature[degC]"]
    parts = [np.degrees(joints), way, (20 + warmth)[:, None]]
    mass = np.array([TOOLS[int(k)][0] for k in kind])
    if loads:
        last = sheet_frames(joints)[:, 6]
        # By the data sheet: from the reflector to the tool's centre of mass.
        arm = np.array([TOOLS[int(k)][1] for k in kind]) - POINTS[kind]
        arm = (turn @ (last[:, :3, :3] @ arm[..., None]))[..., 0]
        moment = np.cross(arm, [0, 0, -G]) * mass[:, None]
        names += ["load_z[N]", "load_rx[N*m]", "load_ry[N*m]"]
        parts += [-G * mass[:, None], moment[:, :2]]
    else:
        names, parts = [*names, "payload[kg]"], [*parts, mass[:, None]]
    names, parts = [*names, "tool[1]"], [*parts, kind[:, None]]
    if seen is not None:
        names, parts = [*names, "time[s]", "x[mm]", "y[mm]", "z[mm]"], [*parts, time[:, None], 1e3 * seen]
    return ",".join(names), np.hstack(parts)


def judged(
    seed: int, rows: int, without: tuple[str, ...], kept: Path | None, names: list[str]
) -> dict[str, list[float]]:
    """RMS and largest miss of one machine [m], by who calibrated it; NaN where there were no commands."""
    if "tools" in without:
        POINTS[1:] = POINTS[0]
    robot, rng = Robot(seed, without), np.random.default_rng([seed, 1])
    joints, share = day(rows, rng), np.linspace(0, 1, rows)
    kind, time = (share > 0.5).astype(int), 3600 * HOURS * share
    warmth = 1 + rng.uniform(5, 9) * (1 - np.exp(-2.2 * share)) + rng.normal(0, 0.15, rows)
    way = ways(shafts(joints))
    seen = robot.measured(joints, kind, warmth, way, time, rng)
    wanted = day(NEW, rng, 0.95)
    then, third = rng.uniform(warmth.min(), warmth.max(), NEW), np.full(NEW, 2)
    # The program's directions are those of the nominal joints; corrections are small beside the ways.
    now = ways(shafts(wanted))
    sent = {"nominal": wanted}
    for full, who in SCRIPTS:
        start, apart = clock.time(), who.startswith("fuller, no shafts")
        ratios, holds = np.eye(3) if apart else SHAFTS, 1e6 if "signs" in who else 1.0
        told: Told = (kind, warmth, ways(joints) if apart else way, share, ratios, holds)
        new: Told = (third, then, ways(wanted) if apart else now, np.zeros(NEW), ratios, holds)
        x, left = fit(joints, told, seen, full)
        sent[who] = corrected(wanted, new, x)
        sent[f"{who} + GP"] = corrected(wanted, new, x, by_process(joints, left, wanted))
        print(
            f"  {who}: {clock.time() - start:.0f} s, leaves {1e6 * np.sqrt((left**2).sum(1).mean()):.0f}",
            file=sys.stderr,
        )
    for who in names:
        machine, loads, motors = OURS[who]
        machine = machine.replace("tool_per: [tool]\n", "") if "tools" in without else machine
        start, turn = clock.time(), robot.turn.as_matrix()
        ended = [ways(shafts(q) if motors else q) for q in (joints, wanted)]
        records = table(joints, kind, warmth, time, ended[0], loads, turn, seen)
        targets = table(wanted, third, then, np.zeros(NEW), ended[1], loads, turn, None)
        with TemporaryDirectory() as folder:
            place = Path(folder) if kept is None else kept / str(seed) / who.replace(", ", "_").replace(" ", "_")
            place.mkdir(parents=True, exist_ok=True)
            found = commanded(place, machine, records, targets, "run", PLAIN)
        sent[who] = np.full_like(wanted, np.nan) if found is None else found
        print(f"  {who}: {clock.time() - start:.0f} s", file=sys.stderr)
    off: dict[str, list[float]] = {}
    for who, q in sent.items():
        bad = np.isnan(q).any()
        off[who] = [np.nan] * 2 if bad else missed(wanted, robot.reached(q, third, then, now))
    quiet = robot.turn.apply(robot.reached(joints, kind, warmth, way)) + robot.stand
    return off | {"of a reading": [float(np.sqrt(((seen - quiet) ** 2).sum(1).mean())), 0.0]}


def main() -> None:
    """Judge machines, the seeds counted from `--seed`, and print what each contestant misses [µm]."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--rows", type=int, default=60)
    options.add_argument("--without", nargs="*", choices=CAUSES, default=[])
    options.add_argument("--keep", type=Path)
    options.add_argument("--ours", default=";".join(OURS), help="names between semicolons")
    given = options.parse_args()
    names = [name for name in given.ours.split(";") if name]
    every = []
    for seed in range(given.seed, given.seed + given.machines):
        kept = given.keep.resolve() if given.keep else None
        every.append(judged(seed, given.rows, tuple(given.without), kept, names))
        shown = (f"{who} {1e6 * a:.0f} / {1e6 * b:.0f}" for who, (a, b) in every[-1].items())
        print(f"{seed} [µm]: " + "   ".join(shown), flush=True)
    middle = {who: np.median([one[who] for one in every], 0) for who in every[0]}
    print("median [µm]: " + "   ".join(f"{who} {1e6 * a:.0f} / {1e6 * b:.0f}" for who, (a, b) in middle.items()))


if __name__ == "__main__":
    main()
