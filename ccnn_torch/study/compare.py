"""Several runs side by side, from their `results.json` alone: `ccnn compare`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ccnn_torch.display import display_unit, number_text
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import csv_text, write_whole
from ccnn_torch.report.results.base import Spread, interval_text
from ccnn_torch.report.results.run import Method, RunResults
from ccnn_torch.report.table import Table, markdown_table

_CSV = ("run", "name", "case", "seed", "repeats", "train", "validation", "test", "data_sha256", "method", "best",
        "quantity", "unit", "before", "after", "ratio_to_floor", "seconds")  # fmt: skip


def read_runs(folders: Sequence[Path]) -> dict[str, RunResults]:
    """Results of finished run folders, by folder.

    Raises:
        InputError: a folder holds no finished run.
    """
    return {str(folder): RunResults.read(folder / "results.json") for folder in folders}


def runs_table(runs: Mapping[str, RunResults]) -> Table:
    """One row a run: its best method, pose error before and after, ratio to the floor, seconds.

    Runs are marked by a letter for the rows that they were judged on: only those of one letter are comparable.
    """
    marks = _marks(runs)
    # Of runs of machines that only turn the angles are told.
    turns = all(results.pose.told[0] == "rotation" for results in runs.values())
    kind = "rotation" if turns else "position"
    largest = max(results.pose[kind].before.rms.median or 0.0 for results in runs.values())
    scale, unit = display_unit("rad" if turns else "m", largest)
    rows = []
    for folder, results in runs.items():
        best, error, counts = results.best_method, results.pose[kind], results.rows
        block = results.methods.get(best or "") or Method(test=None)
        rows.append(
            (
                f"{results.name} ({Path(folder).name})" if Path(folder).name != results.name else results.name,
                marks[folder],
                f"{counts.train + counts.validation} + {counts.test}",
                _method_text(results),
                *(interval_text(error[when].rms, scale, 3) for when in ("before", "after")),
                interval_text(block.ratio_to_floor, digits=3),
                interval_text(block.seconds, digits=3),
            )
        )
    columns = ("run", "test rows", "rows", "method", f"before [{unit}]", f"after [{unit}]", "to floor", "time [s]")
    note = f"Before and after: RMS {kind} error on the test rows. Rows: trained on + tested on."
    if len(set(marks.values())) > 1:
        note += " Runs with different letters were judged on different test rows: their figures are not comparable."
    return Table("Runs", columns, rows, note, words=("test rows", "method"), details=("rows",))


def runs_csv(runs: Mapping[str, RunResults]) -> str:
    """Every method of every run as one row, in SI, with 17 significant digits."""
    rows: list[Sequence[object]] = [_CSV]
    for folder, results in runs.items():
        about = [folder, results.name, results.case or "", results.seed, results.repeats]
        about += [results.rows[part] for part in ("train", "validation", "test")]
        about.append(results.data_sha256 or "")
        for method, block in results.methods.items():
            for kind, pose in results.pose:
                left = block.pose.get(kind)
                if pose is None or left is None:
                    continue
                figures = [pose.before.rms, left.rms, block.ratio_to_floor, block.seconds]
                best = int(method == results.best_method)
                rows.append([*about, method, best, f"{kind}_rms", pose.unit, *map(median_of, figures)])
    return csv_text(rows)


def write_runs(path: Path, runs: Mapping[str, RunResults]) -> None:
    """Write the table as .csv or .md, by what the name ends in.

    Raises:
        InputError: it ends in something else.
    """
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".md"):
        raise InputError(f"--out {path}: write a name that ends in .csv or .md")
    text = runs_csv(runs) if suffix == ".csv" else markdown_table(runs_table(runs)) + "\n"
    write_whole(path, text.encode())


def _marks(runs: Mapping[str, RunResults]) -> dict[str, str]:
    """A letter for each set of test rows: data, seed and repeats, split, and how many rows are in each part.

    The figures before compensation identify the split, which `results.json` does not name: they are those of the test
    rows alone.
    """
    keys: dict[tuple[Any, ...], str] = {}
    found = {}
    for folder, results in runs.items():
        before = {name: block.spread for name, block in results.before.items()}
        key = (results.data_sha256, results.rows.test, _number_key(before))
        found[folder] = keys.setdefault(key, _letter(len(keys)))
    return found


def _number_key(before: Mapping[str, Mapping[str, Spread]]) -> str:
    """Figures as text with 9 digits, so that sums in another order compare equal."""
    return " ".join(
        f"{joint} {quantity} {number_text(spread['median'], 9)}"
        for joint, block in before.items()
        for quantity, spread in block.items()
    )


def _letter(number: int) -> str:
    return chr(ord("A") + number) if number < 26 else str(number + 1)


def _method_text(results: RunResults) -> str:
    """The best method, of how many, and with what beside it."""
    trained = sum(block.test is not None for block in results.methods.values())
    of = f" (best of {trained})" if trained > 1 else ""
    identified = results.geometry is not None and results.geometry.chosen == "identify"
    geometry = "geometry + " if identified else ""
    return f"{geometry}{results.best_method}{of}"


def median_of(spread: Spread | None) -> float | None:
    """The median; None where there is no figure."""
    return None if spread is None else spread.median
