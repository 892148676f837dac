"""Diagnose a real servo whose model is told one wrong thing at a time: a confusion matrix of real causes.

The logs are of Rhoban/bam (see experiments/data/README.md): one servo with a known pendulum, four motions at three
gains. The complete model is identified on two of the motions; the diagnosis sees the two others.

    python experiments/motion_servo.py FOLDER_OF_LOGS [GAIN …]
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares

from ccnn_torch.motion import diagnose_motion, load_logs, nominal_of
from ccnn_torch.motion.effects import motion_effects
from ccnn_torch.motion.setting import problem_of
from ccnn_torch.records.read_table import read_table
from ccnn_torch.records.table import Table

MASS, LENGTH, VOLTS = 0.49, 0.1, 7.4
SPLITS = (("sin_time_square", "up_and_down"), ("sin_sin", "lift_and_drop"))
# In lift_and_drop the drive is off for the last 4 of 6 s, and the pendulum falls. The model is complete; the columns
# that tell this are withheld. Decided before it was run: right is that the section is left out and nothing named, as
# with the columns, or a cause outside the library. No effect of the library sets in amid a run, so that any name, and
# nothing without a word about the section, is missed.
WITHHELD: tuple[tuple[str, ...], ...] = (("torque_on",), ("torque_on", "pwm1"))
Case = tuple[dict[str, float], set[str], tuple[str, ...]]
START = {
    "gain": 0.9,  # at the servo's gain 400; proportional to it
    "inertia": 0.002,
    "viscous": 0.03,
    "coulomb": 0.005,
    "load_friction": 0.25,
    "stribeck": 0.005,
    "torque_limit": 0.7,
    "delay": 0.007,
}


def keys(values: np.ndarray, gain: int) -> dict[str, float]:
    """The complete model of the servo."""
    own = dict(zip(START, np.maximum(values, 1e-6).tolist(), strict=True))
    own["gain"] *= gain / 400
    return own | {"mass": MASS, "length": LENGTH, "stribeck_speed": 0.3, "supply": VOLTS}


def identified(folder: Path, motions: tuple[str, ...], gains: list[int]) -> np.ndarray:
    """Values of `START` that fit the motions at all gains best (soft L1)."""
    logs = {g: load_logs([folder / f"{m}_kp{g}.csv" for m in motions]) for g in gains}

    def residual(values: np.ndarray) -> np.ndarray:
        parts = []
        for gain, own in logs.items():
            problem = problem_of(own, nominal_of("servo", keys(values, gain), ["rad"]), motion_effects(["delay"]))
            theta = torch.zeros(1, problem.library.size, dtype=torch.float64)
            parts.append(problem.pooled(problem.residual(theta, problem.axes))[0][problem.judged].numpy())
        return np.concatenate(parts)

    start = np.array([*START.values()])
    with torch.no_grad():
        return least_squares(
            residual, start, x_scale=start, diff_step=1e-3, loss="soft_l1", f_scale=0.03, max_nfev=25
        ).x


def wrong_things(full: dict[str, float], gain: int) -> dict[str, tuple[dict[str, float], set[str]]]:
    """What the model is told, and the names that are right: {case: (keys, names)}."""
    other = 400 if gain != 400 else 100
    return {
        "complete": (full, set()),
        "mass x 0.5": (full | {"mass": 0.5 * MASS}, {"payload", "gravity"}),
        f"gain of kp {other}": (full | {"gain": full["gain"] * other / gain}, {"servo_gain"}),
        "no friction": (
            {k: v for k, v in full.items() if k not in ("coulomb", "load_friction", "stribeck")},
            {"coulomb"},
        ),
        "no viscous": ({k: v for k, v in full.items() if k != "viscous"}, {"viscous"}),
        "no gravity": (full | {"gravity_sin": -MASS * 9.80665 * LENGTH}, {"gravity"}),
        "no torque limit": ({k: v for k, v in full.items() if k != "torque_limit"}, {"saturation"}),
        "5 V for 7.4 V": (
            full | {"gain": full["gain"] * 5 / VOLTS, "torque_limit": full["torque_limit"] * 5 / VOLTS},
            {"supply", "servo_gain"},
        ),
        "delay of 60 ms more": (full | {"delay": full["delay"] + 0.06}, {"delay"}),
    }


def without(path: Path, columns: tuple[str, ...]) -> Table:
    """A log as if some columns had not been recorded."""
    table = read_table(path)
    units = {name: unit for name, unit in table.units.items() if name not in columns}
    return replace(table, units=units, values=table.values[:, [table.names.index(name) for name in units]])


def main() -> None:
    """Print one line for each case."""
    folder = Path(sys.argv[1])
    gains = [int(g) for g in sys.argv[2:]] or [100, 400, 800]
    print("identified on | kp | told | named | class | driver | probability | gap before -> after, held out [mrad]")
    for k in range(2):
        values = identified(folder, SPLITS[k], [100, 400, 800])
        print(f"# {SPLITS[k]}: " + ", ".join(f"{n} {v:.4g}" for n, v in zip(START, values, strict=True)))
        for gain in gains:
            full, motions = keys(values, gain), SPLITS[1 - k]
            cases: dict[str, Case] = {told: (*case, ()) for told, case in wrong_things(full, gain).items()}
            if "lift_and_drop" in motions:
                cases |= {f"drive off, without {' and '.join(c)}": (full, set(), c) for c in WITHHELD}
            for told, (own, right, columns) in cases.items():
                logs = load_logs([without(folder / f"{m}_kp{gain}.csv", columns) for m in motions])
                found = diagnose_motion(logs, nominal_of("servo", own, ["rad"])).content
                verdict, gap = found["verdict"], found["gap"]
                names = set(verdict["effects"])
                like = {o for e in found["effects"] if e["name"] in names for o in e["indistinguishable_from"]}
                hit = "right" if (names & right if right else not names) else "class" if like & right else "missed"
                said = verdict["outside_library"] or any("drive was off" in note for log in logs for note in log.notes)
                hit = hit if said or not columns else "missed"
                print(
                    f"{'+'.join(SPLITS[k])} | {gain} | {told} | {', '.join(verdict['effects']) or 'nothing'} | "
                    f"{', '.join(sorted(like)) or '-'} | {verdict['driver'] or '-'} | {verdict['probability']:.2f} | "
                    f"{1e3 * gap['before']:.0f} -> {1e3 * gap['after']:.0f} | {hit}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
