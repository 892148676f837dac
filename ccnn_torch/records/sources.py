"""One table from records in a file, in several files, or in a pandas frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from ccnn_torch.errors import InputError
from ccnn_torch.records.read_table import Frame, read_frame, read_table
from ccnn_torch.records.table import FILE as FILE
from ccnn_torch.records.table import Table

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
