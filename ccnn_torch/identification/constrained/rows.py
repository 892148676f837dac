"""Rows of a constraint on the tool: sockets of a plate, distances from an anchor, points on a plane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.config.split import Given, rows_of_test_file, split_by, with_test_file
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import ConstraintConfig, IdentifyConfig
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.records import Records, Table, stack_columns
from ccnn_torch.records.headers import check_joints
from ccnn_torch.records.joint_map import read_joint_map, with_joints
from ccnn_torch.records.load import read_source

GROUPED_BY = {"sockets": "placement", "distances": "anchor", "plane": "plane"}
"""Column that numbers the groups of each kind, unless the config names others."""
# Joints beyond this are taken for degrees [rad], as in records of poses: 4 turns.
_ANGLE_LIMIT = 8 * np.pi


@dataclass(frozen=True)
class ConstraintRows:
    """The rows that take part.

    Attributes:
        joints: `s x n` [SI].
        said: the constraint's value of each row, `s x o` [m]: the socket's place on the plate (o = 3), the distance,
            or the reading (o = 1).
        group: number of each row's placement, anchor or plane, `s`.
        labels: the meaning of each number: the grouping columns and their values.
        weights: `s` [1]; 1 = row to identify from, 0 = held-out row.
        data_hash: SHA-256 of the records.
    """

    joints: Tensor
    said: Tensor
    group: Tensor
    labels: dict[float, dict[str, float]]
    weights: Tensor
    data_hash: str

    @property
    def cell(self) -> Tensor:
        """Number of the place that each row's tool is held in, `s`: one socket of one placement, or the group."""
        keys = torch.cat([self.group[:, None], self.said], dim=-1) if self.said.shape[-1] == 3 else self.group[:, None]
        number: Tensor = torch.unique(keys, dim=0, return_inverse=True)[1]
        return number


def read_constraint(config: IdentifyConfig, mechanism: Mechanism, given: Given | None = None) -> ConstraintRows:
    """Read, select and split the records of a config with a constraint."""
    about = config.constraint
    assert about is not None and config.records is not None
    source = with_test_file(config.records if given is None else given, config.split)
    if isinstance(source, Records):
        raise InputError("records: a constraint has columns of its own; give the path of its file, or a DataFrame")
    counted = read_joint_map(config.joint_map, mechanism.joints, config.columns)
    table = with_joints(read_source(source, config.columns), counted)
    check_joints(table, mechanism.joints)
    there = _taking_part(table, about.where)
    joints = torch.from_numpy(stack_columns(table, mechanism.joints, _ANGLE_LIMIT))[there]
    group, labels = _groups(table, about, there)
    said = torch.from_numpy(stack_columns(table, _columns(table, about)))[there]
    said = said if said.shape[-1] else torch.zeros(len(joints), 1, dtype=torch.float64)
    columns = {name: table.raw(name)[there.numpy()] for name in table.names}
    held = rows_of_test_file(config.split, table.parts)
    nowhere = torch.empty(len(joints), 0, dtype=torch.float64)
    train = split_by(config.split, nowhere, columns, config.seed, 0.0, None if held is None else held[there]).train
    weights = torch.zeros(len(joints), dtype=torch.float64)
    weights[train] = 1.0
    rows = ConstraintRows(joints, said, group, labels, weights, table.data_hash)
    _check_cells(rows, about)
    return rows


def _taking_part(table: Table, where: Mapping[str, float]) -> Tensor:
    """Numbers of the rows that have the values wanted, ascending."""
    chosen = np.ones(len(table), dtype=bool)
    for name, value in where.items():
        if name not in table:
            raise InputError(f"constraint.where: {table.path} has no column '{name}'; it has {', '.join(table.names)}")
        chosen &= table.raw(name) == value
    if not chosen.any():
        wanted = ", ".join(f"{name} = {value:g}" for name, value in where.items())
        raise InputError(f"constraint.where: no row of {table.path} has {wanted}; write values that it contains")
    return torch.from_numpy(np.flatnonzero(chosen))


def _groups(table: Table, about: ConstraintConfig, there: Tensor) -> tuple[Tensor, dict[float, dict[str, float]]]:
    names = about.by or [GROUPED_BY[about.kind]]
    for name in names:
        if name not in table:
            raise InputError(
                f"constraint.by: {table.path} has no column '{name}', which numbers the {GROUPED_BY[about.kind]} of "
                f"each row; add it, or name one of {', '.join(table.names)}"
            )
    values: NDArray[np.float64] = np.stack([table.column(name) for name in names], axis=-1)[there.numpy()]
    if len(names) == 1:
        return torch.from_numpy(values[:, 0].copy()), {v: {names[0]: v} for v in np.unique(values).tolist()}
    each, number = np.unique(values, axis=0, return_inverse=True)
    labels = {float(i): dict(zip(names, row, strict=True)) for i, row in enumerate(each.tolist())}
    return torch.from_numpy(number.reshape(-1).astype(np.float64)), labels


def _columns(table: Table, about: ConstraintConfig) -> list[Coordinate]:
    if about.kind == "sockets":
        return [Coordinate(axis, "m") for axis in "xyz"]
    if about.kind == "distances":
        return [Coordinate("distance", "m")]
    return [Coordinate("reading", "m")] if "reading" in table else []


def _check_cells(rows: ConstraintRows, about: ConstraintConfig) -> None:
    """Every place that a held-out row was held in must be known from other rows."""
    cell = rows.cell
    used = torch.zeros(int(cell.max()) + 1, dtype=torch.float64).index_add(0, cell, rows.weights)
    lost = torch.nonzero(used[cell] == 0)
    if len(lost):
        label = rows.labels[float(rows.group[lost[0, 0]])]
        named = ", ".join(f"{name} {value:g}" for name, value in label.items())
        socket = "a socket of " if about.kind == "sockets" and rows.said.shape[-1] == 3 else ""
        raise InputError(
            f"split: {socket}{named} has held-out rows but none to identify from, so these cannot be judged; write "
            "split.kind=random or a smaller split.test, or measure it more often"
        )
