"""The tables of a suite, from `suite.json` alone: methods against the noise floor, case by case, and how often each is
the best."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from ccnn_torch.display import count_text, display_unit, interval_text, number_text
from ccnn_torch.report.table import Table, markdown_table, print_table, print_text

# The learner whose rank is shown in each case, if it was run.
_WATCHED = "ccnn"


def suite_tables(comparison: Mapping[str, Any]) -> list[Table]:
    """Both tables, in reading order."""
    return [_cases_table(comparison), _methods_table(comparison)]


def suite_markdown(comparison: Mapping[str, Any]) -> str:
    """The tables as Markdown (`suite.md`)."""
    parts = [f"# {comparison['name']}"]
    if _WATCHED in comparison["methods"]:
        parts.append(verdict(comparison))
    return "\n\n".join([*parts, *map(markdown_table, suite_tables(comparison)), *_failures(comparison)]) + "\n"


def print_suite(comparison: Mapping[str, Any], console: Console) -> None:
    """Show the tables and the verdict on a terminal."""
    for table in suite_tables(comparison):
        print_table(table, console)
    for sentence in _failures(comparison):
        print_text(sentence, console, "yellow")
    if _WATCHED in comparison["methods"]:
        print_text(verdict(comparison), console, "bold")


def verdict(comparison: Mapping[str, Any]) -> str:
    """One sentence: in how many cases the watched method is the best, tied, close."""
    block = comparison["methods"][_WATCHED]
    cases, share = count_text(block["cases"], "case"), 100 * block["share"]["best_or_tied"]
    return (
        f"{_WATCHED} is the best method or tied with it in {block['best_or_tied']} of {cases} ({share:.0f} %), the "
        f"best in {block['best']}; in {block['close']} its error is within 5 % of the best method's."
    )


def case_line(results: Mapping[str, Any]) -> str:
    """One line while a suite runs: each method's median ratio to the floor (or its error), and the best."""
    texts = []
    for name, block in results["methods"].items():
        if block["test"] is None:
            texts.append(f"{name} failed")
            continue
        ratio = block["ratio_to_floor"]
        value = ratio["median"] if ratio else block["test"].get("all", {}).get("mse", {}).get("median")
        texts.append(f"{name} {number_text(value, 3)}")
    what = "ratio to the floor" if results["floor"] else "mean squared error"
    return f"{what}: {', '.join(texts)}"


def _cases_table(comparison: Mapping[str, Any]) -> Table:
    methods = list(comparison["methods"])
    floors = all(case["floor"] is not None for case in comparison["cases"])
    key = "ratio_to_floor" if floors else "ratio_to_best"
    rows = []
    for case in comparison["cases"]:
        cells = [_case_text(case)]
        for method in methods:
            block = case["methods"].get(method)
            cells.append("failed" if block is None else interval_text(block[key], digits=3))
        rows.append((*cells, _standing(case)))
    versus = "the noise floor" if floors else "that of the best method"
    words = comparison["definitions"]
    note = (
        f"Medians [5 %, 95 %] over the repeats. Best: {words['best']}. Tied: {words['tied']}. Close: {words['close']}. "
        "In brackets: split, training rows, and the root of the mean squared noise of the held-out rows."
    )
    title = f"Held-out mean squared joint error over all joints, ratio to {versus}"
    return Table(title, ("case", *methods, "best"), tuple(rows), note)


def _case_text(case: Mapping[str, Any]) -> str:
    texts = [case["split"], count_text(case["counts"]["train"] + case["counts"]["validation"], "row")]
    if case["floor"] is not None:
        floor = case["floor"]["median"] ** 0.5
        scale, unit = display_unit(case["unit"], floor)
        texts.append(f"{number_text(floor / scale, 3)} {unit}")
    return f"{case['name']} ({', '.join(texts)})"


def _standing(case: Mapping[str, Any]) -> str:
    """The best method and, if it is another one, the comparison of the watched method with it."""
    block = case["methods"].get(_WATCHED)
    if block is None or block["best"]:
        return str(case["best"])
    words = [word for word in ("tied", "close") if block[word]] or ["behind"]
    ratio = number_text(block["ratio_to_best"]["median"], 3)
    return f"{case['best']}; {_WATCHED} {' and '.join(words)} ({ratio})"


def _methods_table(comparison: Mapping[str, Any]) -> Table:
    rows = []
    for method, block in comparison["methods"].items():
        share = f"{block['best_or_tied']} ({100 * block['share']['best_or_tied']:.0f} %)"
        cells = [method, str(block["cases"]), str(block["best"]), share, str(block["close"])]
        cells += [number_text(block[key], 3) for key in ("typical_ratio_to_best", "seconds")]
        rows.append((*cells, str(block["failed"])))
    columns = ("method", "cases", "best", "best or tied", "close", "ratio", "time [s]", "failed")
    note = (
        "Number of cases. Ratio: its error to the best method's, geometric mean over the cases of the median. Time: of "
        "one repeat, median."
    )
    return Table("How often a method is the best", columns, tuple(rows), note)


def _failures(comparison: Mapping[str, Any]) -> list[str]:
    texts = [f"case '{name}' failed: {sentence}" for name, sentence in comparison["failed"].items()]
    # A learner that is not installed fails alike in every case: reported once.
    where: dict[tuple[str, str], list[str]] = {}
    for case in comparison["cases"]:
        for method, sentence in case["failed_methods"].items():
            where.setdefault((method, sentence), []).append(f"'{case['name']}'")
    for (method, sentence), cases in where.items():
        texts.append(f"{method} failed in {count_text(len(cases), 'case')} ({', '.join(cases)}): {sentence}")
    return texts
