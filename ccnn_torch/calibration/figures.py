"""Figures of a run: training curves as median and 90 % band over the repeats, error against effort, the network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.calibration.page import run_page, write_tables
from ccnn_torch.display import count_text
from ccnn_torch.evolution.network import alive_nodes as path_nodes
from ccnn_torch.report.arrays import ARRAYS_FILE, load_arrays, load_history
from ccnn_torch.report.figures import (
    FLOOR,
    GREY,
    SERIES,
    Plot,
    bare,
    inline_figures,
    joint_error_plot,
    pose_error_plot,
    styled,
    workspace_plot,
)
from ccnn_torch.report.machine import machine_plot
from ccnn_torch.report.results.run import RunResults

Array = NDArray[np.float64]


@styled
def convergence_plot(
    history: Mapping[str, Array],
    method: str,
    *,
    floor: float | None = None,
    constant: float | None = None,
    unit: str = "1",
) -> Plot | None:
    """Fitness and errors against the step of training.

    Args:
        history: `step`: `t`, metrics `t x r` (`fitness_best`, `fitness_mean`, `error_train`, `error_validation`,
            `heldout_mse_all` or `heldout_mse_JOINT`); those that are there are drawn.
        floor, constant: mse of the noise floor and of the constant predictor over all joints [unit²], drawn as lines
            where `heldout_mse_all` is.
        unit: the joints' SI unit.

    Returns:
        None when the history has none of these metrics, or a single step, which converges to nothing.
    """
    step = history["step"]
    if len(step) < 2:
        return None
    panels = [
        ("Fitness", "fitness [1]", [n for n in ("fitness_best", "fitness_mean") if n in history], False),
        ("Training error", "error, standardised [1]", [n for n in history if n.startswith("error_")], True),
        ("Held-out error", f"mse [{_square(unit)}]", _held_out(history), True),
    ]
    panels = [panel for panel in panels if panel[2]]
    if not panels:
        return None
    figure = Figure(figsize=(4.5 * len(panels) + (1.5 if len(panels) == 1 else 0), 3.5), layout="constrained")
    for axes, (title, quantity, names, log) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        for i, name in enumerate(names):
            label = "all joints" if name == "heldout_mse_all" else name.split("_", 1)[1].replace("_", " ")
            _draw_band(axes, step, history[name], SERIES[i % len(SERIES)], label)
        if "heldout_mse_all" in names:
            for value, style, text in ((constant, ":", "constant"), (floor, "--", "noise floor")):
                if value is not None:
                    axes.axhline(value, color=FLOOR, linestyle=style, linewidth=1.6, label=text)
        if log and all((history[name][np.isfinite(history[name])] > 0).all() for name in names):
            axes.set_yscale("log")
        axes.set(title=title, xlabel="step of training", ylabel=quantity)
        axes.legend(loc="best")
    repeats = history[panels[0][2][0]].shape[1]
    band = f"; lines are medians and bands 5 % to 95 % over {repeats} repeats" * (repeats > 1)
    return Plot(f"convergence_{method}", figure, f"Progress of {method} over {len(step)} recorded steps{band}.")


def _held_out(history: Mapping[str, Array]) -> list[str]:
    if "heldout_mse_all" in history:
        return ["heldout_mse_all"]
    return sorted(name for name in history if name.startswith("heldout_mse_"))


def _draw_band(axes: Axes, step: Array, values: Array, colour: str, label: str) -> None:
    """Median over the repeats and, when there are several, the 5 % to 95 % band; values: `t x r`."""
    low, median, high = np.nanquantile(values, [0.05, 0.5, 0.95], axis=1)
    if values.shape[1] > 1:
        axes.fill_between(step, low, high, color=colour, alpha=0.18, linewidth=0)
    axes.plot(step, median, color=colour, label=label)


def _square(unit: str) -> str:
    return "1" if unit == "1" else f"{unit}²"


Mask = NDArray[np.bool_]


def alive_nodes(masks: Sequence[Mask]) -> list[Mask]:
    """Which nodes carry a signal from an input to an output (Zhang and Gao 2012, section III-E).

    A hidden node without a living input or without a living output is dead, and so on through the layers.

    Args:
        masks: layer by layer, `out x in`.

    Returns:
        One array a layer of nodes, inputs first; inputs and outputs always count as alive.
    """
    hidden = path_nodes([torch.as_tensor(mask) for mask in masks])
    ends = np.ones(masks[0].shape[1], dtype=bool), np.ones(masks[-1].shape[0], dtype=bool)
    return [ends[0], *(nodes.numpy() for nodes in hidden), ends[1]]


@styled
def network_plot(masks: Sequence[Mask], weights: Sequence[Array], method: str, joints: Sequence[str] = ()) -> Plot:
    """Draw the connections of a network.

    Args:
        masks: layer by layer, `out x in`.
        weights: layer by layer, `out x (in + 1)`, last column = bias.
        joints: names of the outputs, `n`.
    """
    alive = alive_nodes(masks)
    shown = [
        np.where(np.c_[mask, np.ones(len(mask), dtype=bool)], w, np.nan) for mask, w in zip(masks, weights, strict=True)
    ]
    for i, values in enumerate(shown):
        values[~alive[i + 1]] = np.nan
        values[:, :-1][:, ~alive[i]] = np.nan
    limit = max(float(np.nanmax(np.abs(values), initial=0.0)) for values in shown) or 1.0
    norm = TwoSlopeNorm(0.0, -limit, limit)
    columns = [mask.shape[1] + 1 for mask in masks]
    figure = Figure(
        figsize=(max(7.0, 0.36 * sum(columns) + 2.6), 0.32 * max(len(m) for m in masks) + 1.9), layout="constrained"
    )
    drawn: Any = None
    for i, axes in enumerate(figure.subplots(1, len(masks), squeeze=False, width_ratios=columns)[0]):
        _grey_dead(axes, alive[i], alive[i + 1])
        drawn = axes.pcolormesh(shown[i], cmap="RdBu_r", norm=norm, edgecolors="#DDDDDD", linewidth=0.6)
        bare(axes)
        axes.invert_yaxis()
        axes.set_aspect("equal")
        axes.set_anchor("N")
        last = i == len(masks) - 1
        axes.set_title("to the outputs" if last else f"to hidden layer {i + 1}")
        axes.set_xlabel("input" if i == 0 else f"node of hidden layer {i}")
        axes.set_ylabel("output" if last else f"node of hidden layer {i + 1}")
        axes.set_xticks(np.arange(columns[i]) + 0.5, [*(str(k + 1) for k in range(columns[i] - 1)), "bias"])
        names = list(joints) if last and joints else [str(k + 1) for k in range(len(masks[i]))]
        axes.set_yticks(np.arange(len(masks[i])) + 0.5, names)
        axes.tick_params(length=0, labelsize=7.5)
        axes.get_xticklabels()[-1].set_rotation(90)
    bar = figure.colorbar(drawn, ax=figure.axes, shrink=0.8, pad=0.02)
    bar.set_label("weight [1]")
    bar.outline.set_visible(False)
    there = sum(int(mask.sum()) for mask in masks)
    dead = sum(int((~nodes).sum()) for nodes in alive[1:-1])
    return Plot(
        f"network_{method}",
        figure,
        f"The network of {method}: {there} of {sum(m.size for m in masks)} possible connections (white = none), "
        f"{count_text(dead, 'dead node')} (grey), which the exported model leaves out.",
    )


def _grey_dead(axes: Axes, before: Mask, after: Mask) -> None:
    for row in np.flatnonzero(~after):
        axes.axhspan(float(row), float(row) + 1, color=GREY, linewidth=0)
    for column in np.flatnonzero(~before):
        axes.axvspan(float(column), float(column) + 1, color=GREY, linewidth=0)


_LINKED = ("results.json", "results.csv", "card.json", "model.safetensors", "model.onnx", "config.yaml")


def write_report(folder: str | Path, results: RunResults | None = None) -> Path:
    """Write `results.csv`, `results.md`, `plots/` and `report.html` of a run folder.

    Reads, as far as they are there, `arrays.safetensors`, `history-METHOD.safetensors` and `config.yaml`; the same
    files give the same report, so it can be written again at any time.

    Args:
        results: the content of its `results.json`, which is read when None.

    Returns:
        The path of `report.html`.
    """
    folder = Path(folder)
    results = RunResults.read(folder / "results.json") if results is None else results
    write_tables(folder, results)
    figures = inline_figures(run_plots(folder, results), folder / "plots")
    return run_page(results, figures, Path(folder.name)).write_html(folder / "report.html", _LINKED)


def run_plots(folder: str | Path, results: RunResults) -> list[Plot]:
    """All pictures of a run folder, in reading order; a picture whose data is not there is left out."""
    folder = Path(folder)
    plots: list[Plot | None] = []
    if (folder / ARRAYS_FILE).is_file():
        arrays = load_arrays(folder)
        words = "With " + " + ".join([*results.pose.parts, arrays.labels.get("method", "the model")])
        # What mostly turns has no places to draw errors at, but a map of its angles.
        plots.append(machine_plot(arrays.drawn, words) or workspace_plot(arrays))
        plots += [pose_error_plot(arrays), joint_error_plot(arrays)]
        if arrays.masks:
            names = [joint.name for joint in arrays.joints]
            method = arrays.labels.get("method", "model")
            plots.append(network_plot(arrays.masks, arrays.weights, method, names))
    levels = {"floor": results.floor and results.floor.realised, "constant": results.constant.test}
    lines = {name: block["all"].mse.median for name, block in levels.items() if block and "all" in block}
    paths = {method: folder / f"history-{method}.safetensors" for method in results.methods}
    histories = {method: load_history(path) for method, path in paths.items() if path.is_file()}
    unit = results.joints[0].unit
    for method, history in histories.items():
        plots.append(convergence_plot(history, method, unit=unit, **lines))
    return [plot for plot in plots if plot is not None]
