"""`python -m benchmarks [NAME ...] [--quick] [--model FOLDER] [--out DIR]`: measure, and write table and growth curves.

Writes DIR/table.json, DIR/table.md and DIR/growth.png; the default of DIR is a folder `runs/benchmarks` beside the
checkout's other runs. `--out benchmarks/results` renews the table that the site shows. `--quick` takes about a minute.
"""

from __future__ import annotations

import argparse
import importlib
import time
from pathlib import Path

import torch

from benchmarks.measure import Row
from benchmarks.table import write_results

# Each is a module of this folder with `run(quick, model)`, which yields rows.
NAMES = (
    "fitness", "generation", "training", "bp_lm", "gp", "identification", "planning", "diagnosis", "motion", "command",
    "targets", "start",
)  # fmt: skip


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[[], *NAMES], metavar="NAME", help=f"of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help="smaller sizes, a minute in all")
    parser.add_argument("--model", type=Path, default=Path(__file__).parent.parent / "checkpoints" / "tripod")
    parser.add_argument("--out", type=Path, default=Path("runs") / "benchmarks")
    given = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, list[Row]] = {}
    for name in given.names or NAMES:
        began = time.perf_counter()
        found[name] = list(importlib.import_module(f"benchmarks.{name}").run(given.quick, given.model))
        print(f"{name}: {len(found[name])} rows, {time.perf_counter() - began:.0f} s", flush=True)
    write_results(given.out, found, given.quick)
    print((given.out / "table.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
