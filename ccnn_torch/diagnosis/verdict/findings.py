"""What is wrong, part by part: the joints, legs or links of each effect of a verdict, and the size there, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ccnn_torch.diagnosis.verdict.text import capital, listed
from ccnn_torch.display import display_unit, number_text, own_unit, unit_text
from ccnn_torch.effects import OUTLIER
from ccnn_torch.effects.words import words_of

Block = Mapping[str, Any]

# Standard deviations from which a number is clearly not 0.
_CLEAR = 3.0
# Joints, legs or links that a sentence names.
_MOST_PARTS = 3
# A part below this share of the largest one is not named.
_LEAST_SHARE = 0.1
# Angles at which the largest value of a sum of harmonics is sought.
_ANGLES = 720
_A_TURN = " times a turn"
# Effects whose numbers are waves, and what tells how often these repeat.
_PERIODIC = {"transmission": "frequency", "cogging": "cogging_order"}
# From this share for each kelvin on it is none of a length [1/K].
_NO_GROWTH = 1e-3
# Speeds below this [m/s or rad/s] are drifts, told by the hour.
_DRIFT = 1e-3
_PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


ZERO_OF = "zero of joint "
"""Begin of the sense of a parameter that is the zero of a joint."""


class Finding(NamedTuple):
    """An effect of the verdict in words.

    Attributes:
        effect: its name.
        text: what is wrong, where and how large, without a full stop.
        look: the part to look at, as a sentence.
    """

    effect: str
    text: str
    look: str


def findings(results: Block) -> list[Finding]:
    """One for each effect of the verdict, the largest first.

    Args:
        results: as in `diagnosis.json`.
    """
    by_name = {e["name"]: e for e in results["effects"]}
    found = []
    for name in results["verdict"]["effects"]:
        words, parameters = words_of(name), by_name.get(name, {}).get("parameters", {})
        sizes = _waves(parameters) if name in _PERIODIC else _sizes(parameters)
        named = [part for part in sizes if part]
        shown = [part for part in named if sizes[part][0] >= _LEAST_SHARE * max(sizes[p][0] for p in named)]
        most, more = shown[:_MOST_PARTS], len(shown) > _MOST_PARTS
        text = words.short if name != OUTLIER else f"{len(results['rows_set_aside'])} {words.short}"
        worded = {block.get("word") for block in parameters.values() if not block.get("part")}
        if most and worded.issuperset(most):
            text += f": {'largest ' if more else ''}{'; '.join(f'{part} {sizes[part][1]}' for part in most)}"
            most = []
        elif most:
            text += f" of {places(shown)}: {'largest in ' if more else ''}"
            alone = len(shown) == 1
            text += "; ".join(sizes[part][1] if alone else f"{part} {sizes[part][1]}" for part in most)
        elif "" in sizes:
            text += f": {sizes[''][1].removeprefix(f'{words.short} ')}"
        lag = parameters.get("lag", {}).get("value")
        text += f" (settling in {size_words(lag, 's')})" if lag else ""
        begin = parameters.get("begin")
        if begin is not None and begin["value"] > 0:
            # Without times it is a row's number, from 0.
            row, since = f"row {int(begin['value']) + 2}", f"{size_words(begin['value'], 's')} after the first row"
            text += f" (from {since if begin['unit'] else row} on)"
        like = [
            n for n in by_name.get(name, {}).get("indistinguishable_from", ()) if n not in results["verdict"]["effects"]
        ]
        if like:
            text += f" (or {listed([words_of(n).short for n in like], 'or')}: these data do not distinguish them)"
        look = words.look.format(where=places(most) if most else "the machine")
        # What a table of links calls theta3 is the zero of joint 3 to who masters the robot.
        zeros = [b["sense"] for n, b in clear_parameters(parameters).items() if n.startswith("theta") and "sense" in b]
        zeros = [zero for zero in zeros if zero.startswith(ZERO_OF) and zero in text]
        if zeros:
            look = f"{capital(listed(zeros))}: master the axis again. {look}"
        found.append(Finding(name, text, look))
    return found


def clear_parameters(parameters: Block) -> dict[str, Block]:
    """The coefficients that are clearly not 0, those that are largest against their standard deviations first."""
    sized = {n: b for n, b in parameters.items() if b["sd"] and not b.get("searched")}
    clear = {n: b for n, b in sized.items() if abs(b["value"]) > _CLEAR * b["sd"]}
    return dict(sorted(clear.items(), key=lambda item: -abs(item[1]["value"]) / item[1]["sd"]))


def places(parts: Sequence[str]) -> str:
    """`joints 1 and 2`, `legs 1 to 6`, `joint 2 and leg 3`."""
    kinds: dict[str, list[str]] = {}
    for part in parts:
        kind, _, number = part.partition(" ")
        kinds.setdefault(kind, []).append(number)
    return listed([f"{kind}{'s' if len(n) > 1 else ''} {_numbers(sorted(n, key=_order))}" for kind, n in kinds.items()])


def size_words(value: float, unit: str, digits: int = 3, beside: float | None = None) -> str:
    """A number with a unit that a technician reads: `-7.23 mm`, `2.87 µrad/(N·m)`, `-0.62 %`, `25.6 min`.

    Args:
        value: in SI.
        unit: its unit; empty where it is not known.
        digits: significant ones.
        beside: the number whose standard deviation it is: rates are then told in the unit of that.
    """
    size = abs(value if beside is None else beside)
    if unit == "1/K" and size >= _NO_GROWTH:
        return f"{number_text(100 * value, digits)} %/K"
    if not unit:
        return number_text(value, digits)
    if unit == "1":
        return f"{number_text(100 * value, digits)} %"
    if unit == "s" and abs(value) >= 120:
        return f"{number_text(value / 60, digits)} min"
    if unit in ("m/s", "rad/s") and size < _DRIFT:
        scale, shown = display_unit(unit[:-2], 3600 * value)
        return f"{number_text(3600 * value / scale, digits)} {shown}/h"
    if unit == "s" and abs(value) < 1:
        return f"{number_text(1e3 * value, digits)} ms"
    if unit in ("m", "rad"):
        scale, shown = display_unit(unit, value)
        return f"{number_text(value / scale, digits)} {shown}"
    if unit.startswith(("m/", "rad/", "1/K")):
        scale, prefix = next((p for p in _PREFIXES if size >= p[0]), _PREFIXES[-1])
        shown = "m/m/K" if unit == "1/K" else unit
        return f"{number_text(value / scale, digits)} {prefix}{unit_text(shown)}"
    return f"{number_text(value, digits)} {unit_text(unit)}"


def told_words(block: Block, value: float, digits: int = 3, beside: float | None = None) -> str:
    """A number in the unit that people tell it in where it has one, else as `size_words`."""
    own = own_unit(block)
    if own is None:
        return size_words(value, block["unit"], digits, beside)
    return f"{number_text(value / own[0], digits)} {own[1]}"


def repeats_of(parameters: Block, joint: str) -> Block | None:
    """The number that tells how often a wave of a joint repeats; None where it is no wave."""
    return next((parameters[name] for n in _PERIODIC.values() if (name := f"{joint} {n}") in parameters), None)


def frequency_words(frequency: float, unit: str, digits: int = 3) -> str:
    """`5 times a turn` of a turning joint, `every 5.2 mm` of a sliding one, to so many significant digits."""
    if unit == "1":
        return f"{frequency:.{digits}g}{_A_TURN}"
    scale, shown = display_unit("m", 2 * math.pi / frequency)
    return f"every {number_text(2 * math.pi / frequency / scale, digits)} {shown}"


def _sizes(parameters: Block) -> dict[str, tuple[float, str]]:
    """Of each part its clearest number: how large it is against those of the others, and in words."""
    chosen: dict[str, str] = {}
    # A gain before the zero that it has where it counts from.
    for name, block in sorted(clear_parameters(parameters).items(), key=lambda item: "about" not in item[1]):
        chosen.setdefault(block.get("part") or block.get("word") or "", name)
    told = {name: own_unit(parameters[name]) or (1.0, parameters[name]["unit"]) for name in chosen.values()}
    if len({unit for _, unit in told.values()}) == 1:
        sizes = {part: abs(parameters[name]["value"]) / told[name][0] for part, name in chosen.items()}
    else:
        sizes = {part: abs(parameters[name]["value"]) / parameters[name]["sd"] for part, name in chosen.items()}
    found = {}
    for part in sorted(chosen, key=lambda p: -sizes[p]):
        name, number = chosen[part], part.partition(" ")[2]
        own = "" if name in (part, f"q{number}") else f"{name.removeprefix(f'q{number} ')} "
        word = parameters[name].get("word")
        own = own if not word else "" if word == part else f"{word} "
        value, unit = parameters[name]["value"], parameters[name]["unit"]
        size = told_words(parameters[name], value)
        if (sense := parameters[name].get("sense", "")).startswith(ZERO_OF):
            size += f" ({sense})"
        if not unit and (before := parameters[name].get("nominal")) is not None:
            size = f"{size_words(before, unit)} → {size_words(before + value, unit)}"
        found[part] = (sizes[part], f"{own}{size}")
    return found


def _waves(parameters: Block) -> dict[str, tuple[float, str]]:
    """Of each joint the largest error of the harmonics that are clearly there, and these in words; largest first."""
    clear = clear_parameters(parameters)
    found: dict[str, tuple[float, str]] = {}
    for joint in dict.fromkeys(name.split(" ")[0] for name in clear):
        own = repeats_of(parameters, joint)
        if own is None:
            continue
        angle = np.linspace(0, 2 * np.pi, _ANGLES, endpoint=False)
        whole, sizes = np.zeros(_ANGLES), {}
        for k in (1, 2, 3, 4):
            ends = [f"{joint} {wave}{'' if k == 1 else f' {k}'}" for wave in ("sin", "cos")]
            if not any(end in clear for end in ends):
                continue
            sine, cosine = (parameters.get(end, {"value": 0.0})["value"] for end in ends)
            whole += sine * np.sin(k * angle) + cosine * np.cos(k * angle)
            sizes[k] = math.hypot(sine, cosine)
        largest = float(np.abs(whole).max())
        unit = next(parameters[name]["unit"] for name in clear if name.startswith(f"{joint} "))
        there = sorted(k for k in sizes if sizes[k] >= _LEAST_SHARE * max(sizes.values()))
        often = listed([frequency_words(k * own["value"], own["unit"]) for k in there])
        if own["unit"] == "1":
            often = f"{often.replace(_A_TURN, '')}{_A_TURN}"
        found[f"joint {joint.removeprefix('q')}"] = (largest, f"±{size_words(largest, unit)}, {often}")
    return dict(sorted(found.items(), key=lambda item: -item[1][0]))


def _numbers(sorted_: Sequence[str]) -> str:
    run = [str(int(sorted_[0]) + i) for i in range(len(sorted_))] if sorted_[0].isdigit() else []
    return f"{sorted_[0]} to {sorted_[-1]}" if len(sorted_) > 2 and [*sorted_] == run else listed(sorted_)


def _order(number: str) -> tuple[int, str]:
    return (int(number), "") if number.isdigit() else (0, number)
