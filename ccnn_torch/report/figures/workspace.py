"""The pose error over the workspace, before and after, on one colour scale."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import display_unit, number_text
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.figures.errors import draw_joint_error
from ccnn_torch.report.figures.style import RASTER_ABOVE, Plot, styled

Array = NDArray[np.float64]


@styled
def workspace_plot(arrays: RunArrays) -> Plot | None:
    """Maps of the position error before and after.

    A machine that moves in one plane gets one pair of maps, any other a pair each from above and from the side. Poses
    of a regular grid are drawn as cells (root mean square where several poses share a place), others as dots.

    Args:
        arrays: of one repeat; the map of the simulated machine where there is one, else the held-out rows.

    Returns:
        None when the machine moves along one line only.
    """
    place, before, after, where = _map_data(arrays)
    planes = planes_of(place, arrays.axes)
    if not planes:
        return None
    shapes = [height_of(place, arrays.axes, plane) for plane in planes]
    figure = Figure(figsize=(9.2, sum(3.6 * shape + 0.85 for shape in shapes)), layout="constrained")
    grid = figure.subplots(len(planes), 2, squeeze=False, height_ratios=shapes)
    rms_text = draw_pairs(figure, grid, arrays.axes, planes, place, before, after)
    return Plot(
        "workspace", figure, f"Position error over the workspace {where}, before and after on one scale: {rms_text}."
    )


@styled
def overview_plot(arrays: RunArrays, joint: int | None = None) -> Plot:
    """One wide picture of a run: a joint's error against the noise floor, and the workspace before and after.

    Args:
        arrays: of one repeat.
        joint: which joint; by default the one with the largest error before.
    """
    if joint is None:
        joint = int(np.argmax(np.abs(arrays.measured).max(0)))
    place, before, after, where = _map_data(arrays)
    planes = planes_of(place, arrays.axes)[:1]
    shape = height_of(place, arrays.axes, planes[0]) if planes else 1.0
    # The maps take the width that their shape needs at this height; the joint's panel takes the rest.
    wide = float(np.clip(1 / shape, 0.7, 1.4))
    figure = Figure(figsize=(6.5 + 6.2 * wide if planes else 8.2, 4.0), layout="constrained")
    grid = figure.subplots(1, 3 if planes else 1, width_ratios=(1.8, wide, wide) if planes else (1,), squeeze=False)
    left = grid[0, 0]
    draw_joint_error(left, arrays, joint)
    left.set_xlabel("row of the records")
    left.set_title(f"Joint {arrays.joints[joint].name}", pad=26)
    left.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=3, handletextpad=0.3, columnspacing=1.2)
    caption = f"Error of joint {arrays.joints[joint].name} before and after compensation"
    if planes:
        rms_text = draw_pairs(figure, grid[:, 1:], arrays.axes, planes, place, before, after)
        caption += f" (left), and position error over the workspace {where}: {rms_text}"
    return Plot("overview", figure, caption + ".")


def _map_data(arrays: RunArrays) -> tuple[Array, Array, Array, str]:
    if arrays.map_place is not None and arrays.map_before is not None and arrays.map_after is not None:
        return arrays.map_place, arrays.map_before, arrays.map_after, "of the simulated machine"
    test = arrays.test
    return arrays.place[test], arrays.position_before[test], arrays.position_after[test], "at the held-out rows"


def planes_of(place: Array, axes: tuple[Coordinate, ...]) -> list[tuple[int, int]]:
    """Pairs of coordinates (across, up) to look along: of three that move, the first with each of the others."""
    ranges = np.ptp(place, axis=0)
    largest = {axis.unit: max(r for r, a in zip(ranges, axes, strict=True) if a.unit == axis.unit) for axis in axes}
    moving = [i for i, axis in enumerate(axes) if ranges[i] > 1e-3 * largest[axis.unit]]
    return [(moving[0], other) for other in moving[1:3]]


def height_of(place: Array, axes: tuple[Coordinate, ...], plane: tuple[int, int]) -> float:
    """Height of a map over its width."""
    across, up = plane
    if axes[across].unit != axes[up].unit:
        return 0.8
    return float(np.clip(np.ptp(place[:, up]) / np.ptp(place[:, across]), 0.25, 1.6))


def draw_pairs(
    figure: Figure,
    grid: Any,
    axes: tuple[Coordinate, ...],
    planes: list[tuple[int, int]],
    place: Array,
    before: Array,
    after: Array,
    *,
    titles: tuple[str, str] = ("Before", "After"),
    quantity: str = "position error",
    si_unit: str = "m",
) -> str:
    """Fill a grid of `planes` lines and two columns, add the colour bar; returns the RMS values as text."""
    scale, unit = display_unit(si_unit, float(np.median(before)))
    norm = _norm(before / scale, after / scale)
    drawn: Any = None
    for line, plane in zip(grid, planes, strict=True):
        for panel, values, title in ((line[0], before, titles[0]), (line[1], after, titles[1])):
            drawn = _draw_map(panel, axes, plane, place, values / scale, norm)
            panel.set_title(f"{title}: RMS {number_text(_rms(values) / scale, 3)} {unit}")
    bar = figure.colorbar(drawn, ax=list(grid.flat), shrink=0.85, pad=0.02, aspect=28)
    bar.set_label(f"{quantity} [{unit}]")
    bar.outline.set_visible(False)
    if isinstance(norm, LogNorm):
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        bar.ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        bar.ax.yaxis.set_minor_locator(NullLocator())
    return f"RMS {number_text(_rms(before) / scale, 3)} → {number_text(_rms(after) / scale, 3)} {unit}"


def _norm(before: Array, after: Array) -> Normalize:
    both = np.concatenate([before, after])
    both = both[np.isfinite(both)]
    high = float(both.max())
    low = float(np.quantile(both[both > 0], 0.02)) if (both > 0).any() else 0.0
    return LogNorm(low, high, clip=True) if low > 0 and high / low > 8 else Normalize(0.0, high)


def _draw_map(
    panel: Axes, axes: tuple[Coordinate, ...], plane: tuple[int, int], place: Array, values: Array, norm: Normalize
) -> Any:
    shown = []
    for i in plane:
        # One unit for all lengths of a map (positions of a machine are read in mm), and one for all angles (in mrad).
        scale, unit = (1e-3, "m" + axes[i].unit) if axes[i].unit in ("m", "rad") else (1.0, axes[i].unit)
        shown.append((place[:, i] / scale, f"{axes[i].name} [{unit}]"))
    (horizontal, label), (vertical, up_label) = shown
    panel.set(xlabel=label, ylabel=up_label)
    if axes[plane[0]].unit == axes[plane[1]].unit:
        panel.set_aspect("equal")
    cells = _cells(horizontal, vertical, values)
    if cells is not None:
        panel.grid(False)
        raster = cells[2].size > RASTER_ABOVE
        # Edges in the colour of the cell: SVG viewers would show white seams between the cells.
        return panel.pcolormesh(*cells, norm=norm, cmap="viridis", edgecolors="face", linewidth=0.4, rasterized=raster)
    order = np.argsort(values)
    return panel.scatter(
        horizontal[order],
        vertical[order],
        c=values[order],
        norm=norm,
        cmap="viridis",
        s=float(np.clip(9000 / len(values), 4, 40)),
        linewidths=0,
        rasterized=len(values) > RASTER_ABOVE,
    )


def _cells(horizontal: Array, vertical: Array, values: Array) -> tuple[Array, Array, Array] | None:
    """Values on their regular grid, root mean square per place and NaN where there is none; None = no regular grid."""
    columns, column = np.unique(horizontal.round(9), return_inverse=True)
    lines, line = np.unique(vertical.round(9), return_inverse=True)
    if (
        len(columns) < 2
        or len(lines) < 2
        or len(columns) * len(lines) > 4 * len(np.unique(line * len(columns) + column))
    ):
        return None
    total, count = np.zeros((2, len(lines), len(columns)))
    np.add.at(total, (line, column), np.square(values))
    np.add.at(count, (line, column), 1)
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    return columns, lines, np.sqrt(mean)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values[np.isfinite(values)]))))
