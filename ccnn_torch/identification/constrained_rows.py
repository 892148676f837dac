"""Rows of an identification without a measuring device: read, numbered and split; and the machine that they are of.

A ball in sockets, distances, points on a plane are readings of an instrument; rows of several kinds are those of an
instrument with several parts, each row with the readings of its kind alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.config.sizes import size
from ccnn_torch.config.split import Given, rows_of_test_file, split_by, with_test_file
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import BesideConfig, ConstraintConfig, IdentifyConfig
from ccnn_torch.identification.measured import nominal_machine, notes_of, split_records
from ccnn_torch.identification.problems.sockets import Sockets
from ccnn_torch.identification.problems.whitened import check_finite
from ccnn_torch.mechanisms import Framed, Instrument, Mechanism, Partial, SerialArm, as_measured, fit_unknown
from ccnn_torch.mechanisms.frames.instrument import make_part
from ccnn_torch.mechanisms.frames.part import Part, tool_points
from ccnn_torch.mechanisms.frames.readings import Between, Dial, Pose, Reading, Wire
from ccnn_torch.records import Records, Table, load_records, stack_columns
from ccnn_torch.records.commanded import SECOND, read_joints
from ccnn_torch.records.load import read_source

GROUPED_BY = {"sockets": "placement", "distances": "anchor", "plane": "plane"}
"""Column that numbers the groups of each kind, unless the config names others."""
Kind = ConstraintConfig | BesideConfig
# Joints beyond this are taken for degrees [rad], as in records of poses: 4 turns.
_ANGLE_LIMIT = 8 * np.pi
# Usual tolerance of the extent of a plate with several sockets [m].
_PLATE_TOLERANCE = 1e-4


@dataclass(frozen=True)
class ConstraintRows:
    """The rows that take part, those of the config's `records` first.

    Attributes:
        joints: `s x n` [SI].
        said: what `seen` reads, and after it what that was of, `s x p` [SI]; NaN of what another row's kind reads.
        group: number of each row's placement, anchor or plane, `s`; NaN in rows of `beside`.
        labels: the meaning of each number: the grouping columns and their values.
        cell: number of the place that each row's tool is held in, `s`: one socket of one placement, or the group.
        weights: `s` [1]; 1 = row to identify from, 0 = held-out row.
        data_hash: SHA-256 of the records.
        seen: the mechanism as `said` shows it, what is unknown of an instrument fitted.
        read: names of what is read in the rows of `records`, and of each file of `beside`.
        notes: how the rows were read, one sentence each.
    """

    joints: Tensor
    said: Tensor
    group: Tensor
    labels: dict[float, dict[str, float]]
    cell: Tensor
    weights: Tensor
    data_hash: str
    seen: Mechanism
    read: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """Of an equation of `records`: `rad` where only angles were read, else `m`."""
        return "rad" if all(c.unit == "rad" for c in self.seen.pose if c.name in self.read[0]) else "m"

    def measured(self, names: Sequence[str]) -> Tensor:
        """Which of these channels were measured in each row, `s x c` bool."""
        every = [c.name for c in self.seen.pose]
        return ~self.said[:, [every.index(name) for name in names]].isnan()


def read_constraint(config: IdentifyConfig, mechanism: Mechanism, given: Given | None = None) -> ConstraintRows:
    """Read, select and split the records of a config with a constraint, and read those beside them."""
    about = config.constraint
    assert about is not None and config.records is not None
    source = with_test_file(config.records if given is None else given, config.split)
    if about.kind == "pose":
        rows, records = _poses(config, source, mechanism, None)
        train = split_records(config, records).train
    else:
        if isinstance(source, Records):
            raise InputError("records: a constraint has columns of its own; give the path of its file, or a DataFrame")
        table = read_joints(read_source(source, config.columns), mechanism, config.joint_map, config.columns)
        there = _taking_part(table, about.where)
        rows = _rows_of(table, mechanism, about, there)
        columns = {name: table.raw(name)[there.numpy()] for name in table.names}
        held = rows_of_test_file(config.split, table.parts)
        nowhere = torch.empty(len(there), 0, dtype=torch.float64)
        train = split_by(config.split, nowhere, columns, config.seed, 0.0, None if held is None else held[there]).train
    weights = torch.zeros(len(rows.joints), dtype=torch.float64)
    weights[train] = 1.0
    rows = replace(rows, weights=weights)
    if about.kind != "pose":
        _check_cells(rows, about)
    others = []
    for other in about.beside:
        if other.kind == "pose":
            others.append(_poses(config, other.records, mechanism, other)[0])
        else:
            read = read_source(other.records, config.columns)
            table = read_joints(read, mechanism, config.joint_map, config.columns)
            others.append(_rows_of(table, mechanism, other, torch.arange(len(table))))
    rows = _together(rows, others, mechanism)
    if not isinstance(mechanism, Instrument) or not isinstance(rows.seen, Instrument):
        return rows
    fitted = fit_unknown(rows.seen, rows.joints, rows.said, rows.weights)
    return rows if fitted is None else replace(rows, seen=rows.seen.with_nominal(fitted))


def _together(rows: ConstraintRows, others: Sequence[ConstraintRows], mechanism: Mechanism) -> ConstraintRows:
    """The rows with those of other kinds behind them, as readings of one instrument."""
    if not others:
        return rows
    every, parts, names = [rows, *others], list[Part](), list[list[str]]()
    for i, one in enumerate(every):
        own, columns = _parts(one.seen, mechanism), [c.name for c in one.seen.pose]
        if {*columns} & {name for those in names for name in those}:
            own = [replace(part, name=f"beside{i}") for part in own]
            columns = [f"beside{i}.{name}" for name in columns]
        parts += own
        names.append(columns)
    machine = mechanism.mechanism if isinstance(mechanism, Instrument) else mechanism
    seen = Instrument(machine, *parts)
    there = [c.name for c in seen.pose]
    said = torch.full((sum(len(one.joints) for one in every), len(there)), torch.nan, dtype=torch.float64)
    first = 0
    for one, columns in zip(every, names, strict=True):
        said[first : first + len(one.joints), [there.index(name) for name in columns]] = one.said
        first += len(one.joints)
    more = first - len(rows.joints)
    return replace(
        rows,
        joints=torch.cat([one.joints for one in every]),
        said=said,
        group=torch.nn.functional.pad(rows.group, (0, more), value=torch.nan),
        cell=torch.nn.functional.pad(rows.cell, (0, more), value=-1),
        weights=torch.nn.functional.pad(rows.weights, (0, more), value=1.0),
        seen=seen,
        read=tuple(tuple(own[: one.seen.compared]) for own, one in zip(names, every, strict=True)),
    )


def _parts(seen: Mechanism, mechanism: Mechanism) -> list[Part]:
    """The instruments that show what `seen` does."""
    inner = seen.mechanism if isinstance(seen, Partial) else seen
    if isinstance(inner, Instrument):
        return [*inner.parts]
    return [Part(Pose(mechanism, [c.name for c in seen.pose]))]


def _rows_of(table: Table, mechanism: Mechanism, about: Kind, there: Tensor) -> ConstraintRows:
    """The rows of a table that are numbered, all of weight 1, and the instrument that reads them."""
    joints = torch.from_numpy(stack_columns(table, mechanism.joints, _ANGLE_LIMIT))[there]
    at = tool_points(mechanism, joints)
    weights = torch.ones(len(joints), dtype=torch.float64)
    name = f"mechanism '{mechanism.name}'"
    check_finite(at[None], weights[None] > 0, joints[None], mechanism.joints, name, "xyz")
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
    read = torch.from_numpy(stack_columns(table, _read_columns(table, about)))[there]
    read = read if read.shape[-1] else torch.zeros(len(joints), 1, dtype=torch.float64)
    of = torch.from_numpy(stack_columns(table, second, _ANGLE_LIMIT))[there] if paired else group[:, None]
    # Of a socket its place is what it is, too.
    of = torch.cat([of, read], -1) if about.kind == "sockets" else of
    held_in = of if about.kind == "sockets" else group[:, None]
    seen = Instrument(mechanism, Part(_reading(about, mechanism, at, read, group, paired)))
    return ConstraintRows(
        joints=joints,
        said=torch.cat([read, of], -1),
        group=group,
        labels=labels,
        cell=torch.unique(held_in, dim=0, return_inverse=True)[1],
        weights=weights,
        data_hash=table.data_hash,
        seen=seen,
        read=(tuple(c.name for c in seen.pose[: seen.compared]),),
        notes=table.notes,
    )


def _reading(about: Kind, mechanism: Mechanism, at: Tensor, read: Tensor, group: Tensor, paired: bool) -> Reading:
    """What reads rows of a kind; at `s x 3`: the tool, read `s x c` [SI], group: number of each row's, `s`."""
    numbers = torch.unique(group).tolist()
    if about.kind == "distances":
        return Between(mechanism) if paired else Wire(numbers, zero=0.0)
    if about.kind == "plane":
        return Dial([[0.0, 0.0, 1.0]] * len(numbers), numbers)
    distinct = torch.unique(read, dim=0)
    extent = float(torch.cdist(distinct, distinct).max())
    given = about.plate_tolerance if isinstance(about, ConstraintConfig) else None
    if given is not None and extent == 0:
        raise InputError("plate_tolerance: a plate with a single socket has no scale; leave it out")
    tolerance = _PLATE_TOLERANCE if given is None else size(given, "m", "constraint.plate_tolerance")
    return Sockets(group, read, at, tolerance / extent if extent > 0 else 0.0)


def placed(rows: ConstraintRows, mechanism: Mechanism, exactly: bool = False) -> ConstraintRows:
    """With what reads the rows that have weight where it suits a machine; a machine with instruments has them.

    exactly: by least squares, not by closed forms alone.
    """
    if not isinstance(rows.seen, Instrument) or isinstance(mechanism, Instrument):
        return rows
    about = rows.joints[rows.weights > 0], rows.said[rows.weights > 0]
    seen = rows.seen.around(mechanism).suited(*about)
    return replace(rows, seen=seen.placed(*about) if exactly else seen)


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


def _read_columns(table: Table, about: Kind) -> list[Coordinate]:
    if about.kind == "sockets":
        return [Coordinate(axis, "m") for axis in "xyz"]
    if about.kind == "distances":
        return [Coordinate("distance", "m")]
    return [Coordinate("reading", "m")] if "reading" in table else []


def _check_cells(rows: ConstraintRows, about: Kind) -> None:
    """Every place that a held-out row was held in must be known from other rows."""
    cell = rows.cell
    used = torch.zeros(int(cell.max()) + 1, dtype=torch.float64).index_add(0, cell, rows.weights)
    lost = torch.nonzero(used[cell] == 0)
    if len(lost):
        label = rows.labels[float(rows.group[lost[0, 0]])]
        named = ", ".join(f"{name} {value:g}" for name, value in label.items())
        socket = "a socket of " if about.kind == "sockets" else ""
        raise InputError(
            f"split: {socket}{named} has held-out rows but none to identify from, so these cannot be judged; write "
            "split.kind=random or a smaller split.test, or measure it more often"
        )


def _poses(
    config: IdentifyConfig, source: Given, mechanism: Mechanism, about: BesideConfig | None
) -> tuple[ConstraintRows, Records]:
    """Rows of poses, or of parts of them, in the machine's own base; all of weight 1."""
    if about is not None and about.instrument is not None:
        mechanism = Instrument(mechanism, make_part(about.instrument, mechanism, among=True))
    records = load_records(source, mechanism, [], learns=False, columns=config.columns, joint_map=config.joint_map)
    seen = as_measured(mechanism, records.pose_coordinates, records.path)
    count = len(records)
    rows = ConstraintRows(
        joints=records.joints,
        said=records.pose,
        group=torch.zeros(count, dtype=torch.float64),
        labels={0.0: {"pose": 0.0}},
        cell=torch.zeros(count, dtype=torch.int64),
        weights=torch.ones(count, dtype=torch.float64),
        data_hash=records.data_hash,
        seen=seen,
        read=(tuple(c.name for c in seen.pose[: seen.compared]),),
        notes=tuple(notes_of(records)),
    )
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
