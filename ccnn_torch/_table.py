"""Tables with units: CSV in, CSV out."""

from __future__ import annotations

import csv
import difflib
import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccnn_torch._display import is_shown, visible
from ccnn_torch._reading import read_text
from ccnn_torch.errors import InputError
from ccnn_torch.units import LARGEST, parse_header, to_si, write_hint

__all__ = ["Table", "name_lines", "nearest", "read_table", "write_table"]

# Bytes; a million rows of twenty columns. Read, it takes some ten times that in memory.
_LARGEST_FILE = 500_000_000
_LONGEST_HEADER = 100


@dataclass(frozen=True)
class Table:
    """A table as it stands in the file: nothing is converted or judged until a column is asked for.

    Attributes:
        path: the file, as given.
        units: unit of each column as written, by name, in the file's order.
        values: `rows x columns`, in those units; NaN where a cell is empty or no number.
        lines: line of each row in the file, `rows`, int64 (the header is line 1).
        bad_cells: (row, column) -> text of the cells that are empty or no number.
    """

    path: str
    units: dict[str, str]
    values: NDArray[np.float64]
    lines: NDArray[np.int64]
    bad_cells: dict[tuple[int, int], str] = field(default_factory=dict)

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

    def raw(self, name: str) -> NDArray[np.float64]:
        """The column in its own unit, `rows`, NaN where a cell is empty or no number."""
        return self.values[:, self.names.index(name)]

    def cell(self, name: str, row: int) -> str:
        """A number of the column as written, with its unit."""
        unit = self.units[name]
        return f"{self.raw(name)[row]:g}{'' if unit == '1' else ' ' + unit}"

    def column(self, name: str, si_unit: str | None = None) -> NDArray[np.float64]:
        """A column in SI, `rows`, every value finite.

        Args:
            name: the column.
            si_unit: the SI unit it must be in, or None for whatever it is.

        Raises:
            InputError: the column is missing (with the nearest name), has a wrong or unknown unit, or a cell that is
                empty, no number, NaN, infinite, or larger than anything that is measured (named by line).
        """
        if name not in self.units:
            raise InputError(f"{self.path}: there is no column '{name}'; {self._remedy(name, si_unit)}")
        values = self.raw(name)
        wrong = np.flatnonzero(~np.isfinite(values))
        if len(wrong):
            row = int(wrong[0])
            text = visible(self.bad_cells.get((row, self.names.index(name)), f"{values[row]:g}"), 40)
            what = f"has '{text}'" if text else "is empty"
            more = f", and {len(wrong) - 1} more of its cells are not finite either" if len(wrong) > 1 else ""
            raise InputError(
                f"{self.path}: column '{name}' {what} at {name_lines(self.lines, [row])}{more}; "
                "write a finite number or remove the row"
            )
        converted = to_si(values, self.units[name], si_unit, f"{self.path}: column '{name}'", name)
        far = np.flatnonzero(np.abs(converted) > LARGEST)
        if len(far):
            raise InputError(
                f"{self.path}: column '{name}' has {self.cell(name, int(far[0]))} at "
                f"{name_lines(self.lines, far)}, larger than anything that is measured; correct or remove "
                f"{'it' if len(far) == 1 else 'them'}, or check the unit"
            )
        return converted

    def _remedy(self, name: str, si_unit: str | None) -> str:
        near = nearest(name, self.names)
        if near is not None:
            return f"'{near}' is the nearest there: rename it to '{name}' if it is meant"
        return write_hint(name, si_unit)


def nearest(name: str, candidates: Sequence[str], cutoff: float = 0.6) -> str | None:
    """The candidate that is most likely meant by a misspelt name, without regard to case; None if none is near.

    `cutoff` is the least similarity, of difflib's 0 to 1.
    """
    folded = {candidate.lower(): candidate for candidate in reversed(candidates)}
    near = difflib.get_close_matches(name.lower(), folded, 1, cutoff)
    return folded[near[0]] if near else None


def name_lines(lines: NDArray[np.int64], rows: Sequence[int] | NDArray[np.int64], most: int = 5) -> str:
    """Name rows (given 0-based) for a person, at most `most` of them: "line 17 (row 16)".

    The line is that of the file, whose first line is the header; the row counts the rows below it from 1.
    """
    plural = "s" if len(rows) > 1 else ""
    more = f" and {len(rows) - most} more" if len(rows) > most else ""
    shown_lines = ", ".join(str(int(lines[row])) for row in rows[:most])
    shown_rows = ", ".join(str(int(row) + 1) for row in rows[:most])
    return f"line{plural} {shown_lines} (row{plural} {shown_rows}){more}"


def read_table(path: str | Path, si_units: Mapping[str, str] | None = None) -> Table:
    """Read a CSV file whose headers are ``name[unit]``.

    The separator is a comma, a semicolon or a tab, as the header has it; with the latter two a decimal comma is
    understood. A byte-order mark, blank lines and lines of separators alone (left by spreadsheets) are passed over.

    Args:
        path: the file.
        si_units: SI unit of the columns for which it is known, by name; sharpens the error for a missing unit.

    Raises:
        InputError: the file cannot be read or is empty, a header lacks its unit or stands twice, or a row has another
            number of cells than the header.
    """
    file = str(path)
    text_lines = read_text(file, _LARGEST_FILE, "give the path of a CSV file").split("\n")
    filled = [number for number, line in enumerate(text_lines) if line.strip(" \t,;")]
    if not filled:
        raise InputError(f"{file}: the file is empty; line 1 must be the header, e.g. q1[rad],x[mm]")
    header = text_lines[filled[0]]
    separator = max(",;\t", key=header.count)
    units: dict[str, str] = {}
    for number, cell in enumerate(_cells([header], separator, file, np.array([filled[0] + 1]))[0], 1):
        _check_header(cell, number, file)
        name, unit = parse_header(cell, file, (si_units or {}).get(cell.strip()))
        if name in units:
            raise InputError(f"{file}: column '{name}' stands twice in the header; remove or rename one of them")
        units[name] = unit
    rows = [text_lines[number] for number in filled[1:]]
    if not rows:
        raise InputError(f"{file}: there is a header but no row below it")
    if separator != "," and not any("." in row for row in rows):
        rows = [row.replace(",", ".") for row in rows]
    lines = np.array(filled[1:], dtype=np.int64) + 1
    bad: dict[tuple[int, int], str] = {}
    try:
        values = np.loadtxt(rows, delimiter=separator, comments=None, quotechar='"', ndmin=2)
        uniform = values.shape == (len(rows), len(units))
    except ValueError:
        uniform = False
    if not uniform:
        values, bad = _read_cells(rows, separator, len(units), file, lines)
    return Table(file, units, values, lines, bad)


def write_table(path: str | Path, columns: Mapping[str, ArrayLike]) -> None:
    """Write a CSV file with 17 significant digits, so that `read_table` gives back the same floats bit by bit.

    Args:
        path: the file; an existing one is replaced.
        columns: header ``name[unit]`` -> values `rows`.

    Raises:
        InputError: a header is not of that form, columns differ in length, or the file cannot be written.
    """
    names = [parse_header(header, str(path))[0] for header in columns]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(f"{path}: column '{twice[0]}' would stand twice in the header")
    arrays = [np.asarray(values, dtype=np.float64) for values in columns.values()]
    if len({array.shape for array in arrays}) != 1 or arrays[0].ndim != 1:
        raise InputError(f"{path}: the columns to write must be one-dimensional and of one length")
    buffer = io.StringIO()
    np.savetxt(buffer, np.stack(arrays, axis=1), fmt="%.17g", delimiter=",", header=",".join(columns), comments="")
    try:
        Path(path).write_text(buffer.getvalue(), encoding="utf-8")
    except OSError as reason:
        raise InputError(f"{path}: cannot be written: {reason.strerror}") from None


def _read_cells(
    rows: list[str], separator: str, width: int, file: str, lines: NDArray[np.int64]
) -> tuple[NDArray[np.float64], dict[tuple[int, int], str]]:
    """The slow way, cell by cell, for a file in which something is wrong: finds out what and where."""
    values = np.full((len(rows), width), np.nan)
    bad: dict[tuple[int, int], str] = {}
    for row, cells in enumerate(_cells(rows, separator, file, lines)):
        if len(cells) != width:
            comma = "; with a decimal comma, separate the cells by semicolons" if separator == "," else ""
            counts = f"has {len(cells)} cells, but the header names {width} columns"
            raise InputError(f"{file}: {name_lines(lines, [row])} {counts}{comma}")
        for column, cell in enumerate(cells):
            try:
                values[row, column] = float(cell.replace("_", "?"))
            except ValueError:
                bad[row, column] = cell.strip()
    return values, bad


def _cells(rows: list[str], separator: str, file: str, lines: NDArray[np.int64]) -> list[list[str]]:
    """Each row's cells; a line of the file is a row, also where a quote is opened and not closed."""
    found = []
    for number, row in enumerate(rows):
        try:
            found.append(next(csv.reader([row], delimiter=separator), []))
        except csv.Error as reason:
            raise InputError(f"{file}: {name_lines(lines, [number])} is no line of a CSV file: {reason}") from None
    return found


def _check_header(header: str, number: int, file: str) -> None:
    """Refuse what cannot stand on a screen, or would be a formula in the spreadsheet that opens what we write."""
    name = header.strip()
    if len(name) > _LONGEST_HEADER:
        raise InputError(
            f"{file}: the header of column {number} has {len(name)} characters, '{visible(name, 40)}'; "
            "is line 1 the header? Give names as q1[rad]"
        )
    if not all(map(is_shown, name)):
        raise InputError(f"{file}: the header '{visible(name)}' of column {number} has a control character; remove it")
    if name.startswith(("=", "+", "-", "@")):
        raise InputError(
            f"{file}: the header '{name}' of column {number} begins like a formula, which a spreadsheet would run; "
            "begin the name with a letter"
        )
