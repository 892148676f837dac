"""Measured records: one row per configuration, joints commanded and pose reached, in SI."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch._covariates import DEFAULT_COVARIATES as DEFAULT_COVARIATES
from ccnn_torch._covariates import choose_covariates
from ccnn_torch._table import Table as Table
from ccnn_torch._table import name_lines as name_lines
from ccnn_torch._table import read_table as read_table
from ccnn_torch._table import write_table as write_table
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.units import to_si

__all__ = [
    "DEFAULT_COVARIATES",
    "JOINT_LIMIT",
    "Records",
    "Table",
    "check_rows",
    "load_records",
    "name_lines",
    "read_pose",
    "read_table",
    "stack_columns",
    "write_table",
]

_ROTATION_VECTOR = ("rx", "ry", "rz")
_QUATERNION = ("qw", "qx", "qy", "qz")
# Two turns of a joint and one of a pose angle, rounded up so that 360 degrees written as 6.2832 passes.
JOINT_LIMIT, _POSE_LIMIT = 12.6, 6.3
# The tool of an arm whose frames are unknown may lengthen its reach by this share.
_TOOL_ALLOWANCE = 0.25


class HasCoordinates(Protocol):
    """What records need to know of a mechanism."""

    @property
    def name(self) -> str: ...
    @property
    def joints(self) -> tuple[Coordinate, ...]: ...
    @property
    def pose(self) -> tuple[Coordinate, ...]: ...
    @property
    def orientations(self) -> tuple[str, ...]: ...


@dataclass(frozen=True)
class Records:
    """Measured records in SI, rows in the order measured.

    Attributes:
        path: the file.
        joints: commanded joints, `rows x n`.
        pose: measured pose, `rows x p`, the columns as in `pose_coordinates`.
        covariates: further inputs, `rows x m`, the columns as in `covariate_coordinates`.
        joint_coordinates, pose_coordinates, covariate_coordinates: names and SI units. The pose is the mechanism's,
            less the orientation where it was not measured.
        orientation: how a serial arm's orientation was measured: ``rotation_vector``, ``quaternion`` (converted) or
            ``none``; None for a mechanism whose pose has fixed columns.
        columns: every column that is neither joint nor pose, `rows` each, in SI, NaN where a cell is empty.
        units: unit of each column as written in the file.
        notes: what was dropped or ignored, one sentence each.
        lines: line of each row in the file, `rows`, int64.
        data_hash: SHA-256 of headers and values.
    """

    path: str
    joints: Tensor
    pose: Tensor
    covariates: Tensor
    joint_coordinates: tuple[Coordinate, ...]
    pose_coordinates: tuple[Coordinate, ...]
    covariate_coordinates: tuple[Coordinate, ...]
    orientation: str | None
    columns: dict[str, NDArray[np.float64]]
    units: dict[str, str]
    notes: list[str]
    lines: NDArray[np.int64]
    data_hash: str

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def joint_units(self) -> dict[str, str]:
        """Unit of each joint as written in the file."""
        return {joint.name: self.units[joint.name] for joint in self.joint_coordinates}

    @property
    def pose_units(self) -> dict[str, str]:
        """Unit of each pose coordinate as written in the file (rad for a quaternion's rotation vector)."""
        return {
            coordinate.name: self.units.get(coordinate.name, coordinate.unit) for coordinate in self.pose_coordinates
        }

    @property
    def positions(self) -> Tensor:
        """The pose coordinates that are lengths, `rows x d` [m]."""
        return self.pose[:, [k for k, coordinate in enumerate(self.pose_coordinates) if coordinate.unit == "m"]]

    def name_rows(self, rows: Sequence[int] | NDArray[np.int64]) -> str:
        """Rows (0-based) as a person finds them in the file, e.g. "line 17 (row 16)"."""
        return name_lines(self.lines, rows)


def load_records(
    path: str | Path, mechanism: HasCoordinates, covariates: Sequence[str] | None = None, learns: bool = True
) -> Records:
    """Load records for a mechanism.

    Joint and pose columns are named as the mechanism names them. A serial arm (one that lists `orientations`) may have
    its orientation as a rotation vector `rx, ry, rz`, as a quaternion `qw, qx, qy, qz` or not at all; where a file has
    both, the rotation vector counts. The covariates are by default the columns `time`, `temperature`, `load_*`,
    `direction*` and `speed*` that are there; `covariates` replaces this choice by names or patterns ([] = none). A
    constant covariate is dropped with a note.

    Args:
        learns: whether a learner is trained on the rows: fewer than a linear fit of the inputs needs, twice, are then
            refused. How many an identification needs, its number of parameters tells.

    Raises:
        InputError: a column is missing, stands twice, or has no unit or one of a wrong dimension; a cell is not a
            finite number; values in rad look like degrees; too few rows; no input varies.
    """
    table = read_table(path, {c.name: c.unit for c in (*mechanism.joints, *mechanism.pose)})
    joints = stack_columns(table, mechanism.joints, JOINT_LIMIT)
    pose, coordinates, orientation = read_pose(table, mechanism)
    measured = (*coordinates, *(Coordinate(name, "1") for name in _QUATERNION if orientation is not None))
    chosen, notes = choose_covariates(table, mechanism.joints, measured, covariates)
    if learns:
        _check_enough(table, len(mechanism.joints) + len(chosen))
    still = [joint.name for k, joint in enumerate(mechanism.joints) if np.ptp(joints[:, k]) == 0]
    if len(still) == len(mechanism.joints) and not chosen:
        raise InputError(
            f"{table.path}: no input varies: {', '.join(still)} are constant and there is no covariate that changes; "
            "record configurations that differ"
        )
    notes = [f"joint '{name}' is constant and tells the learner nothing" for name in still] + notes
    others = {name for name in table.names if name not in {c.name for c in (*mechanism.joints, *measured)}}
    return Records(
        path=table.path,
        joints=torch.from_numpy(joints),
        pose=torch.from_numpy(pose),
        covariates=torch.from_numpy(stack_columns(table, chosen)),
        joint_coordinates=tuple(mechanism.joints),
        pose_coordinates=coordinates,
        covariate_coordinates=chosen,
        orientation=orientation,
        columns={name: _leniently(table, name, notes) for name in table.names if name in others},
        units=dict(table.units),
        notes=notes,
        lines=table.lines,
        data_hash=table.data_hash,
    )


def check_rows(records: Records, mechanism: HasCoordinates) -> None:
    """Refuse rows that the mechanism cannot have reached.

    With known frames a row must be `mechanism.reachable(pose)`, where the mechanism has that method. An arm with
    `unknown_frames` can only be judged by its size: no position may be farther from the median position than twice
    `mechanism.reach` [m], to which a quarter is added for the tool where that is unknown too.

    Raises:
        InputError: names the rows.
    """
    unknown: Sequence[str] = getattr(mechanism, "unknown_frames", ())
    if not unknown:
        reachable = getattr(mechanism, "reachable", None)
        if reachable is None or len(records.pose_coordinates) != len(mechanism.pose):
            return
        outside = np.flatnonzero(~reachable(records.pose).numpy())
        if len(outside):
            raise InputError(
                f"{records.path}: the pose at {records.name_rows(outside)} is outside the workspace of "
                f"{mechanism.name}; correct or remove {'it' if len(outside) == 1 else 'them'}, or check the units"
            )
        return
    reach = getattr(mechanism, "reach", None)
    positions = records.positions.numpy()
    if reach is None or positions.shape[1] == 0:
        return
    limit = 2 * float(reach) * (1 + _TOOL_ALLOWANCE * ("tool" in unknown))
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    outside = np.flatnonzero(distance > limit)
    if len(outside):
        far = f"{distance[outside[0]]:.3g} m from the median position"
        raise InputError(
            f"{records.path}: the position at {records.name_rows(outside)} is {far}, farther than {mechanism.name} can "
            f"move ({limit:.3g} m, twice its reach and tool); "
            f"correct or remove {'it' if len(outside) == 1 else 'them'}, or check the units"
        )


def stack_columns(table: Table, coordinates: Sequence[Coordinate], angle_limit: float = np.inf) -> NDArray[np.float64]:
    """Columns side by side, `rows x len(coordinates)`; refuses angles in rad beyond `angle_limit`."""
    values = np.empty((len(table), len(coordinates)))
    for k, coordinate in enumerate(coordinates):
        values[:, k] = table.column(coordinate.name, coordinate.unit)
        far = np.flatnonzero(np.abs(values[:, k]) > angle_limit)
        if table.units[coordinate.name] == "rad" and len(far):
            raise InputError(
                f"{table.path}: column '{coordinate.name}[rad]' has {values[far[0], k]:g} at "
                f"{name_lines(table.lines, far[:1])}, which looks like degrees; write '{coordinate.name}[deg]'"
            )
    return values


def read_pose(
    table: Table, mechanism: HasCoordinates
) -> tuple[NDArray[np.float64], tuple[Coordinate, ...], str | None]:
    """Pose `rows x p` [SI], its coordinates, and how the orientation was measured."""
    if not mechanism.orientations:
        return stack_columns(table, mechanism.pose, _POSE_LIMIT), tuple(mechanism.pose), None
    position = tuple(c for c in mechanism.pose if c.name not in _ROTATION_VECTOR)
    full = (*position, *(Coordinate(name, "rad") for name in _ROTATION_VECTOR))
    if any(name in table for name in _ROTATION_VECTOR):
        return stack_columns(table, full, _POSE_LIMIT), full, "rotation_vector"
    if not any(name in table for name in _QUATERNION):
        return stack_columns(table, position), position, "none"
    quaternion = stack_columns(table, [Coordinate(name, "1") for name in _QUATERNION])
    norm = np.linalg.norm(quaternion, axis=1)
    # Written with three digits a unit quaternion is within 0.001 of norm 1; ten times that is no quaternion.
    wrong = np.flatnonzero(np.abs(norm - 1) > 0.01)
    if len(wrong):
        raise InputError(
            f"{table.path}: the quaternion qw, qx, qy, qz at {name_lines(table.lines, wrong)} has norm "
            f"{norm[wrong[0]]:.3g} instead of 1; correct it, or give the orientation as rx[rad], ry[rad], rz[rad]"
        )
    # Only here: few files give quaternions, and the import takes long.
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_rotvec()
    return np.concatenate([stack_columns(table, position), vector], axis=1), full, "quaternion"


def _check_enough(table: Table, inputs: int) -> None:
    least = 2 * (inputs + 1)
    if len(table) < least:
        raise InputError(
            f"{table.path}: {len(table)} rows are too few, at least {least} are needed: a linear fit in {inputs} "
            f"inputs has {inputs + 1} unknowns per joint, and as many rows again must judge it"
        )


def _leniently(table: Table, name: str, notes: list[str]) -> NDArray[np.float64]:
    """A column that is perhaps never used: not judged, and left as written if its unit is not known."""
    try:
        return to_si(table.raw(name), table.units[name], where=f"column '{name}'")
    except InputError as reason:
        notes.append(f"{reason}; its values are kept as written")
        return table.raw(name).copy()
