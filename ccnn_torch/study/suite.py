"""Comparison of methods over the cases of a suite: `suite.json`, `suite.csv` and `suite.md`.

Everything is about the held-out mean squared error of the joint deviation, over all joints, repeat by repeat:

* the *best* method of a case has the lowest median over the repeats;
* a method is *tied* with it where the 5 % to 95 % interval, over the repeats, of its error divided by the best
  method's error in the same repeat (same machine, rows, noise) contains 1;
* it is *close* where the median of that ratio is at most 1.05, which is stricter where repeats scatter.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.statistics import ratio
from ccnn_torch.config.tree import apply_overrides, resolve_paths, validated
from ccnn_torch.display import count_text, number_text, with_unit
from ccnn_torch.engine import Engine
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import write_rows, write_whole
from ccnn_torch.files.yaml_file import read_yaml
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.page import Page, Section
from ccnn_torch.report.results.base import Spread, interval_text
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.report.results.suite import Case, Standing, SuiteResults, Summary
from ccnn_torch.report.screen import say_place, stdout
from ccnn_torch.report.table import Table
from ccnn_torch.study.runs import Study, run_study

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
    """Write `suite.csv`, `suite.md` and, last, `suite.json`; returns the path of the last."""
    header = ("case", "method", "quantity", "unit", "median", "low", "high", "values")
    write_rows(folder / "suite.csv", header, _long_table(comparison))
    write_whole(folder / "suite.md", suite_page(comparison).markdown())
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


# Keys of the suite itself, where they come from the command line.
_OWN = ("name", "out", "engine")

# Both take longer than many cases; a suite is for the comparison.
_DEFAULTS = {"save_models": False, "save_report": False}


class SuiteFile(BaseModel):
    """The form of a suite's file."""

    model_config = ConfigDict(extra="forbid", frozen=True, coerce_numbers_to_str=True)

    name: str = Field(default="suite", min_length=1, description="name of the suite; default: the file's name")
    out: str | None = Field(default=None, description="folder to write; default runs/NAME")
    engine: Engine = Field(
        default="local", description="where the cases run: local, processes, dask, or a scheduler as tcp://HOST:8786"
    )
    base: dict[str, Any] = Field(default_factory=dict, description="keys that all cases share, as in a config of a run")
    cases: list[dict[str, Any]] = Field(
        default=[],
        validate_default=True,
        min_length=1,
        description="a name each, and the keys in which it differs from base",
    )


def load_suite(path: str | Path, overrides: Iterable[str] = ()) -> Study:
    """Read a suite's file and put overrides over every case.

    A case is `base` with the case's keys over it (sections are merged, lists replaced), then the overrides. `name=…`
    and `out=…` are those of the suite. Model files, plots and reports of the cases are not written unless the keys
    `save_models: true`, `save_report: true` say so.

    Raises:
        InputError: the file, a case or an override cannot be used; names the case.
    """
    path = Path(path)
    tree = read_yaml(path)
    tree.setdefault("name", path.stem)
    resolve_paths(tree, Path(os.path.realpath(path.parent)))
    overrides = list(overrides)
    own = [text for text in overrides if text.partition("=")[0].strip() in _OWN]
    given = apply_overrides(tree, own, Path.cwd())
    file = validated(SuiteFile, tree, str(path), given)
    out = Path(file.out) if file.out else Path("runs") / file.name
    others = [text for text in overrides if text not in own]
    cases: dict[str, RunConfig] = {}
    for number, keys in enumerate(file.cases, 1):
        name = _name(keys, f"{path}: case {number}", cases)
        case = _merged(_DEFAULTS, _merged(file.base, keys)) | {"name": name}
        resolve_paths(case, Path(os.path.realpath(path.parent)))
        changed = apply_overrides(case, others, Path.cwd())
        cases[name] = validated(RunConfig, case | {"out": str(out / name)}, f"{path}, case '{name}'", changed)
    return Study(file.name, out, cases, file.engine)


def _name(keys: Mapping[str, Any], where: str, taken: Iterable[str]) -> str:
    name = keys.get("name")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][\w.-]*", name):
        raise InputError(f"{where}: name: must be letters, digits, '-', '_' and '.', it names a folder; not {name!r}")
    if name in taken:
        raise InputError(f"{where}: name: '{name}' is given twice; give each case its own")
    return name


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """One tree over another: sections are merged, all else is replaced."""
    tree = deepcopy(dict(base))
    for key, value in over.items():
        below = tree.get(key)
        both = isinstance(below, dict) and isinstance(value, dict)
        tree[key] = _merged(below, value) if both else deepcopy(value)  # type: ignore[arg-type]
    return tree


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
        texts.append(with_unit(case.floor.median**0.5, case.unit))
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
