"""Units of table columns: the header form ``name[unit]`` and the way to SI and back.

pint knows the units, but treats an angle as a plain number: it turns `rad`, `deg` and `1` into one another silently.
So two units count as convertible here only when their base units agree *with the radian among them*.
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccnn_torch.errors import InputError

# Not grad, which is a degree to some and a 400th of a turn to others. pint would read Grad as gigaradians, MM as
# megamolar, Min as megainches, Nm as textile number metres, and C as coulombs.
_WORDS = {
    "deg": "Grad Altgrad Winkelgrad gradi grado grados degré degrés º",
    "rad": "Radiant radianti radianes radián radiani",
    "arcmin": "Bogenminuten Winkelminuten",
    "arcsec": "Bogensekunden Winkelsekunden",
    "s": "Sek sek Sekunde Sekunden seconde secondes secondi segundos Sec",
    "min": "Min Minute Minuten minuti minutos",
    "h": "Std std Stunde Stunden heure heures ore hora horas",
    "m": "Meter mètre mètres metri metros",
    "mm": "MM Millimeter millimètre millimètres millimetri milímetros milimetros",
    "um": "px pixel pixels Pixel Mikrometer micromètre micromètres micrometri micrómetros",
    "in": "Zoll pouce pouces pollici pulgadas",
    "K": "Kelvin",
    "degC": "Celsius ºC",
    "N": "Newton",
    "N*m": "Nm",
    "N*mm": "Nmm",
    "rpm": "RPM",
}
_WHOLE = {
    **dict.fromkeys(("C", "℃", "Grad C", "Grad Celsius", "deg C", "° C", "º C"), "degC"),
    **dict.fromkeys(("U/min", "tr/min", "giri/min"), "rpm"),
    **dict.fromkeys(("-", "–", "—"), "1"),
}
_BY_WORD = {word: unit for unit, words in _WORDS.items() for word in words.split()}
_LETTERS = re.compile(r"[^\W\d_]+")


@cache
def as_read(unit: str) -> str:
    """The unit in the words that are looked up, e.g. ``deg/s`` for ``Grad/Sek.``; any other text as it is."""
    unit = unit.removesuffix(".") if _LETTERS.fullmatch(unit.removesuffix(".")[-1:]) else unit
    return _WHOLE.get(unit) or _LETTERS.sub(lambda word: _BY_WORD.get(word[0], word[0]), unit)


STANDARD_GRAVITY = 9.80665
"""m/s^2."""
LARGEST = 1e12
"""No number of a record or a geometry file is larger in SI: it is 7 times the Earth's distance from the Sun in m, a
stiffness or a pressure beyond steel's, and sums of its square still keep the smaller terms."""

# What a measured quantity is usually written in, for the remedy in an error, and what it is called.
_EXAMPLES = {
    "m": ("m", "mm"),
    "rad": ("rad", "deg"),
    "K": ("degC", "K"),
    "s": ("s", "min"),
    "1": ("1",),
    "m/s": ("m/s", "mm/s"),
    "rad/s": ("rad/s", "deg/s"),
}
_KINDS = {
    "1": "a number without unit",
    "m": "a length",
    "rad": "an angle",
    "s": "a time",
    "K": "a temperature",
    "N": "a force",
    "N*m": "a moment",
    "m/s": "a speed",
    "rad/s": "an angular speed",
}
# Names for products of base units, the first that fits; joules come out as N*m, which is what a robot's record means.
_NAMED = ("1", "N", "N*m", "N/m", "N*m/rad", "Pa", "W", "V", "m/s", "rad/s", "m/s^2", "rad/s^2", "1/K")
_SYMBOLS = {"meter": "m", "radian": "rad", "second": "s", "kelvin": "K", "kilogram": "kg", "ampere": "A", "mole": "mol"}
_COMMON = ("m", "mm", "um", "cm", "in", "rad", "mrad", "deg", "arcsec", "s", "min", "ms", "degC", "K", "N", "N*m", "1")

_PARENTHESES = re.compile(r"\s*(?P<name>[^()\[\]]*?)\s*\((?P<unit>[^()\[\]]*)\)\s*")
_HEADER = re.compile(r"\s*(?P<name>[^\[\]]*?)\s*\[(?P<unit>[^\[\]]*)\]\s*")
_FACTOR = r"(?:[A-Za-zµμΩÅ_]+|%|°C?)(?:(?:\^|\*\*)-?[1-9]|⁻?[²³¹])?"
_EXPRESSION = re.compile(rf"(?:1|{_FACTOR})(?:\s*[*/·⋅.\s]\s*{_FACTOR})*")
# Signs of a product, which pint's versions read differently.
_PRODUCT = re.compile("[·⋅.]")
_REFUSED = {
    "Mm": "megametres; for millimetres write mm",
    "grad": "a 400th of a turn to some and a degree to others; write gon or deg",
}


@dataclass(frozen=True)
class _Unit:
    pint_name: str
    base: frozenset[tuple[str, float]]


class _UnknownUnit(Exception):
    """The reason, as the end of a sentence."""


def split_header(header: str) -> tuple[str, str]:
    """Name and unit of a column header; the unit is empty where the header has none.

    Beside ``name[unit]`` this takes ``name (unit)`` where the parentheses hold a unit that is known; anything else is a
    name without unit.
    """
    match = _HEADER.fullmatch(header)
    if match is not None:
        return match["name"], match["unit"].strip()
    match = _PARENTHESES.fullmatch(header)
    if match is not None and match["name"] and _is_unit(match["unit"].strip()):
        return match["name"], match["unit"].strip()
    return header.strip(), ""


def parse_header(header: str, file: str, si_unit: str | None = None) -> tuple[str, str]:
    """Split a column header ``name[unit]`` into name and unit (as written; ``1`` = no unit).

    Args:
        header: the header as in the file.
        file: the file, for the error.
        si_unit: what the column should be in, where known; sharpens the remedy in the error.

    Raises:
        InputError: no name, no unit, or something that is not of this form.
    """
    match = _HEADER.fullmatch(header)
    if match is None:
        name = header.partition("[")[0].strip()
        if "[" in header or "]" in header:
            raise InputError(
                f"{file}: the header '{header}' is not of the form name[unit]; {write_hint(name, si_unit)}"
            )
        if not name:
            raise InputError(f"{file}: a column has no header; write one of the form name[unit], or remove the column")
        raise InputError(f"{file}: column '{name}' has no unit; {write_hint(name, si_unit)}")
    name, unit = match["name"], match["unit"].strip()
    if not name:
        raise InputError(f"{file}: the header '{header}' has a unit but no name; write name[{unit or 'unit'}]")
    if not unit:
        raise InputError(f"{file}: column '{name}' has no unit; {write_hint(name, si_unit)}")
    return name, unit


def write_hint(name: str, si_unit: str | None = None) -> str:
    """The remedy "write 'q1[rad]' or 'q1[deg]'" for a column whose unit is known or guessed by the column's name."""
    name = name or "name"
    if si_unit is None and re.fullmatch(r"q\d+", name):
        examples: tuple[str, ...] = ("rad", "deg", "m")
    else:
        examples = _EXAMPLES.get(si_unit or _guess(name), (si_unit,) if si_unit else ("mm", "1"))
    forms = " or ".join(f"'{name}[{unit}]'" for unit in examples)
    return f"write {forms}" + ("" if si_unit or name == "name" else " ([1] = no unit)" if "1" in examples else "")


def _guess(name: str) -> str:
    if name in ("x", "y", "z"):
        return "m"
    if name in ("rx", "ry", "rz"):
        return "rad"
    return {"time": "s", "temperature": "K"}.get(name, "")


def si_unit_of(unit: str, where: str = "") -> str:
    """The canonical SI unit of a unit: ``m``, ``rad``, ``s``, ``K``, ``N``, ``N*m``, ``1``, ``rad/s`` …

    Raises:
        InputError: the unit is not known; `where` opens the sentence.
    """
    usual = _USUAL.get(as_read(unit))
    if usual is not None:
        return usual[0]
    try:
        return _canonical(_lookup(unit).base)
    except _UnknownUnit as reason:
        raise InputError(f"{where}{': ' if where else ''}the unit '{unit}' {reason}") from None


def to_si(
    values: ArrayLike, unit: str, si_unit: str | None = None, where: str = "", name: str = "", hint: str = ""
) -> NDArray[np.float64]:
    """Convert values in `unit` to SI; absolute temperatures by their offset, not by a factor.

    Args:
        values: any shape, in `unit`.
        unit: as written in a header, e.g. ``mm``, ``deg``, ``degC``, ``1``.
        si_unit: the SI unit that is wanted, or None for that of `unit`.
        where: opens the sentence of an error, e.g. ``records.csv: column 'q1'``.
        name: the column's name, for the remedy.
        hint: the remedy for values that are not from a column.

    Raises:
        InputError: unknown unit, or one of another dimension (an angle and a plain number differ).
    """
    array = np.asarray(values, dtype=np.float64)
    usual, factor = _USUAL.get(as_read(unit), ("", 1.0))
    if usual and si_unit in (None, usual):
        return array + _CELSIUS if as_read(unit) == "degC" else array * factor
    found = si_unit_of(unit, where)
    if si_unit is not None and _lookup(unit).base != _lookup(si_unit).base:
        kind = f", {_KINDS[found]}," if found in _KINDS else ""
        wanted = _KINDS.get(si_unit, f"in {si_unit}")
        raise InputError(f"{where} is in '{unit}'{kind} but must be {wanted}; {hint or write_hint(name, si_unit)}")
    return np.asarray(_registry().Quantity(array, _lookup(unit).pint_name).to_base_units().magnitude, dtype=np.float64)


_WITH_UNIT = re.compile(r"(?P<number>[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?inf|nan)\s*(?P<unit>.*)", re.IGNORECASE)
_WRITTEN = {"m": "0.4 mm", "rad": "0.03 deg", "1": "0.002"}


def amount(text: str, si_unit: str | None, where: str) -> float:
    """The number of a text such as `0.4 mm` in SI; without a unit it is in SI, and si_unit None takes any unit.

    Raises:
        InputError: it is no number with a unit, or of another dimension; `where` opens the sentence.
    """
    match = _WITH_UNIT.fullmatch(text.strip())
    if match is None:
        raise InputError(f"{where}: '{text}' is no number with a unit; write e.g. 0.4 mm, or a number in SI")
    number = float(match["number"])
    if not match["unit"]:
        return number
    hint = f"write e.g. {_WRITTEN.get(si_unit or '', 'a number')}, or a number in SI"
    return float(to_si(number, match["unit"], si_unit, where, hint=hint))


def told_in(unit: str, si_unit: str) -> float:
    """What one of a unit is in SI, that of a parameter; an angle may be told as a slope, `um/m`."""
    slope = si_unit == "rad" and si_unit_of(unit) == "1"
    return float(to_si(1.0, unit, "1" if slope else si_unit, unit))


def from_si(values: ArrayLike, si_unit: str, unit: str) -> NDArray[np.float64]:
    """Inverse of `to_si`. values: any shape, in `si_unit`; returns the same shape in `unit`."""
    array = np.asarray(values, dtype=np.float64)
    if unit == si_unit:
        return array.copy()
    to_si(np.zeros(0), unit, si_unit, f"the target unit of '{si_unit}'")
    names = _lookup(si_unit).pint_name, _lookup(unit).pint_name
    return np.asarray(_registry().Quantity(array, names[0]).to(names[1]).magnitude, dtype=np.float64)


# Usual units with their SI unit and pint's own factor: pint's registry takes half a second to make.
_USUAL = {unit: (unit, 1.0) for unit in ("m", "rad", "s", "K", "N", "N*m", "1", "m/s", "rad/s", "V", "A")} | {
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "deg": ("rad", math.pi / 180),
    "mrad": ("rad", 1e-3),
    "urad": ("rad", 1e-6),
    "ms": ("s", 1e-3),
    "degC": ("K", 1.0),
}
_CELSIUS = 273.15


@cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


@cache
def _lookup(unit: str) -> _Unit:
    import pint

    if unit in _REFUSED:
        raise _UnknownUnit(f"means {_REFUSED[unit]}")
    name = as_read(unit)
    if not _EXPRESSION.fullmatch(name):
        raise _UnknownUnit(_not_known(unit))
    registry = _registry()
    try:
        parsed = registry.parse_units(_PRODUCT.sub("*", name))
    except (pint.UndefinedUnitError, pint.DefinitionSyntaxError, ValueError):
        raise _UnknownUnit(_not_known(unit)) from None
    zero, one = (registry.Quantity(value, parsed).to_base_units() for value in (0.0, 1.0))
    base = frozenset((str(key), float(power)) for key, power in one.unit_items())
    # Zero maps to zero for every scale, to 273.15 K for a temperature, and to 1 for a logarithmic unit such as dB.
    if zero.magnitude != 0.0 and base != {("kelvin", 1.0)}:
        raise _UnknownUnit("is logarithmic, which is not supported; give the column in a linear unit")
    return _Unit(str(parsed), base)


@cache
def _canonical(base: frozenset[tuple[str, float]]) -> str:
    for unit in _NAMED:
        if _lookup(unit).base == base:
            return unit
    factors = sorted(base, key=lambda item: (item[1] < 0, item[0]))
    text = ""
    for key, power in factors:
        symbol = _SYMBOLS.get(key, key) + ("" if abs(power) == 1 else f"^{abs(power):g}")
        text += f"{'/' if power < 0 else '*' if text else ''}{symbol}"
    return text if not text.startswith("/") else f"1{text}"


def _is_unit(text: str) -> bool:
    """Whether a text is a unit that is known; a bare number, as in ``probe (1)``, is none."""
    try:
        return text != "1" and _lookup(text) is not None
    except _UnknownUnit:
        return False


def _not_known(unit: str) -> str:
    folded = {name.lower(): name for name in reversed(_COMMON)}
    near = difflib.get_close_matches(unit.lower(), folded, 1, 0.5)
    return f"is not known; did you mean '{folded[near[0]]}'?" if near else "is not known; write e.g. mm, rad, deg or 1"
