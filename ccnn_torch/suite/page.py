"""Comparison of methods over the cases of a suite: `suite.json`, `suite.csv`, `suite.md` and a picture.

Everything is about the held-out mean squared error of the joint deviation, over all joints, repeat by repeat:

* the *best* method of a case has the lowest median over the repeats;
* a method is *tied* with it where the 5 % to 95 % interval, over the repeats, of its error divided by the best
  method's error in the same repeat (same machine, rows, noise) contains 1;
* it is *close* where the median of that ratio is at most 1.05, which is stricter where repeats scatter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccnn_torch.calibration.statistics import spread
from ccnn_torch.files.write import write_whole
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.figures.style import save_figure
from ccnn_torch.report.json_files import write_json
from ccnn_torch.suite.figure import suite_plot
from ccnn_torch.suite.tables import suite_markdown

CLOSE = 1.05
DEFINITIONS = {
    "best": "lowest median, over the repeats, of the held-out mean squared error over all joints",
    "tied": "the 5 % to 95 % interval over the repeats of (its error / the best method's error) contains 1",
    "close": f"the median over the repeats of that ratio is at most {CLOSE}",
}

Block = dict[str, Any]


def compare(
    name: str,
    results: Mapping[str, Mapping[str, Any]],
    about: Mapping[str, Mapping[str, Any]],
    failed: Mapping[str, str],
) -> Block:
    """The content of `suite.json`.

    Args:
        name: of the suite.
        results: content of `results.json` of every case that was run, by name.
        about: description of each case, by name.
        failed: sentence of each case that has no results.
    """
    failed = dict(failed)
    cases: list[Block] = []
    for case, found in results.items():
        if "all" not in found["constant"]["test"]:
            failed[case] = "the joints have different units, so that there is no error over all of them"
        else:
            cases.append({"name": case, **about[case], **_case(found)})
    return {
        "name": name,
        "cases": cases,
        "failed": failed,
        "methods": _summary(cases),
        "definitions": DEFINITIONS,
    }


def _case(results: Mapping[str, Any]) -> Block:
    """Every method of a case against the floor and against the best of them."""
    floor = results["floor"]
    errors = {
        method: block["test"]["all"]["mse"] for method, block in results["methods"].items() if block["test"] is not None
    }
    errors.setdefault("constant", results["constant"]["test"]["all"]["mse"])
    judged = {method: mse for method, mse in errors.items() if mse["median"] is not None}
    best = min(judged, key=lambda method: float(judged[method]["median"]))
    methods: dict[str, Block] = {}
    for method, mse in errors.items():
        run = results["methods"].get(method, {})
        versus = _ratio(mse, errors[best])
        methods[method] = {
            "mse": mse,
            "ratio_to_floor": None if floor is None else _ratio(mse, floor["realised"]["all"]["mse"]),
            "ratio_to_best": versus,
            "best": method == best,
            "tied": method == best or _contains_one(versus),
            "close": versus["median"] is not None and versus["median"] <= CLOSE,
            "seconds": run.get("seconds"),
        }
    return {
        "case": results["case"],
        "unit": results["joints"][0]["unit"],
        "seed": results["seed"],
        "repeats": results["repeats"],
        "counts": results["rows"],
        "floor": None if floor is None else floor["realised"]["all"]["mse"],
        "best": best,
        "methods": methods,
        "failed_methods": {m: b["failed"] for m, b in results["methods"].items() if b["test"] is None},
    }


def _ratio(above: Mapping[str, Any], below: Mapping[str, Any]) -> Block:
    """Spread of the ratio of two errors, repeat by repeat."""
    top, bottom = (np.array(block["values"], dtype=float) for block in (above, below))
    return spread(np.divide(top, bottom, out=np.full_like(top, np.nan), where=bottom > 0))


def _contains_one(ratio: Mapping[str, Any]) -> bool:
    return ratio["median"] is not None and bool(ratio["low"] <= 1 <= ratio["high"])


def _summary(cases: list[Block]) -> dict[str, Block]:
    """How often each method is best, tied with the best, close to it, over the cases that it was run in."""
    names = dict.fromkeys(method for case in cases for method in (*case["methods"], *case["failed_methods"]))
    summary: dict[str, Block] = {}
    for method in names:
        searched = [case for case in cases if method in case["methods"] or method in case["failed_methods"]]
        found = [case["methods"][method] for case in searched if method in case["methods"]]
        counts = {
            "best": sum(block["best"] for block in found),
            "best_or_tied": sum(block["tied"] for block in found),
            "close": sum(block["close"] for block in found),
        }
        versus = [block["ratio_to_best"]["median"] for block in found if block["ratio_to_best"]["median"] is not None]
        seconds = [block["seconds"]["median"] for block in found if block["seconds"]]
        summary[method] = {
            "cases": len(searched),
            "failed": len(searched) - len(found),
            **counts,
            "share": {key: count / len(searched) for key, count in counts.items()},
            "typical_ratio_to_best": float(np.exp(np.mean(np.log(versus)))) if versus and min(versus) > 0 else None,
            "seconds": float(np.median(seconds)) if seconds else None,
        }
    return summary


def write_suite(folder: Path, comparison: Mapping[str, Any]) -> Path:
    """Write `suite.csv`, `suite.md`, `suite.png`, `suite.svg` and, last, `suite.json`; returns the path of the last."""
    header = ("case", "method", "quantity", "unit", "median", "low", "high", "values")
    write_rows(folder / "suite.csv", header, _tidy(comparison))
    write_whole(folder / "suite.md", suite_markdown(comparison))
    if comparison["cases"]:
        save_figure(suite_plot(comparison).figure, folder / "suite")
    path = folder / "suite.json"
    write_json(path, comparison)
    return path


def _tidy(comparison: Mapping[str, Any]) -> Iterator[tuple[str | float | None, ...]]:
    """One row a case, method and quantity, in SI; the values of the repeats in the last column, with spaces."""

    def row(case: str, method: str, quantity: str, unit: str, block: Mapping[str, Any]) -> tuple[Any, ...]:
        values = " ".join("" if v is None else f"{v:.17g}" for v in block["values"])
        return (case, method, quantity, unit, block["median"], block["low"], block["high"], values)

    for case in comparison["cases"]:
        square = f"{case['unit']}^2"
        if case["floor"] is not None:
            yield row(case["name"], "floor", "mse", square, case["floor"])
        for method, block in case["methods"].items():
            yield row(case["name"], method, "mse", square, block["mse"])
            for quantity, unit in (("ratio_to_floor", "1"), ("ratio_to_best", "1"), ("seconds", "s")):
                if block[quantity] is not None:
                    yield row(case["name"], method, quantity, unit, block[quantity])
