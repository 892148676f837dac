"""What stands above the header of a table: comments, which are passed over, and titles, which are refused."""

from __future__ import annotations

import re
from collections.abc import Sequence

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.records.headers import is_number
from ccnn_torch.units import split_header

SEPARATORS = ",;\t"
"""What may stand between the cells of a line of text."""

_COMMENT = re.compile(r'\s*"?(#|;|//|%)')
_MARK = re.compile(r'\s*(?:#+|//|%+)\s*(?=[^\s,;"])')


def is_comment(line: str) -> bool:
    """Whether a line above the header begins with ``#``, ``;``, ``//`` or ``%``."""
    return _COMMENT.match(line) is not None


def header_row(lines: Sequence[str]) -> int:
    """Number of the header among lines that are not blank: the first that is no comment.

    A line that begins like a comment is the header nevertheless (numpy writes it so) where as many cells stand below
    it, numbers among them.
    """
    first = next((k for k, line in enumerate(lines) if not is_comment(line)), len(lines))
    if first in (0, len(lines)):
        return max(first - 1, 0)
    separator = max(SEPARATORS, key=lines[first - 1].count)
    below = lines[first].split(separator)
    named = lines[first - 1].count(separator) + 1 == len(below) and any(map(is_number, below))
    return first - 1 if named else first


def bare_header(line: str) -> str:
    """The header without the mark of a comment; ``#`` alone is a name."""
    return _MARK.sub("", line, count=1) if _MARK.match(line) else line


def refuse_title(file: str, rows: Sequence[Sequence[str]], lines: Sequence[int]) -> None:
    """Refuse a first row that is a title: a row of texts that fills more cells follows, or it has one cell alone.

    Args:
        file: for the error.
        rows: the cells of the header and of what is below it; a cell with a decimal comma may be in two.
        lines: their lines in the file.

    Raises:
        InputError: names the title's line, and the header's.
    """
    first, *others = ([text for cell in row if (text := cell.strip(' "'))] for row in rows)
    alone = len(first) == 1 and not split_header(first[0])[1]
    for line, cells in zip(lines[1:], others, strict=False):
        numbers = any(is_number(part) for cell in cells for part in re.split(f"[{SEPARATORS}]", cell))
        if len(cells) > len(first) and (alone or not numbers):
            raise InputError(
                f"{file}: line {lines[0]}, '{visible(first[0], 40)}', is a title, not the header: line {line} has "
                "more cells; remove it, or begin it with #"
            )
