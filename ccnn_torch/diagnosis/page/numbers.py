"""The numbers to enter in a controller, a DH file or a URDF: those of the verdict's effects that are clearly not 0."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ccnn_torch.diagnosis.verdict.findings import clear_parameters, frequency_words, repeats_of, size_words
from ccnn_torch.display import display_unit, number_text, unit_text
from ccnn_torch.effects.words import words_of
from ccnn_torch.report.table import Table

Block = Mapping[str, Any]
_Z95 = 1.96
# Of the middle from which a gain counts: a gain of some thousandths times the rest is no error.
_MIDDLE_DIGITS = 6
# Numbers of an effect, however many effects there are.
_FEWEST = 2
# A wave of forty periods over the travel, ten travels from where the joint counts from, is in step to a thousandth.
_PERIOD_DIGITS = 7
_OWN_UNIT = "A number without unit has that of the simulator."


def numbers_table(results: Block, most: int) -> Table | None:
    """The largest numbers with their 95 % intervals; of parameters of the model also what to enter in their place.

    Args:
        results: as in `diagnosis.json`.
        most: about so many are shown, of each effect those that are largest against their standard deviations.
    """
    rows, notes, left_out = [], [], 0
    by_name, chosen = {e["name"]: e for e in results["effects"]}, results["verdict"]["effects"]
    each = max(most // max(len(chosen), 1), _FEWEST)
    for effect in chosen:
        parameters = by_name.get(effect, {}).get("parameters", {})
        clear = clear_parameters(parameters)
        for name in list(clear)[:each]:
            block = parameters[name]
            value, unit, error = block["value"], block["unit"], _Z95 * block["sd"]
            part = block.get("part") or ""
            enter = "–" if block.get("nominal") is None else _whole(block["nominal"] + value, unit, block["sd"])
            text = f"{_named(name, part)}{_often(name, parameters)}{_counted(block)}"
            text = text if len(chosen) == 1 else f"{words_of(effect).short}, {text}"
            rows.append((text, size_words(value, unit, 4), f"± {size_words(error, unit, 2, value)}", enter))
        left_out += max(len(clear) - each, 0)
        notes += [_OWN_UNIT] if any(not block["unit"] for block in clear.values()) else []
        notes += [words_of(effect).meaning] if clear and words_of(effect).meaning else []
    if not rows:
        return None
    columns: tuple[str, ...] = ("number", "error found", "95 %", "enter instead")
    cells: list[tuple[str, ...]] = [*rows]
    if all(row[3] == "–" for row in rows):
        columns, cells = columns[:3], [row[:3] for row in rows]
    if left_out:
        notes.append(f"{left_out} more that are clearly not 0 are in diagnosis.json.")
    notes.append("The intervals hold if nothing else acts and the rest of the model is right.")
    return Table("Numbers to enter", columns, cells, " ".join(notes))


def _named(name: str, part: str) -> str:
    """A number as results call it, after the joint, leg or link that it belongs to."""
    own = name.removeprefix(f"q{part.partition(' ')[2]} ") if part else name
    return part if own in (part, f"q{part.partition(' ')[2]}") else f"{part} {own}".strip()


def _often(name: str, parameters: Block) -> str:
    """How often a wave of a periodic error repeats; empty for other numbers."""
    joint, *rest = name.split(" ")
    own = repeats_of(parameters, joint)
    if own is None or not rest:
        return ""
    times = int(rest[1]) if len(rest) > 1 and rest[1].isdigit() else 1
    return f", {frequency_words(times * own['value'], own['unit'], _PERIOD_DIGITS)}"


def _counted(block: Block) -> str:
    """From where a gain counts, and which way a number does, where that is not the usual one."""
    if "sense" in block:
        return f", {block['sense']}"
    if "about" not in block:
        return ""
    about = block["about"]
    scale, unit = (1e-3, "mm") if about["unit"] == "m" else (1.0, unit_text(about["unit"]))
    return f", about {about['joint']} = {number_text(about['value'] / scale, _MIDDLE_DIGITS)} {unit}"


def _whole(value: float, unit: str, sd: float) -> str:
    """A number to enter, to the digits that are known: lengths in mm, angles in rad and degrees."""
    if unit == "m":
        scale, shown = display_unit("m", 1.0)
        return f"{value / scale:.{_decimals(sd / scale)}f} {shown}"
    text = f"{value:.{_decimals(sd)}f} {unit_text(unit)}".removesuffix(" 1").strip()
    degrees = math.degrees(1.0)
    return f"{text} = {value * degrees:.{_decimals(sd * degrees)}f}°" if unit == "rad" else text


def _decimals(sd: float) -> int:
    """Decimals down to a tenth of a standard deviation."""
    return min(max(1 - math.floor(math.log10(sd)), 0), 12) if sd > 0 else 6
