"""Held-out error against time and against evaluations, all methods on one axis."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.calibration.page.reach import CURVE
from ccnn_torch.display import count_text
from ccnn_torch.report.figures.style import FLOOR, SERIES, Plot, styled

Array = NDArray[np.float64]
_AXES = (
    ("seconds", "time inside the learner [s]"),
    ("evaluations", "evaluations [1]"),
)


@styled
def progress_plot(
    histories: Mapping[str, Mapping[str, Array]],
    *,
    floor: float | None = None,
    constant: float | None = None,
    unit: str = "1",
) -> Plot | None:
    """Held-out error of every method against what it cost.

    Args:
        histories: training curves by method: `heldout_mse_all` [unit²], `seconds` and, where counted, `evaluations`,
            each `t x r`.
        floor, constant: mse of the noise floor and of the constant predictor over all joints [unit²].
        unit: the joints' SI unit.

    Returns:
        None where fewer than two methods have such curves.
    """
    shown = {name: found for name, found in histories.items() if CURVE in found and "seconds" in found}
    panels = [entry for entry in _AXES if any(entry[0] in found for found in shown.values())]
    if len(shown) < 2:
        return None
    figure = Figure(figsize=(4.8 * len(panels), 3.9), layout="constrained")
    for axes, (axis, label) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for i, (name, found) in enumerate(shown.items()):
            if axis in found:
                _draw(axes, found[axis], found[CURVE], SERIES[i % len(SERIES)], name)
        for value, style, text in ((constant, ":", "constant correction"), (floor, "--", "noise floor")):
            if value is not None and value > 0:
                axes.axhline(value, color=FLOOR, linestyle=style, linewidth=1.6, label=text)
        axes.set(xscale="log", yscale="log", xlabel=label)
    first = figure.axes[0]
    first.set_ylabel(f"held-out mse [{'1' if unit == '1' else f'{unit}²'}]")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 8))
    repeats = next(iter(shown.values()))[CURVE].shape[1]
    return Plot(
        "progress",
        figure,
        "Error on held-out rows against what it cost, in the fit on all training rows: time (one repeat's share) and "
        "passes of the training rows through one model. Dots are the last steps. "
        f"Medians over {count_text(repeats, 'repeat')}.",
    )


def _draw(axes: Axes, cost: Array, error: Array, colour: str, label: str) -> None:
    """cost, error: `t x r`."""
    x, y = np.nanmedian(cost, axis=1), np.nanmedian(error, axis=1)
    there = (x > 0) & (y > 0)
    axes.plot(x[there], y[there], color=colour, label=label)
    axes.plot(x[there][-1:], y[there][-1:], "o", color=colour, markersize=5)
