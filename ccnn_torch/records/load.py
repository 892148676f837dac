"""Measured records: one row per configuration, joints commanded and pose reached, in SI."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.records.commanded import Moving, is_open, read_joints
from ccnn_torch.records.covariates import DEFAULT_COVARIATES as DEFAULT_COVARIATES, choose_covariates
from ccnn_torch.records.headers import (
    JOINT_LIMIT,
    ROTATION_VECTOR,
    HasCoordinates,
    check_orientation,
    read_pose as read_pose,
    stack_columns as stack_columns,
    unused_joints,
)
from ccnn_torch.records.read_table import Frame, read_frame, read_table
from ccnn_torch.records.table import FILE as FILE, Table, name_lines as name_lines, write_table as write_table
from ccnn_torch.units import to_si

Source = str | Path | Frame | Sequence[str | Path | Frame]


def is_frame(source: object) -> bool:
    """Whether this is a pandas DataFrame, or has the same attributes."""
    return hasattr(source, "columns") and hasattr(source, "to_numpy")


def read_source(source: Source, columns: Mapping[str, str] | None = None) -> Table:
    """Read records from any supported source.

    Args:
        source: a file, several files with the same columns, or a pandas DataFrame. Rows of several files are
            concatenated, and a column `file` (0, 1, …) numbers them, unless they have one of that name.
        columns: header in the file -> ``name[unit]`` or ``ignore``; for each of several files.

    Raises:
        InputError: a file cannot be read, or files differ in their columns.
    """
    if isinstance(source, str | Path):
        return read_table(source, columns)
    if is_frame(source):
        return read_frame(cast(Frame, source), columns)
    if isinstance(source, Sequence) and source:
        tables = [read_source(each, columns) for each in source]
        return tables[0] if len(tables) == 1 else _joined(tables)
    raise InputError(
        f"records: {'an empty list' if source == [] else f'a {type(source).__name__}'} holds none; give the path of a "
        "CSV file, a list of paths, or a DataFrame"
    )


def _joined(tables: Sequence[Table]) -> Table:
    """Rows of several files, one after the other."""
    first = tables[0]
    for other in tables[1:]:
        _check_alike(first, other)
    values = np.concatenate([t.values[:, [t.names.index(name) for name in first.names]] for t in tables])
    starts = np.cumsum([0, *map(len, tables)])
    bad = {
        (int(start) + row, first.names.index(table.names[column])): text
        for start, table in zip(starts, tables, strict=False)
        for (row, column), text in table.bad_cells.items()
    }
    units, notes = dict(first.units), [note for table in tables for note in table.notes]
    if FILE in units:
        notes.append(f"the files have a column '{FILE}' of their own, which was kept; no other numbers the files")
    else:
        units[FILE] = "1"
        number = np.repeat(np.arange(len(tables), dtype=np.float64), [len(table) for table in tables])
        values = np.concatenate([values, number[:, None]], axis=1)
    return replace(
        first,
        path=", ".join(table.path for table in tables),
        units=units,
        values=values,
        lines=np.concatenate([table.lines for table in tables]),
        bad_cells=bad,
        parts=tuple((table.path, len(table)) for table in tables),
        notes=tuple(notes),
    )


def _check_alike(first: Table, other: Table) -> None:
    for one, two in ((first, other), (other, first)):
        lost = [name for name in one.names if name not in two]
        if lost:
            raise InputError(
                f"{two.path}: there is no column '{lost[0]}', which {one.path} has; files that are read together need "
                "the same columns: add it there, or remove it here"
            )
    for name in first.names:
        if first.units[name] != other.units[name]:
            raise InputError(
                f"{other.path}: column '{name}' is in {other.units[name] or 'no unit'}, but in {first.path} in "
                f"{first.units[name] or 'no unit'}; give both the same unit"
            )


# A joint is beyond its limits by more than rounding [rad or m]; in more than this share of the rows that is said, as
# are directions of 0.
_AT_LIMIT, _MANY = 1e-6, 0.1
# A slide that moves less than this share of its travel may have limits in another unit.
_USED = 0.02
# The tool of an arm whose frames are unknown may lengthen its reach by this share.
_TOOL_ALLOWANCE = 0.25


@dataclass(frozen=True)
class Records:
    """Measured records in SI, rows in the order measured.

    Attributes:
        path: the file; several with commas between them.
        joints: commanded joints, `rows x n`.
        pose: measured pose, `rows x p`, the columns as in `pose_coordinates`; NaN where a cell is empty.
        covariates: further inputs, `rows x m`, the columns as in `covariate_coordinates`.
        joint_coordinates, pose_coordinates, covariate_coordinates: names and SI units. The pose is the mechanism's,
            less the orientation where it was not measured.
        orientation: how a serial arm's orientation was measured: ``rotation_vector``; ``quaternion``, ``kuka``,
            ``fanuc`` or ``staubli`` (converted); or ``none``. None for a mechanism whose pose has fixed columns.
        columns: every column that is neither joint nor pose, `rows` each, in SI, NaN where a cell is empty.
        units: unit of each column as written in the file; empty where it has none.
        notes: what was dropped, ignored or guessed, one sentence each.
        lines: line of each row in the file, `rows`, int64.
        data_hash: SHA-256 of headers and values.
        parts: where rows are from, in order: file and number of its rows; empty for a single file.
        doubt: on joints of commanded poses that may be others, joints beyond the machine's limits, and directions of
            0 and 1; empty without.
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
    parts: tuple[tuple[str, int], ...] = ()
    doubt: str = ""

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def positions(self) -> Tensor:
        """The pose coordinates that are lengths, `rows x d` [m]; the mean where one was not measured."""
        found = self.pose[:, [k for k, coordinate in enumerate(self.pose_coordinates) if coordinate.unit == "m"]]
        return torch.where(found.isnan(), found.nanmean(0), found)

    @property
    def whole(self) -> Tensor:
        """Rows whose pose was measured in all its coordinates, `rows`, bool."""
        return ~self.pose.isnan().any(-1)

    @property
    def missing(self) -> list[str]:
        """Sentences on coordinates of the pose that were not measured in some rows."""
        counts: dict[int, list[str]] = {}
        for count, coordinate in zip(self.pose.isnan().sum(0).tolist(), self.pose_coordinates, strict=True):
            counts.setdefault(count, []).append(coordinate.name)
        return [
            f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} missing in {count} of {len(self)} rows, which "
            "count with what was measured"
            for count, names in counts.items()
            if count
        ]

    def name_rows(self, rows: Sequence[int] | NDArray[np.int64]) -> str:
        """Rows (0-based) by their lines in the file, e.g. "line 17 (row 16)"."""
        return name_lines(self.lines, rows, parts=self.parts)


def load_records(
    source: Source | Records,
    mechanism: Moving,
    covariates: Sequence[str] | None = None,
    learns: bool = True,
    columns: Mapping[str, str] | None = None,
    joint_map: Mapping[str, str] | None = None,
) -> Records:
    """Load records for a mechanism.

    Joint and pose columns are named as the mechanism names them. Where there are no joints, they are the nominal
    inverse kinematics of the poses that were commanded, `goal_x`, `goal_y` … (`commanded.read_joints`), of an arm those
    of all solutions with which the rows fit best (`SerialArm.fitting_branches`). A serial arm
    (one that lists `orientations`) may have its orientation as a rotation vector `rx, ry, rz`, as a quaternion
    `qw, qx, qy, qz`, as Euler angles (`kuka_a, kuka_b, kuka_c`, `fanuc_w, fanuc_p, fanuc_r`,
    `staubli_rx, staubli_ry, staubli_rz`) or not at all; where a
    file has several, the first of these counts. The covariates are by default the columns `time`, `temperature`,
    `load_*`, `torque_*`, `direction*` and `speed*` that are there; `covariates` replaces this choice by names or
    patterns ([] = none). A constant covariate is dropped with a note. A column that is not used needs no unit.

    Args:
        source: a CSV file or an .xlsx workbook; several of them, whose rows are concatenated and whose
            column `file` numbers them; a pandas DataFrame with headers as in a file; or records that are loaded
            already, which stay as they are.
        learns: whether a learner is trained on the rows: fewer than twice the unknowns of a linear fit are then
            refused. An identification checks their number by its parameters.
        columns: header in the file -> ``name[unit]``, or ``ignore``.
        joint_map: joint -> sum of columns, where the controller counts otherwise: ``{"q3": "J3 - J2"}``.

    Raises:
        InputError: a column is missing, is repeated, or has no unit or one of a wrong dimension; a cell is not a
            finite number; values in rad look like degrees; columns look like an orientation that is not read; files
            differ in their columns; too few rows; no input varies.
    """
    if isinstance(source, Records):
        return _loaded(source, mechanism, covariates, columns or joint_map)
    as_read = read_source(source, columns)
    table = read_joints(as_read, mechanism, joint_map, columns)
    joints = stack_columns(table, mechanism.joints, JOINT_LIMIT)
    pose, coordinates, orientation, read = read_pose(table, mechanism, partial=True)
    _refuse_empty(table, pose, coordinates)
    _refuse_without_given(table, mechanism, pose, coordinates)
    doubt, fitting = "", getattr(mechanism, "fitting_branches", None)
    if fitting is not None and len(coordinates) in (3, 6) and not joint_map and is_open(as_read, mechanism.joints):
        there, doubt = fitting(torch.from_numpy(joints), torch.from_numpy(pose))
        joints = there.numpy()
    used = {joint.name for joint in mechanism.joints} | set(read)
    # No other form of an arm's pose may be an input either: it is unknown when a command is given.
    measured = dict.fromkeys(read, "") | {coordinate.name: coordinate.unit for coordinate in coordinates}
    groups = [name for key in ("frame_per", "tool_per") for name in getattr(mechanism, key, ())]
    chosen, notes = choose_covariates(table, mechanism.joints, measured, covariates, groups)
    doubt = "; ".join(filter(None, [doubt, _beyond_limits(mechanism, joints), _half_signs(table, chosen)]))
    unused = [name for name in table.names if name not in used | {c.name for c in chosen}]
    lacking = [c.name for c in mechanism.pose if c.name not in {one.name for one in coordinates}]
    if orientation == "none" or {*ROTATION_VECTOR} <= {*lacking}:
        check_orientation(table, mechanism, unused)
    if learns:
        _check_enough(table, len(mechanism.joints) + len(chosen))
    still = [joint.name for k, joint in enumerate(mechanism.joints) if np.ptp(joints[:, k]) == 0]
    if len(still) == len(mechanism.joints) and not chosen:
        raise InputError(
            f"{table.path}: no input varies: {', '.join(still)} are constant and there is no covariate that changes; "
            "record configurations that differ"
        )
    if lacking and not (orientation == "none" and len(coordinates) == 3):
        parts, others = ", ".join(c.name for c in coordinates), ", ".join(lacking)
        notes.append(f"of the pose only {parts} was measured: an error that {others} alone would show stays")
    notes = [
        *(f"joint '{name}' is constant and carries no information" for name in still),
        *notes,
        *table.notes,
        *([doubt] if doubt else []),
    ]
    alike = unused_joints(table, mechanism.joints, unused)
    if alike:
        notes.append(
            f"columns {', '.join(alike)} look like joints and are not used; {mechanism.name} has no such joint"
        )
    records = Records(
        path=table.path,
        joints=torch.from_numpy(joints),
        pose=torch.from_numpy(pose),
        covariates=torch.from_numpy(stack_columns(table, chosen)),
        joint_coordinates=tuple(mechanism.joints),
        pose_coordinates=coordinates,
        covariate_coordinates=chosen,
        orientation=orientation,
        columns={name: _leniently(table, name, notes) for name in table.names if name not in used},
        units=dict(table.units),
        notes=notes,
        lines=table.lines,
        data_hash=table.data_hash,
        parts=table.parts,
        doubt=doubt,
    )
    return replace(records, notes=[*records.missing, *notes])


def check_rows(records: Records, mechanism: HasCoordinates) -> None:
    """Refuse rows that the mechanism cannot have reached.

    With known frames a row must be `mechanism.reachable(pose)`, where the mechanism has that method. An arm with
    `unknown_frames` can only be judged by its size: no position may be farther from the median position (of its group
    of `frame_per`) than twice `mechanism.reach` [m], to which a quarter is added for the tool where it is unknown too.

    Raises:
        InputError: names the rows.
    """
    unknown: Sequence[str] = getattr(mechanism, "unknown_frames", ())
    if not unknown:
        reachable = getattr(mechanism, "reachable", None)
        if reachable is None or len(records.pose_coordinates) != len(mechanism.pose):
            return
        outside = np.flatnonzero((records.whole & ~reachable(records.pose)).numpy())
        if len(outside):
            other = "; if poses are measured in another frame than the machine's own, write " + (
                "base_frame: unknown into its file"
                if hasattr(mechanism, "convention")
                else "mechanism: framed, and the mechanism and its keys as mechanism_keys: {mechanism: …, keys: {…}}"
            )
            raise InputError(
                f"{records.path}: the pose at {records.name_rows(outside)} is outside the workspace of "
                f"{mechanism.name}; correct or remove {'it' if len(outside) == 1 else 'them'}, or check the units"
                f"{other if len(outside) > _MANY * len(records) else ''}"
            )
        return
    reach = getattr(mechanism, "reach", None)
    positions = records.positions.numpy()
    if reach is None or positions.shape[1] == 0:
        return
    limit = 2 * float(reach) * (1 + _TOOL_ALLOWANCE * ("tool" in unknown))
    # Another base frame may be anywhere.
    keys = [records.columns[name] for name in getattr(mechanism, "frame_per", ()) if name in records.columns]
    group = np.zeros(len(positions))
    if keys:
        group = np.unique(np.stack(keys, -1), axis=0, return_inverse=True)[1].reshape(-1).astype(np.float64)
    distance = np.zeros(len(positions))
    for mine in (group == one for one in np.unique(group)):
        distance[mine] = np.linalg.norm(positions[mine] - np.median(positions[mine], axis=0), axis=1)
    outside = np.flatnonzero(distance > limit)
    if len(outside):
        far = f"{distance[outside[0]]:.3g} m from the median position"
        raise InputError(
            f"{records.path}: the position at {records.name_rows(outside)} is {far}, farther than {mechanism.name} can "
            f"move ({limit:.3g} m, twice its reach and tool); "
            f"correct or remove {'it' if len(outside) == 1 else 'them'}, or check the units"
        )


def _refuse_empty(table: Table, pose: NDArray[np.float64], coordinates: Sequence[Coordinate]) -> None:
    """Raise `InputError` where a row has nothing of the pose."""
    empty = np.flatnonzero(np.isnan(pose).all(1))
    if len(empty):
        shown = ", ".join(c.name for c in coordinates)
        raise InputError(
            f"{table.path}: nothing of the pose was measured at {table.name_rows(empty)}; remove "
            f"{'it' if len(empty) == 1 else 'them'}, or write what was measured of {shown}"
        )


def _refuse_without_given(
    table: Table, mechanism: HasCoordinates, pose: NDArray[np.float64], coordinates: Sequence[Coordinate]
) -> None:
    """Raise `InputError` where an instrument read something and what it was pointed at is not said."""
    names = [c.name for c in coordinates]
    for name, reads in getattr(mechanism, "given_of", {}).items():
        mine = [names.index(one) for one in reads if one in names]
        lacking = np.isnan(pose[:, names.index(name)]) if name in names else np.ones(len(pose), dtype=bool)
        wrong = np.flatnonzero(lacking & ~np.isnan(pose[:, mine]).all(1))
        if mine and len(wrong):
            raise InputError(
                f"{table.path}: column '{name}' is empty at {table.name_rows(wrong)}, where {', '.join(reads)} was "
                "read; say what it was read of"
            )


def _beyond_limits(mechanism: Moving, joints: NDArray[np.float64]) -> str:
    """Where many rows are beyond the limits of a joint that the machine's file names, or use hardly any of a slide's
    travel between them; else empty."""
    limits = getattr(mechanism, "limits", None)
    if limits is None or not getattr(mechanism, "recipe", {}).get("keys", {}).get("limits"):
        return ""
    low, high = limits.numpy().T
    beyond = ((joints < low - _AT_LIMIT) | (joints > high + _AT_LIMIT)).sum(0)
    most = _MANY * len(joints)
    said, names = [], [joint.name for joint in mechanism.joints]
    if far := [f"{name} in {n}" for name, n in zip(names, beyond, strict=True) if n > most]:
        said.append(
            f"joints are beyond the limits of the machine's file (key limits), {', '.join(far)} of {len(joints)} rows: "
            "no command will go there, so correct the limits if the machine does"
        )
    used, travel = np.ptp(joints, axis=0), high - low
    hardly = (used > 0) & (used < _USED * travel) & (travel < np.inf) & [c.unit == "m" for c in mechanism.joints]
    if few := [f"{names[i]} {used[i]:.3g} m of {travel[i]:.3g} m" for i in np.flatnonzero(hardly)]:
        said.append(
            f"rows use hardly any of the travel in the machine's file, {', '.join(few)}: check the unit of its limits"
        )
    return "; ".join(said)


def _half_signs(table: Table, chosen: Sequence[Coordinate]) -> str:
    """A sentence where directions of motion are 0 and 1 in the place of -1 and 1; else empty."""
    names = [c.name for c in chosen if c.name.startswith("direction")]
    # A joint that moves one way alone has few rows before its first motion.
    wrong = [n for n in names if set(table.raw(n)) == {0.0, 1.0} and np.mean(table.raw(n) == 0) > _MANY]
    if not wrong:
        return ""
    return f"{', '.join(wrong)}: 0 or 1, and never -1; write the sign of the motion, or backlash is told twice as large"


def _loaded(
    records: Records,
    mechanism: HasCoordinates,
    covariates: Sequence[str] | None,
    columns: Mapping[str, str] | None,
) -> Records:
    """Records as they are, where they are of this mechanism."""
    names, wanted = ([c.name for c in joints] for joints in (records.joint_coordinates, mechanism.joints))
    if names != wanted:
        raise InputError(
            f"{records.path}: these records have the joints {', '.join(names)}, and {mechanism.name} has "
            f"{', '.join(wanted)}; load them with this mechanism"
        )
    if covariates or columns:
        key = "covariates" if covariates else "columns"
        raise InputError(f"{key}: the records are loaded already; give it to load_records instead")
    return records


def fewest_rows(inputs: int) -> int:
    """Rows that a learner of so many inputs needs."""
    return 2 * (inputs + 1)


def _check_enough(table: Table, inputs: int) -> None:
    least = fewest_rows(inputs)
    if len(table) < least:
        raise InputError(
            f"{table.path}: {len(table)} rows are too few, at least {least} are needed: a linear fit in {inputs} "
            f"inputs has {inputs + 1} unknowns per joint, and as many rows again must judge it"
        )


def _leniently(table: Table, name: str, notes: list[str]) -> NDArray[np.float64]:
    """A column that is perhaps never used: not judged, and left as written if its unit is not known."""
    try:
        return to_si(table.raw(name), table.units[name] or "1", where=f"column '{name}'")
    except InputError as reason:
        notes.append(f"{reason}; its values are kept as written")
        return table.raw(name).copy()
