"""The course of a motion over time: command and position, and what is left before and after."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ccnn_torch.display import display_unit
from ccnn_torch.motion.phases import PHASES
from ccnn_torch.report.figures.style import AFTER, BEFORE, FLOOR, GREY, SERIES, Plot, styled

Arrays = Mapping[str, NDArray[np.float64]]
# Joints that are drawn, those with the largest gap.
_MOST = 3
# Phases that are shaded.
_SHADED = {"reversal": SERIES[1], "standstill": GREY}


@styled
def course_plot(results: Mapping[str, Any], arrays: Arrays) -> Plot | None:
    """Of the run with the largest gap: command and position, and the residual with and without the verdict's effects.

    Args:
        results: as in `diagnosis.json`.
        arrays: `time`, `judged` `b x s`, `command`, `position`, `before`, `after`, `phase` `n x b x s`, and `run` `b`.
    """
    if "before" not in arrays:
        return None
    judged, before = arrays["judged"] > 0.5, arrays["before"]
    size = (np.square(before) * judged).sum((0, 2))
    runs = arrays["run"]
    worst = max(np.unique(runs), key=lambda r: float(size[runs == r].mean()))
    mine = np.flatnonzero(runs == worst)
    by_joint = (np.square(before) * judged)[:, mine].sum((1, 2))
    joints = sorted(np.argsort(-by_joint)[:_MOST].tolist())
    figure = Figure(figsize=(8.4, 3.4 * len(joints)), layout="tight")
    grid = figure.subplots(2 * len(joints), 1, sharex=True, squeeze=False)[:, 0]
    unit = results["gap"]["unit"]
    for k, i in enumerate(joints):
        top, low = grid[2 * k], grid[2 * k + 1]
        scale, shown = display_unit(unit, float(np.abs(before[i][:, :][judged]).max()) or 1.0)
        for b in mine:
            on, first = judged[b], b == mine[0]
            t = arrays["time"][b][on]
            for axes, name, unit_, look, label in (
                (top, "command", 1.0, {"color": FLOOR, "linestyle": "--"}, "command"),
                (top, "position", 1.0, {"color": SERIES[2]}, "position"),
                (low, "before", scale, {"color": BEFORE}, "model as it is"),
                (low, "after", scale, {"color": AFTER}, "with the effects"),
            ):
                axes.plot(t, arrays[name][i, b][on] / unit_, label=label if first else None, **look)
            for name, colour in _SHADED.items():
                there = arrays["phase"][i, b][on] == PHASES.index(name)
                shade: dict[str, Any] = {
                    "color": colour,
                    "alpha": 0.18,
                    "linewidth": 0,
                    "label": name if first else None,
                }
                low.fill_between(t, 0, 1, where=there, transform=low.get_xaxis_transform(), **shade)
        top.set_ylabel(f"q{i + 1} [{unit}]")
        low.set_ylabel(f"residual [{shown}]")
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=2)
        low.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=4)
    grid[-1].set_xlabel("time [s]")
    caption = (
        "The run with the largest gap. Measured less simulated position, held out: by a fit that saw no part of this "
        "run (or, of a single run, not this part). Shaded: reversals (yellow) and standstill (grey)."
    )
    return Plot("course", figure, caption)
