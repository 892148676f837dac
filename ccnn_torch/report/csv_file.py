"""How all tables of figures are written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from ccnn_torch.files.write import csv_text, write_whole


def write_rows(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[str | float | None]]) -> None:
    """Write a CSV file; numbers have 17 significant digits, None is an empty cell.

    Raises:
        WriteError: it cannot be written.
    """
    write_whole(path, csv_text([header, *rows]))
