"""One look for all pictures, and files that are the same bytes for the same numbers.

Figures are made without pyplot, so nothing of matplotlib's global state is read or left behind.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import count_text, display_unit, number_text, with_unit
from ccnn_torch.files.write import write_whole
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.page import InlineFigure

# Okabe and Ito's palette: distinguishable with every common form of colour blindness, and in grey print.
BEFORE = "#D55E00"
AFTER = "#0072B2"
FLOOR = "#6E6E6E"
GREY = "#B8B8B8"
SERIES = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
RASTER_ABOVE = 3000
"""Points above which a layer is drawn as pixels inside the SVG, which would else grow to megabytes."""

_PNG_DPI = 150
_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.8,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "figure.facecolor": "white",
    "figure.dpi": 100,
    "lines.linewidth": 1.6,
    "axes.formatter.useoffset": False,
    "svg.hashsalt": "ccnn_torch",
    "svg.fonttype": "path",
}

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Plot:
    """A picture: its file name without ending, the figure, and its caption."""

    name: str
    figure: Figure
    caption: str


def styled(function: Callable[P, T]) -> Callable[P, T]:
    """Run a function with the plot style of this package."""

    @wraps(function)
    def inner(*args: P.args, **kwargs: P.kwargs) -> T:
        with mpl.rc_context(_STYLE):
            return function(*args, **kwargs)

    return inner


@styled
def save_figure(figure: Figure, path: str | Path, pixels: bool = True) -> Path:
    """Write a figure as SVG and as PNG; equal figures give equal bytes.

    Args:
        figure: what to write.
        path: file name; its ending, if any, is replaced by `.svg` and `.png`.
        pixels: whether to write the PNG as well.

    Returns:
        The path of the SVG.

    Raises:
        WriteError: they cannot be written.
    """
    svg = Path(path).with_suffix(".svg")
    # The layout is found once and kept: finding it again for each file costs more than the drawing. The canvas that
    # measures the texts for it draws the PNG, too, and need not measure them again.
    figure.set_dpi(_PNG_DPI)
    canvas = FigureCanvasAgg(figure)
    layout = figure.get_layout_engine()
    if layout is not None:
        # Twice: panels of one scale take their shape from the first, and texts above and below them move with it.
        for _ in range(2):
            layout.execute(figure)
        figure.set_layout_engine("none")
    # Written by the canvases themselves: `savefig` draws everything once more beforehand, to find the layout.
    if pixels:
        _write(svg.with_suffix(".png"), canvas.print_png, {"Software": None})
    _write(svg, FigureCanvasSVG(figure).print_svg, {"Date": None, "Creator": None})
    return svg


def _write(path: Path, print_to: Callable[..., None], about: dict[str, None]) -> None:
    content = io.BytesIO()
    print_to(content, metadata=about)
    write_whole(path, content.getvalue())


def inline_figures(plots: Iterable[Plot], folder: Path) -> list[InlineFigure]:
    """Save plots as SVG, and give them as figures of a page."""
    found = []
    for plot in plots:
        svg = save_figure(plot.figure, folder / plot.name, pixels=False)
        text = inline_svg(svg.read_text(encoding="utf-8"), plot.name)
        found.append(InlineFigure(plot.name, plot.caption, text))
    return found


def inline_svg(text: str, name: str) -> str:
    """A saved SVG as an element for a page that holds several: no prolog, no metadata, ids that begin with the name.

    Args:
        text: content of an SVG file that `save_figure` wrote.
        name: the plot's name.
    """
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\1{name}-", text)


def bare(axes: Axes) -> None:
    """Take the grid and all spines away, for pictures of matrices and maps."""
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)


Array = NDArray[np.float64]
_MANY_DECADES = 1e3
"""Ratio above which a logarithmic axis has one label a decade; more would touch each other."""
_FAINT_UP_TO = 200
"""Rows above which the training rows are left out: they would hide the held-out ones."""


@styled
def joint_error_plot(arrays: RunArrays) -> Plot:
    """Each joint's error over the rows, before and after, beside the noise floor where it is known.

    Args:
        arrays: of one repeat; only the held-out rows are strong dots, the others are faint.
    """
    count = len(arrays.joints)
    columns = 1 if count <= 3 else 2
    lines = -(-count // columns)
    figure = Figure(figsize=(8.2, 1.9 * lines + 0.9), layout="constrained")
    axes = figure.subplots(lines, columns, sharex=True, squeeze=False)
    for i, axis in enumerate(axes.flat):
        if i < count:
            draw_joint_error(axis, arrays, i)
        else:
            axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("row of the records")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
    rms = float(np.sqrt(np.mean(np.square((arrays.measured - arrays.predicted)[arrays.test]))))
    same = len({joint.unit for joint in arrays.joints}) == 1
    amount = f", with {with_unit(rms, arrays.joints[0].unit)} RMS left over all joints" if same else ""
    faint = " (strong dots; faint dots are training rows)" * (len(arrays.test) <= _FAINT_UP_TO)
    floor = "; the grey band is ±2 standard deviations of the noise, which no model can remove" * (
        arrays.noise is not None
    )
    return Plot(
        "joint_errors",
        figure,
        f"Deviation of each joint before compensation and what is left after it, on "
        f"{count_text(int(arrays.test.sum()), 'held-out row')}{faint}{amount}{floor}.",
    )


def draw_joint_error(axes: Axes, arrays: RunArrays, joint: int) -> None:
    """Draw one joint's panel of `joint_error_plot`."""
    about: Coordinate = arrays.joints[joint]
    before = arrays.measured[:, joint]
    after = before - arrays.predicted[:, joint]
    scale, unit = display_unit(about.unit, float(np.abs(before).max()))
    row = np.arange(1, len(before) + 1)
    raster = len(before) > RASTER_ABOVE
    axes.axhline(0, color="#555555", linewidth=0.8)
    train, test = ~arrays.test, arrays.test
    size = float(np.clip(40 / np.sqrt(test.sum()), 1.5, 5))
    for values, colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        if len(row) <= _FAINT_UP_TO:
            axes.plot(row[train], values[train] / scale, ".", color=colour, alpha=0.25, markersize=3.5)
        axes.plot(row[test], values[test] / scale, "o", color=colour, markersize=size, label=label, rasterized=raster)
    if arrays.noise is not None:
        band = 2 * float(np.sqrt(np.mean(np.square(arrays.noise[:, joint])))) / scale
        axes.axhspan(-band, band, color=FLOOR, alpha=0.22, linewidth=0, label="noise floor (±2σ)", zorder=0.5)
    axes.set_ylabel(f"error of {about.name} [{unit}]")
    axes.margins(x=0.015)


def pose_error_plot(arrays: RunArrays) -> Plot:
    """Distribution of the held-out pose error before and after, position and (where there is one) orientation."""
    rows = count_text(int(arrays.test.sum()), "held-out row")
    errors = [
        (title, unit, {"before": before[arrays.test], "after": after[arrays.test]})
        for title, unit, before, after in arrays.pose_errors
    ]
    return distribution_plot(errors, f"Share of the {rows} whose pose error is at most the value on the axis")


_OF_ERRORS = {"before": BEFORE, "after": AFTER, "measurement noise": FLOOR}


@styled
def distribution_plot(errors: Sequence[tuple[str, str, Mapping[str, Array]]], caption: str) -> Plot:
    """Share of rows whose error is at most so large, a panel for each kind of error.

    Args:
        errors: title, SI unit, and the errors `s` before and after, and of the measurement noise where it is known.
        caption: its first words; the medians follow.
    """
    figure = Figure(figsize=(4.6 * len(errors) + (1.2 if len(errors) == 1 else 0), 3.5), layout="constrained")
    panels = figure.subplots(1, len(errors), squeeze=False)[0]
    medians = [_draw_distribution(axes, *one) for axes, one in zip(panels, errors, strict=True)]
    return Plot("pose_error", figure, f"{caption}: {' and '.join(medians)}.")


def _draw_distribution(axes: Axes, title: str, si_unit: str, errors: Mapping[str, Array]) -> str:
    scale, unit = display_unit(si_unit, float(np.median(errors["before"])))
    medians = []
    for label, values in errors.items():
        shown, colour = np.sort(values) / scale, _OF_ERRORS[label]
        median = float(np.median(shown))
        medians.append(median)
        share = np.arange(1, len(shown) + 1) / len(shown) * 100
        axes.step(np.r_[shown[:1], shown], np.r_[0, share], where="post", color=colour, label=label, linewidth=2)
        axes.plot(median, 50, "o", color=colour, markersize=6)
        axes.annotate(
            number_text(median, 3), (median, 50), xytext=(7, -11), textcoords="offset points", color=colour, fontsize=9
        )
    least = min(float(v[v > 0].min()) if (v > 0).any() else np.inf for v in errors.values())
    if np.isfinite(least) and errors["before"].max() / least > 10:
        axes.set_xscale("log")
        _log_ticks(axes.xaxis, errors["before"].max() / least)
    axes.set_title(title.capitalize())
    axes.set_xlabel(f"{title} [{unit}]")
    axes.set_ylabel("share of rows [%]")
    axes.set_ylim(0, 101)
    axes.legend(loc="upper left")
    return f"median {title} {number_text(medians[0], 3)} → {number_text(medians[1], 3)} {unit}"


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
    if not planes_of(place, arrays.axes):
        return None
    figure, rms_text = maps(arrays.axes, place, before, after)
    return Plot(
        "workspace", figure, f"Position error over the workspace {where}, before and after on one scale: {rms_text}."
    )


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


def _height_of(place: Array, axes: tuple[Coordinate, ...], plane: tuple[int, int]) -> float:
    """Height of a map over its width."""
    across, up = plane
    if axes[across].unit != axes[up].unit:
        return 0.8
    return float(np.clip(np.ptp(place[:, up]) / np.ptp(place[:, across]), 0.25, 1.6))


def maps(
    axes: tuple[Coordinate, ...],
    place: Array,
    before: Array,
    after: Array,
    *,
    titles: tuple[str, str] = ("Before", "After"),
    quantity: str = "position error",
    si_unit: str = "m",
) -> tuple[Figure, str]:
    """Values `s` over places `s x d` before and after, a line of two maps for each of `planes_of`, on one scale.

    Returns:
        the figure, and the RMS values as text.
    """
    planes = planes_of(place, axes)
    shapes = [_height_of(place, axes, plane) for plane in planes]
    figure = Figure(figsize=(9.2, sum(3.6 * shape + 0.85 for shape in shapes)), layout="constrained")
    grid = figure.subplots(len(planes), 2, squeeze=False, height_ratios=shapes)
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
        low, high = bar.ax.get_ylim()
        _log_ticks(bar.ax.yaxis, high / low)
    return figure, f"RMS {number_text(_rms(before) / scale, 3)} → {number_text(_rms(after) / scale, 3)} {unit}"


def _log_ticks(axis: Axis, ratio: float) -> None:
    """Few ticks with plain numbers on a logarithmic axis whose ends have this ratio; minor ones take most of a plot."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if ratio < _MANY_DECADES else (1,)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(NullLocator())


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
