"""`ccnn sweep`: run the jobs of a sweep, and put their figures into one table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ccnn_torch.calibration.calibrate import makers
from ccnn_torch.display import number_text
from ccnn_torch.files.write import sweep as clean
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.report.table import Table, print_table
from ccnn_torch.run_folder.folder import locked, resume_hint
from ccnn_torch.suite.job import check_folder, finish_cases
from ccnn_torch.sweep.config import Sweep

_FIGURES = (
    *("best_method", "joint_mse", "joint_mse_low", "joint_mse_high", "joint_unit", "ratio_to_floor[1]"),
    *("position_before[m]", "position_after[m]", "rotation_before[rad]", "rotation_after[rad]", "seconds[s]", "failed"),
)
_SHOWN = ("best_method", "joint_mse", "position_before[m]", "position_after[m]")
Row = dict[str, str | float | None]


def run_sweep(sweep: Sweep, quiet: bool = False) -> tuple[Path, list[Row]]:
    """Run the jobs that are not finished yet; each is an ordinary run folder, and a second call keeps it.

    Returns:
        The path of `sweep.csv`, and its rows: of each job the keys and figures.

    Raises:
        InputError: a job cannot be run, its folder holds another run, or the folder is in use.
        MethodFailedError: not a single job could be run.
    """
    for config in sweep.jobs.values():
        makers(config)
        check_folder(config)
    with locked(sweep.out):
        clean(sweep.out, below=False)
        results, failed = finish_cases(sweep.jobs, sweep.engine, quiet)
        rows = list(sweep_rows(sweep, results, failed))
        path = sweep.out / "sweep.csv"
        with resume_hint("the same command"):
            write_rows(path, tuple(rows[0]), (tuple(row.values()) for row in rows))
    if not quiet:
        cells = tuple(tuple(_cell(row[key]) for key in ("job", *_SHOWN)) for row in rows)
        print_table(
            Table("Jobs", ("job", *_SHOWN), cells, "Medians over the repeats of a job, on held-out rows."), stdout
        )
        for name, sentence in failed.items():
            note(f"job {name} failed: {sentence}", quiet)
        say_place(f"Everything is in {sweep.out}; curves: tensorboard --logdir {sweep.out}")
    return path, rows


def sweep_rows(sweep: Sweep, results: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str]) -> Iterator[Row]:
    """A row for each job: its name, the keys that vary, and medians over its repeats, in SI."""
    for name, values in sweep.values.items():
        row: Row = {"job": name, **dict(zip(sweep.keys, values, strict=True)), **dict.fromkeys(_FIGURES)}
        yield row | (_figures(results[name]) if name in results else {"failed": failed[name]})


def _figures(results: Mapping[str, Any]) -> Row:
    best = results["best_method"]
    block, position, rotation = results["methods"][best], results["pose"]["position"], results["pose"]["rotation"]
    # Joints of different units have no error together; the first one stands for them.
    joint = results["joints"][0]
    mse = block["test"].get("all", block["test"][joint["name"]])["mse"]
    ratio = block["ratio_to_floor"]
    median = partial(_median, "rms")
    return {
        "best_method": best,
        "joint_mse": mse["median"],
        "joint_mse_low": mse["low"],
        "joint_mse_high": mse["high"],
        "joint_unit": f"{joint['unit']}^2",
        "ratio_to_floor[1]": None if ratio is None else ratio["median"],
        "position_before[m]": median(position["before"]),
        "position_after[m]": median(position["after"]),
        "rotation_before[rad]": None if rotation is None else median(rotation["before"]),
        "rotation_after[rad]": None if rotation is None else median(rotation["after"]),
        "seconds[s]": block["seconds"]["median"],
    }


def _median(key: str, block: Mapping[str, Any]) -> float | None:
    value: float | None = block[key]["median"]
    return value


def _cell(value: str | float | None) -> str:
    return value if isinstance(value, str) else number_text(value, 3)
