"""Joint errors row by row and the distribution of the pose error, before and after compensation."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.figures.style import AFTER, BEFORE, FLOOR, RASTER_ABOVE, Plot, styled

Array = NDArray[np.float64]
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
    scale, unit = display_unit(arrays.joints[0].unit, rms)
    amount = f", with {number_text(rms / scale, 3)} {unit} RMS left over all joints" if same else ""
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


@styled
def pose_error_plot(arrays: RunArrays) -> Plot:
    """Distribution of the held-out pose error before and after, position and (where there is one) orientation."""
    pairs = arrays.pose_errors
    figure = Figure(figsize=(4.6 * len(pairs) + (1.2 if len(pairs) == 1 else 0), 3.5), layout="constrained")
    medians = []
    for axes, (title, unit, before, after) in zip(figure.subplots(1, len(pairs), squeeze=False)[0], pairs, strict=True):
        medians.append(_draw_distribution(axes, title, unit, before[arrays.test], after[arrays.test]))
    return Plot(
        "pose_error",
        figure,
        f"Share of the {count_text(int(arrays.test.sum()), 'held-out row')} whose pose error is at most the value on "
        f"the axis: {' and '.join(medians)}.",
    )


def _draw_distribution(axes: Axes, title: str, si_unit: str, before: Array, after: Array) -> str:
    scale, unit = display_unit(si_unit, float(np.median(before)))
    medians = []
    for values, colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        shown = np.sort(values) / scale
        median = float(np.median(shown))
        medians.append(median)
        share = np.arange(1, len(shown) + 1) / len(shown) * 100
        axes.step(np.r_[shown[:1], shown], np.r_[0, share], where="post", color=colour, label=label, linewidth=2)
        axes.plot(median, 50, "o", color=colour, markersize=6)
        axes.annotate(
            number_text(median, 3), (median, 50), xytext=(7, -11), textcoords="offset points", color=colour, fontsize=9
        )
    least = min(float(v[v > 0].min()) if (v > 0).any() else np.inf for v in (before, after))
    if np.isfinite(least) and before.max() / least > 10:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_title(title.capitalize())
    axes.set_xlabel(f"{title} [{unit}]")
    axes.set_ylabel("share of rows [%]")
    axes.set_ylim(0, 101)
    axes.legend(loc="upper left")
    return f"median {title} {number_text(medians[0], 3)} → {number_text(medians[1], 3)} {unit}"
