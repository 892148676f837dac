"""The page of a pose plan: standard deviations, gain of each further pose, recommended number."""

from __future__ import annotations

from collections.abc import Sequence

from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.planning import Plan
from ccnn_torch.report.table import Table, markdown_table


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
        short: about a dozen rows and O1 alone, for a screen.
    """
    gains = plan.choice.gains
    counts = gains.count.tolist()
    step = max(1, len(counts) // 10) if short else 1
    shown = [i for i, n in enumerate(counts) if i % step == 0 or n in (len(plan.pose), plan.choice.recommended)]
    seen = gains.observability
    indices = {"O1": seen.o1}
    if not short:
        indices |= {"O1 (by k)": seen.o1_by_parameters, "O2": seen.o2}
    rows = []
    for i in shown:
        worst = int((gains.sd[i] / plan.scale).argmax())
        parameter = plan.parameters[worst]
        scale, unit = display_unit(parameter.unit, float(gains.sd[i, worst]))
        rows.append(
            (
                str(counts[i]) + ("" if counts[i] <= len(plan.pose) else " (more)"),
                *(number_text(float(index[i]), 3) for index in indices.values()),
                _percent(float(gains.information_gain[i])),
                _percent(float(gains.sd_gain[i])),
                f"{parameter.name} {number_text(float(gains.sd[i, worst]) / scale, 3)} {unit}",
            )
        )
    return Table(
        "What each further pose gives" + (f", leg {plan.leg}" if plan.leg is not None else ""),
        ("poses", *indices, "gain of det^(1/2k)", "fall of largest sd", "largest sd"),
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


def plan_markdown(mechanism: str, plans: Sequence[Plan], least_gain: float, picture: str, caption: str) -> str:
    """The page, in Markdown.

    Args:
        mechanism: its name.
        plans: one, or one a leg.
        least_gain: what a further pose must give, a share.
        picture: file name of the picture beside the page.
        caption: of the picture.
    """
    first = plans[0]
    parts = [
        f"# Poses to measure: {mechanism}",
        f"Chosen from {first.candidates} configurations ({first.drawn} drawn; the others are outside the limits or too "
        f"near to a singularity) so that O1 is largest. The most informative rows come first: these "
        "alone are good, too.",
        *(plan_sentence(plan, least_gain) for plan in plans),
        *filter(None, map(left_out_sentence, plans)),
        f"![{caption}]({picture})\n\n{caption}",
    ]
    for plan in plans:
        parts += [_section(parameter_table(plan)), _section(gain_table(plan))]
    return "\n\n".join(parts) + "\n"


def _section(table: Table) -> str:
    return markdown_table(table).strip()


def _percent(share: float) -> str:
    return "–" if share != share else f"{100 * share:.1f} %"
