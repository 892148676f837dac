"""Tables with units, and the way to write them as CSV."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic_core import to_json

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import csv_cell, writing_whole
from ccnn_torch.spelling import nearest
from ccnn_torch.units import LARGEST, parse_header, si_unit_of, split_header, to_si, write_hint

FILE = "file"
"""The column that numbers the files where there are several: 0, 1, …"""
# A number with thousands separators: two of them, or one and another mark before the decimals.
_GROUPED = re.compile(r"-?\d{1,3}(?:([., ])\d{3}(?:\1\d{3})+(?:[.,]\d*)?|([., ])\d{3}(?!\2)[.,]\d+)")
# A number with a decimal comma, in a file whose commas are between cells or whose other numbers have points.
_COMMA = re.compile(r"[+-]?\d+,\d+")
PAYLOAD = "payload"
"""A column that is read as a load where it has a mass, and no other column has a load."""


@dataclass(frozen=True)
class Table:
    """A table as in the file; a column is converted and checked when it is read.

    Attributes:
        path: the file, as given; several with commas between them.
        units: unit of each column as written, by name, in the file's order; empty where the header has none.
        values: `rows x columns`, in those units; NaN where a cell is empty or no number.
        lines: line of each row in the file, `rows`, int64 (the header is line 1).
        bad_cells: (row, column) -> text of the cells that are empty or no number.
        parts: where rows are from, in order: file and number of its rows; empty for a single file.
        notes: remarks on how the file was read, one sentence each.
        start: how many rows of the file stand before these, where this is a part of it.
        words: what the file calls columns that were given names of ours.
        declared: `m` or `rad` -> unit that the file says lengths or angles are in where their headers have none.
    """

    path: str
    units: dict[str, str]
    values: NDArray[np.float64]
    lines: NDArray[np.int64]
    bad_cells: dict[tuple[int, int], str] = field(default_factory=dict)
    parts: tuple[tuple[str, int], ...] = ()
    notes: tuple[str, ...] = ()
    start: int = 0
    declared: Mapping[str, str] = field(default_factory=dict)
    words: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Column names in the file's order."""
        return tuple(self.units)

    def __contains__(self, name: str) -> bool:
        return name in self.units

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def data_hash(self) -> str:
        """SHA-256 (hex) of headers and values as read: the same for every separator, line end and way to write 1e-3."""
        digest = hashlib.sha256(json.dumps(self.units).encode())
        digest.update(self.values.astype("<f8").tobytes())
        return digest.hexdigest()

    def without(self, names: Sequence[str]) -> Table:
        """The table without some columns."""
        kept = [k for k, name in enumerate(self.names) if name not in names]
        place = {k: i for i, k in enumerate(kept)}
        bad = {(row, place[column]): text for (row, column), text in self.bad_cells.items() if column in place}
        units = {name: unit for name, unit in self.units.items() if name not in names}
        return replace(self, units=units, values=self.values[:, kept], bad_cells=bad) if names else self

    def header(self, name: str) -> str:
        """The column's header, ``name[unit]``; the bare name where it has no unit."""
        return f"{name}[{self.units[name]}]" if self.units[name] else name

    def name_rows(self, rows: Sequence[int] | NDArray[np.int64]) -> str:
        """Rows (0-based) by their lines in the file: "line 17 (row 16)", with the file where there are several."""
        return name_lines(self.lines, rows, parts=self.parts, start=self.start)

    def raw(self, name: str) -> NDArray[np.float64]:
        """The column in its own unit, `rows`, NaN where a cell is empty or no number."""
        return self.values[:, self.names.index(name)]

    def cells(self, name: str) -> NDArray[np.float64] | list[str]:
        """The column in its own unit as `write_table` takes it, `rows`: numbers, or texts where a cell is a text."""
        number = self.names.index(name)
        texts = {row: text for (row, column), text in self.bad_cells.items() if column == number and text}
        if not texts:
            return self.raw(name)
        return [texts.get(row, cell) for row, cell in enumerate(_numbers(self.raw(name)))]

    def cell(self, name: str, row: int) -> str:
        """A number of the column as written, with its unit."""
        unit = self.units[name]
        return f"{self.raw(name)[row]:g}{'' if unit == '1' else ' ' + unit}"

    def blank(self, name: str) -> NDArray[np.bool_]:
        """Rows in which a column's cell is empty, `rows`."""
        number = self.names.index(name)
        rows = [row for (row, column), text in self.bad_cells.items() if column == number and not text]
        return np.isin(np.arange(len(self)), rows)

    def column(self, name: str, si_unit: str | None = None, gaps: bool = False) -> NDArray[np.float64]:
        """A column in SI, `rows`, every value finite.

        Args:
            name: the column.
            si_unit: the SI unit it must be in, or None for any; without a unit it is then as written.
            gaps: whether cells may be empty; NaN stands for them.

        Raises:
            InputError: the column is missing (with the nearest name), has no, a wrong or an unknown unit, or a cell
                that is empty, no number, NaN, infinite, or larger than anything that is measured (named by line).
        """
        if name not in self.units:
            raise InputError(f"{self.path}: there is no column '{name}'; {self._remedy(name, si_unit)}")
        unit = self.units[name]
        if not unit and si_unit is not None:
            parse_header(name, self.path, si_unit)
        values = self.raw(name)
        wrong = np.flatnonzero(~np.isfinite(values) & ~(self.blank(name) & gaps))
        if len(wrong):
            texts = [self.bad_cells.get((row, self.names.index(name)), f"{values[row]:g}") for row in wrong.tolist()]
            rows, text = wrong[[text == texts[0] for text in texts]], visible(texts[0], 40)
            what = f"has '{text}'" if text else "is empty"
            rest = len(wrong) - len(rows)
            more = f", and {rest} more of its cells {'is' if rest == 1 else 'are'} not finite either" if rest else ""
            more += "" if text else self._other_gaps(name)
            remedy = f"write a finite number or remove the row{'s' if more or len(rows) > 1 else ''}"
            if _GROUPED.fullmatch(text):
                remedy = "write numbers without thousands separators"
            elif _COMMA.fullmatch(text):
                point = text.replace(",", ".")
                remedy = (
                    f"write its decimal comma as a point ({point}), or all numbers with a comma and ; between cells"
                )
            raise InputError(f"{self.path}: column '{name}' {what} at {self.name_rows(rows)}{more}; {remedy}")
        converted = to_si(values, unit or "1", si_unit, f"{self.path}: column '{name}'", name)
        far = np.flatnonzero(np.abs(converted) > LARGEST)
        if len(far):
            raise InputError(
                f"{self.path}: column '{name}' has {self.cell(name, int(far[0]))} at "
                f"{self.name_rows(far)}, larger than anything that is measured; correct or remove "
                f"{'it' if len(far) == 1 else 'them'}, or check the unit"
            )
        return converted

    def _other_gaps(self, name: str) -> str:
        """Which other columns have empty cells, and where; those that are mostly empty are meant to be."""
        found: dict[str, list[str]] = {}
        for other in self.names:
            blank = np.flatnonzero(self.blank(other))
            if other != name and len(blank) and np.isfinite(self.raw(other)).mean() > 0.5:
                found.setdefault(self.name_rows(blank), []).append(other)
        named = [f"{', '.join(names)} at {rows}" for rows, names in found.items()]
        return f"; cells are also empty in {', in '.join(named)}" if named else ""

    def _remedy(self, name: str, si_unit: str | None) -> str:
        # A length is never meant for an angle.
        fitting = [own for own in self.names if si_unit is None or _may_be(self.units[own], si_unit)]
        near = nearest(name, fitting)
        if near is not None:
            mapped = f'columns: {{"{near}": "{name}[{self.units[near] or si_unit or "unit"}]"}}'
            return f"'{near}' is the nearest there: rename it to '{name}' if it is meant, or write {mapped}"
        return write_hint(name, si_unit)


def _may_be(unit: str, si_unit: str) -> bool:
    """Whether values in this unit, as written, may be of a quantity in that SI unit; so may those without one."""
    try:
        return not unit or si_unit_of(unit) == si_unit
    except InputError:
        return True


def name_lines(
    lines: NDArray[np.int64],
    rows: Sequence[int] | NDArray[np.int64],
    most: int = 5,
    parts: Sequence[tuple[str, int]] = (),
    start: int = 0,
) -> str:
    """Text that names rows (given 0-based) by their lines, at most `most` of them: "line 17 (row 16)".

    The line is that of the file, whose first line is the header; the row counts the rows below it from 1. With `parts`
    (files and the numbers of their rows) the file is named and the row counts in it: "line 17 (row 16) of day2.csv".
    `start` rows stand before these.
    """
    more = f" and {len(rows) - most} more" if len(rows) > most else ""
    ends = np.cumsum([count for _, count in parts])
    owners = np.searchsorted(ends, np.asarray(rows[:most], dtype=np.int64), side="right")
    named = []
    for owner in dict.fromkeys(owners.tolist()):
        there = [int(row) for row, own in zip(rows[:most], owners, strict=True) if own == owner]
        first = 0 if owner == 0 else int(ends[owner - 1])
        plural = "s" if len(there) > 1 else ""
        shown_lines = ", ".join(str(int(lines[row])) for row in there)
        shown_rows = ", ".join(str(start + row - first + 1) for row in there)
        file = f" of {parts[owner][0]}" if parts else ""
        named.append(f"line{plural} {shown_lines} (row{plural} {shown_rows}){file}")
    return " and ".join(named) + more


def write_table(path: str | Path, columns: Mapping[str, ArrayLike | list[str]]) -> None:
    """Write a CSV file with the shortest decimals from which `read_table` gives back the same floats bit by bit.

    Args:
        path: the file; an existing one is replaced.
        columns: header ``name[unit]``, or a bare name -> values `rows`; NaN is written as an empty cell. A list of
            texts is written so that a spreadsheet takes none of them for a formula.

    Raises:
        InputError: columns have one name or differ in length, or the file cannot be written.
    """
    with writing_table(path) as write:
        write(columns)


@contextmanager
def writing_table(path: str | Path) -> Iterator[Callable[[Mapping[str, ArrayLike | list[str]]], None]]:
    """As `write_table`, part by part: gives what writes the next rows. The file is there at the end, or not at all."""
    if not Path(path).absolute().parent.is_dir():
        raise InputError(f"{path}: cannot be written (its folder is not there); make it, or correct the name")
    with writing_whole(path) as stream:

        def write(columns: Mapping[str, ArrayLike | list[str]]) -> None:
            names = [split_header(header)[0] for header in columns]
            twice = [name for name in names if names.count(name) > 1]
            if twice:
                raise InputError(f"{path}: column '{twice[0]}' would occur twice in the header")
            cells = [_cells(values) for values in columns.values()]
            if len(set(map(len, cells))) != 1:
                raise InputError(f"{path}: the columns to write must be of one length")
            head = "" if stream.tell() else ",".join(map(_quoted, columns)) + "\n"
            stream.write((head + "\n".join([*map(",".join, zip(*cells, strict=True)), ""])).encode())

        yield write


def _cells(values: ArrayLike | list[str]) -> list[str]:
    if isinstance(values, list) and any(isinstance(cell, str) for cell in values):
        return [_quoted(csv_cell(str(cell))) for cell in values]
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1:
        raise InputError("the columns to write must be one-dimensional")
    return _numbers(array)


def _numbers(values: NDArray[np.float64]) -> list[str]:
    """The text of each number; empty where it is none."""
    # Python's own formatting takes several times as long.
    text = to_json(values.tolist(), inf_nan_mode="constants").decode()[1:-1] + ","
    text = text.replace("NaN", "").replace("Infinity", "inf").replace(".0,", ",")
    return text.split(",")[:-1] if len(values) else []


def _quoted(cell: str) -> str:
    return '"' + cell.replace('"', '""') + '"' if any(mark in cell for mark in ',"\r\n') else cell
