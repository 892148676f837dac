"""One machine from the measurement to the true poses under the commands of every file, as one row of figures.

The rule of frames, the same for all contestants: the wanted pose of ideal joints is the nominal machine's, in the base
and tool frame that bring it nearest (position, and 0.3 m/rad times orientation) to the noise-free true poses of the
measured rows. That gives the figures `fixed`. A contestant fits frames to its own noisy rows, so for the figures
without that word the two frames are fitted again by the same rule to the true poses that its commands of the set
`inside` reach. The reference is treated alike. Of a machine with fewer joints than coordinates these figures, and
`before`, have only the part of an error that its joints can change; `fixed` has all of it. Parallel machines are
measured in their own base and have no frames to fit: there both are the same.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ccnn_validation.delivered.machine import Machine, Pose
from ccnn_validation.delivered.plan import SETS, Rows, measured_pose, measured_rows, test_rows
from ccnn_validation.delivered.product import calibrated, delivered, promised
from ccnn_validation.delivered.reference import apart, commands, expected, fitted, fitted_frames, reachable, rms
from ccnn_validation.delivered.rotation import Array
from ccnn_validation.delivered.tables import Commands

Figures = dict[str, float | str | None]
RELIABLE = 1.2
"""The reference counts where its model error is at most so many times what its Cramér-Rao bound says."""
_TRAINED = 0.7
"""Share of the rows that the program trains on."""
_DAMPED = 3


def judged(
    machine: Machine, rows: int, tests: int, command: str, forms: Sequence[str], keys: Sequence[str], out: Path
) -> Figures:
    """The row of a machine.

    Args:
        machine: as drawn.
        rows: measured rows.
        tests: rows of each test set.
        command, keys: how the program calibrates; see `calibrated`.
        forms: files by which commands are made; see `delivered`.
        out: folder for its files.
    """
    measured_at = measured_rows(machine, rows)
    measured = measured_pose(machine, measured_at)
    sets = test_rows(machine, tests)
    true = machine.true_pose(measured_at.joints, measured_at.covariates)
    frames = fitted_frames(machine, measured_at.joints, true)
    row: Figures = {"kind": machine.kind, "seed": machine.seed, "extras": "+".join(machine.extras)}
    row |= {"noise_mm": 1e3 * machine.noise[0] * math.sqrt(true.position.shape[1])}
    row |= {"noise_mrad": 1e3 * machine.noise[1] * math.sqrt(3) if true.rotation is not None else 0.0}
    inside = sets["inside"]
    wanted = machine.nominal_pose(frames, inside.joints)
    span = reachable(machine, frames, inside.joints)
    row["whole"] = "" if span is None else "fixed_"
    row |= _pair("before", rms(wanted, machine.true_pose(inside.joints, inside.covariates), span))
    row |= reference_row(machine, measured_at, measured, sets, frames)
    start = time.perf_counter()
    contestant = calibrated(machine, measured_at, measured, command, keys, out)
    row["seconds"] = time.perf_counter() - start
    promise = promised(contestant)
    for name, scale, unit in (("position", 1e3, "mm"), ("rotation", 1e3, "mrad")):
        for key, column in ((name, "promised"), (f"{name}_explained", "explained")):
            value = promise[key]
            row[f"{column}_{unit}"] = None if value is None else scale * value
    for form in forms:
        found = delivered(contestant, form, machine, sets)
        if found:
            row |= reached(machine, sets, found, frames, form)
    row["said"] = " | ".join(contestant.said)
    (out / "row.json").write_text(json.dumps(row, indent=1) + "\n")
    return row


def reference_row(machine: Machine, at: Rows, measured: Pose, sets: Mapping[str, Rows], frames: Array) -> Figures:
    """Figures of the reference: what it reaches, its model error, and what its Cramér-Rao bound says.

    Args:
        machine, sets, frames: as of `reached`.
        at, measured: measured rows and what was read there.
    """
    fit = fitted(machine, at, measured)
    target = fitted_frames(machine, at.joints, measured)
    found = {}
    for name, rows in sets.items():
        joints = commands(machine, fit.unknowns, machine.nominal_pose(target, rows.joints), rows)
        found[name] = Commands(joints, np.zeros(len(joints)))
    inside = sets["inside"]
    at_command = Rows(found["inside"].joints, inside.covariates, inside.columns)
    model = rms(
        machine.pose(fit.unknowns, at_command.joints, at_command.covariates),
        machine.true_pose(at_command.joints, at_command.covariates),
    )
    bound = expected(machine, fit, at_command)
    ratios = [m / b for m, b in zip(model, bound, strict=True) if b > 0]
    row = _pair("reference_model", model) | _pair("reference_predicted", bound)
    row |= _pair("predicted_on_trained_share", expected(machine, fit, at_command, _TRAINED))
    row["reference_counts"] = float(max(ratios) <= RELIABLE)
    return row | reached(machine, sets, found, frames, "reference")


def reached(
    machine: Machine, sets: Mapping[str, Rows], found: Mapping[str, Commands], frames: Array, who: str
) -> Figures:
    """RMS of the true machine under commands: in frames fitted again, in the given ones, and without damped rows.

    Args:
        machine: the true one.
        sets: rows of ideal joints by the names of `SETS`.
        found: their commands.
        frames: base and tool frame of the rule.
        who: prefix of the figures' names.
    """
    row: Figures = {}
    poses = {n: machine.true_pose(found[n].joints, sets[n].covariates) for n in SETS}
    spans = {n: reachable(machine, frames, sets[n].joints) for n in SETS}
    again = fitted_frames(machine, sets["inside"].joints, poses["inside"], spans["inside"])
    for name in SETS:
        wanted = machine.nominal_pose(again, sets[name].joints)
        row |= _pair(f"{who}_{name}", rms(wanted, poses[name], spans[name]))
        row |= _pair(f"{who}_{name}_fixed", rms(machine.nominal_pose(frames, sets[name].joints), poses[name]))
        exact = found[name].status != _DAMPED
        if not exact.all():
            row |= _pair(
                f"{who}_{name}_exact", rms(_some(wanted, exact), _some(poses[name], exact), _rows(spans[name], exact))
            )
        row[f"{who}_{name}_damped"] = float((~exact).sum())
        row[f"{who}_{name}_outside"] = float((found[name].status == 1).sum())
        errors = np.linalg.norm(apart(wanted, poses[name])[:, : wanted.position.shape[1]], axis=-1)
        row[f"{who}_{name}_max_mm"] = 1e3 * float(errors.max())
    row[f"{who}_jump"] = jump(sets["wrist"].joints, found["wrist"].joints)
    return row


def jump(ideal: Array, command: Array) -> float:
    """Largest jump of a commanded joint between neighbouring rows, over that of the ideal joints."""
    return float(np.abs(np.diff(command, axis=0)).max() / np.abs(np.diff(ideal, axis=0)).max())


def _rows(span: Array | None, rows: NDArray[np.bool_]) -> Array | None:
    return None if span is None else span[rows]


def _some(pose: Pose, rows: NDArray[np.bool_]) -> Pose:
    return Pose(pose.position[rows], None if pose.rotation is None else pose.rotation[rows])


def _pair(name: str, figures: tuple[float, float]) -> Figures:
    return {f"{name}_mm": 1e3 * figures[0], f"{name}_mrad": 1e3 * figures[1]}
