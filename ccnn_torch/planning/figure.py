"""Figure of a pose plan: the poses, and the gain of each further one."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.planning import Plan
from ccnn_torch.report.figures.style import FLOOR, GREY, SERIES, Plot, styled


@styled
def plan_plot(pose: Sequence[Coordinate], plans: Sequence[Plan], least_gain: float) -> Plot:
    """The planned poses among the candidates, and the gain of each further pose.

    Args:
        pose: the pose coordinates; the first is drawn against the second and, where there is one, the third.
        plans: one, or one a leg.
        least_gain: what a further pose must give, a share.
    """
    planes = [(0, j) for j in range(1, min(3, len(pose)))] or [(0, 0)]
    figure = Figure(figsize=(4.4 * len(planes) + 4.8, 4.2), layout="constrained")
    *maps, curves = figure.subplots(1, len(planes) + 1, width_ratios=[1.0] * len(planes) + [1.1], squeeze=False)[0]
    for axes, plane in zip(maps, planes, strict=True):
        _draw_map(axes, pose, plans, plane)
    _draw_gains(curves, plans, least_gain)
    caption = (
        "The planned poses among the candidates (left), and the share by which each further pose makes the information "
        f"det^(1/2k) larger (right; {100 * least_gain:g} % is the least that is worth a measurement)."
    )
    return Plot("plan", figure, caption)


def _draw_map(axes: Axes, pose: Sequence[Coordinate], plans: Sequence[Plan], plane: tuple[int, int]) -> None:
    across, up = plane
    around = plans[0].around
    axes.scatter(around[:, across], around[:, up], s=3, color=GREY, linewidths=0, rasterized=True, label="candidates")
    for i, plan in enumerate(plans):
        color = SERIES[i % len(SERIES)]
        x, y = plan.pose[:, across], plan.pose[:, up]
        label = "planned" if plan.leg is None else f"leg {plan.leg}"
        axes.scatter(x, y, s=22, color=color, edgecolors="white", linewidths=0.6, zorder=3, label=label)
    if pose[across].unit == pose[up].unit:
        axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{pose[across].name} [{pose[across].unit}]")
    axes.set_ylabel(f"{pose[up].name} [{pose[up].unit}]")
    axes.set_title("Poses", pad=22)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=4, handletextpad=0.2, columnspacing=1.0)


def _draw_gains(axes: Axes, plans: Sequence[Plan], least_gain: float) -> None:
    for i, plan in enumerate(plans):
        gains, color = plan.choice.gains, SERIES[i % len(SERIES)]
        label = "gain" if plan.leg is None else f"leg {plan.leg}"
        axes.plot(gains.count, 100 * gains.information_gain, ".-", color=color, label=label)
        if plan.choice.recommended is not None:
            axes.axvline(plan.choice.recommended, color=color, linewidth=1.0, linestyle=":")
    counts = plans[0].choice.gains.count
    axes.plot(counts, 50 / counts, color=FLOOR, linewidth=1.0, linestyle="--", label="averaging alone, 1 / (2 n)")
    axes.axhline(100 * least_gain, color=FLOOR, linewidth=1.0)
    axes.axvline(len(plans[0].pose), color="#222222", linewidth=1.0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("poses (line: planned; dotted: recommended)")
    axes.set_ylabel("gain of the last pose [%]")
    axes.set_title("What each further pose gives", pad=22)
    axes.legend(loc="upper right")
