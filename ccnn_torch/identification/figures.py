"""Figures of an identification, in reading order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import display_unit, number_text
from ccnn_torch.identification.page import holder
from ccnn_torch.report.figures import AFTER, BEFORE, FLOOR, SERIES, Plot, bare, styled
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
        _plain(axes.xaxis)
        axes.set(xlabel=f"{name} error [{unit}]", ylabel="share of poses [%]", ylim=(0, 101))
        axes.set_title(name.capitalize())
        axes.legend(loc="upper left")
        medians = (number_text(float(np.median(v)) / scale, 3) for v in (before, after))
        texts.append(f"median {name} error {' → '.join(medians)} {unit}")
    caption = "Share of the held-out poses whose measured pose is at most so far from the predicted one: "
    if "constraint" in results:
        caption = f"Share of the held-out rows that are at most so far from where {holder(results)} the tool: "
    return Plot("pose_error", figure, caption + " and ".join(texts) + ".")


def _drawing(width: float, height: float) -> tuple[Figure, Any]:
    """A figure [inches] with one pair of axes."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _plain(axis: Any) -> None:
    """Numbers of a logarithmic axis without powers of ten."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")


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
        figure, axes = _drawing(9.2, 3.8)
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
        _plain(axes.yaxis)
        axes.set_xticks(range(len(at)), [free[i][0] for i in at], rotation=60, ha="right")
        axes.set_ylabel(f"|identified - true| [{shown}]")
        figure.legend(loc="outside upper center", ncols=min(len(methods) + 1, 7))
        kind = {"m": "lengths", "rad": "angles", "1": "gains"}.get(unit, "couplings")
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
    figure, axes = _drawing(6.4, 3.6)
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
    _plain(axes.yaxis)
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
    figure, axes = _drawing(7.2, 3.2)
    for values, colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        axes.plot(np.arange(1, len(values) + 1), np.abs(values), "o", color=colour, markersize=3, label=label)
    axes.set(xlabel="equation", ylabel="|residual| / its noise", yscale="log")
    _plain(axes.yaxis)
    axes.legend()
    rms = [number_text(float(np.sqrt(np.mean(np.square(v)))), 3) for v in (before, after)]
    return Plot(
        "residuals",
        figure,
        f"Residuals of the equations that were identified from (training rows, first machine): RMS {rms[0]} → "
        f"{rms[1]}; 1 is the noise where it is known, else the unit is the residual's own.",
    )


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


@styled
def correlation_plot(results: Results, arrays: Arrays) -> Plot | None:
    """Correlation of the parameters' estimates."""
    matrix = arrays["correlation"]
    if matrix.size == 0 or not np.isfinite(matrix).any():
        return None
    names = [name for name, block in results["parameters"].items() if block["free"]]
    names = names if len(names) == len(matrix) else [str(i + 1) for i in range(len(matrix))]
    side = 2.2 + 0.2 * len(names)
    figure, axes = _drawing(side + 1.0, side)
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
    figure, axes = _drawing(6.0, 3.2)
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


@styled
def map_plot(results: Results, arrays: Arrays) -> Plot | None:
    """RMS position error over the machines at each place, before and by each method (Figure 6 of paper 004)."""
    if "map" not in arrays or "map_before" not in arrays:
        return None
    maps = {"before": arrays["map_before"]}
    maps |= {m: arrays[f"map_{m}"] for m in results["methods"] if f"map_{m}" in arrays}
    known = np.isfinite(np.stack(list(maps.values()))).all(0)
    place = arrays["map"][known, :2]
    maps = {name: values[known] for name, values in maps.items()}
    after = np.concatenate([v for name, v in maps.items() if name != "before"])
    scale, unit = display_unit("m", float(np.median(after)))
    norm = LogNorm(float(np.quantile(after, 0.01)) / scale, float(np.quantile(after, 0.99)) / scale, clip=True)
    first_scale, first_unit = display_unit("m", float(np.median(maps["before"])))
    figure = Figure(figsize=(3.3 * len(maps) + 1.2, 3.5), layout="constrained")
    texts = []
    drawn: Any = None
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, (name, values) in zip(panels, maps.items(), strict=True):
        own = name == "before"
        shown = values / (first_scale if own else scale)
        # Before, the error is hundreds of times larger: it has a scale of its own.
        picture = axes.scatter(*place.T, c=shown, s=14, marker="s", cmap="viridis", norm=None if own else norm)
        # The median: at the edge, which is singular, one place counts more than all others in a mean square.
        middle = number_text(float(np.median(values)) / (first_scale if own else scale), 3)
        texts.append(f"{name} {middle} {first_unit if own else unit}")
        axes.set_title(f"{name}: median {middle} {first_unit if own else unit}")
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.grid(False)
        if own:
            figure.colorbar(picture, ax=axes, shrink=0.8, label=first_unit)
        else:
            drawn = picture
    if drawn is not None:
        figure.colorbar(drawn, ax=list(panels[1:]), shrink=0.8, label=unit)
    return Plot(
        "map",
        figure,
        "Position error over the workspace, commanded exactly by the geometry: RMS over the machines at each place, "
        "and of these the median over the places: " + ", ".join(texts) + ".",
    )


@styled
def poses_plot(results: Results, arrays: Arrays) -> Plot | None:
    """Where the first machine was measured: common poses and those of each leg (Figure 4 of paper 004)."""
    if "observed" not in arrays:
        return None
    sets = {"common": arrays["observed"][0]}
    sets |= {f"leg {name[len('observed_leg') :]}": arrays[name][0] for name in sorted(arrays) if "observed_leg" in name}
    if sets["common"].shape[1] < 2:
        return None
    figure = Figure(figsize=(3.4 * len(sets) + 0.4, 3.4), layout="constrained")
    for k, (axes, (name, pose)) in enumerate(
        zip(figure.subplots(1, len(sets), squeeze=False)[0], sets.items(), strict=True)
    ):
        if "map" in arrays:
            axes.plot(*arrays["map"][:, :2].T, ".", color="#DDDDDD", markersize=2)
        axes.plot(pose[:, 0], pose[:, 1], "o", color=SERIES[k % len(SERIES)], markersize=5)
        axes.set_title(f"{name}: {len(pose)} poses")
        axes.set_aspect("equal", adjustable="datalim")
    return Plot("poses", figure, "First two measured coordinates of the poses that were identified from.")
