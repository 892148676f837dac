"""`ccnn sweep`: the figures of all runs in one table."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.display import number_text
from ccnn_torch.engine import check_engine
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import write_rows
from ccnn_torch.report.results.run import PoseFigures, RunResults
from ccnn_torch.report.screen import note, say_place, stdout
from ccnn_torch.report.table import Table, print_table
from ccnn_torch.study.compare import median_of
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
        "ratio_to_floor[1]": median_of(block.ratio_to_floor),
        **_pose("position", results.pose.position),
        **_pose("rotation", results.pose.rotation),
        "seconds[s]": median_of(block.seconds),
    }


def _pose(kind: str, block: PoseFigures | None) -> Row:
    if block is None:
        return {}
    return {f"{kind}_{when}[{block.unit}]": block[when].rms.median for when in ("before", "after")}


def _cell(value: str | float | None) -> str:
    return value if isinstance(value, str) else number_text(value, 3)


_LONGEST = 80
# Each job is checked before the first one starts, in some milliseconds.
_MOST = 2000


def load_sweep(path: str | Path | None, changes: Iterable[str], out: str | Path) -> Study:
    """Read a config and make a job of every combination of values.

    Args:
        path: the config of a run; None for defaults.
        changes: `key=a,b,c` for a key that varies, `key=value` for all jobs; a list is one value in its brackets.
            `engine=…` is where the jobs run.
        out: folder of the sweep.

    Raises:
        InputError: a change or a job's config cannot be used; names the job.
    """
    every, varied, engine = [], {}, "local"
    for text in changes:
        key, equals, value = text.partition("=")
        options = _split(value)
        if key.strip() == "engine" and equals:
            try:
                engine = check_engine(value.strip())
            except ValueError as problem:
                raise InputError(f"engine: {problem}") from None
        elif len(options) == 1:
            every.append(text)
        elif "" in options or key in varied:
            raise InputError(f"'{text}': " + ("a value is empty" if "" in options else f"{key} is varied twice"))
        else:
            varied[key.strip()] = options
    if not varied:
        raise InputError(
            "name a key that varies, with its values: ccnn sweep CONFIG seed=0,1,2 methods=gp,ccnn --out DIR"
        )
    count = math.prod(len(options) for options in varied.values())
    if count > _MOST:
        product = " x ".join(f"{len(options)} of {key}" for key, options in varied.items())
        raise InputError(
            f"a sweep of {count:,} jobs ({product}): up to {_MOST:,} are taken; give fewer values, or several sweeps"
        )
    values: dict[str, tuple[str, ...]] = {}
    jobs: dict[str, RunConfig] = {}
    for combination in itertools.product(*varied.values()):
        words = [f"{key}={value}" for key, value in zip(varied, combination, strict=True)]
        name = _name(words)
        try:
            config = RunConfig.from_file(path, [*every, *words, f"out={Path(out) / name}", f"name={name}"])
        except InputError as problem:
            raise InputError(f"job {' '.join(words)}: {problem}") from None
        if name in jobs:
            raise InputError(f"job {' '.join(words)} is there twice; give each value once")
        values[name], jobs[name] = combination, config
    return Study("sweep", Path(out), jobs, engine, tuple(varied), values)


def _split(text: str) -> list[str]:
    """Values between commas outside of brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote or letter in "\"'":
            quote = "" if letter == quote else quote or letter
        depth += 0 if quote else (letter in "[{") - (letter in "]}")
        if letter == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _name(words: Sequence[str]) -> str:
    """A folder's name that tells the values; with a hash where it would be too long."""
    text = "_".join(words)
    name = "_".join(re.sub(r"[^\w.]+", "-", word).strip("-.") for word in words)
    return name if len(name) <= _LONGEST else f"{name[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
