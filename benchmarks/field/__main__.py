"""The command: every entry on every split of every set, one file for each cell, so that a stopped run goes on.

python -m benchmarks.field                                    # what is shipped: UR10 b, UR5, WAM
python -m benchmarks.field --data FOLDER --out runs/field
python -m benchmarks.field --only ur10_b,random,scipy_geometry
python -m benchmarks.field --entry my_method.py:fit --only ur5
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.field.cells import Cell, finished
from benchmarks.field.data import Data, load, sources
from benchmarks.field.entries import ENTRIES, entry_of
from benchmarks.field.page import write_results
from benchmarks.field.scores import INJECTION, REPLICATES, tasks
from ccnn_torch.errors import InputError


def main(arguments: Sequence[str]) -> int:
    """Run the cells that are not there yet and write the table; 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.field", description=__doc__)
    parser.add_argument("--data", type=Path, help="folder with a folder of records.csv and nominal.yaml for each set")
    parser.add_argument("--out", type=Path, default=Path("runs/field"), help="folder to write, and to go on in")
    parser.add_argument("--only", default="", help="names of sets, splits, entries; of a kind without a name all")
    parser.add_argument("--entry", action="append", default=[], help="one more entry, path/to/file.py:NAME")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    given = parser.parse_args(arguments)
    try:
        return _run(given)
    except InputError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 2


def _run(given: argparse.Namespace) -> int:
    if given.data is not None and not given.data.is_dir():
        raise InputError(f"--data {given.data}: is no folder; give one that holds a folder for each set")
    names = [*ENTRIES, *given.entry]
    entries = {name: entry_of(name) for name in names}
    wanted = [name for name in given.only.split(",") if name]
    known = {s.name for s in sources(given.data)}
    for name in wanted:
        if name not in {*known, *names, *_TASKS}:
            kinds = f"set ({', '.join(sorted(known))}), split ({', '.join(_TASKS)}) or entry ({', '.join(names)})"
            raise InputError(f"--only {name}: is no {kinds}")
    sets: dict[str, Data] = {}
    notes = []
    for source in sources(given.data):
        if _is_in(source.name, known, wanted):
            loaded = load(source, given.data)
            if isinstance(loaded, str):
                notes.append(loaded)
                print(loaded)
            else:
                sets[source.name] = loaded
    cells = [
        (data.source, task, name)
        for data in sets.values()
        for name in names
        if _is_in(name, {*names}, wanted)
        for task in tasks(data, entries[name])
        if _is_in(task, {*_TASKS}, wanted)
    ]
    (given.out / "cells").mkdir(parents=True, exist_ok=True)
    results: dict[Cell, dict[str, Any]] = {}
    for cell, found in finished(cells, given.data, given.out, given.jobs):
        results[cell] = found
        print(f"{len(results)}/{len(cells)} {cell[0].name} {cell[1]} {cell[2]}: {_said(found)}", flush=True)
    ordered = [(cell[0].name, *cell[1:], results[cell]) for cell in cells]
    about = {name: entry.about for name, entry in entries.items()}
    write_results(given.out, ordered, {name: data.source for name, data in sets.items()}, about, notes)
    print(f"{given.out}/table.md, table.json, errors.png")
    return 0


_TASKS = ("random", "target", "block", "placement", "day", "published", REPLICATES, INJECTION)


def _is_in(name: str, kind: set[str], wanted: Sequence[str]) -> bool:
    """Whether a name of a kind is wanted: all are where none of the kind is."""
    return name in wanted or not kind & {*wanted}


def _said(found: dict[str, Any]) -> str:
    if "position" in found:
        return f"{1e6 * found['position']:.0f} um in {found['seconds']:.1f} s of processor time"
    return str(found.get("failed", ", ".join(f"{c}: {v['named']}" for c, v in found.get("causes", {}).items())))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
