"""Where the gap is: a map before and after, and the shares by output, joint, leg and regime."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.page.data import About, used_rows
from ccnn_torch.diagnosis.page.localisation import shares
from ccnn_torch.report.figures.style import AFTER, Plot, styled
from ccnn_torch.report.figures.workspace import draw_pairs, height_of, planes_of

Array = NDArray[np.float64]
Block = Mapping[str, Any]
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
