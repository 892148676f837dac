"""Pictures of a diagnosis: the gap against the floor, probabilities, where it lies, and the course of a motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.page.data import About, gaps_of, used_rows
from ccnn_torch.diagnosis.page.tables import shares
from ccnn_torch.diagnosis.verdict.text import driver_words, floor_words, probability_words
from ccnn_torch.display import display_unit, number_text
from ccnn_torch.motion.stretches import PHASES
from ccnn_torch.report.figures import AFTER, BEFORE, FLOOR, GREY, SERIES, Plot, draw_pairs, height_of, planes_of, styled

Block = Mapping[str, Any]
_LIKE = SERIES[4]
# Candidates below this probability are not drawn one by one.
_LEAST = 0.01
_DRAWN = 12


@styled
def gap_plot(results: Block) -> Plot | None:
    """The gap before, with each effect alone, and with all of the verdict, as bars against the noise floor."""
    shown = [(name, block) for name, block in gaps_of(results) if block["before"]]
    if not shown:
        return None
    bars = {name: _bars(results, block, alone=name == shown[0][0]) for name, block in shown}
    heights = [len(bars[name]) + 1.6 for name, _ in shown]
    figure = Figure(figsize=(8.4, 0.34 * sum(heights) + 0.5 * len(shown)), layout="tight")
    grid = figure.subplots(len(shown), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (name, block) in zip(grid, shown, strict=True):
        scale, unit = display_unit(block["unit"], block["before"])
        reach = max(max(value, ends[1] if ends else 0.0) for _, value, ends, _ in bars[name]) / scale
        _draw_bars(axes, bars[name], reach, scale, unit)
        axes.set_xlim(0, 1.16 * reach)
        floor = block["noise_floor"]
        if floor is not None:
            label = f"{floor_words(results)} {number_text(floor / scale, 3)} {unit}"
            # An estimate is no bound, and not drawn as one.
            dashes = ":" if results.get("noise") == "estimated" else "--"
            axes.axvline(floor / scale, color=FLOOR, linestyle=dashes, label=label)
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)
        axes.set_xlabel(f"{name} gap, RMS on data not used for fitting [{unit}]")
        axes.set_title(f"{name.capitalize()} gap")
    caption = (
        "How far the model is from the machine on data not used for fitting: as it is, with one effect alone, and "
        "with all effects of the verdict. Whiskers: 95 % intervals. Dashed: the noise as given or as the records show "
        "it. Dotted: an estimate of the noise, which may hold another cause, so that a model can get below it."
    )
    return Plot("gap", figure, caption)


Bar = tuple[str, float, tuple[float, float] | None, str]


def _bars(results: Block, block: Block, *, alone: bool) -> list[Bar]:
    verdict, floor = results["verdict"], block["noise_floor"] or 0.0
    bars: list[Bar] = [("model as it is", block["before"], None, BEFORE)]
    if alone:
        for e in results["effects"]:
            if e["gap_after"] is None or not (e["name"] in verdict["effects"] or e["probability"] >= _LEAST):
                continue
            ends = _ends(block["before"], floor, e["shrink_ci95"])
            bars.append((f"with {e['name']} alone", e["gap_after"], ends, _LIKE))
            if len(bars) > 8:
                break
    if verdict["effects"]:
        ends = _ends(block["before"], floor, verdict["shrink_ci95"]) if alone else None
        bars.append((_all_words(verdict["effects"]), block["after"], ends, AFTER))
    network = results.get("network") or {}
    if alone and network.get("gap_after") is not None:
        low, high = network["gap_after_ci95"]
        bars.append(("and a network on the remainder", network["gap_after"], (low, high), SERIES[2]))
    # One effect alone is all of the verdict then: one bar shows it.
    if len(verdict["effects"]) == 1:
        bars = [bar for bar in bars if bar[0] != f"with {verdict['effects'][0]} alone"]
    return [bar for bar in bars if bar[1] is not None]


def _ends(before: float, floor: float, interval: list[float] | None) -> tuple[float, float] | None:
    """The gap's interval from that of its shrink, whose definition turned round."""
    if interval is None:
        return None
    low, high = (math.sqrt(floor**2 + (1 - s) * max(before**2 - floor**2, 0.0)) for s in reversed(interval))
    return low, high


def _draw_bars(axes: Axes, bars: list[Bar], reach: float, scale: float = 1.0, unit: str = "") -> None:
    """Bars with their sizes beside them, in a unit of that scale [SI], or of probabilities; reach: of the longest."""
    for i, (_, value, ends, colour) in enumerate(bars):
        right = size = value / scale
        axes.barh(i, size, height=0.62, color=colour)
        if ends is not None:
            # A shrink is never below 0, but an effect that is not there makes the gap larger on rows it has not seen.
            left, right = min(ends[0] / scale, size), max(ends[1] / scale, size)
            axes.hlines(i, left, right, color="#222222", linewidth=1.3)
            axes.vlines([left, right], i - 0.13, i + 0.13, color="#222222", linewidth=1.3)
        text = f"{number_text(size, 3)} {unit}" if unit else probability_words(size)
        axes.text(right + 0.012 * reach, i, text, va="center", fontsize=9)
    axes.set_yticks(range(len(bars)), [bar[0] for bar in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)


def _all_words(names: list[str]) -> str:
    return "without the bad rows" if names == ["outlier"] else f"with {' + '.join(names)}"


@styled
def probability_plot(results: Block) -> Plot | None:
    """How probable each candidate is; the verdict's stand out, and what cannot be distinguished from them is
    lighter."""
    verdict = results["verdict"]
    names = set(verdict["effects"])
    like = {n for e in results["effects"] if e["name"] in names for n in e["indistinguishable_from"]} - names
    probability = verdict["probability"]
    bars: list[Bar] = []
    if verdict["none"]:
        bars.append(("none: noise only", probability, None, AFTER))
    if verdict["outside_library"]:
        bars.append((f"outside the library:\n{driver_words(verdict['driver'])}", probability, None, BEFORE))
    listed = {e["name"] for e in results["effects"]}
    bars += [(name, probability, None, AFTER) for name in verdict["effects"] if name not in listed]
    for e in results["effects"]:
        if len(bars) < _DRAWN and (e["name"] in names | like or e["probability"] >= _LEAST):
            colour = AFTER if e["name"] in names else _LIKE if e["name"] in like else GREY
            bars.append((e["name"], e["probability"], None, colour))
    if not bars:
        return None
    figure = Figure(figsize=(8.4, 0.34 * len(bars) + 1.0), layout="tight")
    axes = figure.subplots()
    _draw_bars(axes, bars, 1.0)
    axes.set_xlim(0, 1.14)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
    axes.set_xlabel("probability [1]")
    hidden = len(listed) - sum(bar[0] in listed for bar in bars)
    caption = "How probable each explanation is after seeing these rows: dark blue, in the verdict"
    caption += "; light blue, not distinguished from one in the verdict by these rows" if like else ""
    caption += "; orange, something that no effect of the library describes" if verdict["outside_library"] else ""
    return Plot("probabilities", figure, caption + (f". {hidden} further effects were tried." if hidden else "."))


Array = NDArray[np.float64]
# Groups of shares that are parts of the machine; the others are conditions of the rows.
_OF_MACHINE = ("outputs", "joints", "legs")
# Space between two groups of bars, in bars.
_GAP = 0.6


@styled
def remainder_map(arrays: Mapping[str, Array], about: About) -> Plot | None:
    """The gap over the workspace as the model is, and what the verdict's effects leave.

    A machine whose position does not span a plane is drawn over its first joints.
    """
    if "residual" not in arrays or "remainder" not in arrays:
        return None
    held, aside = used_rows(arrays, len(arrays["residual"]))
    rows = held & ~aside if (held & ~aside).any() else ~aside
    before, after = (arrays[name][rows] for name in ("residual", "remainder"))
    quantity, unit, part = "position gap", "m", slice(0, 3)
    if not np.nanmax(np.abs(before[:, part]), initial=0.0) > 0 and before.shape[1] > 3:
        quantity, unit, part = "rotation gap", "rad", slice(3, None)
    before, after = (np.linalg.norm(values[:, part], axis=-1) for values in (before, after))
    found = _places(arrays, about)
    if found is None:
        return None
    place, axes, over = found
    place = place[rows]
    known = np.isfinite(before + after) & np.isfinite(place).all(-1)
    place, before, after = place[known], before[known], after[known]
    if not len(before) or not before.max() > 0:
        return None
    planes = planes_of(place, axes)
    shapes = [height_of(place, axes, plane) for plane in planes]
    figure = Figure(figsize=(9.2, sum(3.6 * shape + 0.85 for shape in shapes)), layout="constrained")
    grid = figure.subplots(len(planes), 2, squeeze=False, height_ratios=shapes)
    text = draw_pairs(
        figure,
        grid,
        axes,
        planes,
        place,
        before,
        after,
        titles=("Model as it is", "What the verdict leaves"),
        quantity=quantity,
        si_unit=unit,
    )
    which = "rows not used for fitting" if (held & ~aside).any() else "rows"
    caption = f"The {quantity} over the {over}, on {len(before)} {which}, on one scale: {text}. A pattern that is left "
    return Plot("map", figure, caption + "on the right is not explained; noise has none.")


def _places(arrays: Mapping[str, Array], about: About) -> tuple[Array, tuple[Coordinate, ...], str] | None:
    """Coordinates to draw over, their names, and what they are."""
    place = tuple(Coordinate(name, "m") for name in "xyz")
    joints = tuple(Coordinate(f"q{i + 1}", about.unit(f"q{i + 1}")) for i in range(_width(arrays.get("joints"))))
    for name, axes, over in (("place", place, "workspace"), ("joints", joints, "joints")):
        if name in arrays and len(axes) > 1:
            values = arrays[name]
            if planes_of(values[np.isfinite(values).all(-1)], axes):
                return values, axes, over
    return None


def _width(values: Array | None) -> int:
    return 0 if values is None else int(values.shape[1])


@styled
def where_plot(results: Block, about: About) -> Plot | None:
    """Shares of the gap by output, joint and leg, and beside them by covariate regime; None where there is no gap."""
    if results["verdict"]["none"]:
        return None
    parts = list(shares(results, about))
    machine = [part for part in parts if part[0] in _OF_MACHINE]
    columns = [column for column in (machine, parts[len(machine) :]) if column]
    if not columns:
        return None
    lengths = [len(column) + _GAP * len({part[0] for part in column}) for column in columns]
    figure = Figure(figsize=(4.7 * len(columns), 0.3 * max(lengths) + 0.8), layout="tight")
    # Few axes: each costs more than its bars.
    grid = figure.subplots(1, len(columns), squeeze=False)[0]
    reach = max(max(share, interval[1] if interval else 0.0) for _, _, share, interval in parts)
    for axes, column in zip(grid, columns, strict=True):
        starts = [i > 0 and part[0] != column[i - 1][0] for i, part in enumerate(column)]
        y = np.arange(len(column)) + _GAP * np.cumsum(starts)
        axes.barh(y, [100 * share for _, _, share, _ in column], height=0.62, color=AFTER)
        for at, (_, _, share, interval) in zip(y, column, strict=True):
            end = share
            if interval is not None:
                axes.hlines(at, 100 * interval[0], 100 * interval[1], color="#222222", linewidth=1.3)
                end = max(share, interval[1])
            axes.text(100 * (end + 0.015 * reach), at, f"{100 * share:.0f} %", va="center", fontsize=8.5)
        axes.set_yticks(y, [part for _, part, _, _ in column])
        axes.set_ylim(max(lengths) - _GAP - 0.4, -0.6)
        axes.set_xlim(0, 115 * reach)
        axes.set_title("By output, joint and leg" if column is machine else "By condition")
        axes.set_xlabel("share of the gap [%]")
        axes.grid(axis="y", visible=False)
    caption = "Which share of the gap (of its mean square) lies where; lines are 95 % intervals where they are known."
    return Plot("where", figure, caption)


Arrays = Mapping[str, NDArray[np.float64]]
# Joints that are drawn, those with the largest gap.
_MOST = 3
# Phases that are shaded.
_SHADED = {"reversal": SERIES[1], "standstill": GREY}


@styled
def course_plot(results: Mapping[str, Any], arrays: Arrays) -> Plot | None:
    """Of the run with the largest gap: command and position, and the residual with and without the verdict's effects.

    Args:
        results: as in `diagnosis.json`.
        arrays: `time`, `judged` `b x s`, `command`, `position`, `before`, `after`, `phase` `n x b x s`, and `run` `b`.
    """
    if "before" not in arrays:
        return None
    judged, before = arrays["judged"] > 0.5, arrays["before"]
    size = (np.square(before) * judged).sum((0, 2))
    runs = arrays["run"]
    worst = max(np.unique(runs), key=lambda r: float(size[runs == r].mean()))
    mine = np.flatnonzero(runs == worst)
    by_joint = (np.square(before) * judged)[:, mine].sum((1, 2))
    joints = sorted(np.argsort(-by_joint)[:_MOST].tolist())
    figure = Figure(figsize=(8.4, 3.4 * len(joints)), layout="tight")
    grid = figure.subplots(2 * len(joints), 1, sharex=True, squeeze=False)[:, 0]
    unit = results["gap"]["unit"]
    for k, i in enumerate(joints):
        top, low = grid[2 * k], grid[2 * k + 1]
        scale, shown = display_unit(unit, float(np.abs(before[i][:, :][judged]).max()) or 1.0)
        for b in mine:
            on, first = judged[b], b == mine[0]
            t = arrays["time"][b][on]
            for axes, name, unit_, look, label in (
                (top, "command", 1.0, {"color": FLOOR, "linestyle": "--"}, "command"),
                (top, "position", 1.0, {"color": SERIES[2]}, "position"),
                (low, "before", scale, {"color": BEFORE}, "model as it is"),
                (low, "after", scale, {"color": AFTER}, "with the effects"),
            ):
                axes.plot(t, arrays[name][i, b][on] / unit_, label=label if first else None, **look)
            for name, colour in _SHADED.items():
                there = arrays["phase"][i, b][on] == PHASES.index(name)
                shade: dict[str, Any] = {
                    "color": colour,
                    "alpha": 0.18,
                    "linewidth": 0,
                    "label": name if first else None,
                }
                low.fill_between(t, 0, 1, where=there, transform=low.get_xaxis_transform(), **shade)
        top.set_ylabel(f"q{i + 1} [{unit}]")
        low.set_ylabel(f"residual [{shown}]")
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=2)
        low.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=4)
    grid[-1].set_xlabel("time [s]")
    caption = (
        "The run with the largest gap. Measured less simulated position, held out: by a fit that saw no part of this "
        "run (or, of a single run, not this part). Shaded: reversals (yellow) and standstill (grey)."
    )
    return Plot("course", figure, caption)
