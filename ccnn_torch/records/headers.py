"""The header of a table: names and units as in the file, or as given by a map of columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ccnn_torch.display import is_shown, visible
from ccnn_torch.errors import InputError
from ccnn_torch.spelling import nearest
from ccnn_torch.units import si_unit_of, split_header, to_si

# Characters of a name.
_LONGEST = 100
IGNORE = "ignore"
"""The entry in a map of columns for a column to leave out."""


@dataclass(frozen=True)
class Header:
    """Names, units and positions of the columns that are kept.

    Attributes:
        units: unit of each column, by name, in the file's order; empty where it has none.
        kept: number of each of these columns among all of the file.
        width: how many columns the file has.
    """

    units: dict[str, str]
    kept: list[int]
    width: int


def read_header(cells: Sequence[str], file: str, columns: Mapping[str, str] | None = None, line: int = 1) -> Header:
    """Read a header.

    Args:
        cells: as in the file; a cell without text gets the name ``column 3`` or the like.
        file: the file, for the error.
        line: of the file, for the error.
        columns: header as in the file (or its name alone) -> ``name[unit]``, or ``ignore``. The unit may be left out
            where the file has it.

    Raises:
        InputError: there is no header, a name is repeated, or the map names no column of the file, lacks a unit or
            contradicts the file's.
    """
    if all(is_number(cell) for cell in cells):
        raise InputError(
            f"{file}: line {line} must be the header, e.g. q1[rad],x[mm], but it holds numbers alone; "
            "write one above them"
        )
    targets = _targets(cells, file, columns or {})
    units: dict[str, str] = {}
    kept: list[int] = []
    first: dict[str, str] = {}
    for k, cell in enumerate(cells):
        if targets.get(k) == IGNORE:
            continue
        name, unit = split_header(cell)
        if k in targets:
            name, unit = _mapped(cell.strip(), unit, targets[k], file)
        elif not name and unit:
            raise InputError(f"{file}: the header '{cell}' has a unit but no name; write name[{unit}]")
        name = name or f"column {k + 1}"
        _check_name(name, k + 1, file)
        if name in units:
            if targets:
                raise InputError(
                    f"{file}: '{first[name]}' and '{cell.strip()}' would both be the column '{name}'; write "
                    f'columns: {{"{cell.strip()}": {IGNORE}}} for the one that is not meant'
                )
            raise InputError(f"{file}: column '{name}' occurs twice in the header; remove or rename one of them")
        units[name] = unit
        first[name] = cell.strip()
        kept.append(k)
    return Header(units, kept, len(cells))


def columns_there(units: Mapping[str, str], columns: Mapping[str, str]) -> dict[str, str]:
    """The entries of a map of columns whose header a table has (its names and units as written), blanks aside."""
    return {key: target for key, target in columns.items() if any(_means(key, pair) for pair in units.items())}


def _means(key: str, pair: tuple[str, str]) -> bool:
    """Whether an entry's key means the column of this name and unit."""
    return pair in (split_header(key), (key.strip(), pair[1]))


def _check_name(name: str, number: int, file: str) -> None:
    """Refuse names that are too long, have control characters, or are formulas to a spreadsheet."""
    wrong = ""
    if len(name) > _LONGEST:
        wrong = f"has {len(name)} characters; is line 1 the header?"
    elif not all(map(is_shown, name)):
        wrong = "has a control character"
    elif name.startswith(("=", "+", "-", "@")):
        wrong = "begins like a formula, which a spreadsheet would run"
    if wrong:
        raise InputError(
            f"{file}: the header '{visible(name, 40)}' of column {number} {wrong}; give it a name such as q1[rad]"
        )


def _targets(cells: Sequence[str], file: str, columns: Mapping[str, str]) -> dict[int, str]:
    """Number of a column -> its entry in the map."""
    whole = [cell.strip() for cell in cells]
    pairs = [split_header(cell) for cell in cells]
    names = [name for name, _ in pairs]
    found: dict[int, str] = {}
    for key, target in columns.items():
        there = [k for k, cell in enumerate(whole) if cell == key.strip()]
        there = there or [k for k, pair in enumerate(pairs) if _means(key, pair)]
        if len(there) != 1:
            near = nearest(key, [*whole, *names])
            hint = f"did you mean '{near}'?" if near else f"it has {', '.join(whole)}"
            what = f"has no column '{key}'; {hint}" if not there else f"has {len(there)} columns '{key}'; rename one"
            raise InputError(f"columns: {file} {what}")
        if there[0] in found:
            raise InputError(f"columns: '{whole[there[0]]}' of {file} is named twice; remove one of the entries")
        found[there[0]] = target.strip()
    return found


def _mapped(cell: str, written: str, target: str, file: str) -> tuple[str, str]:
    """Name and unit that the map gives a column whose unit in the file is `written`."""
    name, unit = split_header(target)
    where = f"columns: '{target}' for '{cell}'"
    if not name or any(mark in name for mark in "[]"):
        raise InputError(f"{where} is not of the form name[unit]; write e.g. q1[deg], or {IGNORE}")
    if name.startswith("direction"):
        unit = unit or "1"
    if not (unit or written):
        raise InputError(f"{where} has no unit; write e.g. {name}[deg], {name}[mm] or {name}[1] (no unit)")
    if unit and written and not _same(unit, written, where):
        raise InputError(f"{where} is in {unit}, but {file} has it in {written}; write {name}[{written}]")
    return name, unit or written


def _same(unit: str, written: str, where: str) -> bool:
    """Whether two units are one, such as deg and °; a unit in the file that is not known is overruled by the map's."""
    si_unit_of(unit, where)
    try:
        kinds = si_unit_of(unit), si_unit_of(written)
    except InputError:
        return True
    return kinds[0] == kinds[1] and bool((to_si([0.0, 1.0], unit) == to_si([0.0, 1.0], written)).all())


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a point or a decimal comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True
