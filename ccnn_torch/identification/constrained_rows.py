"""Rows of an identification without a measuring device: read, numbered and split; and the machine that they are of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.config.split import Given, rows_of_test_file, split_by, with_test_file
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import BesideConfig, ConstraintConfig, IdentifyConfig
from ccnn_torch.identification.measured import nominal_machine, notes_of, split_records
from ccnn_torch.identification.problems.constraints import tool_points
from ccnn_torch.mechanisms import Framed, Instrument, Mechanism, SerialArm, as_measured, fit_unknown
from ccnn_torch.mechanisms.frames.part import Part
from ccnn_torch.mechanisms.frames.readings import Between, Dial, Reading, Wire
from ccnn_torch.records import Records, Table, load_records, stack_columns
from ccnn_torch.records.commanded import SECOND, read_joints
from ccnn_torch.records.load import read_source

GROUPED_BY = {"sockets": "placement", "distances": "anchor", "plane": "plane"}
"""Column that numbers the groups of each kind, unless the config names others."""
Kind = ConstraintConfig | BesideConfig
# Joints beyond this are taken for degrees [rad], as in records of poses: 4 turns.
_ANGLE_LIMIT = 8 * np.pi


@dataclass(frozen=True)
class ConstraintRows:
    """The rows that take part.

    Attributes:
        joints: `s x n` [SI].
        said: what is said of each row, `s x o` [SI]: the socket's place on the plate (o = 3), or what `seen` reads,
            and after it what that was of.
        group: number of each row's placement, anchor or plane, `s`.
        labels: the meaning of each number: the grouping columns and their values.
        weights: `s` [1]; 1 = row to identify from, 0 = held-out row.
        data_hash: SHA-256 of the records.
        seen: the mechanism as `said` shows it, what is unknown of an instrument fitted; None of sockets.
        notes: how the rows were read, one sentence each.
    """

    joints: Tensor
    said: Tensor
    group: Tensor
    labels: dict[float, dict[str, float]]
    weights: Tensor
    data_hash: str
    seen: Mechanism | None = None
    notes: tuple[str, ...] = ()

    @property
    def in_sockets(self) -> bool:
        """Whether what is said of a row is its socket's place."""
        return self.seen is None

    @property
    def unit(self) -> str:
        """Of an equation: `rad` where only angles were read, else `m`."""
        read = [] if self.seen is None else self.seen.pose[: self.seen.compared]
        return "rad" if read and all(c.unit == "rad" for c in read) else "m"

    def measured(self, names: Sequence[str]) -> Tensor:
        """Which of these channels were measured in each row, `s x c` bool."""
        if self.seen is None:
            return torch.ones(len(self.joints), len(names), dtype=torch.bool)
        every = [c.name for c in self.seen.pose]
        return ~self.said[:, [every.index(name) for name in names]].isnan()

    @property
    def cell(self) -> Tensor:
        """Number of the place that each row's tool is held in, `s`: one socket of one placement, or the group."""
        keys = torch.cat([self.group[:, None], self.said], dim=-1) if self.in_sockets else self.group[:, None]
        number: Tensor = torch.unique(keys, dim=0, return_inverse=True)[1]
        return number


def read_constraint(config: IdentifyConfig, mechanism: Mechanism, given: Given | None = None) -> ConstraintRows:
    """Read, select and split the records of a config with a constraint."""
    about = config.constraint
    assert about is not None and config.records is not None
    source = with_test_file(config.records if given is None else given, config.split)
    if about.kind == "pose":
        rows, records = poses_of(config, source, mechanism)
        weights = torch.zeros(len(records), dtype=torch.float64)
        weights[split_records(config, records).train] = 1.0
        return placed(replace(rows, weights=weights))
    if isinstance(source, Records):
        raise InputError("records: a constraint has columns of its own; give the path of its file, or a DataFrame")
    table = read_joints(read_source(source, config.columns), mechanism, config.joint_map, config.columns)
    there = _taking_part(table, about.where)
    rows = _rows_of(table, mechanism, about, there)
    joints = rows.joints
    columns = {name: table.raw(name)[there.numpy()] for name in table.names}
    held = rows_of_test_file(config.split, table.parts)
    nowhere = torch.empty(len(joints), 0, dtype=torch.float64)
    train = split_by(config.split, nowhere, columns, config.seed, 0.0, None if held is None else held[there]).train
    weights = torch.zeros(len(joints), dtype=torch.float64)
    weights[train] = 1.0
    rows = replace(rows, weights=weights)
    _check_cells(rows)
    return read_by(rows, mechanism, about)


def rows_of(table: Table, mechanism: Mechanism, about: Kind) -> ConstraintRows:
    """All rows of a table, of weight 1."""
    return read_by(_rows_of(table, mechanism, about, torch.arange(len(table))), mechanism, about)


def _rows_of(table: Table, mechanism: Mechanism, about: Kind, there: Tensor) -> ConstraintRows:
    """The rows of a table that are numbered, all of weight 1, without what reads them."""
    joints = torch.from_numpy(stack_columns(table, mechanism.joints, _ANGLE_LIMIT))[there]
    second = [Coordinate(f"{j.name}{SECOND}", j.unit) for j in mechanism.joints]
    paired = about.kind == "distances" and any(c.name in table for c in second)
    if paired and about.by is not None:
        raise InputError(
            f"constraint.by: {table.path} has distances between two places, {second[0].name} …, which no anchor "
            "numbers; remove the key"
        )
    if paired:
        group, labels = torch.zeros(len(joints), dtype=torch.float64), {0.0: {"pairs": 0.0}}
    else:
        group, labels = _groups(table, about, there)
    said = torch.from_numpy(stack_columns(table, _said_columns(table, about)))[there]
    said = said if said.shape[-1] else torch.zeros(len(joints), 1, dtype=torch.float64)
    seen = None if about.kind == "sockets" else mechanism
    if seen is not None:
        of = torch.from_numpy(stack_columns(table, second, _ANGLE_LIMIT))[there] if paired else group[:, None]
        said = torch.cat([said, of], -1)
    weights = torch.ones(len(joints), dtype=torch.float64)
    return ConstraintRows(joints, said, group, labels, weights, table.data_hash, seen, table.notes)


def read_by(rows: ConstraintRows, mechanism: Mechanism, about: Kind) -> ConstraintRows:
    """With the instrument that reads distances or heights, where it suits this machine."""
    if about.kind in ("sockets", "pose"):
        return rows
    used, numbers = rows.weights > 0, [*rows.labels]
    if about.kind == "plane":
        at = tool_points(mechanism, rows.joints)
        groups = [used & (rows.group == n) for n in numbers]
        reading: Reading = Dial([_normal(at[mine], rows.said[mine, 0]) for mine in groups], numbers)
    else:
        paired = "pairs" in rows.labels[numbers[0]]
        reading = Between(mechanism) if paired else Wire(numbers)
    return placed(replace(rows, seen=Instrument(mechanism, Part(reading))))


def _normal(points: Tensor, readings: Tensor) -> list[float]:
    """Of the plane near points `s x 3` [m], towards where the readings `s` rise."""
    normal = torch.linalg.svd(points - points.mean(0), full_matrices=True)[2][-1]
    rising = float(((points @ normal) * (readings - readings.mean())).sum())
    return [float(v) for v in (-normal if rising < 0 else normal)]


def placed(rows: ConstraintRows) -> ConstraintRows:
    """With what is unknown of an instrument fitted to its rows, links nominal."""
    if not isinstance(rows.seen, Instrument):
        return rows
    fitted = fit_unknown(rows.seen, rows.joints, rows.said, rows.weights)
    return rows if fitted is None else replace(rows, seen=rows.seen.with_nominal(fitted))


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


def _groups(table: Table, about: Kind, there: Tensor) -> tuple[Tensor, dict[float, dict[str, float]]]:
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


def _said_columns(table: Table, about: Kind) -> list[Coordinate]:
    if about.kind == "sockets":
        return [Coordinate(axis, "m") for axis in "xyz"]
    if about.kind == "distances":
        return [Coordinate("distance", "m")]
    return [Coordinate("reading", "m")] if "reading" in table else []


def _check_cells(rows: ConstraintRows) -> None:
    """Every place that a held-out row was held in must be known from other rows."""
    cell = rows.cell
    used = torch.zeros(int(cell.max()) + 1, dtype=torch.float64).index_add(0, cell, rows.weights)
    lost = torch.nonzero(used[cell] == 0)
    if len(lost):
        label = rows.labels[float(rows.group[lost[0, 0]])]
        named = ", ".join(f"{name} {value:g}" for name, value in label.items())
        socket = "a socket of " if rows.in_sockets else ""
        raise InputError(
            f"split: {socket}{named} has held-out rows but none to identify from, so these cannot be judged; write "
            "split.kind=random or a smaller split.test, or measure it more often"
        )


def poses_of(config: IdentifyConfig, source: Given, mechanism: Mechanism) -> tuple[ConstraintRows, Records]:
    """Rows of poses, or of parts of them, in the machine's own base; all of weight 1."""
    records = load_records(source, mechanism, [], learns=False, columns=config.columns, joint_map=config.joint_map)
    seen = as_measured(mechanism, records.pose_coordinates, records.path)
    group, weights = torch.zeros(len(records), dtype=torch.float64), torch.ones(len(records), dtype=torch.float64)
    about = (group, {0.0: {"pose": 0.0}}, weights, records.data_hash)
    rows = ConstraintRows(records.joints, records.pose, *about, seen=seen, notes=tuple(notes_of(records)))
    return rows, records


def machine_in_own_base(config: IdentifyConfig) -> tuple[Mechanism, list[str]]:
    """The mechanism; of an arm one without frames per group, since the constraint has its own."""
    mechanism = nominal_machine(config)
    assert config.constraint is not None
    kinds = {config.constraint.kind, *(one.kind for one in config.constraint.beside)}
    ignored = [key for key in ("frame_per", "tool_per") if getattr(mechanism, key)]
    if ignored and ("pose" in kinds or not isinstance(mechanism, SerialArm)):
        raise InputError(
            f"{config.mechanism}: {ignored[0]}: poses beside a constraint are in the machine's own base; remove the "
            "key and give poses in that base, or remove constraint to identify from poses of several set-ups"
        )
    if not isinstance(mechanism, SerialArm):
        return (Framed(mechanism, base=False, tool=True) if config.frame.tool else mechanism), []
    if config.frame.tool:
        raise InputError("frame.tool: an arm has a tool offset of its own, which is identified anyway; remove the key")
    plain = mechanism.with_orientation("none")
    arm = SerialArm(**{**plain.recipe["keys"], "unknown_frames": [], "frame_per": [], "tool_per": []})
    said = f"{' and '.join(ignored)} of the mechanism count for nothing here: the constraint has its own placements."
    return arm.with_nominal(plain.nominal), [said] if ignored else []
