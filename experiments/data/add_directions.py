"""Add to records of an arm, measured step by step, the direction in which each joint came to its pose.

    python experiments/data/add_directions.py PATH/TO/wam_tracker/records.csv experiments/data/wam.csv

The rows of one `set` follow each other by `step`. A joint that stood still keeps its last direction.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from ccnn_torch.records import read_table


def add_directions(source: Path, target: Path) -> None:
    """Write joints [deg], the measured position [mm], directions and the set of every row, in the order measured."""
    table = read_table(source)
    order = np.lexsort((table.raw("step"), table.raw("set")))
    joints = np.stack([table.raw(name)[order] for name in table.names if name[0] == "q" and name[1:].isdigit()], -1)
    first = np.flatnonzero(np.diff(table.raw("set")[order], prepend=-1))
    way = np.sign(np.diff(joints, axis=0, prepend=joints[:1]))
    way[first] = 1
    for row in np.flatnonzero((way == 0).any(-1)):
        way[row] = np.where(way[row] == 0, way[row - 1], way[row])
    header = [f"q{k + 1}[deg]" for k in range(joints.shape[1])] + ["x[mm]", "y[mm]", "z[mm]"]
    header += [f"direction{k + 1}[1]" for k in range(joints.shape[1])] + ["set[1]"]
    lines = [",".join(header)]
    position = np.stack([table.raw(name)[order] for name in "xyz"], -1)
    numbers = zip(joints, position, way.astype(int), table.raw("set")[order].astype(int), strict=True)
    for q, x, d, number in numbers:
        lines.append(",".join([*(f"{v:.6f}" for v in (*q, *x)), *map(str, d), str(number)]))
    target.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(f"usage: python {sys.argv[0]} SOURCE.csv TARGET.csv")
    add_directions(Path(sys.argv[1]), Path(sys.argv[2]))
