"""What a table is, and its forms: on a terminal that may be too narrow for it, and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from ccnn_torch.display import visible

__all__ = ["Table", "markdown_table", "print_table", "print_text"]

_LONGEST_NAME = 28
# Characters of a line; no sentence of ours is as long.
_LONGEST = 5000


@dataclass(frozen=True)
class Table:
    """Title, column headers, rows of text (one entry a column), a sentence below, and the columns that hold words.

    The first column holds words as well; all others hold numbers and are set flush right.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    words: tuple[str, ...] = ()


def markdown_table(table: Table) -> str:
    """One table as Markdown: title, rows, and the sentence below."""
    head, *lines = (
        "| " + " | ".join(visible(cell).replace("|", "\\|") for cell in line) + " |"
        for line in (table.columns, *table.rows)
    )
    rule = "| " + " | ".join(["---", *["---:"] * (len(table.columns) - 1)]) + " |"
    return "\n\n".join([f"## {table.title}", "\n".join([head, rule, *lines]), *([table.note] if table.note else [])])


def print_text(text: str, console: Console, style: str = "", wrap: bool = True) -> None:
    """Show a sentence as it is: what looks like markup is none, and nothing in it is obeyed by the terminal.

    Args:
        text: what to show.
        console: where.
        style: rich's, of all of it.
        wrap: break it between words at the terminal's edge; in a file or a pipe a line stays a line.
    """
    console.print(_plain(text), style=style, soft_wrap=not (wrap and console.is_terminal))


def _plain(text: str) -> Text:
    """Text that no part of is read as markup; its line breaks are ours."""
    return Text("\n".join(visible(line, _LONGEST) for line in text.split("\n")))


def print_table(table: Table, console: Console) -> None:
    """Show a table, in parts where the terminal is too narrow; each part repeats the first column."""
    # Measured as on a terminal without an edge: a width is else never more than there is.
    wide = console.options.update(max_width=10_000)
    parts: list[list[int]] = [[0]]
    for column in range(1, len(table.columns)):
        wider = [*parts[-1], column]
        fits = console.measure(_shown(table, wider), options=wide).maximum <= console.width
        if fits or len(parts[-1]) == 1:
            parts[-1] = wider
        else:
            parts.append([0, column])
    for i, part in enumerate(parts):
        # Beside the table, not in it: a title or a note is then as wide as the terminal, not as a narrow part.
        print_text(table.title + (", continued" if i else ""), console, "bold")
        console.print(_shown(table, part))
    if table.note:
        print_text(table.note, console, "italic dim")


def _shown(table: Table, columns: Sequence[int]) -> RichTable:
    shown = RichTable()
    for i in columns:
        left = i == 0 or table.columns[i] in table.words
        shown.add_column(
            _plain(table.columns[i]), justify="left" if left else "right", overflow="fold", max_width=_width(table, i)
        )
    for row in table.rows:
        # The interval below its median: three such columns then fit into 80 characters.
        shown.add_row(*(_plain(row[i].replace(" [", "\n[") if i else row[i]) for i in columns))
    return shown


def _width(table: Table, column: int) -> int:
    """Room for what may not be broken: numbers, and words of the header; a long name is broken between words."""
    cells = [row[column] for row in table.rows]
    if column == 0:
        return min(_LONGEST_NAME, max(len(cell) for cell in (table.columns[0], *cells)))
    parts = [part for cell in cells for part in cell.replace(" [", "\n[").split("\n")]
    return max(len(part) for part in (*table.columns[column].replace(" [", "\n[").split(), *parts))
