"""The page of a pose plan and its picture: poses, standard deviations, gain of each further pose, how many."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.planning import Plan
from ccnn_torch.report.figures import FLOOR, GREY, SERIES, Plot, styled
from ccnn_torch.report.page import Page, Section, sections_of
from ccnn_torch.report.table import Table


def plan_sentence(plan: Plan, least_gain: float) -> str:
    """The gain of a plan over random poses, and the recommended number of poses."""
    count = len(plan.pose)
    subject = f"leg {plan.leg}" if plan.leg is not None else count_text(len(plan.parameters), "parameter")
    against = plan.o1 / plan.choice.random_o1 if plan.choice.random_o1 > 0 else float("inf")
    text = f"{count_text(count, 'pose')} for {subject}: O1 is {number_text(against, 3)} times that of random ones"
    if plan.choice.bound is not None:
        text += f", and at least {100 * plan.choice.bound:.0f} % of what is possible in det^(1/k)"
    percent = f"{100 * least_gain:g} %"
    recommended = plan.choice.recommended
    if recommended is None:
        return f"{text}. Even the last pose evaluated still gives more than {percent}: plan more."
    if recommended > count:
        return f"{text}. Up to {recommended} poses each further one still gives more than {percent}."
    return f"{text}. After {recommended} poses a further one gives less than {percent}."


def left_out_sentence(plan: Plan) -> str:
    """The combinations that no pose determines; empty if every parameter is determined."""
    if not plan.choice.left_out:
        return ""
    subject = f"Of leg {plan.leg} no" if plan.leg is not None else "No"
    return (
        f"{subject} pose distinguishes: {'; '.join(plan.choice.left_out)}. The plan is for what poses determine: "
        "parameters without a row in the table keep their values. A prior or another instrument would determine them."
    )


def gain_table(plan: Plan, short: bool = False) -> Table:
    """Figures of the first n poses, and the gain of the last of them.

    Args:
        plan: one plan.
        short: about a dozen rows, for a screen.
    """
    gains = plan.choice.gains
    counts = gains.count.tolist()
    step = max(1, len(counts) // 10) if short else 1
    shown = [i for i, n in enumerate(counts) if i % step == 0 or n in (len(plan.pose), plan.choice.recommended)]
    rows = []
    for i in shown:
        worst = int((gains.sd[i] / plan.scale).argmax())
        parameter = plan.parameters[worst]
        scale, unit = display_unit(parameter.unit, float(gains.sd[i, worst]))
        rows.append(
            (
                str(counts[i]) + ("" if counts[i] <= len(plan.pose) else " (more)"),
                number_text(float(gains.o1[i]), 3),
                _percent(float(gains.information_gain[i])),
                _percent(float(gains.sd_gain[i])),
                f"{parameter.name} {number_text(float(gains.sd[i, worst]) / scale, 3)} {unit}",
            )
        )
    return Table(
        "What each further pose gives" + (f", leg {plan.leg}" if plan.leg is not None else ""),
        ("poses", "O1", "gain of det^(1/2k)", "fall of largest sd", "largest sd"),
        tuple(rows),
        "Parameters in plausible errors and measurements in noise; a pose that only averages the noise gains 1/(2n).",
    )


def parameter_table(plan: Plan) -> Table:
    """Standard deviation of each parameter with the planned poses, and with random ones."""
    rows = []
    pairs = zip(plan.parameters, plan.sd.tolist(), plan.choice.random_sd.tolist(), strict=True)
    for parameter, planned, random in pairs:
        scale, unit = display_unit(parameter.unit, planned)
        rows.append((parameter.name, unit, *(number_text(v / scale, 3) for v in (planned, random))))
    return Table(
        "Standard deviation of each parameter" + (f", leg {plan.leg}" if plan.leg is not None else ""),
        ("parameter", "unit", f"{len(plan.pose)} planned poses", "as many random ones"),
        tuple(rows),
    )


def plan_page(
    mechanism: str, plans: Sequence[Plan], least_gain: float, first: Sequence[Section] = (), short: bool = False
) -> Page:
    """What a plan shows.

    Args:
        mechanism: its name.
        plans: one, or one a leg.
        least_gain: what a further pose must give, a share.
        first: what stands before the tables.
        short: as `gain_table`.
    """
    one = plans[0]
    tables = (table for plan in plans for table in (parameter_table(plan), gain_table(plan, short)))
    note = (
        f"Chosen from {one.candidates} configurations ({one.drawn} drawn; the others are outside the limits or too "
        "near to a singularity) so that O1 is largest. The most informative rows come first: these alone are good, too."
    )
    return Page(
        name=f"Poses to measure: {mechanism}",
        kind="plan of measurements",
        verdict=" ".join(plan_sentence(plan, least_gain) for plan in plans),
        sections=[*first, *sections_of(tables)],
        cautions=[*filter(None, map(left_out_sentence, plans))],
        notes=[note],
    )


def _percent(share: float) -> str:
    return "–" if share != share else f"{100 * share:.1f} %"


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
