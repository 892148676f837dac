"""Figures of an identification, in reading order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import display_unit, number_text
from ccnn_torch.identification.page.constraint import holder
from ccnn_torch.identification.page.figure_knowledge import correlation_plot, parameter_plot, singular_value_plot
from ccnn_torch.identification.page.figure_maps import map_plot, poses_plot
from ccnn_torch.report.figures.style import AFTER, BEFORE, FLOOR, SERIES, Plot, styled

Array = NDArray[np.float64]
Arrays = Mapping[str, Array]
Results = Mapping[str, Any]
# Pooled over machines, more poses than this add nothing to a picture.
_DRAWN = 4000


def identified_plots(results: Results, arrays: Arrays) -> list[Plot]:
    """All pictures; one whose data is not there is left out."""
    plots: list[Plot | None] = [
        pose_distribution_plot(results, arrays),
        parameter_plot(results, arrays),
        *deviation_plots(results, arrays),
        map_plot(results, arrays),
        poses_plot(results, arrays),
        count_plot(results),
        residual_plot(arrays),
        correlation_plot(results, arrays),
        singular_value_plot(results),
    ]
    return [plot for plot in plots if plot is not None]


@styled
def pose_distribution_plot(results: Results, arrays: Arrays) -> Plot | None:
    """Held-out pose error before and after, all machines pooled, and the measurement noise where it is known."""
    shown = [
        (n, u) for n, u in (("position", "m"), ("rotation", "rad")) if results["test"][n] and f"{n}_before" in arrays
    ]
    if not shown:
        return None
    figure = Figure(figsize=(4.6 * len(shown) + 1.0, 3.5), layout="constrained")
    texts = []
    for axes, (name, si_unit) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        before, after = (_pooled(arrays[f"{name}_{when}"]) for when in ("before", "after"))
        scale, unit = display_unit(si_unit, float(np.median(before)))
        lines = [("before", before, BEFORE), ("after", after, AFTER)]
        if f"{name}_noise" in arrays:
            lines.append(("measurement noise", _pooled(arrays[f"{name}_noise"]), FLOOR))
        for label, values, colour in lines:
            sorted_values = np.sort(values) / scale
            share = 100 * np.arange(1, len(values) + 1) / len(values)
            dashed = "--" if colour == FLOOR else "-"
            axes.plot(sorted_values, share, dashed, color=colour, label=label, linewidth=2)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set(xlabel=f"{name} error [{unit}]", ylabel="share of poses [%]", ylim=(0, 101))
        axes.set_title(name.capitalize())
        axes.legend(loc="upper left")
        medians = (number_text(float(np.median(v)) / scale, 3) for v in (before, after))
        texts.append(f"median {name} error {' → '.join(medians)} {unit}")
    caption = "Share of the held-out poses whose measured pose is at most so far from the predicted one: "
    if "constraint" in results:
        caption = f"Share of the held-out rows that are at most so far from where {holder(results)} the tool: "
    return Plot("pose_error", figure, caption + " and ".join(texts) + ".")


def _pooled(values: Array) -> Array:
    flat = values.reshape(-1)
    flat = flat[np.isfinite(flat)]
    return flat[:: max(1, len(flat) // _DRAWN)]


@styled
def deviation_plots(results: Results, arrays: Arrays) -> list[Plot]:
    """|identified - true| of every parameter by every method, one picture for each unit (Figures 7 and 8 of 001)."""
    free = [(name, block) for name, block in results["parameters"].items() if block["free"]]
    methods = [m for m in results["methods"] if f"deviation_{m}" in arrays]
    plots = []
    for unit in dict.fromkeys(block["unit"] for _, block in free if methods):
        at = [i for i, (_, block) in enumerate(free) if block["unit"] == unit and i < _width(arrays, methods)]
        if not at:
            continue
        tables = {m: np.abs(arrays[f"deviation_{m}"][:, at]) for m in methods}
        scale, shown = display_unit(unit, float(max(np.median(t) for t in tables.values())) or 1.0)
        figure = Figure(figsize=(9.2, 3.8), layout="constrained")
        axes = figure.subplots()
        for k, (method, table) in enumerate(tables.items()):
            x = np.arange(len(at)) + 0.7 * ((k + 0.5) / len(methods) - 0.5)
            low, middle, high = np.quantile(table, (0.05, 0.5, 0.95), axis=0) / scale
            colour = SERIES[k % len(SERIES)]
            axes.vlines(x, np.maximum(low, 1e-12), high, color=colour, linewidth=1.4, alpha=0.7)
            axes.plot(x, middle, "o", color=colour, markersize=4, label=method)
        bound = np.median(arrays[f"bound_{methods[0]}"][:, at], axis=0) / scale
        known = np.isfinite(bound)
        axes.plot(
            np.arange(len(at))[known],
            bound[known],
            "_",
            color=FLOOR,
            markersize=14,
            markeredgewidth=2,
            label="bound (1σ)",
        )
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xticks(range(len(at)), [free[i][0] for i in at], rotation=60, ha="right")
        axes.set_ylabel(f"|identified - true| [{shown}]")
        figure.legend(loc="outside upper center", ncols=min(len(methods) + 1, 7))
        kind = {"m": "lengths", "rad": "angles", "1": "gains"}.get(unit, unit)
        plots.append(
            Plot(
                f"deviations_{kind}",
                figure,
                f"Deviation of the identified {kind} from the true ones by method: median and 5 % to 95 % over the "
                "machines; the grey mark is the Cramér-Rao bound, one standard deviation.",
            )
        )
    return plots


def _width(arrays: Arrays, methods: list[str]) -> int:
    return int(arrays[f"deviation_{methods[0]}"].shape[1])


@styled
def count_plot(results: Results) -> Plot | None:
    """Pose error after compensation against the number of measured poses, by method."""
    counts = results["counts"]
    if not counts:
        return None
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    poses = [entry["poses"] for entry in counts]
    for k, method in enumerate(counts[0]["methods"]):
        blocks = [entry["methods"][method] for entry in counts]
        middle = np.array([b["position"] for b in blocks], dtype=np.float64) / 1e-3
        edges = [b.get("spread", {}).get("position", [b["position"]] * 2) for b in blocks]
        low, high = np.array(edges, dtype=np.float64).T / 1e-3
        colour = SERIES[k % len(SERIES)]
        axes.fill_between(poses, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(poses, middle, "o-", color=colour, label=method)
    axes.set(xlabel="poses measured", ylabel="RMS position error left [mm]", yscale="log", xscale="log")
    axes.set_xticks(poses, [str(p) for p in poses])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.legend()
    return Plot(
        "measurements",
        figure,
        "Position error of the machines under exact commands against the number of poses measured: median and 5 % to "
        "95 % over the machines.",
    )


@styled
def residual_plot(arrays: Arrays) -> Plot | None:
    """Residuals of the rows that were identified from, before and after, of the first machine."""
    numbers = sorted(int(n.rpartition("_")[2]) for n in arrays if n.startswith("residual_after_"))
    if not numbers:
        return None
    before, after = (
        np.concatenate([arrays[f"residual_{w}_{n}"].reshape(-1) for n in numbers]) for w in ("before", "after")
    )
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes = figure.subplots()
    for values, colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        axes.plot(np.arange(1, len(values) + 1), np.abs(values), "o", color=colour, markersize=3, label=label)
    axes.set(xlabel="equation", ylabel="|residual| / its noise", yscale="log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.legend()
    rms = [number_text(float(np.sqrt(np.mean(np.square(v)))), 3) for v in (before, after)]
    return Plot(
        "residuals",
        figure,
        f"Residuals of the equations that were identified from (training rows, first machine): RMS {rms[0]} → "
        f"{rms[1]}; 1 is the noise where it is known, else the unit is the residual's own.",
    )
