"""`ccnn sweep`: the figures of all runs in one table."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from ccnn_torch.display import number_text
from ccnn_torch.report.csv_file import write_rows
from ccnn_torch.report.results.base import Spread
from ccnn_torch.report.results.run import PoseFigures, RunResults
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.report.table import Table, print_table
from ccnn_torch.study.runs import Study, run_study

_FIGURES = (
    *("best_method", "joint_mse", "joint_mse_low", "joint_mse_high", "joint_unit", "ratio_to_floor[1]"),
    *("position_before[m]", "position_after[m]", "rotation_before[rad]", "rotation_after[rad]", "seconds[s]", "failed"),
)
_SHOWN = ("job", "best_method", "joint_mse", "position_before[m]", "position_after[m]")
Row = dict[str, str | float | None]


def run_sweep(sweep: Study, quiet: bool = False) -> tuple[Path, list[Row]]:
    """Run the jobs of a sweep, as `run_study`.

    Returns:
        The path of `sweep.csv`, and its rows: of each job the keys and figures, medians over its repeats in SI.
    """
    return run_study(sweep, partial(_write, quiet=quiet), quiet)


def _write(
    sweep: Study, results: Mapping[str, RunResults], failed: Mapping[str, str], quiet: bool
) -> tuple[Path, list[Row]]:
    rows: list[Row] = []
    for name, values in sweep.values.items():
        figures: Row = _figures(results[name]) if name in results else {"failed": failed[name]}
        rows.append({"job": name, **dict(zip(sweep.keys, values, strict=True)), **dict.fromkeys(_FIGURES), **figures})
    path = sweep.out / "sweep.csv"
    write_rows(path, tuple(rows[0]), (tuple(row.values()) for row in rows))
    if not quiet:
        cells = tuple(tuple(_cell(row[key]) for key in _SHOWN) for row in rows)
        print_table(Table("Jobs", _SHOWN, cells, "Medians over the repeats of a job, on held-out rows."), stdout)
        for name, sentence in failed.items():
            note(f"job {name} failed: {sentence}", quiet)
        say_place(f"Everything is in {sweep.out}; curves: tensorboard --logdir {sweep.out}")
    return path, rows


def _figures(results: RunResults) -> Row:
    best = results.best_method or ""
    block = results.methods[best]
    assert block.test is not None
    # Joints of different units have no error together; the first one stands for them.
    joint = results.joints[0]
    mse = block.test.get("all", block.test[joint.name]).mse
    return {
        "best_method": best,
        "joint_mse": mse.median,
        "joint_mse_low": mse.low,
        "joint_mse_high": mse.high,
        "joint_unit": f"{joint.unit}^2",
        "ratio_to_floor[1]": _median(block.ratio_to_floor),
        **_pose("position", results.pose.position),
        **_pose("rotation", results.pose.rotation),
        "seconds[s]": _median(block.seconds),
    }


def _median(spread: Spread | None) -> float | None:
    return None if spread is None else spread.median


def _pose(kind: str, block: PoseFigures | None) -> Row:
    if block is None:
        return {}
    return {f"{kind}_{when}[{block.unit}]": block[when].rms.median for when in ("before", "after")}


def _cell(value: str | float | None) -> str:
    return value if isinstance(value, str) else number_text(value, 3)
