"""Training curves: fitness, errors and the state of the subpopulations, as median and 90 % band over the repeats."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import count_text
from ccnn_torch.report.figures.style import FLOOR, SERIES, Plot, styled

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


@styled
def population_plot(history: Mapping[str, Array], method: str) -> Plot | None:
    """Connection density and diversity of each subpopulation against the generation.

    Args:
        history: `step`: `t`, `density` and `diversity`: `t x r x k`.

    Returns:
        None when the history has neither.
    """
    names = [name for name in ("density", "diversity") if name in history]
    if not names:
        return None
    texts = {"density": "share of connections [1]", "diversity": "diversity [1]"}
    figure = Figure(figsize=(4.5 * len(names) + (1.5 if len(names) == 1 else 0), 3.3), layout="constrained")
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        values = history[name]
        for i in range(values.shape[2]):
            _draw_band(axes, history["step"], values[..., i], SERIES[i % len(SERIES)], f"subpopulation {i + 1}")
        axes.set(title=name.capitalize(), xlabel="generation", ylabel=texts[name])
        axes.set_ylim(bottom=0)
        axes.legend(loc="best")
    layers, repeats = history[names[0]].shape[2], history[names[0]].shape[1]
    return Plot(
        f"population_{method}",
        figure,
        f"{' and '.join(names).capitalize()} of the {layers} subpopulations of {method} (one for each layer of "
        f"connections, the first next to the inputs), over {count_text(repeats, 'repeat')}.",
    )


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
