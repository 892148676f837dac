"""Text exports of measuring programs: tables between lines of text, often one for each group or pose.

Cells are apart by tabs, semicolons, commas or blanks; every table has a line of names above it, or is like the one
before. Below the names there may be a line of units, above them one that says what several columns are.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mode
from typing import NamedTuple

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.records.formats import Keys
from ccnn_torch.records.headers import is_number
from ccnn_torch.records.read_table import SEPARATORS, TextFile, bare_header, header_row, table_of
from ccnn_torch.records.table import Table
from ccnn_torch.units import si_unit_of, split_header

# Bytes; exports of 50,000 rows are smaller.
_LARGEST = 5_000_000
_HEAD = 20
# How cells are apart, what is most certain first: in columns of blanks a name may have one blank.
_WAYS = ("\t", ";", ",", r"\s{2,}", r"\s+")
_FEWEST = 2
_NAMED = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?|[\[(][^\])]*[\])]")
_UNITS = re.compile(r".*\b(?:units?|einheit(?:en)?|unités?|unità|unidad(?:es)?)\b(.*)", re.IGNORECASE)
_SUMMARY = re.compile(
    r"(mean|average|avg|mittel\w*|moyenne|media|max\w*|min\w*|std\w*|sigma|rms|range|sum\w*|[ar]p)\b.*", re.IGNORECASE
)
_NUMBER = r"[+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?"
_GIVEN = re.compile(rf"([^\W\d]\w*)\s*[=:]\s*({_NUMBER})(?![\d.,:/-])\s*([^\s\d,;=:]*)(?!\s*[=:])")
_LABEL = re.compile(r"\W*([^\W\d_]+)\s*(?:[:=#]\s*)?(.*)")
_ABOUT = re.compile(r"\s*([^\W\d]\w*)[\w ]*:\s*(?=[^\W\d]\w*\s*[=:])")


class _Line(NamedTuple):
    number: int
    text: str
    cells: list[str]

    @property
    def data(self) -> bool:
        """Whether most of what is there are numbers."""
        filled = [cell for cell in self.cells if cell]
        numbers = sum(map(is_number, filled))
        return numbers >= 2 and 2 * numbers >= len(filled)


class _Block(NamedTuple):
    """A table: its names, its rows, and the lines of text above it."""

    names: list[str]
    rows: list[_Line]
    above: list[_Line]


def recognised(path: Path) -> bool:
    """Whether a file is text with tables that is no plain table: has text above the names, or several tables."""
    if not path.is_file() or path.stat().st_size > _LARGEST:
        return False
    try:
        text = TextFile(str(path))
    except InputError:
        return False
    lines = [*text.filled()]
    return not _plain(lines) and bool(_blocks(lines))


def read(path: Path, keys: Keys) -> Table:
    """All rows of an export; `group` or what it is called there numbers its tables where there are several.

    Args:
        path: the file.
        keys: none.

    Raises:
        InputError: tables differ in their columns, or a row has another number of cells than its names.
    """
    file = str(path)
    text = TextFile(file)
    lines = [*text.filled()]
    blocks = _blocks(lines)
    names, first = blocks[0].names, blocks[0]
    for block in blocks:
        if not block.names:
            raise InputError(
                f"{file}: lines {block.rows[0].number} to {block.rows[-1].number} hold numbers without names above "
                "them; write a line of names there, such as q1[rad], or remove them"
            )
        for line in block.rows:
            if len(line.cells) != len(block.names):
                raise InputError(
                    f"{file}: line {line.number} has {len(line.cells)} cells, but the table's names are "
                    f"{len(block.names)}; correct the line"
                )
        if block.names != names:
            raise InputError(
                f"{file}: the table from line {block.rows[0].number} has other columns than that from line "
                f"{first.rows[0].number}; keep tables of one kind in the file"
            )
    own, left = _measured(blocks)
    rows = [line.cells for block in own for line in block]
    comma = _decimal_commas(rows)
    more = _given(blocks, comma) if len(blocks) > 1 else {}
    counts = [len(block) for block in own]
    columns = {
        name: [v for v, count in zip(each, counts, strict=True) for _ in range(count)] for name, each in more.items()
    }
    notes = [f"{path.name}: {len(blocks)} table(s) from line {first.rows[0].number} on; lines of text were passed over"]
    if len(blocks) > 1:
        word, labels = _labels(blocks, [*names, *columns])
        columns[f"{word}[1]"] = [k for k, count in enumerate(counts) for _ in range(count)]
        listed = ", ".join(f"{k} is '{visible(label, 30)}'" for k, label in enumerate(labels[:10]))
        notes.append(f"{path.name}: {word} {listed}{' …' if len(labels) > 10 else ''}")
    if left:
        notes.append(f"{path.name}: line(s) {', '.join(map(str, left[:10]))} sum up others and were left out")
    cells = [[*row, *(str(each[i]) for each in columns.values())] for i, row in enumerate(rows)]
    numbers = [line.number for block in own for line in block]
    table = table_of(file, [*names, *columns], cells, numbers, comma, [*text.notes, *notes])
    inside = {*numbers, *left}
    return replace(table, declared=_declared(line for number, line in lines if number not in inside))


def _plain(lines: Sequence[tuple[int, str]]) -> bool:
    """Whether a file is one table below its names, with nothing but comments above them."""
    head = [line for _, line in lines[:_HEAD]]
    if head and re.fullmatch(r"sep=[,;\t]", head[0].strip(" ")):
        return True
    place = header_row(head)
    if place + 1 >= len(head):
        return True
    header, below = bare_header(head[place]), head[place + 1]
    separator = max(SEPARATORS, key=header.count)
    cells, first = _cells(header, separator), _cells(below, separator)
    if (
        len(cells) != len(first)
        or not any(map(is_number, first))
        or any(line == head[place] for _, line in lines[place + 1 :])
    ):
        return False
    return all(split_header(cell)[1] for cell in cells) or not _declared(head[:place])


def _blocks(lines: Sequence[tuple[int, str]]) -> list[_Block]:
    """The tables, their cells apart in the way by which most rows fit their names; [] where there are too few."""
    ways = [way for way in _WAYS if way not in SEPARATORS or any(way in text for _, text in lines)]
    found = [_blocks_of([_Line(n, text, _cells(text, way)) for n, text in lines], way) for way in ways]
    fitting = [sum(len(line.cells) == len(b.names) for b in own for line in b.rows) for own in found]
    best = max(range(len(ways)), key=lambda k: fitting[k])
    return found[best] if fitting[best] >= _FEWEST else []


def _blocks_of(lines: Sequence[_Line], way: str) -> list[_Block]:
    found: list[_Block] = []
    end = k = 0
    while k < len(lines):
        if not lines[k].data:
            k += 1
            continue
        begin = k
        while k < len(lines) and lines[k].data:
            k += 1
        width = mode(len(_filled(line.cells)) for line in lines[begin:k])
        names, above = _names(lines[end:begin], width, way)
        if not names and found and len(found[-1].names) == width:
            names, above = found[-1].names, list(lines[end:begin])
        if not names and k - begin >= _FEWEST:
            found.append(_Block([], list(lines[begin:k]), []))
        if names:
            width = len(names)
            # A row of which everything was lost is one all the same; the names of the next table are none.
            texts = {line.text for line in lines[end:begin]}
            while (
                k < len(lines)
                and (lines[k].data or len(_filled(lines[k].cells)) == width)
                and lines[k].text not in texts
            ):
                k += 1
            # Separators at the end of a line are no cells.
            rows = [r if _filled(r.cells[width:]) else r._replace(cells=r.cells[:width]) for r in lines[begin:k]]
            found.append(_Block(names, rows, above))
            end = k
    return found


def _names(above: Sequence[_Line], width: int, way: str) -> tuple[list[str], list[_Line]]:
    """Names of the columns with their units, and the lines above them; [] where there are none."""
    rest = list(above)
    units = _unit_row(rest[-1].cells) if len(rest) > 1 else []
    if units:
        rest.pop()
    if not rest:
        return [], []
    last, apart = rest.pop(), way in SEPARATORS
    names = _NAMED.findall(last.text) if way == _WAYS[-1] else last.cells
    # Between separators a column may have no name.
    if len(_filled(names)) != width and not (apart and len(names) >= width > 1):
        return [], []
    names = names[: max(width, len(_filled(names)))]
    some = [name for name in names if name]
    if any(map(is_number, some)) or not some:
        return [], []
    if rest and apart and len({*some}) < len(some) and len(rest[-1].cells) > 1:
        names = _under(rest.pop().cells, names)
    if len(units) > len(names):
        units = _filled(units)
    if len(units) > len(names):
        return [], []
    if units:
        # From the right, where the first ones are blank.
        units = [""] * (len(names) - len(units)) + units
        names = [f"{n}[{u}]" if u and not split_header(n)[1] else n for n, u in zip(names, units, strict=True)]
    return names, rest


def _filled(cells: Sequence[str]) -> list[str]:
    """Cells up to the last one that is not empty."""
    return list(cells[: max((k + 1 for k, cell in enumerate(cells) if cell), default=0)])


def _under(above: Sequence[str], names: Sequence[str]) -> list[str]:
    """Names that occur several times, with what stands above them, which holds until the next text there."""
    found, what = [], ""
    for k, name in enumerate(names):
        here = above[k] if k < len(above) else ""
        what = here or what
        found.append(f"{what} {name}" if what and names.count(name) > 1 and name else name or here)
    return found


def _unit_row(cells: Sequence[str]) -> list[str]:
    """Units of a row that has nothing else; [] of another row."""
    bare = [cell.strip("[]() ") for cell in cells]
    return bare if all(_kind(unit) for unit in bare if unit) and any(bare) else []


def _cells(line: str, way: str) -> list[str]:
    if len(way) > 1:
        return re.split(way, line.strip())
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=way), [])]
    except csv.Error:
        return [line]


def _measured(blocks: Sequence[_Block]) -> tuple[list[list[_Line]], list[int]]:
    """Rows of each table without those that sum up others, and the lines of these."""
    first = [line.cells[0] for block in blocks for line in block.rows]
    counted = sum(map(is_number, first)) > 0.5 * len(first)
    left: list[int] = []
    kept: list[list[_Line]] = []
    for block in blocks:
        kept.append([])
        for line in block.rows:
            name = line.cells[0]
            summary = _SUMMARY.fullmatch(name) or (counted and name and not is_number(name))
            left += [line.number] if summary else []
            kept[-1] += [] if summary else [line]
    return kept, left


def _decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    cells = {cell for row in rows for cell in row if is_number(cell)}
    return any("," in cell for cell in cells) and not any("." in cell for cell in cells)


def _given(blocks: Sequence[_Block], comma: bool) -> dict[str, list[float]]:
    """Numbers that the text above every table names: header -> one for each table."""
    each: list[dict[str, float]] = []
    for block in blocks:
        found: dict[str, float] = {}
        for line in block.above:
            about = _ABOUT.match(line.text)
            for name, number, unit in _GIVEN.findall(line.text, about.end() if about else 0):
                header = f"{about[1]}_{name}" if about else name
                header += f"[{unit}]" if _kind(unit) else ""
                found[header] = float(number.replace(",", ".") if comma else number.replace(",", ""))
        each.append(found)
    names = {split_header(name)[0] for name in blocks[0].names}
    common = [h for h in each[0] if all(h in found for found in each) and split_header(h)[0] not in names]
    return {header: [found[header] for found in each] for header in common}


def _labels(blocks: Sequence[_Block], names: Sequence[str]) -> tuple[str, list[str]]:
    """What the tables are called, a word that is no name of a column, and the label of each."""
    words, labels = [], []
    for k, block in enumerate(blocks):
        texts = [line.text for line in block.above if not _GIVEN.search(line.text) and not _UNITS.match(line.text)]
        match = _LABEL.match(texts[-1]) if texts else None
        words.append(match[1].lower() if match else "group")
        labels.append((match[2].strip() if match else "") or f"table {k + 1}")
    word = words[0] if {*words} == {words[0]} else "group"
    taken = {split_header(name)[0] for name in names}
    return word if word not in taken else f"{word}_of_table", labels


def _declared(texts: Iterable[str]) -> dict[str, str]:
    """SI unit -> the unit that lengths or angles are in, as a line of text says."""
    found: dict[str, str] = {}
    for text in texts:
        match = _UNITS.match(text)
        for unit in re.split(r"[\s,;:/=()\[\]\"]+", match[1]) if match else []:
            kind = _kind(unit) or _kind(unit.lower())
            if kind in ("m", "rad"):
                found.setdefault(kind, unit if _kind(unit) else unit.lower())
    return found


def _kind(unit: str) -> str | None:
    try:
        return si_unit_of(unit) if unit else None
    except InputError:
        return None
