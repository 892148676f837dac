"""What judges of drawn machines share: the program as a user calls it, and the table of what each one misses."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from numpy.typing import NDArray

from ccnn_validation.delivered.product import Contestant
from ccnn_validation.delivered.tables import read_commands

__all__ = ["commanded", "judge_machines", "judge_motions"]

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


Motions = dict[str, dict[str, list[float]]]
"""What is missed, four numbers, by contestant and new motion."""


def judge_motions(
    about: str | None,
    judged: Callable[[int, str, Path, list[str]], Motions],
    causes: Sequence[str],
    ours: str,
    form: str,
) -> None:
    """Judge machines in motion, the seeds counted from `--seed`, and print what each contestant misses.

    Args:
        about: of the program.
        judged: seed, cause that is switched off, folder, and contestants of ours, to what is missed.
        causes: that can be switched off.
        ours: contestants of ours where none are asked for, between commas.
        form: of the four numbers of a motion.
    """
    options = argparse.ArgumentParser(description=about)
    options.add_argument("--seed", type=int, required=True)
    options.add_argument("--machines", type=int, default=1)
    options.add_argument("--without", choices=("", *causes), default="", help="a cause that is switched off")
    options.add_argument("--keep", type=Path, help="folder of the files; by default a temporary one")
    options.add_argument("--ours", default=ours)
    given = options.parse_args()
    folder = (given.keep or Path(mkdtemp())).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(given.seed, given.seed + given.machines):
        found = judged(seed, given.without, folder, [name for name in given.ours.split(",") if name])
        for who, kinds in found.items():
            print(f"  {who}: " + "   ".join(f"{kind} {form.format(*four)}" for kind, four in kinds.items()), flush=True)
        (folder / f"{seed}{given.without}.json").write_text(json.dumps(found, indent=1))


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
