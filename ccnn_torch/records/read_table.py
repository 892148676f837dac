"""Read tables: CSV of every dialect and code page, Excel workbooks, pandas frames."""

from __future__ import annotations

import codecs
import csv
import io
import re
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, Protocol, TypeVar
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import read_bytes
from ccnn_torch.records.formats import Keys, read_form
from ccnn_torch.records.headers import Header, is_number, read_header
from ccnn_torch.records.table import PAYLOAD, Table, name_lines
from ccnn_torch.units import STANDARD_GRAVITY, as_read, split_header, to_si

# Units of a payload that is a mass.
_MASSES = ("kg", "g", "lb")
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


def check_no_title(file: str, rows: Sequence[Sequence[str]], lines: Sequence[int]) -> None:
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


# Bytes; a million rows of twenty columns. Read, it takes some ten times that in memory.
_LARGEST_FILE = 500_000_000
# Exceptions of openpyxl, zipfile and the XML parser on a damaged workbook.
_DAMAGED = (
    *(BadZipFile, EOFError, KeyError, IndexError, ValueError, TypeError, AttributeError, SyntaxError, zlib.error),
    *(RuntimeError, OverflowError),
)
# Times the size of its file that a workbook may have unpacked; tables of numbers have 5 to 30.
_MOST_PACKED = 100
_WORKBOOKS = (".xlsx", ".xlsm")
_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_DOT_NUMBER = re.compile(r"[+-]?\d*\.\d*([eE][+-]?\d+)?")
# Cells that are numbers of JSON, as nearly all are: its parser takes a quarter of the time of NumPy's.
_NUMBERS = TypeAdapter(list[float])
# A row of a spreadsheet.
_Cells = Sequence[object]
_Row = TypeVar("_Row")
# Rows, their lines, and how many stand before them -> values, and the text of cells that are no number.
_Numbers = Callable[[list[_Row], NDArray[np.int64], int], tuple[NDArray[np.float64], dict[tuple[int, int], str]]]


class Frame(Protocol):
    """The attributes by which a pandas DataFrame is recognised."""

    @property
    def columns(self) -> Iterable[Any]: ...
    def to_numpy(self) -> NDArray[Any]: ...


def read_table(path: str | Path, columns: Mapping[str, str] | None = None, keys: Keys | None = None) -> Table:
    """Read a CSV file, the first sheet of an .xlsx workbook that has a header, or what is in one of the `FORMS`.

    CSV: the separator is a comma, a semicolon or a tab, as the header has it; with the latter two a decimal comma is
    understood. The text is UTF-8, UTF-16 with a byte-order mark, or else Windows code page 1252, which is then
    noted. Blank lines and lines of separators alone (left by spreadsheets) are skipped, and so are comments above the
    header: lines that begin with ``#``, ``;``, ``//`` or ``%``.

    Args:
        path: the file.
        columns: header in the file -> ``name[unit]`` or ``ignore``.
        keys: what is said of a form of `FORMS`, by key.

    Raises:
        InputError: the file cannot be read or is empty, a header is repeated, `columns` does not fit it, a title
            stands above it, or a row has another number of cells than the header.
    """
    table = read_form(path, keys or {})
    return next(read_parts(path, None, columns)) if table is None else mapped(table, columns or {})


def read_parts(path: str | Path, rows: int | None, columns: Mapping[str, str] | None = None) -> Iterator[Table]:
    """The table of `read_table` in parts of so many rows, so that no more of it is in memory; None = in one part.

    Raises as `read_table`, when the part with the error is reached.
    """
    file = str(path)
    if Path(file).suffix.lower() in _WORKBOOKS:
        return _workbook_parts(file, rows, columns)
    return _csv_parts(file, rows, columns)


def _csv_parts(file: str, rows: int | None, columns: Mapping[str, str] | None) -> Iterator[Table]:
    text = TextFile(file)
    filled = text.filled()
    # Comments, the header, and twenty lines below it.
    head: list[tuple[int, str]] = []
    below = -1
    while below < 20 and (line := next(filled, None)) is not None:
        head.append(line)
        below += below >= 0 or not is_comment(line[1])
    # Excel's own first line, which names the separator.
    if head and re.fullmatch(r"sep=[,;\t]", head[0][1].strip(" ")):
        head = head[1:]
    if not head:
        raise InputError(f"{file}: the file is empty; line 1 must be the header, e.g. q1[rad],x[mm]")
    head = head[header_row([line for _, line in head]) :]
    number, first = head[0][0], bare_header(head[0][1])
    separator = max(SEPARATORS, key=first.count)
    near = [first, *(line for _, line in head[1:20])]
    check_no_title(file, [row.split(max(SEPARATORS, key=row.count)) for row in near], [n for n, _ in head])
    header = read_header(next(_split([first], separator, file, [number])), file, columns, number)
    comma = separator != "," and _has_decimal_commas(text, number, separator)

    def numbers(
        lines_of_text: list[str], lines: NDArray[np.int64], start: int
    ) -> tuple[NDArray[np.float64], dict[tuple[int, int], str]]:
        plain = [row.replace(",", ".") for row in lines_of_text] if comma else lines_of_text
        if {row.count(separator) for row in plain} == {header.width - 1}:
            # -0 would be an integer, without its sign.
            cells = (",".join(plain).replace(separator, ",") + ",").replace("-0,", "-0.0,")
            try:
                values = np.array(_NUMBERS.validate_json(f"[{cells[:-1]}]", strict=True))
                return values.reshape(len(plain), header.width), {}
            except ValueError:
                pass
        return _read_cells(_split(lines_of_text, separator, file, lines), header, file, lines, separator, comma, start)

    yield from _parts(file, header, chain(head[1:], filled), numbers, rows, text.notes)


def _parts(
    file: str,
    header: Header,
    numbered: Iterator[tuple[int, _Row]],
    numbers: _Numbers[_Row],
    rows: int | None,
    notes: Sequence[str] = (),
) -> Iterator[Table]:
    """Tables of so many rows each, in order; numbered: line of the file and what stands in it, below the header."""
    start = 0
    while batch := list(islice(numbered, rows)):
        lines = np.array([number for number, _ in batch], dtype=np.int64)
        values, bad = numbers([row for _, row in batch], lines, start)
        yield _kept(file, header, values, lines, bad, notes, start)
        start += len(batch)
    if not start:
        raise InputError(f"{file}: there is a header but no row below it")


def _split(
    rows: Sequence[str], separator: str, file: str, lines: Sequence[int] | NDArray[np.int64]
) -> Iterator[list[str]]:
    """Each row's cells; a line of the file is a row, also where a quote is opened and not closed."""
    for line, row in zip(lines, rows, strict=True):
        try:
            yield next(csv.reader([row], delimiter=separator), [])
        except csv.Error as reason:
            raise InputError(f"{file}: line {line} is no line of a CSV file: {reason}") from None


def read_frame(frame: Frame, columns: Mapping[str, str] | None = None) -> Table:
    """A table of a pandas DataFrame, whose headers are ``name[unit]`` as in a file.

    Rows are named as `DataFrame.to_csv` would write them. Raises as `read_table`.
    """
    file = "DataFrame"
    header = read_header([str(column) for column in frame.columns], file, columns)
    rows = frame.to_numpy()
    if len(rows) == 0:
        raise InputError(f"{file}: it has columns but no row")
    lines = np.arange(len(rows), dtype=np.int64) + 2
    values, bad = _read_cells(rows.tolist(), header, file, lines)
    # A DataFrame has no other empty cell.
    bad |= {(row, column): "" for row, column in np.argwhere(np.isnan(values)).tolist() if (row, column) not in bad}
    return _kept(file, header, values, lines, bad)


def _workbook_parts(file: str, rows: int | None, columns: Mapping[str, str] | None) -> Iterator[Table]:
    found = _sheet_with_header(file)
    if found is None:
        raise InputError(f"{file}: no sheet begins with a header, a row of texts such as q1[rad] and x[mm]")
    title, filled = found
    check_no_title(file, [["" if c is None else str(c) for c in row] for _, row in filled], [n for n, _ in filled])
    width = max(k + 1 for _, row in filled for k, cell in enumerate(row) if _filled(cell))
    where = f"{file} (sheet {title})"
    header = read_header([str(cell or "") for cell in _fit(filled[0][1], width)], where, columns)

    def numbers(
        cells: list[_Cells], lines: NDArray[np.int64], start: int
    ) -> tuple[NDArray[np.float64], dict[tuple[int, int], str]]:
        return _read_cells((_fit(row, width) for row in cells), header, where, lines, start=start)

    yield from _parts(where, header, iter(filled[1:]), numbers, rows)


def _sheet_with_header(file: str) -> tuple[str, list[tuple[int, _Cells]]] | None:
    """Name of the first sheet with a header, and its rows that are not empty with their numbers; None without one."""
    try:
        import openpyxl
    except ImportError:
        raise InputError(
            f"{file}: reading a workbook needs openpyxl; install it with pip install 'ccnn-torch[excel]', or save the "
            "sheet as CSV"
        ) from None
    try:
        with warnings.catch_warnings():
            # Of styles and extensions that it passes over.
            warnings.simplefilter("ignore", UserWarning)
            # Formulas count by the values that were last calculated.
            content = io.BytesIO(read_bytes(file, _LARGEST_FILE, "give the path of a CSV file or a workbook"))
            _check_size(file, content)
            book = openpyxl.load_workbook(content, read_only=True, data_only=True)
            for sheet in book.worksheets:
                # Some programs write a wrong extent.
                sheet.reset_dimensions()
                rows = ((k + 1, row) for k, row in enumerate(sheet.iter_rows(values_only=True)))
                filled = [(number, row) for number, row in rows if any(map(_filled, row))]
                # A comment has a row for itself.
                while filled and [is_comment(str(c)) for c in filled[0][1] if _filled(c)] == [True]:
                    filled.pop(0)
                if filled and all(isinstance(cell, str) for cell in filled[0][1] if _filled(cell)):
                    return sheet.title, filled
        return None
    except _DAMAGED:
        raise InputError(f"{file}: this is no workbook that openpyxl can read; save the sheet as CSV") from None


def _check_size(file: str, content: io.BytesIO) -> None:
    """Refuse a workbook that is packed more densely than rows of numbers can be; only the sizes are read."""
    packed = len(content.getbuffer())
    unpacked = sum(part.file_size for part in ZipFile(content).infolist())
    if unpacked > min(_LARGEST_FILE, max(_MOST_PACKED * packed, 10_000_000)):
        raise InputError(
            f"{file}: has {unpacked / 1e6:,.0f} MB unpacked, mostly of cells that are empty or alike; save the rows of "
            "measurements alone, as CSV"
        )


def _fit(row: _Cells, width: int) -> _Cells:
    return [*row[:width], *[None] * (width - len(row))]


def _filled(cell: object) -> bool:
    return cell is not None and str(cell).strip() != ""


def table_of(
    file: str, names: Sequence[str], rows: Sequence[_Cells], lines: Sequence[int], comma: bool, notes: Sequence[str]
) -> Table:
    """A table of cells whose headers are ``name[unit]``; comma: whether it is the decimal separator.

    Raises as `read_table`.
    """
    header, numbers = read_header(names, file), np.array(lines, dtype=np.int64)
    values, bad = _read_cells(rows, header, file, numbers, decimal_comma=comma)
    return _kept(file, header, values, numbers, bad, notes)


def mapped(table: Table, columns: Mapping[str, str]) -> Table:
    """A table that was read without a map of columns, with its names and units as the map has them.

    Raises:
        InputError: as `read_table`, where the map does not fit.
    """
    if not columns:
        return table
    header = read_header([table.header(name) for name in table.names], table.path, columns)
    return _kept(table.path, header, table.values, table.lines, table.bad_cells, table.notes, table.start)


def _kept(
    file: str,
    header: Header,
    values: NDArray[np.float64],
    lines: NDArray[np.int64],
    bad: Mapping[tuple[int, int], str],
    notes: Sequence[str] = (),
    start: int = 0,
) -> Table:
    """The table of the columns that the header keeps."""
    place = {column: k for k, column in enumerate(header.kept)}
    cells = {(row, place[column]): text for (row, column), text in bad.items() if column in place}
    return _with_load(Table(file, header.units, values[:, header.kept], lines, cells, notes=tuple(notes), start=start))


def _with_load(table: Table) -> Table:
    """With a column `load_z`, the weight of what a column `payload` has as a mass, where no column has a load."""
    unit = table.units.get(PAYLOAD, "")
    if as_read(unit) not in _MASSES or any(name.startswith("load_") for name in table.names):
        return table
    number, added = table.names.index(PAYLOAD), len(table.names)
    weight = -STANDARD_GRAVITY * to_si(table.raw(PAYLOAD), unit, "kg")
    bad = {(row, added): text for (row, column), text in table.bad_cells.items() if column == number}
    note = (
        f"{table.header(PAYLOAD)} counts as load_z, -{STANDARD_GRAVITY:.2f} N a kilogram; where z does not point up, "
        "write load_x[N] ... in its place"
    )
    return replace(
        table,
        units=table.units | {"load_z": "N"},
        values=np.column_stack([table.values, weight]),
        bad_cells=table.bad_cells | bad,
        notes=(*table.notes, note),
    )


# What a line without cells is made of.
_BLANK = " \t,;\n"


class TextFile:
    """The lines of a file, of which only the bytes are held; `notes` says where its code page had to be guessed."""

    def __init__(self, file: str) -> None:
        self._data = read_bytes(file, _LARGEST_FILE, "give the path of a CSV file")
        self.notes: list[str] = []
        code = next((name for mark, name in _MARKS if self._data.startswith(mark)), None)
        if code is None and b"\0" in self._data:
            raise InputError(f"{file}: this is no text file; save it as CSV, or as a workbook with the ending .xlsx")
        for self._code in (code,) if code else ("utf-8", "cp1252"):
            try:
                self._data.decode(self._code)
            except UnicodeDecodeError:
                continue
            if self._code == "cp1252":
                read_as = "is not UTF-8 and was read as Windows code page 1252; check units such as ° and µm"
                self.notes.append(f"{Path(file).name} {read_as}")
            return
        raise InputError(f"{file}: the file is neither UTF-8 nor UTF-16 nor Windows-1252 text; save it as 'CSV UTF-8'")

    def filled(self) -> Iterator[tuple[int, str]]:
        """Number and text of each line that has more than separators."""
        for number, line in enumerate(io.TextIOWrapper(io.BytesIO(self._data), encoding=self._code), 1):
            # Most lines begin with a number.
            if line[0] not in _BLANK or line.strip(_BLANK):
                yield number, line.removesuffix("\n")


def _has_decimal_commas(text: TextFile, header: int, separator: str) -> bool:
    """Whether commas are decimal separators below a header: there are some, and no cell is a number with a point."""
    if not any("," in row for number, row in text.filled() if number > header):
        return False
    rows = (row for number, row in text.filled() if number > header)
    return not any(_DOT_NUMBER.fullmatch(cell.strip(' "')) for row in rows for cell in row.split(separator))


def _read_cells(
    rows: Iterable[_Cells],
    header: Header,
    file: str,
    lines: NDArray[np.int64],
    separator: str = "",
    decimal_comma: bool = False,
    start: int = 0,
) -> tuple[NDArray[np.float64], dict[tuple[int, int], str]]:
    """The cells as numbers, and the text of cells that are none."""
    values = np.full((len(lines), header.width), np.nan)
    bad: dict[tuple[int, int], str] = {}
    for row, cells in enumerate(rows):
        if len(cells) != header.width:
            more = separator == "," and len(cells) > header.width
            comma = "; with a decimal comma, separate the cells by semicolons" if more else ""
            counts = f"has {len(cells)} cells, but the header names {header.width} columns"
            raise InputError(f"{file}: {name_lines(lines, [row], start=start)} {counts}{comma}")
        for column, cell in enumerate(cells):
            if isinstance(cell, bool):
                bad[row, column] = str(cell).upper()
                continue
            try:
                values[row, column] = float(_plain(cell, decimal_comma) if isinstance(cell, str) else cell)  # type: ignore[arg-type]
            except (TypeError, ValueError, OverflowError):
                text = str(cell).strip()
                bad[row, column] = "" if text in ("None", "<NA>", "NaT") else text
    return values, bad


def _plain(cell: str, decimal_comma: bool) -> str:
    """A number as Python writes it, without the underscores that only Python knows."""
    return (cell.replace(",", ".") if decimal_comma else cell).replace("_", "?")
