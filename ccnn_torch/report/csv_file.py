"""`results.csv`: every figure of `results.json` as one tidy row, in SI; and how all tables of figures are written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ccnn_torch.files.write import csv_text, write_whole

HEADER = ("method", "split", "quantity", "joint", "unit", "median", "low", "high")
Row = tuple[str, str, str, str, str, float | None, float | None, float | None]


def tidy_rows(results: Mapping[str, Any]) -> Iterator[Row]:
    """Yield (method, split, quantity, joint, unit, median, low, high); `joint` is empty where it means nothing."""
    units = {joint["name"]: joint["unit"] for joint in results["joints"]}
    units["all"] = next(iter(units.values()))

    def row(method: str, split: str, quantity: str, joint: str, unit: str, spread: Mapping[str, Any]) -> Row:
        return (method, split, quantity, joint, unit, spread["median"], spread["low"], spread["high"])

    for split, key in (("train", "before_train"), ("test", "before")):
        for joint, block in (results.get(key) or {}).items():
            for quantity, spread in block["spread"].items():
                yield row("before", split, quantity, joint, units[joint], spread)
    blocks: dict[str, Mapping[str, Any] | None] = {name: m["test"] for name, m in results["methods"].items()}
    blocks["constant"] = blocks.get("constant") or results["constant"]["test"]
    for kind, floor in (results["floor"] or {}).items():
        blocks[f"floor_{kind}"] = floor
    for method, errors in blocks.items():
        for joint, measures in (errors or {}).items():
            for quantity, spread in measures.items():
                unit = units[joint] if quantity == "mae" or units[joint] == "1" else f"{units[joint]}^2"
                yield row(method, "test", quantity, joint, unit, spread)
    trained = {name: block for name, block in results["methods"].items() if block["test"] is not None}
    for method, block in {"constant": results["constant"], **trained}.items():
        for quantity, split, unit in (
            ("ratio_to_floor", "test", "1"),
            ("coverage", "test", "1"),
            ("seconds", "", "s"),
            ("evaluations", "", "1"),
            ("converged", "", "1"),
        ):
            if block.get(quantity):
                yield row(method, split, quantity, "", unit, block[quantity])
        for joint, spread in (block.get("sd") or {}).items():
            yield row(method, "test", "sd", joint, units[joint], spread)
        for name, left in (block.get("pose") or {}).items():
            # That of the best method is written below, with the error before compensation.
            if left and method != results.get("best_method"):
                for measure in ("rms", "max"):
                    yield row(method, "test", f"{name}_{measure}", "", left["unit"], left[measure])
    for name, block in results["pose"].items():
        for when in ("before", "after", "explained", "geometry", "effects", "not_compensable"):
            for measure, spread in ((block or {}).get(when) or {}).items():
                method = (results.get("best_method") or "") if when == "after" else when
                yield row(method, "test", f"{name}_{measure}", "", block["unit"], spread)


def write_csv(path: str | Path, results: Mapping[str, Any]) -> None:
    """Write `results.csv`; numbers have 17 significant digits, an unknown one is empty."""
    write_rows(path, HEADER, tidy_rows(results))


def write_rows(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[str | float | None]]) -> None:
    """Write a CSV file; numbers have 17 significant digits, None is an empty cell.

    Raises:
        WriteError: it cannot be written.
    """
    write_whole(path, csv_text([header, *rows]))
