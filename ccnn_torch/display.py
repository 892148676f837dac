"""Display SI numbers in the unit that gives 1 to 999, with four digits; and escape text from outside."""

from __future__ import annotations

import math
import os
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

from ccnn_torch.units import told_in

# All but letters, digits and signs that open, close or continue nothing in C, Structured Text, HAL, CSV and Markdown;
# `*` and `/` stand within a unit, and no sign at the beginning makes a formula of a cell or a request of a manual page.
_NOT_PLAIN = re.compile(
    r"[^A-Za-z0-9 _.,:;=+%()\[\]^'*/-]|^[=+.'-]|(?<![A-Za-z0-9])[*/]|[*](?![A-Za-z0-9])|/(?![A-Za-z0-9(])"
)

_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def display_unit(unit: str, magnitude: float | None) -> tuple[float, str]:
    """The prefixed unit for numbers of about this magnitude.

    Args:
        unit: `m` or `rad`; any other SI unit stays, written as in print.
        magnitude: a typical number [unit]; 1e-3 and more is shown in mm or mrad, less in µm or µrad, less than 1e-7 in
            nm or nrad; None where it is not known.

    Returns:
        Divide a number by the first to have it in the second.
    """
    if unit not in ("m", "rad") or magnitude is None:
        return 1.0, unit_text(unit)
    wanted = (10.0, 1e-3, 1e-7, 0.0)
    scale, prefix = next(
        entry for entry, least in zip(_PREFIXES, wanted, strict=True) if abs(magnitude) >= least or entry[1] == "n"
    )
    return scale, prefix + unit


def unit_text(unit: str) -> str:
    """A unit as in print: `rad/N/m` and `rad/(N*m)` are both `rad/(N·m)`."""
    over, *under = unit.replace("(", "").replace(")", "").replace("*", "·").split("/")
    return f"{over}/{f'({below})' if '·' in (below := '·'.join(under)) else below}" if under else over


_PRINTED = {"arcsec": '"', "arcmin": "'", "deg": "°"}


def own_unit(block: Mapping[str, Any]) -> tuple[float, str] | None:
    """What one of the unit is in SI that people tell a number in, and that unit as in print; None where it has none.

    Args:
        block: with its SI `unit` and the unit that is `shown`.
    """
    shown = block.get("shown")
    if not shown:
        return None
    text = _PRINTED.get(shown, shown)
    return told_in(shown, block["unit"]), f"µ{text[1:]}" if text.startswith("um") else unit_text(text)


def number_text(value: float | None, digits: int = 4) -> str:
    """A number to so many significant digits; `–` for None. Exponents are for 1.234e-10 and 1.234e+05, not for 2990."""
    if value is None:
        return "–"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        whole = float(f"{value:.{digits - 1}e}")
        if abs(whole) >= 10**digits:
            return f"{whole:.0f}"
        text = f"{value:#.{digits}g}"
        return text.rstrip(".")
    return f"{value:.{digits - 1}e}"


def with_unit(value: float | None, unit: str, digits: int = 3, like: float | None = None) -> str:
    """A number [unit] with the prefixed unit that fits it, or that fits a number `like` it; `–` for None."""
    if value is None:
        return "–"
    scale, shown = display_unit(unit, value if like is None else like)
    return f"{number_text(value / scale, digits)} {shown}"


def count_text(count: int, word: str) -> str:
    """`1 repeat`, `30 repeats`."""
    return f"{count} {word}" if count == 1 else f"{count} {word}{'es' if word.endswith('ch') else 's'}"


def visible(text: str, longest: int = 200) -> str:
    """Escape text from outside for a screen or a page: control characters are shown as codes.

    Control characters, marks that turn the direction of writing, and halves of pairs become \\x1b or \\u202e; of a text
    that is too long the middle is left out, since a message begins with the place and ends with the remedy.
    """
    if len(text) > longest:
        text = f"{text[: longest * 2 // 3]} … {text[len(text) - longest // 3 :]}"
    return "".join(c if is_shown(c) else c.encode("unicode_escape").decode() for c in text)


def plain(text: str) -> str:
    """Escape text from outside for a comment, a description or a cell of an exported file.

    What is no letter of ASCII, no digit and no sign that is harmless in every language becomes its code, {U+002A}; so
    do a `*` and a `/` that do not stand as in a unit, `W/(m^2*K)`. HAL's compiler would read a \\u002a back.
    """
    return _NOT_PLAIN.sub(lambda found: f"{{U+{ord(found[0]):04X}}}", text)


def identifiers(texts: Sequence[str], longest: int = 24) -> list[str]:
    """Names of letters, digits and `_` for texts from outside, each another one; what is such a name stays."""
    found: list[str] = []
    for text in texts:
        name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:longest].rstrip("_") or "unnamed"
        taken = {other.lower() for other in found}
        others = (f"{name}_{k}" for k in range(2, len(texts) + 2))
        found.append(name if name.lower() not in taken else next(n for n in others if n.lower() not in taken))
    return found


def is_shown(character: str) -> bool:
    """Whether a character is visible, or a space."""
    return character.isprintable() or unicodedata.category(character) == "Zs"


def short_path(path: str) -> str:
    """A file's folder and name: enough to know it by, and nothing of the machine on which a page was made."""
    return "/".join(PurePath(path).parts[-2:])


def typed_path(path: str) -> str:
    """A path as it may be typed here: relative where it is below the current folder."""
    near = os.path.relpath(path)
    return path if near.startswith("..") else near


def to_enter(block: Mapping[str, Any], value: float) -> str:
    """A number to enter, to the digits that `sd` allows: in its own unit, else lengths in mm, angles in rad and °."""
    unit, sd = block["unit"], block["sd"]
    if own := own_unit(block):
        return f"{value / own[0]:.{_decimals(sd / own[0])}f} {own[1]}"
    if unit == "m":
        scale, shown = display_unit("m", 1.0)
        return f"{value / scale:.{_decimals(sd / scale)}f} {shown}"
    text = f"{value:.{_decimals(sd)}f} {unit_text(unit)}".removesuffix(" 1").strip()
    degrees = math.degrees(1.0)
    return f"{text} = {value * degrees:.{_decimals(sd * degrees)}f}°" if unit == "rad" else text


def _decimals(sd: float) -> int:
    """Decimals down to a tenth of a standard deviation."""
    return min(max(1 - math.floor(math.log10(sd)), 0), 12) if sd > 0 else 6
