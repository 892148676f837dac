"""Choose about 500 rows of records: whole target poses, drawn with a fixed seed, in the order measured.

    python experiments/data/choose_rows.py PATH/TO/ur10_b/records.csv experiments/data/ur10_b_500.csv

The lines are copied as they stand. Rows share a target pose when their `goal_*` columns agree to 5 mm and 0.01 rad.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from ccnn_torch.records import read_table

GOAL = {"goal_x": 0.005, "goal_y": 0.005, "goal_z": 0.005, "goal_rx": 0.01, "goal_ry": 0.01, "goal_rz": 0.01}


def choose_rows(source: Path, target: Path, rows: int = 500, seed: int = 0) -> None:
    """Copy the header and the first whole target poses of a random order that make up at least `rows` rows."""
    table = read_table(source)
    keys = np.stack([np.round(table.column(name) / step) for name, step in GOAL.items()], axis=1)
    _, group, size = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    order = np.random.default_rng(seed).permutation(len(size))
    enough = int(np.searchsorted(np.cumsum(size[order]), rows)) + 1
    chosen = np.isin(group.reshape(-1), order[:enough])
    lines = source.read_text(encoding="utf-8").splitlines()
    kept = [lines[0], *(lines[number - 1] for number in table.lines[chosen])]
    target.write_text("\n".join(kept) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(f"usage: python {sys.argv[0]} SOURCE.csv TARGET.csv")
    choose_rows(Path(sys.argv[1]), Path(sys.argv[2]))
