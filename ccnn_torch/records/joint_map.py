"""Joints as linear functions of a file's columns, where a controller counts otherwise: `joint_map: {q3: "J3 - J2"}`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.records.table import Table
from ccnn_torch.spelling import hint
from ccnn_torch.units import from_si, si_unit_of, split_header, to_si

Array = NDArray[np.float64]

_NUMBER = r"\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+"
# A sign and: a column, with or without a number before it; or a number with its unit.
_TERM = re.compile(
    rf"\s*(?P<sign>[+-])?\s*(?:(?:(?P<factor>{_NUMBER})\s*\*\s*)?(?P<name>'[^']+'|[^\W\d]\w*)"
    rf"|(?P<number>{_NUMBER})\s*(?P<unit>[^\s+\-*']+))\s*"
)
# A matrix whose condition number is larger cannot be inverted to the last digits that a controller shows.
_CONDITION = 1e6


@dataclass(frozen=True)
class JointMap:
    """Joints q = matrix · shown + offset, of what a controller shows.

    Attributes:
        text: the entries of the config.
        joints: of the mechanism, n.
        columns: name of the column of each joint's own count, n.
        written: names in the formulas as they stand there -> the column that is meant.
        matrix: `n x n` [1].
        offset: `n` [SI].
    """

    text: dict[str, str]
    joints: tuple[Coordinate, ...]
    columns: tuple[str, ...]
    written: dict[str, str]
    matrix: Array
    offset: Array

    def of_shown(self, shown: Array) -> Array:
        """Joints of what the controller shows, `... x n` [SI] each."""
        return shown @ self.matrix.T + self.offset

    def shown(self, joints: Array) -> Array:
        """What the controller shows at these joints, `... x n` [SI] each."""
        return (joints - self.offset) @ np.linalg.inv(self.matrix).T

    def change_shown(self, change: Array) -> Array:
        """A change of the joints as the controller shows it, `... x n` [SI] each."""
        return change @ np.linalg.inv(self.matrix).T

    def spread_shown(self, sd: Array) -> Array:
        """Standard deviations of independent joints as the controller shows them, `... x n` [SI] each."""
        return np.asarray(np.sqrt(np.square(sd) @ np.square(np.linalg.inv(self.matrix)).T))

    def is_in(self, names: Sequence[str], table: Table) -> bool:
        """Whether a file counts as the controller does: has the formulas' columns under the names that these write.

        Args:
            names: of the file's columns, as they stand there.
            table: the file, its columns mapped.
        """
        return all(write in names or (write == column and column in table) for write, column in self.written.items())


def read_joint_map(
    entries: Mapping[str, str], joints: Sequence[Coordinate], columns: Mapping[str, str] | None = None
) -> JointMap | None:
    """The map of a config; None where it has no entries.

    Args:
        entries: joint -> sum of columns, each with a number before it or not, and constants: `J3 - J2`,
            `0.5*J2 + 90 deg`, `'Axis 3' - J2`. A joint without an entry is the column of its name.
        joints: of the mechanism.
        columns: header in the file -> ``name[unit]``; a formula may name a column by either.

    Raises:
        InputError: an entry is no joint or no such sum, a constant has another unit, or the map cannot be inverted.
    """
    if not entries:
        return None
    names = [joint.name for joint in joints]
    for name in entries:
        if name not in names:
            near = hint(name, names, "the joints are")
            raise InputError(f"joint_map: '{name}' is no joint of the mechanism; {near}")
    meant = {split_header(header)[0]: split_header(target)[0] for header, target in (columns or {}).items()}
    written: dict[str, str] = {}
    factors: list[dict[str, float]] = []
    offset = np.zeros(len(joints))
    for k, joint in enumerate(joints):
        terms, offset[k] = _terms(entries[joint.name], joint) if joint.name in entries else ({joint.name: 1.0}, 0.0)
        if joint.name in entries:
            written |= {name: meant.get(name, name) for name in terms}
        found: dict[str, float] = {}
        for name, factor in terms.items():
            column = meant.get(name, name)
            found[column] = found.get(column, 0.0) + factor
        factors.append(found)
    shown = _own_columns(factors, names)
    matrix = np.array([[found.get(column, 0.0) for column in shown] for found in factors])
    if np.linalg.cond(matrix) > _CONDITION:
        raise InputError(
            f"joint_map: the columns {', '.join(shown)} do not follow from the joints, so that commands cannot be "
            'written back; give every joint a column of its own, as in {q3: "J3 - J2"}'
        )
    return JointMap(dict(entries), tuple(joints), shown, written, matrix, offset)


def with_joints(table: Table, joint_map: JointMap | None) -> Table:
    """The table with the mechanism's joints in the place of what the controller shows.

    Raises:
        InputError: a column is missing, has no unit or one of another dimension than the joint, or a cell is no number.
    """
    if joint_map is None:
        return table
    _check_units(table, joint_map)
    shown = np.stack(
        [table.column(name, joint.unit) for name, joint in zip(joint_map.columns, joint_map.joints, strict=True)], -1
    )
    values = joint_map.of_shown(shown)
    kept = [name for name in table.names if name not in joint_map.columns]
    units, columns = {}, []
    for k, (name, joint) in enumerate(zip(joint_map.columns, joint_map.joints, strict=True)):
        same = joint.name not in joint_map.text
        units[joint.name] = table.units[name]
        columns.append(table.raw(name) if same else from_si(values[:, k], joint.unit, table.units[name]))
    place = {table.names.index(name): len(columns) + k for k, name in enumerate(kept)}
    bad = {(row, place[column]): text for (row, column), text in table.bad_cells.items() if column in place}
    units |= {name: table.units[name] for name in kept}
    columns += [table.raw(name) for name in kept]
    return replace(table, units=units, values=np.stack(columns, -1), bad_cells=bad)


def _terms(text: str, joint: Coordinate) -> tuple[dict[str, float], float]:
    """Factors of columns by name, and the sum of the constants [SI]."""
    where = f"joint_map: {joint.name}: '{text}'"
    factors: dict[str, float] = {}
    constant, at = 0.0, 0
    while at < len(text):
        match = _TERM.match(text, at)
        if match is None or (at > 0 and match["sign"] is None):
            raise InputError(
                f"{where} is no sum of columns at '{text[at:].strip()[:20]}'; write e.g. J3 - J2 or 0.5*J2 + 90 deg"
            )
        sign = -1.0 if match["sign"] == "-" else 1.0
        if match["name"] is not None:
            name = match["name"].strip("'")
            factors[name] = factors.get(name, 0.0) + sign * float(match["factor"] or 1)
        else:
            constant += sign * float(to_si(float(match["number"]), match["unit"], joint.unit, where))
        at = match.end()
    if not any(factors.values()):
        raise InputError(f"{where} names no column; write e.g. J3 - J2")
    return factors, constant


def _own_columns(factors: Sequence[Mapping[str, float]], names: Sequence[str]) -> tuple[str, ...]:
    """The column that counts for each joint: that of its name, else the first of its own that is no other's.

    Raises:
        InputError: there are more or fewer columns than joints.
    """
    used = list(dict.fromkeys(column for found in factors for column in found))
    if len(used) != len(names):
        raise InputError(
            f"joint_map: the {len(names)} joints follow from {len(used)} columns ({', '.join(used)}); for commands to "
            "be written back there must be as many columns as joints"
        )
    own = {name: name for name in names if name in used}
    for name, found in zip(names, factors, strict=True):
        if name not in own:
            free = [column for column in (*found, *used) if column not in own.values() and column not in names]
            own[name] = free[0]
    return tuple(own[name] for name in names)


def _check_units(table: Table, joint_map: JointMap) -> None:
    """Raise `InputError` where a column that a joint is made of has another dimension than the joint."""
    for joint, row in zip(joint_map.joints, joint_map.matrix, strict=True):
        for column, factor in zip(joint_map.columns, row, strict=True):
            unit = table.units.get(column, "")
            if factor and unit and si_unit_of(unit, f"{table.path}: column '{column}'") != joint.unit:
                raise InputError(
                    f"joint_map: {joint.name} is in {joint.unit}, and the column '{column}' of {table.path} in {unit}; "
                    "a joint is made of columns of its own kind"
                )
