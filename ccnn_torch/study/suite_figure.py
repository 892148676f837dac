"""Figure of a suite: error of each method relative to the noise floor, for all cases."""

from __future__ import annotations

from matplotlib.figure import Figure

from ccnn_torch.display import count_text
from ccnn_torch.report.figures.style import FLOOR, GREY, SERIES, Plot, styled
from ccnn_torch.report.results.suite import SuiteResults

# The methods of a row are offset, so that their intervals do not overlap.
_SPREAD = 0.62


@styled
def suite_plot(comparison: SuiteResults) -> Plot:
    """Rows = cases, points = methods with their 5 % to 95 % intervals, on a logarithmic axis.

    The axis is the ratio to the noise floor, or to the best method where a case has no known floor.
    """
    cases, methods = comparison.cases, list(comparison.methods)
    floors = all(case.floor is not None for case in cases)
    key = "ratio_to_floor" if floors else "ratio_to_best"
    others = [method for method in methods if method != "constant"]
    colours = {method: SERIES[i % len(SERIES)] for i, method in enumerate(others)} | {"constant": GREY}
    figure = Figure(figsize=(8.2, 1.5 + 0.36 * len(cases)), layout="constrained")
    axes = figure.subplots()
    for i, method in enumerate(methods):
        offset = _SPREAD * ((i + 0.5) / len(methods) - 0.5)
        there = [(row, case.methods[method]) for row, case in enumerate(cases) if method in case.methods]
        known = [(row, block) for row, block in there if block[key].median is not None]
        if not known:
            continue
        at = [row + offset for row, _ in known]
        middle = [block[key].median for _, block in known]
        low = [block[key].low for _, block in known]
        high = [block[key].high for _, block in known]
        axes.hlines(at, low, high, color=colours[method], linewidth=1.4, alpha=0.7)
        axes.plot(middle, at, "o", color=colours[method], markersize=4.5, label=method)
    axes.axvline(1.0, color=FLOOR, linewidth=1.2, linestyle="--", zorder=0.5)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_yticks(range(len(cases)), [f"{case.name} ({case.split})" for case in cases])
    axes.set_ylim(len(cases) - 0.4, -0.6)
    versus = "noise floor" if floors else "best method"
    axes.set_xlabel(f"held-out mean squared joint error / {versus} [1]")
    figure.legend(loc="outside upper center", ncols=min(len(methods), 6))
    return Plot(
        "suite",
        figure,
        f"{count_text(len(cases), 'case')}: held-out mean squared joint error of each method as a multiple of the "
        f"{versus}, median and 5 % to 95 % interval over the repeats.",
    )
