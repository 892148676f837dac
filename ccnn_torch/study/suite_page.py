"""The tables of a suite, from `suite.json` alone: methods against the noise floor, case by case, and how often each is
the best."""

from __future__ import annotations

from matplotlib.figure import Figure

from ccnn_torch.display import count_text, display_unit, number_text
from ccnn_torch.report.figures import FLOOR, GREY, SERIES, Plot, styled
from ccnn_torch.report.page import Page, Section
from ccnn_torch.report.results.base import interval_text
from ccnn_torch.report.results.suite import Case, SuiteResults
from ccnn_torch.report.table import Table

# The learner whose rank is shown in each case, if it was run.
_WATCHED = "ccnn"


def suite_page(comparison: SuiteResults) -> Page:
    """All that a suite shows."""
    return Page(
        name=comparison.name,
        kind="comparison of methods",
        verdict=verdict(comparison),
        sections=[
            Section(tables=[_cases_table(comparison), _methods_table(comparison)], sentences=_failures(comparison))
        ],
    )


def verdict(comparison: SuiteResults) -> str:
    """One sentence: in how many cases the watched method is the best, tied, close; empty where it was not run."""
    if _WATCHED not in comparison.methods:
        return ""
    block = comparison.methods[_WATCHED]
    cases, share = count_text(block.cases, "case"), 100 * block.share["best_or_tied"]
    return (
        f"{_WATCHED} is the best method or tied with it in {block.best_or_tied} of {cases} ({share:.0f} %), the "
        f"best in {block.best}; in {block.close} its error is within 5 % of the best method's."
    )


def _cases_table(comparison: SuiteResults) -> Table:
    methods = list(comparison.methods)
    floors = all(case.floor is not None for case in comparison.cases)
    key = "ratio_to_floor" if floors else "ratio_to_best"
    rows = []
    for case in comparison.cases:
        cells = [_case_text(case)]
        for method in methods:
            block = case.methods.get(method)
            cells.append("failed" if block is None else interval_text(block[key], digits=3))
        rows.append((*cells, _standing(case)))
    versus = "the noise floor" if floors else "that of the best method"
    words = comparison.definitions
    note = (
        f"Medians [5 %, 95 %] over the repeats. Best: {words['best']}. Tied: {words['tied']}. Close: {words['close']}. "
        "In brackets: split, training rows, and the root of the mean squared noise of the held-out rows."
    )
    title = f"Held-out mean squared joint error over all joints, ratio to {versus}"
    return Table(title, ("case", *methods, "best"), rows, note)


def _case_text(case: Case) -> str:
    texts = [case.split, count_text(case.counts.train + case.counts.validation, "row")]
    if case.floor is not None and case.floor.median is not None:
        floor = case.floor.median**0.5
        scale, unit = display_unit(case.unit, floor)
        texts.append(f"{number_text(floor / scale, 3)} {unit}")
    return f"{case.name} ({', '.join(texts)})"


def _standing(case: Case) -> str:
    """The best method and, if it is another one, the comparison of the watched method with it."""
    block = case.methods.get(_WATCHED)
    if block is None or block.best:
        return str(case.best)
    words = [word for word in ("tied", "close") if block[word]] or ["behind"]
    ratio = number_text(block.ratio_to_best.median, 3)
    return f"{case.best}; {_WATCHED} {' and '.join(words)} ({ratio})"


def _methods_table(comparison: SuiteResults) -> Table:
    rows = []
    for method, block in comparison.methods.items():
        share = f"{block.best_or_tied} ({100 * block.share['best_or_tied']:.0f} %)"
        cells = [method, str(block.cases), str(block.best), share, str(block.close)]
        cells += [number_text(block[key], 3) for key in ("typical_ratio_to_best", "seconds")]
        rows.append((*cells, str(block.failed)))
    columns = ("method", "cases", "best", "best or tied", "close", "ratio", "time [s]", "failed")
    note = (
        "Number of cases. Ratio: its error to the best method's, geometric mean over the cases of the median. Time: of "
        "one repeat, median."
    )
    return Table("How often a method is the best", columns, rows, note)


def _failures(comparison: SuiteResults) -> list[str]:
    texts = [f"case '{name}' failed: {sentence}" for name, sentence in comparison.failed.items()]
    # A learner that is not installed fails alike in every case: reported once.
    where: dict[tuple[str, str], list[str]] = {}
    for case in comparison.cases:
        for method, sentence in case.failed_methods.items():
            where.setdefault((method, sentence), []).append(f"'{case.name}'")
    for (method, sentence), cases in where.items():
        texts.append(f"{method} failed in {count_text(len(cases), 'case')} ({', '.join(cases)}): {sentence}")
    return texts


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
