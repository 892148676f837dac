"""Figure of a masked network: one matrix for each layer of connections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import count_text
from ccnn_torch.evolution.network import alive_nodes as path_nodes
from ccnn_torch.report.figures.style import GREY, Plot, bare, styled

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def alive_nodes(masks: Sequence[Mask]) -> list[Mask]:
    """Which nodes carry a signal from an input to an output (paper 000, section III-E).

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
