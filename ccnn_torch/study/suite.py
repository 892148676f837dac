"""Comparison of methods over the cases of a suite: `suite.json`, `suite.csv`, `suite.md` and a picture.

Everything is about the held-out mean squared error of the joint deviation, over all joints, repeat by repeat:

* the *best* method of a case has the lowest median over the repeats;
* a method is *tied* with it where the 5 % to 95 % interval, over the repeats, of its error divided by the best
  method's error in the same repeat (same machine, rows, noise) contains 1;
* it is *close* where the median of that ratio is at most 1.05, which is stricter where repeats scatter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.statistics import ratio
from ccnn_torch.files.write import write_whole
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.figures.style import save_figure
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.base import Spread
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.report.results.suite import Case, Standing, SuiteResults, Summary
from ccnn_torch.report.screen import say_place, stdout
from ccnn_torch.study.runs import Study, run_study
from ccnn_torch.study.suite_figure import suite_plot
from ccnn_torch.study.suite_page import suite_page

CLOSE = 1.05
DEFINITIONS = {
    "best": "lowest median, over the repeats, of the held-out mean squared error over all joints",
    "tied": "the 5 % to 95 % interval over the repeats of (its error / the best method's error) contains 1",
    "close": f"the median over the repeats of that ratio is at most {CLOSE}",
}


def run_suite(suite: Study, quiet: bool = False) -> Path:
    """Run the cases of a suite, as `run_study`, and compare the methods over all of them.

    A case in which no method can be trained is reported and left out of the comparison; the next call tries it again.

    Returns:
        The path of `suite.json`.
    """
    return run_study(suite, partial(_write, quiet=quiet), quiet)


def _write(suite: Study, results: Mapping[str, RunResults], failed: Mapping[str, str], quiet: bool) -> Path:
    comparison = compare(suite.name, results, suite.runs, failed)
    if not quiet:
        suite_page(comparison).show(stdout)
    path = write_suite(suite.out, comparison)
    if not quiet:
        say_place(f"Everything is in {suite.out}")
    return path


def compare(
    name: str, results: Mapping[str, RunResults], configs: Mapping[str, RunConfig], failed: Mapping[str, str]
) -> SuiteResults:
    """The results of a suite.

    Args:
        name: of the suite.
        results: of every case that was run, by name.
        configs: of each case, by name.
        failed: sentence of each case that has no results.
    """
    failed = dict(failed)
    cases = []
    for case, found in results.items():
        if found.constant.mse is None:
            failed[case] = "the joints have different units, so that there is no error over all of them"
        else:
            cases.append(_case(case, configs[case], found, found.constant.mse))
    return SuiteResults(name=name, cases=cases, failed=failed, methods=_summary(cases), definitions=DEFINITIONS)


def _case(name: str, config: RunConfig, results: RunResults, constant: Spread) -> Case:
    """Every method of a case against the floor and against the best of them."""
    about: dict[str, Any] = config.realistic.model_dump() if config.case == "realistic" else {}
    floor = None if results.floor is None else results.floor.realised["all"].mse
    errors = {method: block.mse for method, block in results.methods.items() if block.mse is not None}
    errors.setdefault("constant", constant)
    judged = {method: mse.median for method, mse in errors.items() if mse.median is not None}
    best = min(judged, key=lambda method: judged[method])
    methods = {}
    for method, mse in errors.items():
        versus = ratio(mse, errors[best])
        tied = versus.low is not None and versus.high is not None and versus.low <= 1 <= versus.high
        methods[method] = Standing(
            mse=mse,
            ratio_to_floor=None if floor is None else ratio(mse, floor),
            ratio_to_best=versus,
            best=method == best,
            tied=method == best or tied,
            close=versus.median is not None and versus.median <= CLOSE,
            seconds=results.methods[method].seconds if method in results.methods else None,
        )
    return Case(
        name=name,
        split=config.split.kind,
        **about,
        case=results.case,
        unit=results.joints[0].unit,
        seed=results.seed,
        repeats=results.repeats,
        counts=results.rows,
        floor=floor,
        best=best,
        methods=methods,
        failed_methods={m: b.failed or "" for m, b in results.methods.items() if b.test is None},
    )


def _summary(cases: list[Case]) -> dict[str, Summary]:
    """How often each method is best, tied with the best, close to it, over the cases that it was run in."""
    summary = {}
    for method in dict.fromkeys(method for case in cases for method in (*case.methods, *case.failed_methods)):
        found = [case.methods[method] for case in cases if method in case.methods]
        asked = len(found) + sum(method in case.failed_methods for case in cases)
        counts = {
            "best": sum(block.best for block in found),
            "best_or_tied": sum(block.tied for block in found),
            "close": sum(block.close for block in found),
        }
        versus = [block.ratio_to_best.median for block in found if block.ratio_to_best.median is not None]
        seconds = [block.seconds.median or 0.0 for block in found if block.seconds is not None]
        summary[method] = Summary(
            cases=asked,
            failed=asked - len(found),
            **counts,
            share={key: count / asked for key, count in counts.items()},
            typical_ratio_to_best=float(np.exp(np.mean(np.log(versus)))) if versus and min(versus) > 0 else None,
            seconds=float(np.median(seconds)) if seconds else None,
        )
    return summary


def write_suite(folder: Path, comparison: SuiteResults) -> Path:
    """Write `suite.csv`, `suite.md`, `suite.png`, `suite.svg` and, last, `suite.json`; returns the path of the last."""
    header = ("case", "method", "quantity", "unit", "median", "low", "high", "values")
    write_rows(folder / "suite.csv", header, _long_table(comparison))
    write_whole(folder / "suite.md", suite_page(comparison).markdown())
    if comparison.cases:
        save_figure(suite_plot(comparison).figure, folder / "suite")
    path = folder / "suite.json"
    write_json(path, comparison)
    return path


def _long_table(comparison: SuiteResults) -> Iterator[tuple[str | float | None, ...]]:
    """One row a case, method and quantity, in SI; the values of the repeats in the last column, with spaces."""
    for case in comparison.cases:
        square = f"{case.unit}^2"
        figures = [("floor", "mse", square, case.floor)]
        for method, block in case.methods.items():
            figures.append((method, "mse", square, block.mse))
            for quantity, unit in (("ratio_to_floor", "1"), ("ratio_to_best", "1"), ("seconds", "s")):
                figures.append((method, quantity, unit, block[quantity]))
        for *about, spread in figures:
            if spread is not None:
                values = " ".join("" if v is None else f"{v:.17g}" for v in spread.values)
                yield (case.name, *about, spread.median, spread.low, spread.high, values)
