"""What judges of drawn machines share: the program as a user calls it, and the table of what each one misses."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ccnn_validation.delivered.product import Contestant
from ccnn_validation.delivered.tables import read_commands

__all__ = ["commanded", "judge_machines"]

Array = NDArray[np.float64]


def commanded(
    folder: Path,
    machine: str,
    records: tuple[str, Array],
    targets: tuple[str, Array],
    command: str = "run",
    config: str = "mechanism: machine.yaml\n",
    file: str = "machine.yaml",
    flags: str = "",
) -> Array | None:
    """Commands by the file that a calibration writes, `s x n` [SI]; None where there are none.

    Args:
        folder: to write into.
        machine: text of its file.
        records, targets: header and rows.
        command: `run` or `identify`.
        config: lines of the config beside its records.
        file: name of the machine's file.
        flags: of the call that writes the commands.
    """
    for name, (header, rows) in (("rows.csv", records), ("targets.csv", targets)):
        np.savetxt(folder / name, rows, "%.12g", ",", header=header, comments="")
    (folder / file).write_text(machine)
    (folder / "config.yaml").write_text(f"records: rows.csv\n{config}")
    contestant = Contestant(folder, command)
    contestant.call(command, "config.yaml", f"out={command}", "save_report=false")
    model = {"run": "model.safetensors", "identify": "identified.yaml"}[command]
    contestant.call("compensate", f"{command}/{model}", "targets.csv", f"{command}.csv", *flags.split())
    path, joints = folder / f"{command}.csv", sum(column.startswith("q") for column in targets[0].split(","))
    return read_commands(path, joints).joints if path.is_file() else None


def judge_machines(about: str | None, judged: Callable[[int, int], dict[str, float]], rows: int) -> None:
    """Judge machines, the seeds counted from `--seed`, and print what each contestant misses [µm].

    Args:
        about: of the program.
        judged: seed and rows to what is missed [m], by who calibrated the machine.
        rows: measured rows where none are asked for.
    """
    options = argparse.ArgumentParser(description=about)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=4)
    options.add_argument("--rows", type=int, default=rows)
    given = options.parse_args()
    found = {str(seed): judged(seed, given.rows) for seed in range(given.seed, given.seed + given.machines)}
    every = list(found.values())
    found["median"] = {who: float(np.median([one[who] for one in every])) for who in every[0]}
    for name, one in found.items():
        print(f"{name} [µm]: " + "   ".join(f"{who} {1e6 * value:.2f}" for who, value in one.items()))
