"""Read tables: CSV of every dialect and code page, Excel workbooks, pandas frames."""

from __future__ import annotations

import codecs
import csv
import io
import re
import warnings
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import read_bytes
from ccnn_torch.records.headers import Header, read_header
from ccnn_torch.records.preamble import SEPARATORS, bare_header, header_row, is_comment, refuse_title
from ccnn_torch.records.table import Table, name_lines

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
# A row of a spreadsheet.
_Cells = Sequence[object]


class Frame(Protocol):
    """The attributes by which a pandas DataFrame is recognised."""

    @property
    def columns(self) -> Iterable[Any]: ...
    def to_numpy(self) -> NDArray[Any]: ...


def read_table(path: str | Path, columns: Mapping[str, str] | None = None) -> Table:
    """Read a CSV file, or the first sheet of an .xlsx workbook that has a header, with headers ``name[unit]``.

    CSV: the separator is a comma, a semicolon or a tab, as the header has it; with the latter two a decimal comma is
    understood. The text is UTF-8, UTF-16 with a byte-order mark, or else Windows code page 1252, which is then
    noted. Blank lines and lines of separators alone (left by spreadsheets) are skipped, and so are comments above the
    header: lines that begin with ``#``, ``;``, ``//`` or ``%``.

    Args:
        path: the file.
        columns: header in the file -> ``name[unit]`` or ``ignore``.

    Raises:
        InputError: the file cannot be read or is empty, a header is repeated, `columns` does not fit it, a title
            stands above it, or a row has another number of cells than the header.
    """
    file = str(path)
    if Path(file).suffix.lower() in _WORKBOOKS:
        return _read_workbook(file, columns)
    text, notes = _read_text(file)
    text_lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    filled = [number for number, line in enumerate(text_lines) if line.strip(" \t,;")]
    # Excel's own first line, which names the separator.
    if filled and re.fullmatch(r"sep=[,;\t]", text_lines[filled[0]].strip(" ")):
        filled = filled[1:]
    if not filled:
        raise InputError(f"{file}: the file is empty; line 1 must be the header, e.g. q1[rad],x[mm]")
    filled = filled[header_row([text_lines[number] for number in filled]) :]
    first = bare_header(text_lines[filled[0]])
    separator = max(SEPARATORS, key=first.count)
    near = [first, *(text_lines[number] for number in filled[1:20])]
    refuse_title(file, [row.split(max(SEPARATORS, key=row.count)) for row in near], [n + 1 for n in filled])
    header = read_header(next(_split([first], separator, file, [filled[0] + 1])), file, columns, filled[0] + 1)
    rows = [text_lines[number] for number in filled[1:]]
    if not rows:
        raise InputError(f"{file}: there is a header but no row below it")
    if separator != "," and _has_decimal_commas(rows, separator):
        rows = [row.replace(",", ".") for row in rows]
    lines = np.array(filled[1:], dtype=np.int64) + 1
    bad: dict[tuple[int, int], str] = {}
    try:
        values = np.loadtxt(rows, delimiter=separator, comments=None, quotechar='"', ndmin=2)
        uniform = values.shape == (len(rows), header.width)
    except ValueError:
        uniform = False
    if not uniform:
        values, bad = _read_cells(_split(rows, separator, file, lines), header, file, lines, separator)
    return _kept(file, header, values, lines, bad, notes)


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
    return _kept(file, header, values, lines, bad)


def _read_workbook(file: str, columns: Mapping[str, str] | None) -> Table:
    found = _sheet_with_header(file)
    if found is None:
        raise InputError(f"{file}: no sheet begins with a header, a row of texts such as q1[rad] and x[mm]")
    title, filled = found
    refuse_title(file, [["" if c is None else str(c) for c in row] for _, row in filled], [n for n, _ in filled])
    width = max(k + 1 for _, row in filled for k, cell in enumerate(row) if _filled(cell))
    where = f"{file} (sheet {title})"
    header = read_header([str(cell or "") for cell in _fit(filled[0][1], width)], where, columns)
    if len(filled) == 1:
        raise InputError(f"{where}: there is a header but no row below it")
    lines = np.array([number for number, _ in filled[1:]], dtype=np.int64)
    values, bad = _read_cells((_fit(row, width) for _, row in filled[1:]), header, where, lines)
    return _kept(where, header, values, lines, bad)


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


def _kept(
    file: str,
    header: Header,
    values: NDArray[np.float64],
    lines: NDArray[np.int64],
    bad: Mapping[tuple[int, int], str],
    notes: Sequence[str] = (),
) -> Table:
    """The table of the columns that the header keeps."""
    place = {column: k for k, column in enumerate(header.kept)}
    cells = {(row, place[column]): text for (row, column), text in bad.items() if column in place}
    return Table(file, header.units, values[:, header.kept], lines, cells, notes=tuple(notes))


def _read_text(file: str) -> tuple[str, list[str]]:
    """The text of a file, and a note where its code page had to be guessed."""
    data = read_bytes(file, _LARGEST_FILE, "give the path of a CSV file")
    code = next((name for mark, name in _MARKS if data.startswith(mark)), None)
    if code is None and b"\0" in data:
        raise InputError(f"{file}: this is no text file; save it as CSV, or as a workbook with the ending .xlsx")
    for name in (code,) if code else ("utf-8", "cp1252"):
        try:
            text = data.decode(name)
        except UnicodeDecodeError:
            continue
        guessed = f"{Path(file).name} is not UTF-8 and was read as Windows code page 1252; check units such as ° and µm"
        return text, [guessed] if name == "cp1252" else []
    raise InputError(f"{file}: the file is neither UTF-8 nor UTF-16 nor Windows-1252 text; save it as 'CSV UTF-8'")


def _has_decimal_commas(rows: Sequence[str], separator: str) -> bool:
    """Whether commas are decimal separators: there are some, and no cell is a number with a point."""
    if not any("," in row for row in rows):
        return False
    return not any(_DOT_NUMBER.fullmatch(cell.strip(' "')) for row in rows for cell in row.split(separator))


def _read_cells(
    rows: Iterable[_Cells], header: Header, file: str, lines: NDArray[np.int64], separator: str = ""
) -> tuple[NDArray[np.float64], dict[tuple[int, int], str]]:
    """The cells as numbers, and the text of cells that are none."""
    values = np.full((len(lines), header.width), np.nan)
    bad: dict[tuple[int, int], str] = {}
    for row, cells in enumerate(rows):
        if len(cells) != header.width:
            comma = "; with a decimal comma, separate the cells by semicolons" if separator == "," else ""
            counts = f"has {len(cells)} cells, but the header names {header.width} columns"
            raise InputError(f"{file}: {name_lines(lines, [row])} {counts}{comma}")
        for column, cell in enumerate(cells):
            if isinstance(cell, bool):
                bad[row, column] = str(cell).upper()
                continue
            try:
                values[row, column] = float(cell.replace("_", "?") if isinstance(cell, str) else cell)  # type: ignore[arg-type]
            except (TypeError, ValueError, OverflowError):
                text = str(cell).strip()
                bad[row, column] = "" if text in ("None", "<NA>", "NaT") else text
    return values, bad
