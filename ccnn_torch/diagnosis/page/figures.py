"""Pictures of a diagnosis: the gap against the floor, and how probable each explanation is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ccnn_torch.diagnosis.page.data import gaps_of
from ccnn_torch.diagnosis.verdict.text import driver_words, floor_words, probability_words
from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.figures.style import AFTER, BEFORE, FLOOR, GREY, SERIES, Plot, styled

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
        _draw_bars(axes, bars[name], scale, unit)
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


def _draw_bars(axes: Axes, bars: list[Bar], scale: float, unit: str) -> None:
    reach = max(max(value, ends[1] if ends else 0.0) for _, value, ends, _ in bars) / scale
    for i, (_, value, ends, colour) in enumerate(bars):
        size = value / scale
        axes.barh(i, size, height=0.62, color=colour)
        right = size
        if ends is not None:
            # A shrink is never below 0, but an effect that is not there makes the gap larger on rows it has not seen.
            left, right = min(ends[0] / scale, size), max(ends[1] / scale, size)
            axes.hlines(i, left, right, color="#222222", linewidth=1.3)
            axes.vlines([left, right], i - 0.13, i + 0.13, color="#222222", linewidth=1.3)
        axes.text(right + 0.012 * reach, i, f"{number_text(size, 3)} {unit}", va="center", fontsize=9)
    axes.set_yticks(range(len(bars)), [bar[0] for bar in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xlim(0, 1.16 * reach)
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
    bars = []
    if verdict["none"]:
        bars.append(("none: noise only", verdict["probability"], AFTER))
    if verdict["outside_library"]:
        bars.append((f"outside the library:\n{driver_words(verdict['driver'])}", verdict["probability"], BEFORE))
    listed = {e["name"] for e in results["effects"]}
    bars += [(name, verdict["probability"], AFTER) for name in verdict["effects"] if name not in listed]
    for e in results["effects"]:
        if len(bars) < _DRAWN and (e["name"] in names | like or e["probability"] >= _LEAST):
            colour = AFTER if e["name"] in names else _LIKE if e["name"] in like else GREY
            bars.append((e["name"], e["probability"], colour))
    if not bars:
        return None
    figure = Figure(figsize=(8.4, 0.34 * len(bars) + 1.0), layout="tight")
    axes = figure.subplots()
    for i, (_, probability, colour) in enumerate(bars):
        axes.barh(i, probability, height=0.62, color=colour)
        axes.text(probability + 0.012, i, probability_words(probability), va="center", fontsize=9)
    axes.set_yticks(range(len(bars)), [bar[0] for bar in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xlim(0, 1.14)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
    axes.set_xlabel("probability [1]")
    axes.grid(axis="y", visible=False)
    hidden = len(listed) - sum(bar[0] in listed for bar in bars)
    caption = "How probable each explanation is after seeing these rows: dark blue, in the verdict"
    caption += "; light blue, not distinguished from one in the verdict by these rows" if like else ""
    caption += "; orange, something that no effect of the library describes" if verdict["outside_library"] else ""
    return Plot("probabilities", figure, caption + (f". {hidden} further effects were tried." if hidden else "."))
