"""A welding arm of 1.4 m reach, calibrated in the shop with draw-wire sensors alone, judged under a third payload.

`python -m ccnn_validation.wire_arm --seed N [--machines N] [--rows N] [--who LIST] [--keep FOLDER]`. Two wires stand
at places known to 5 cm, and hang on a hook whose place is known to a millimetre; what each drum showed at its stop is
known to half a millimetre. A session of `--rows` poses with 2 kg, and one with 8 kg, in an arm that warms up. Ours
(`ccnn run`, by the written file) stands beside plain and fuller scripts of the same rows. Judged are other places on
another day under 5 kg, in the frame and at the tool point that suit what is reached best, as RMS and largest.

Of ours: `wires` as they are read, with the payload as loads; `weightless` without the effect of it; `torques` with what
it asks of the drives, by the drawing, in the place of the loads; and, with these torques: `told` less the true starts,
`searched` less those at which `ccnn run` itself leaves least, `turns` one wire at a time (odd rows, even rows), `one`
the first wire alone. `xyz` is a tracker with the wires' noise, with loads.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ccnn_validation.drawn import commanded
from ccnn_validation.wire_arm_robot import (
    DRAWN,
    HIGH,
    HOOK,
    LOW,
    Arm,
    Array,
    G,
    Visit,
    both,
    chain,
    session,
    tip,
    torque,
    visited,
)
from ccnn_validation.wire_arm_script import fitted, followed

NEW, AFTER = 300, 5.0
OURS = "wires,weightless,torques,told,turns,one,xyz"
WEIGHTLESS = "effects: [joint_gain, transmission, backlash, friction, gravity, thermal, coupling]\n"
SHEET = """robot: welding arm
dof: 6
convention: standard Denavit-Hartenberg
units: {length: m, angle: deg}
a: [0.15, 0.60, -0.02, 0, 0, 0]
alpha: [-90, 0, -90, 90, -90, 0]
d: [0.45, 0, 0, 0.64, 0, 0.10]
theta: [0, -90, 0, 0, 0, 0]
limits: [[-170, 170], [-80, 130], [-170, 110], [-185, 185], [-125, 125], [-350, 350]]
gears: [125, 160, 125, 100, 80, 50]
base_frame: BASE
tool_offset: unknown
"""
WIRE = "mechanism: instrument\nmechanism_keys: {mechanism: machine.yaml, kind: wire, anchors: NUMBER}\n"
NAMES = [
    *(f"q{k}[rad]" for k in range(1, 7)), "temperature[degC]", *(f"direction{k}[1]" for k in range(1, 7)),
]  # fmt: skip


def told(visit: Visit, torques: bool) -> tuple[list[str], Array]:
    """The columns beside what was read: the weight of what is carried, or what it asks of the drives."""
    axes, places, flange = chain(visit.joints, DRAWN)
    force, centre = np.multiply.outer(visit.mass, [0.0, 0.0, -G]), tip(flange, visit.centre)
    moment = np.cross(centre - tip(flange, HOOK), force)
    if torques:
        names, columns = [f"torque_q{k}[N*m]" for k in range(1, 7)], torque(axes, places, centre, force)
    else:
        names = [f"load_{n}[N]" for n in "xyz"] + [f"load_r{n}[N*m]" for n in "xyz"]
        columns = np.c_[force, moment]
    return [*NAMES, *names], np.c_[visit.joints, visit.temperature, visit.direction, columns]


def alone(read: Array) -> Array:
    """Readings of one wire at a time: the other's cell is none."""
    left = read.copy()
    left[0::2, 1] = left[1::2, 0] = np.nan
    return left


def written(folder: Path, kind: str, visit: Visit, read: Array, after: Visit) -> dict[str, Any]:
    """Arguments of `commanded`; a row for each reading of a wire."""
    torques, wires = kind not in ("wires", "weightless", "xyz"), kind != "xyz"
    names, columns = told(visit, torques)
    # What never changes, as the torque of an upright axis, needs no column.
    keep = [k for k in range(len(names)) if np.ptp(columns[:, k]) > 1e-9]
    header = ",".join(names[k] for k in keep)
    folder.mkdir(parents=True, exist_ok=True)
    if wires:
        row, wire = np.nonzero(np.isfinite(read))
        rows = np.c_[columns[row][:, keep], wire + 1, read[row, wire]]
        records, config = (f"{header},anchor[1],distance[m]", rows), WIRE.replace("NUMBER", str(read.shape[1]))
    else:
        records, config = (f"{header},x[m],y[m],z[m]", np.c_[columns[:, keep], read]), "mechanism: machine.yaml\n"
    return {
        "folder": folder,
        "machine": SHEET.replace("BASE", "identity" if wires else "unknown"),
        "records": records,
        "targets": (header, told(after, torques)[1][:, keep]),
        "config": config + (WEIGHTLESS if kind == "weightless" else ""),
    }


def searched(folder: Path, visit: Visit, read: Array, after: Visit) -> Array:
    """Starts of the wires at which `ccnn run` leaves least of held-out rows: the lowest place of a paraboloid [m]."""
    step = 0.6e-3
    tried = step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1]])
    left = []
    for number, start in enumerate(tried):
        at = folder / f"try{number}"
        commanded(**written(at, "searched", visit, read - start, after))
        pose = json.loads((at / "run" / "results.json").read_text())["pose"]["position"]
        # What the effects leave: that of the file may be far worse.
        left.append(pose.get("effects", pose["geometry"])["rms"]["median"] ** 2)
    u, v = (tried / step).T
    c = np.linalg.solve(np.c_[np.ones(6), u, v, u * u, v * v, u * v], left)
    return np.asarray(step * np.linalg.solve([[2 * c[3], c[5]], [c[5], 2 * c[4]]], -c[1:3]))


def missed(wanted: Array, reached: Array) -> tuple[float, float]:
    """What is missed in the best frame, with the best point on the nominal flange: RMS and largest [m]."""

    def off(x: Array) -> Array:
        return np.asarray((Rotation.from_rotvec(x[:3]).apply(reached) + x[3:6] - tip(wanted, HOOK + x[6:])).ravel())

    found = least_squares(off, np.zeros(9), x_scale=1e-3)
    far = np.linalg.norm(found.fun.reshape(-1, 3), axis=-1)
    return float(np.sqrt((far**2).mean())), float(far.max())


Missed = dict[str, tuple[float, float]]


def judged(seed: int, rows: int, who: list[str], folder: Path) -> Missed:
    """RMS and largest of what one arm misses [m], by who calibrated it; NaN where there were no commands."""
    arm, rng = Arm(seed), np.random.default_rng([seed, 1])
    light = session(arm, 2.0, rows, (22 + rng.uniform(-2, 2), 30 + rng.uniform(-2, 2)), rng)
    visit = both(light, session(arm, 8.0, rows, (27 + rng.uniform(-2, 2), 32 + rng.uniform(-2, 2)), rng))
    read, single = arm.measured(visit, rng), arm.measured(visit, rng, (0,))
    places = arm.tracked(visit, rng)
    target = rng.uniform(LOW + 0.1, HIGH - 0.1, (NEW, 6))
    # As a planner does it: not near the wrist's singular place.
    target[:, 4] = rng.choice([-1, 1], NEW) * rng.uniform(0.3, 1.5, NEW)
    after = visited(target, np.full(NEW, AFTER), rng.uniform(24, 31, NEW), rng)
    wanted = chain(target, DRAWN)[2]
    sent: dict[str, Array | None] = {"as drawn": target}
    shown: dict[str, tuple[Array, tuple[int, ...]]] = {
        "wires": (read, (0, 1)),
        "turns": (alone(read), (0, 1)),
        "one": (single, (0,)),
        "xyz": (places, ()),
    }
    for name in [name for name in shown if name in who]:
        for how in ("plain", "fuller"):
            fit = fitted(visit, *shown[name], how == "fuller")
            sent[f"{how} {name}"] = followed(fit, after, wanted)
            starts = f", starts {np.round(1e6 * fit.device[3::5])}" if name != "xyz" else ""
            print(f"  {how} {name}: left {1e6 * fit.left:.0f} µm{starts}", flush=True)
    print(f"  true starts {np.round(1e6 * arm.zero)}, noise {np.round(1e6 * arm.noise)} µm", flush=True)
    for name in who:
        begun, at = time.monotonic(), folder / f"{seed}_{name}"
        given = shown.get(name, shown["wires"])[0]
        if name == "told":
            given = given - arm.zero
        elif name == "searched":
            starts_found = searched(at, visit, given, after)
            print(f"  searched starts {np.round(1e6 * starts_found)}", flush=True)
            given = given - starts_found
        sent[f"ours {name}"] = commanded(**written(at, name, visit, given, after))
        print(f"  ours {name}: {time.monotonic() - begun:.0f} s", flush=True)
    nothing = float("nan"), float("nan")
    found = {}
    for name, joints in sent.items():
        got = None if joints is None else arm.reached(Visit(**{**vars(after), "joints": joints}))
        found[name] = nothing if got is None or np.isnan(got).any() else missed(wanted, got)
    return found


def main() -> None:
    """Judge machines, the seeds counted from `--seed`, and print what each contestant misses."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--rows", type=int, default=100, help="poses of a session; there are two")
    options.add_argument("--who", default=OURS, help="of ours, between commas")
    options.add_argument("--keep", type=Path, help="folder of the files; by default a temporary one")
    given = options.parse_args()
    folder = (given.keep or Path(mkdtemp())).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    every = []
    for seed in range(given.seed, given.seed + given.machines):
        every.append(judged(seed, given.rows, [name for name in given.who.split(",") if name], folder))
        (folder / f"{seed}.json").write_text(json.dumps(every[-1], indent=1))
        print(f"{seed} [µm]: " + "   ".join(f"{n} {1e6 * v[0]:.0f} ({1e6 * v[1]:.0f})" for n, v in every[-1].items()))
    middle = {name: np.nanmedian([one[name] for one in every], axis=0) for name in every[0]}
    print("median [µm]: " + "   ".join(f"{n} {1e6 * v[0]:.0f} ({1e6 * v[1]:.0f})" for n, v in middle.items()))


if __name__ == "__main__":
    main()
