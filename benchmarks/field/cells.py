"""Cells: one entry on one task of one set, one file each, so that a stopped run goes on."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.field.data import Data, Source, load
from benchmarks.field.entries import entry_of
from benchmarks.field.scores import score
from ccnn_torch.errors import CcnnError

Cell = tuple[Source, str, str]
"""Set, task, name of the entry."""


def place_of(out: Path, cell: Cell) -> Path:
    """The file of a cell."""
    entry = re.sub(r"[^\w.-]+", "_", cell[2])
    return out / "cells" / f"{cell[0].name}-{cell[1]}-{entry}.json"


def finished(cells: Sequence[Cell], folder: Path | None, out: Path, jobs: int) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """The cells that are there, then the others as they are done."""
    there = [cell for cell in cells if place_of(out, cell).is_file()]
    for cell in there:
        yield cell, json.loads(place_of(out, cell).read_text(encoding="utf-8"))
    left = [cell for cell in cells if cell not in there]
    if jobs < 2:
        for cell in left:
            yield cell, compute(cell, folder, out)
        return
    # Read where a process starts: one thread each.
    os.environ["OMP_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(compute, cell, folder, out): cell for cell in left}
        for done in as_completed(running):
            yield running[done], done.result()


def compute(cell: Cell, folder: Path | None, out: Path) -> dict[str, Any]:
    """One cell, written as a whole when it is done; an entry that refuses the rows has its sentence there."""
    source, task, name = cell
    data = load(source, folder)
    assert isinstance(data, Data)
    try:
        found = score(data, entry_of(name), task)
    except (CcnnError, ValueError) as problem:
        found = {"failed": f"{type(problem).__name__}: {problem}"}
    place = place_of(out, cell)
    part = place.with_suffix(".part")
    part.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    part.replace(place)
    return found
