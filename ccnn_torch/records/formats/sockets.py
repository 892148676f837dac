"""Folders of a ball that was put into sockets (MUKCa, github.com/platonics-delft/kinematics_calibration).

Each placement of the plate is a folder with `hole_0.csv` and `hole_1.csv`, or the folder itself is the only one: joint
angles in radians, a row each time, without a header. The sockets of the published plate are 50 mm apart.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.errors import InputError
from ccnn_torch.files.read import read_text
from ccnn_torch.records.formats import Keys
from ccnn_torch.records.table import Table

# Bytes of a file; 20 rows have 3 kB.
_LARGEST = 10_000_000
# Between neighbouring sockets [mm].
_APART = 50.0
_HOLE = re.compile(r"hole_(\d+)\.csv")


def read(path: Path, keys: Keys) -> Table:
    """The rows of all placements: `placement`, `socket`, `q1` … and the socket's place on the plate, `x`, `y`, `z`.

    Args:
        path: the folder.
        keys: none.

    Raises:
        InputError: a file is empty, has something else than numbers, or another number of joints than the first.
    """
    there = [*path.glob("hole_*.csv"), *path.glob("*/hole_*.csv")]
    files = sorted((file for file in there if _HOLE.fullmatch(file.name)), key=_order)
    folders = list(dict.fromkeys(file.parent for file in files))
    rows = [_angles(file) for file in files]
    for file, own in zip(files, rows, strict=True):
        if own.shape[1] != rows[0].shape[1]:
            raise InputError(
                f"{file}: has {own.shape[1]} joints, and {files[0]} {rows[0].shape[1]}; give the folder of one arm"
            )
    socket = np.repeat([float(_HOLE.fullmatch(file.name)[1]) for file in files], [len(own) for own in rows])  # type: ignore[index]
    placement = np.repeat([float(folders.index(file.parent)) for file in files], [len(own) for own in rows])
    names = ", ".join(f"{k} is {folder.name}" for k, folder in enumerate(folders))
    values = [placement, socket, *np.concatenate(rows).T, _APART * socket, 0 * socket, 0 * socket]
    units = {"placement": "1", "socket": "1"} | {f"q{i + 1}": "rad" for i in range(rows[0].shape[1])}
    return Table(
        str(path),
        units | {"x": "mm", "y": "mm", "z": "mm"},
        np.stack(values, -1),
        np.concatenate([np.arange(len(own), dtype=np.int64) + 1 for own in rows]),
        parts=tuple((str(file), len(own)) for file, own in zip(files, rows, strict=True)),
        notes=(f"{path}: placement {names}", f"{path}: sockets were taken to be {_APART:g} mm apart"),
    )


def _order(file: Path) -> tuple[str, int]:
    return str(file.parent), int(_HOLE.fullmatch(file.name)[1])  # type: ignore[index]


def _angles(file: Path) -> NDArray[np.float64]:
    lines = [line for line in read_text(file, _LARGEST).split("\n") if line.strip()]
    if not lines:
        raise InputError(f"{file}: the file is empty; write the joint angles [rad] of each time, a row each")
    try:
        return np.loadtxt(lines, delimiter=",", comments=None, ndmin=2)
    except ValueError as reason:
        raise InputError(f"{file}: must hold joint angles [rad] with commas between them alone: {reason}") from None
