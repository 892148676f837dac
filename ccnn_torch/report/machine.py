"""The picture of a machine with its errors, the same for every command: the first one of a page.

It is drawn from arrays by name: `drawn.place` `s x 3` [m]; `drawn.before` and `drawn.after`, vectors `s x 3` [m], or
sizes `s` where only these are known; and each leg or link, `drawn.line.NAME` `k x 3` [m].
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.figures import AFTER, BEFORE, FLOOR, GREY, Plot, styled

Array = NDArray[np.float64]
_PLACE, _BEFORE, _AFTER, _LINE = "drawn.place", "drawn.before", "drawn.after", "drawn.line."
# More arrows than this hide each other.
_MOST_ARROWS = 160
# Length of a large arrow, the 90 % quantile, as a share of the width of the poses.
_LENGTH = 0.12
# How far above a panel the scale of its errors is [inches].
_ABOVE = 0.15
# Characters of a title that fit above a panel.
_TITLE = 26
# Of the width below which a machine has no second direction.
_FLAT = 1e-3


@styled
def machine_plot(arrays: Mapping[str, Array], after_words: str) -> Plot | None:
    """Position errors at the measured poses, in the plane of largest extent, before and after: arrows, or circles.

    Args:
        arrays: as at the top of this file; without lines the machine is left out.
        after_words: title of the second panel.

    Returns:
        None where the machine has no position that spans a plane, or no error in it.
    """
    if _PLACE not in arrays:
        return None
    place, before, after = (arrays[name] for name in (_PLACE, _BEFORE, _AFTER))
    rows = np.isfinite(np.column_stack([place, before, after])).all(-1)
    place, before, after = place[rows], before[rows], after[rows]
    if len(place) < 2:
        return None
    extent = np.ptp(place, axis=0)
    plane = sorted(np.argsort(-extent, kind="stable")[:2].tolist())
    if extent[plane].min() <= _FLAT * extent.max():
        return None
    width = float(extent[plane].max())
    arrows = before.ndim == 2
    long = float(np.quantile(np.linalg.norm(before[:, plane], axis=1) if arrows else before, 0.9))
    if not long > 0:
        return None
    times = _round(_LENGTH * width / long)
    # Every so many rows, in their order: the same file gives the same picture.
    chosen = np.unique(np.linspace(0, len(place) - 1, min(len(place), _MOST_ARROWS)).round().astype(int))
    lines = {name.removeprefix(_LINE): value for name, value in arrays.items() if name.startswith(_LINE)}
    everything = np.concatenate([*lines.values(), place])
    shapes = [np.ptp(values[:, plane[1]]) / np.ptp(values[:, plane[0]]) for values in (everything, place)]
    inches = (10.2 if lines else 7.6, 1.2 + 2.8 * float(np.clip(max(shapes), 0.4, 1.3)))
    figure = Figure(figsize=inches, layout="constrained")
    panels = list(figure.subplots(1, 3 if lines else 2, squeeze=False)[0])
    if lines:
        _draw_machine(panels.pop(0), lines, place, plane)
    norms = [np.linalg.norm(values, axis=-1) if arrows else values for values in (before, after)]
    sizes = [float(np.sqrt(np.square(values).mean())) for values in norms]
    scale, unit = display_unit("m", sizes[0])
    titles = ("Model as it is", after_words)
    # Between title and panel, however high this is.
    above = 1 + _ABOVE / inches[1]
    for axes, values, size, title, colour in zip(panels, (before, after), sizes, titles, (BEFORE, AFTER), strict=True):
        axes.scatter(1e3 * place[chosen][:, plane[0]], 1e3 * place[chosen][:, plane[1]], s=5, color=GREY, linewidths=0)
        _draw_errors(axes, place[chosen][:, plane], values[chosen], plane, times, long, above, colour)
        # No wider than its panel.
        axes.set_title(f"{fill(title, _TITLE)}\nRMS {number_text(size / scale, 3)} {unit}", pad=19)
        _frame(axes, plane, place, _LENGTH * width)
    shown = "" if len(chosen) == len(place) else f", {len(chosen)} of {len(place)} rows"
    beside = "The machine in the middle of the measured poses (dots); where " if lines else "Where "
    worst = int(norms[0].argmax())
    where = ", ".join(f"{name} {1e3 * value:.0f}" for name, value in zip("xyz", place[worst], strict=True))
    caption = (
        f"{beside}it stops, measured from where the model says, drawn {times:g} times as large on both sides{shown}, "
        f"in the robot's frame: {number_text(sizes[0] / scale, 3)} → {number_text(sizes[1] / scale, 3)} {unit} RMS. "
        f"The largest error before, {number_text(norms[0][worst] / scale, 3)} {unit}, is at {where} mm."
    )
    if not arrows:
        caption = caption.replace("measured from where the model says, drawn", "circles as wide as the error is large,")
    return Plot("machine", figure, caption)


def _draw_errors(
    axes: Axes, place: Array, values: Array, plane: list[int], times: float, long: float, above: float, colour: str
) -> None:
    """Errors at places `s x 2` [m]: arrows of vectors `s x 3`, circles of sizes `s` [m]; and above them their scale."""
    across, up = 1e3 * place.T
    key = _round(long)
    scale, unit = display_unit("m", key)
    if values.ndim == 1:
        for x, y, size in zip(across, up, values, strict=True):
            axes.add_patch(Circle((x, y), 500 * times * size, edgecolor=colour, facecolor="none", linewidth=1.0))
        text = f"diameter = error {times:g} ×"
        axes.annotate(text, (0.01, above), xycoords="axes fraction", fontsize=8.5, va="center")
        return
    arrows = axes.quiver(
        across,
        up,
        *(1e3 * times * values[:, i] for i in plane),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=colour,
        width=0.005,
    )
    label = f"{key / scale:g} {unit} (arrows {times:g} ×)"
    axes.quiverkey(arrows, 0.01, above, 1e3 * times * key, label, labelpos="E", fontproperties={"size": 8.5})


def _draw_machine(axes: Axes, lines: Mapping[str, Array], place: Array, plane: list[int]) -> None:
    """Legs or links with their numbers, and the poses that were measured."""
    axes.scatter(1e3 * place[:, plane[0]], 1e3 * place[:, plane[1]], s=4, color=GREY, linewidths=0)
    everything = np.concatenate([*lines.values(), place])
    wide = float(np.ptp(everything[:, plane], axis=0).max())
    labelled: list[Array] = []
    for name, line in lines.items():
        kind, _, number = name.partition(" ")
        thin = kind not in ("leg", "link")
        across, up = (1e3 * line[:, i] for i in plane)
        axes.plot(across, up, color=FLOOR, linewidth=1.2 if thin else 2.4, zorder=3)
        axes.scatter(across, up, s=12, color="#222222", zorder=4)
        start = line[0, plane]
        # Numbers of a wrist would lie on each other.
        if number and all(np.linalg.norm(start - other) > 0.06 * wide for other in labelled):
            labelled.append(start)
            at = (1e3 * start[0], 1e3 * start[1])
            axes.annotate(number, at, textcoords="offset points", xytext=(5, 4), fontsize=9, fontweight="bold")
    axes.set_title("The machine\nand the poses")
    _frame(axes, plane, everything, 0.06 * wide)


def _frame(axes: Axes, plane: list[int], points: Array, margin: float) -> None:
    """Axes in mm on one scale around points `s x 3` [m]."""
    axes.set(xlabel=f"{'xyz'[plane[0]]} [mm]", ylabel=f"{'xyz'[plane[1]]} [mm]")
    ends = [(1e3 * (points[:, i].min() - margin), 1e3 * (points[:, i].max() + margin)) for i in plane]
    axes.set(xlim=ends[0], ylim=ends[1])
    axes.set_aspect("equal")


def _round(value: float) -> float:
    """The largest of 1, 2, 5, 10, 20 … that is not above."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= value * (1 + 1e-12))
