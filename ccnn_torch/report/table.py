"""The one type of table, and two of its renderers: the terminal and Markdown. HTML has it in `macros.html.jinja`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from ccnn_torch.display import visible

# Characters that the first column and columns of words get where the terminal is too narrow for their longest cell.
_LEAST_FIRST = 14
_LEAST_WORDS = 24
_LONGEST_NAME = 28
# Characters of a line; no sentence of this package is as long.
_LONGEST = 5000


@dataclass(frozen=True)
class Table:
    """A table of text.

    Attributes:
        title: one line above the table.
        columns: headers, `columns`.
        rows: one cell for each column, `rows x columns`.
        note: sentences below the table.
        words: headers of the columns that hold words and are flush left. The first column is one of them, all others
            hold numbers and are flush right.
        details: headers of the columns that a terminal shows only where all columns fit. Files have all columns.
        page_only: a terminal does not show the table; page and files do.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    note: str = ""
    words: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    page_only: bool = False


def table_of(title: str, columns: Mapping[str, Sequence[str]], note: str = "", details: Sequence[str] = ()) -> Table:
    """A table out of its columns, header -> cells."""
    return Table(title, tuple(columns), list(zip(*columns.values(), strict=True)), note, details=tuple(details))


def markdown_table(table: Table) -> str:
    """A table as Markdown: title, rows, and note."""
    head, *lines = (
        "| " + " | ".join(visible(cell).replace("|", "\\|") for cell in line) + " |"
        for line in (table.columns, *table.rows)
    )
    rule = "| " + " | ".join(["---", *["---:"] * (len(table.columns) - 1)]) + " |"
    return "\n\n".join([f"## {table.title}", "\n".join([head, rule, *lines]), *([table.note] if table.note else [])])


def print_text(text: str, console: Console, style: str = "", wrap: bool = True) -> None:
    """Print text without interpreting markup or control characters.

    Args:
        text: what to print.
        console: where.
        style: rich's style of the whole text.
        wrap: break lines between words at the edge of a terminal; a file or a pipe gets whole lines.
    """
    console.print(_plain(text), style=style, soft_wrap=not (wrap and console.is_terminal))


def print_labelled(label: str, text: str, console: Console) -> None:
    """Print `label: text`, the label in bold, as `print_text` prints text."""
    line = Text.assemble((f"{_plain(label)}: ", "bold"), _plain(text))
    console.print(line, soft_wrap=not console.is_terminal)


def _plain(text: str) -> Text:
    """Text without markup; line breaks are kept, other control characters are shown as codes."""
    return Text("\n".join(visible(line, _LONGEST) for line in text.split("\n")))


def print_table(table: Table, console: Console) -> None:
    """Print a table in one piece; on a narrow terminal without the columns that do not fit, which are named below.

    A table that is for the page only is not printed.
    """
    if table.page_only:
        return
    shown = fitting_columns(table, console.width)
    grid = RichTable()
    for i in shown:
        words = _holds_words(table, i)
        width = _least_width(table, i)
        grid.add_column(
            _plain(_header(table.columns[i])),
            justify="left" if words else "right",
            overflow="fold",
            no_wrap=not words,
            min_width=width,
            max_width=_LONGEST_NAME if i == 0 else None if words else width,
        )
    for row in table.rows:
        grid.add_row(*(_plain(_cell(row[i]) if i else row[i]) for i in shown))
    # Printed beside the table: a title or a note of the table itself would be as narrow as the table.
    print_text(table.title, console, "bold")
    console.print(grid)
    if table.note:
        print_text(table.note, console, "italic dim")
    if left_out := [column for i, column in enumerate(table.columns) if i not in shown]:
        names = "; ".join(left_out)
        print_text(f"A wider terminal, or the report, also has {len(left_out)} more columns: {names}.", console, "dim")


def fitting_columns(table: Table, width: int) -> list[int]:
    """Numbers of the columns that a terminal shows: all, else those that are not details, from the left.

    Args:
        table: the table.
        width: characters of a line of the terminal.
    """
    shown = list(range(len(table.columns)))
    if _total_width(table, shown) > width:
        shown = [i for i in shown if table.columns[i] not in table.details]
    while len(shown) > 2 and _total_width(table, shown) > width:
        shown.pop()
    return shown


def _total_width(table: Table, shown: Iterable[int]) -> int:
    # Each column has two spaces and a line; the table has one line more.
    return 1 + sum(_least_width(table, i) + 3 for i in shown)


def _least_width(table: Table, column: int) -> int:
    """Characters that a column needs at least; numbers are never broken."""
    cells = [_cell(row[column]) for row in table.rows]
    longest = max(_width(text) for text in (_header(table.columns[column]), *cells))
    if _holds_words(table, column):
        return min(longest, _LEAST_WORDS if column else _LEAST_FIRST)
    return longest


def _holds_words(table: Table, column: int) -> bool:
    return column == 0 or table.columns[column] in table.words


def _cell(text: str) -> str:
    """A cell as printed: the interval is on the line below its median."""
    return text.replace(" [", "\n[")


def _header(text: str) -> str:
    """A header as printed: in two lines, broken where the longer line is shortest."""
    words = text.split(" ")
    breaks = (" ".join(words[:i]) + "\n" + " ".join(words[i:]) for i in range(1, len(words)))
    return min(breaks, key=_width, default=text)


def _width(text: str) -> int:
    return max(map(cell_len, text.split("\n")))
