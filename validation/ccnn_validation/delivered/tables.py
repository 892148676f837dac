"""Files between judge and program: records and targets as CSV with headers `name[unit]`, and what comes back."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ccnn_validation.delivered.machine import Machine, Pose
from ccnn_validation.delivered.plan import Rows
from ccnn_validation.delivered.rotation import Array

_SI = {"rad": 1.0, "deg": math.pi / 180, "m": 1.0, "mm": 1e-3, "1": 1.0, "N": 1.0, "degC": 1.0}
_UNITS = {"temperature": "degC", "load_z": "N"}
Columns = list[tuple[str, Array]]


def degrees(machine: Machine) -> bool:
    """Whether a machine's files are in degrees and millimetres, an arm's with quaternions; every second one's are."""
    return machine.seed % 2 == 1


@dataclass(frozen=True)
class Commands:
    """Commands of a file in its row order, SI.

    Attributes:
        joints: `s x n`.
        status: 0 exact, 1 outside, 2 not finite, 3 damped, `s`; without that column 1 where outside the domain.
    """

    joints: Array
    status: Array


def write_records(path: Path, machine: Machine, rows: Rows, measured: Pose) -> None:
    """Measured rows: joints, pose and covariates."""
    _write(path, [*_joints(machine, rows), *_pose(measured, degrees(machine), machine.frames > 0), *_covariates(rows)])


def write_targets(path: Path, machine: Machine, rows: Rows) -> None:
    """Ideal joints and covariates, in the units of the records."""
    _write(path, [*_joints(machine, rows), *_covariates(rows)])


def read_commands(path: Path, joints: int) -> Commands:
    """Columns `command_q1[unit]` … and `status[1]`, or `inside_domain[1]` where there is no status.

    Raises:
        ValueError: a column of a command is missing.
    """
    with path.open(newline="") as file:
        header, *lines = list(csv.reader(file))
    table = np.array(lines, float)
    named = {h.partition("[")[0]: (i, h.partition("[")[2].rstrip("]")) for i, h in enumerate(header)}
    wanted = [f"command_q{i + 1}" for i in range(joints)]
    if missing := [name for name in wanted if name not in named]:
        raise ValueError(f"{path}: no column {missing[0]}")
    command = np.stack([table[:, named[name][0]] * _SI[named[name][1]] for name in wanted], -1)
    status = table[:, named["status"][0]] if "status" in named else 1 - table[:, named["inside_domain"][0]]
    return Commands(command, status)


def _joints(machine: Machine, rows: Rows) -> Columns:
    found = []
    for i, unit in enumerate(machine.units):
        shown = {"rad": "deg", "m": "mm"}[unit] if degrees(machine) else unit
        found.append((f"q{i + 1}[{shown}]", rows.joints[:, i] / _SI[shown]))
    return found


def _pose(measured: Pose, shown: bool, arm: bool) -> Columns:
    unit = "mm" if shown else "m"
    found = [(f"{axis}[{unit}]", v / _SI[unit]) for axis, v in zip("xyz", measured.position.T, strict=False)]
    if measured.rotation is None:
        return found
    turn = Rotation.from_matrix(measured.rotation)
    if shown and arm:
        x, y, z, w = turn.as_quat().T
        return [*found, ("qw[1]", w), ("qx[1]", x), ("qy[1]", y), ("qz[1]", z)]
    return found + [(f"r{axis}[rad]", v) for axis, v in zip("xyz", turn.as_rotvec().T, strict=True)]


def _covariates(rows: Rows) -> Columns:
    return [(f"{name}[{_UNITS.get(name, '1')}]", rows.covariates[name]) for name in rows.columns]


def _write(path: Path, columns: Sequence[tuple[str, Array]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([name for name, _ in columns])
        writer.writerows([[f"{v:.12g}" for v in line] for line in np.stack([v for _, v in columns], -1)])
