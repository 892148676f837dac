"""Tables on a terminal of 80 columns: one piece, headers of two lines, numbers whole; files have every column."""

import io
import re

import pytest
from rich.console import Console

from ccnn_torch.report.table import Table, fitting_columns, markdown_table, print_table

WIDE = Table(
    "Error",
    ("method", "q1 [µm]", "q2 [µm]", "q3 [µm]", "all joints [µm]", "coverage of 95 % [1]", "why"),
    (("a network with a long name of its own", *["12.34 [12.01, 13.02]"] * 5, "it was chosen for a reason " * 3),),
    "A note.",
    words=("why",),
    details=("q1 [µm]", "q2 [µm]", "q3 [µm]"),
)


def shown(table: Table, width: int) -> list[str]:
    screen = io.StringIO()
    print_table(table, Console(file=screen, width=width, force_terminal=True, color_system=None))
    return screen.getvalue().splitlines()


def test_details_are_left_out_where_the_terminal_is_narrow() -> None:
    lines = shown(WIDE, 80)
    assert sum(line.startswith("┏") for line in lines) == 1, "one piece"
    assert max(map(len, lines)) <= 80
    assert sum(line.startswith("┃") for line in lines) == 2, "a header of two lines"
    text = "\n".join(lines)
    assert "12.34" in text and "[12.01, 13.02]" in text
    assert "A wider terminal, or the report, also has 3 more columns: q1 [µm]; q2 [µm]; q3 [µm]." in " ".join(
        text.split()
    )
    assert "coverage" in text and "A note." in text


@pytest.mark.parametrize("width", [40, 60, 80, 100, 200])
def test_no_table_is_wider_than_its_terminal(width: int) -> None:
    assert max(map(len, shown(WIDE, width))) <= width
    kept = fitting_columns(WIDE, width)
    assert kept[0] == 0 and len(kept) >= 2
    assert (len(kept) == len(WIDE.columns)) == (width == 200)


def test_files_have_every_column() -> None:
    head = markdown_table(WIDE).splitlines()[2]
    assert all(column in head for column in WIDE.columns)


def test_a_table_for_the_page_is_not_printed() -> None:
    assert shown(Table("Time", ("a", "b"), (("1", "2"),), page_only=True), 80) == []


def test_first_column_is_broken_between_words() -> None:
    lines = [line for line in shown(WIDE, 80) if line.startswith("│")]
    names = " ".join(re.split(r"\s*│\s*", line)[1] for line in lines)
    assert "a network with a long name of its own" in " ".join(names.split())
