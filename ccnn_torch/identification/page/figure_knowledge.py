"""Figures of the parameters: values with intervals, correlations, singular values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import display_unit
from ccnn_torch.report.figures.style import AFTER, BEFORE, SERIES, Plot, bare, styled

Array = NDArray[np.float64]
Arrays = Mapping[str, Array]
Results = Mapping[str, Any]
_Z95 = 1.96


@styled
def parameter_plot(results: Results, arrays: Arrays) -> Plot | None:
    """Identified minus nominal value of the first machine with its 95 % interval, a panel for each unit."""
    free = {name: block for name, block in results["parameters"].items() if block["free"]}
    units = list(dict.fromkeys(block["unit"] for block in free.values()))
    all_names = list(results["parameters"])
    values = arrays[f"values_{results['method']}"][0]
    start = arrays["start"][0]
    truth = arrays["truth"][0] if "truth" in arrays else None
    rows = [[n for n, b in free.items() if b["unit"] == unit] for unit in units]
    figure = Figure(figsize=(8.4, 0.9 + 0.24 * sum(map(len, rows)) + 0.5 * len(rows)), layout="constrained")
    grid = figure.subplots(len(units), 1, squeeze=False, height_ratios=[len(r) + 1 for r in rows])[:, 0]
    for axes, unit, names in zip(grid, units, rows, strict=True):
        at = [all_names.index(n) for n in names]
        change = values[at] - start[at]
        scale, shown = display_unit(unit, float(np.abs(change).max()) or 1e-3)
        y = np.arange(len(names))
        sd = np.array([free[n]["sd"] if free[n]["sd"] is not None else np.nan for n in names], dtype=np.float64)
        known = np.isfinite(sd)
        axes.errorbar(
            change[known] / scale,
            y[known],
            xerr=_Z95 * sd[known] / scale,
            fmt="o",
            color=AFTER,
            markersize=4,
            capsize=2,
            label="identified, 95 % interval",
        )
        axes.plot(change[~known] / scale, y[~known], "x", color=BEFORE, label="not identifiable")
        if truth is not None:
            axes.plot((truth - start)[at] / scale, y, "|", color="#222222", markersize=9, label="true")
        axes.axvline(0, color="#777777", linewidth=0.8)
        axes.set_yticks(y, names)
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlabel(f"difference from nominal [{shown}]")
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3)
    which = " of the first machine" if results["machines"] > 1 else ""
    return Plot(
        "parameters",
        figure,
        f"Identified parameters{which} with 95 % intervals; a cross marks a parameter that the rows do not determine.",
    )


@styled
def correlation_plot(results: Results, arrays: Arrays) -> Plot | None:
    """Correlation of the parameters' estimates."""
    matrix = arrays["correlation"]
    if matrix.size == 0 or not np.isfinite(matrix).any():
        return None
    names = [name for name, block in results["parameters"].items() if block["free"]]
    names = names if len(names) == len(matrix) else [str(i + 1) for i in range(len(matrix))]
    side = 2.2 + 0.2 * len(names)
    figure = Figure(figsize=(side + 1.0, side), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    bare(axes)
    axes.set_xticks(range(len(names)), names, rotation=90)
    axes.set_yticks(range(len(names)), names)
    figure.colorbar(image, ax=axes, shrink=0.7, label="correlation")
    lower = np.abs(np.where(np.isfinite(matrix), matrix, 0.0)) * ~np.eye(len(matrix), dtype=bool)
    i, j = np.unravel_index(int(lower.argmax()), lower.shape)
    return Plot(
        "correlation",
        figure,
        f"Correlation of the estimates; white where nothing is known. The strongest pair is {names[i]} and {names[j]} "
        f"({matrix[i, j]:.3f}).",
    )


@styled
def singular_value_plot(results: Results) -> Plot | None:
    """Singular values of the scaled Jacobian; where they drop to rounding, a combination is not known."""
    lists = [np.asarray(values, dtype=np.float64) for values in results["singular_values"] if values]
    if not lists:
        return None
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.subplots()
    for k, values in enumerate(lists):
        label = f"leg {k + 1}" if len(lists) > 1 else None
        axes.plot(np.arange(1, len(values) + 1), values, "o-", color=SERIES[k % len(SERIES)], label=label)
    axes.set(xlabel="number", ylabel="singular value", yscale="log")
    if len(lists) > 1:
        axes.legend()
    positive = [v[v > 0] for v in lists]
    worst = max(float(v.max() / v.min()) for v in positive if len(v))
    return Plot(
        "singular_values",
        figure,
        f"Singular values of the identification Jacobian in units of the plausible errors (condition {worst:.3g}).",
    )
