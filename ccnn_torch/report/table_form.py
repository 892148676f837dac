"""What a table is, and how it is shown on a terminal that may be too narrow for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

__all__ = ["Table", "print_table"]

_LONGEST_NAME = 28


@dataclass(frozen=True)
class Table:
    """Title, column headers, rows of text (one entry a column), and a sentence below."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def print_table(table: Table, console: Console) -> None:
    """Show a table, in parts where the terminal is too narrow; each part repeats the first column."""
    parts: list[list[int]] = [[0]]
    for column in range(1, len(table.columns)):
        wider = [*parts[-1], column]
        fits = console.measure(_shown(table, wider)).maximum <= console.width
        if fits or len(parts[-1]) == 1:
            parts[-1] = wider
        else:
            parts.append([0, column])
    for i, part in enumerate(parts):
        shown = _shown(table, part)
        shown.title = escape(table.title + (", continued" if i else ""))
        # Markup is on in titles and captions, off nowhere: what comes from outside is escaped.
        shown.caption = (escape(table.note) or None) if i == len(parts) - 1 else None
        console.print(shown)


def _shown(table: Table, columns: Sequence[int]) -> RichTable:
    shown = RichTable(title_justify="left", title_style="bold", caption_justify="left")
    for i in columns:
        # Too long a name is broken between words; numbers are folded only where nothing else helps.
        width = None if i else min(_LONGEST_NAME, max(len(row[0]) for row in (table.columns, *table.rows)))
        shown.add_column(escape(table.columns[i]), justify="right" if i else "left", overflow="fold", max_width=width)
    for row in table.rows:
        # The interval below its median: three such columns then fit into 80 characters.
        shown.add_row(*(escape(row[i].replace(" [", "\n[") if i else row[i]) for i in columns))
    return shown
