"""Figures of an identification, in reading order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import display_unit
from ccnn_torch.identification.page import holder
from ccnn_torch.report.figures import AFTER, BEFORE, Plot, distribution_plot, styled
from ccnn_torch.report.machine import machine_plot

Array = NDArray[np.float64]
Arrays = Mapping[str, Array]
Results = Mapping[str, Any]
# Pooled over machines, more poses than this add nothing to a picture.
_DRAWN = 4000


def identified_plots(results: Results, arrays: Arrays) -> list[Plot]:
    """All pictures; one whose data is not there is left out."""
    plots: list[Plot | None] = [
        machine_plot(arrays, "As identified"),
        pose_distribution_plot(results, arrays),
        parameter_plot(results, arrays),
    ]
    return [plot for plot in plots if plot is not None]


def pose_distribution_plot(results: Results, arrays: Arrays) -> Plot | None:
    """Held-out pose error before and after, all machines pooled, and the measurement noise where it is known."""
    errors = []
    for name, unit in (("position", "m"), ("rotation", "rad")):
        if results["test"][name] and f"{name}_before" in arrays:
            parts = {"before": "before", "after": "after", "measurement noise": "noise"}
            there = {label: f"{name}_{part}" for label, part in parts.items() if f"{name}_{part}" in arrays}
            errors.append((f"{name} error", unit, {label: _pooled(arrays[key]) for label, key in there.items()}))
    if not errors:
        return None
    caption = "Share of the held-out poses whose measured pose is at most so far from the predicted one"
    if "constraint" in results:
        caption = f"Share of the held-out rows that are at most so far from where {holder(results)} the tool"
    return distribution_plot(errors, caption)


def _pooled(values: Array) -> Array:
    flat = values.reshape(-1)
    flat = flat[np.isfinite(flat)]
    return flat[:: max(1, len(flat) // _DRAWN)]


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
        axes.set_yticks(y, [free[n].get("word") or n for n in names])
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
