"""Measured rows of the robots, and their nominal arms."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import parse_yaml

from .arm import Arm
from .frames import Seen, see
from .kinds import Floats

__all__ = ["ROBOTS", "Robot", "robot_of"]

# The first one is in the repository, so that seed 0 needs no other data.
ROBOTS = ("ur10_b", "ur10_a", "ur5_tracker", "wam_tracker")


@dataclass(frozen=True)
class Robot:
    """All rows of one robot that may be drawn.

    Attributes:
        name: of `ROBOTS`.
        text: its geometry file.
        joints: `s x n` [rad].
        position: in the tracker's frame, `s x 3` [m].
        turn: rotation vectors, `s x 3` [rad]; None where the tracker gives positions alone.
        direction: sign of the way of each joint from the row before, `s x n`, never 0.
        seen: the arm as the tracker sees it.
    """

    name: str
    text: str
    joints: Floats
    position: Floats
    turn: Floats | None
    direction: Floats
    seen: Seen


def robot_of(name: str) -> Robot:
    """A robot's rows.

    Raises:
        InputError: its data is not there.
    """
    folder = os.environ.get("CCNN_MEASURED")
    if folder:
        records, geometry = Path(folder) / name / "records.csv", Path(folder) / name / "nominal.yaml"
    elif name == "ur10_b":
        data = Path(__file__).parents[4] / "experiments" / "data"
        records, geometry = data / "ur10_b_500.csv", data / "ur10.yaml"
    else:
        raise InputError(f"rows of {name} are needed: set CCNN_MEASURED to the folder that holds {name}/records.csv.")
    for path in (records, geometry):
        if not path.is_file():
            raise InputError(f"rows of {name} are needed, but there is no {path.name} in {path.parent}.")
    return read(name, records, geometry)


@cache
def read(name: str, records: Path, geometry: Path) -> Robot:
    """The rows of a robot in the order measured, in SI."""
    table = np.genfromtxt(records, delimiter=",", names=True, deletechars="", dtype=float)
    columns = {header: table[header] for header in table.dtype.names or ()}
    text = geometry.read_text(encoding="utf-8")
    keys = parse_yaml(text, str(geometry))
    n = int(keys["dof"])
    keep = columns["set[1]"] == 0 if "set[1]" in columns else np.ones(len(table), bool)
    order = np.argsort(columns["step[1]"][keep], kind="stable") if "step[1]" in columns else np.arange(keep.sum())
    columns = {header: values[keep][order] for header, values in columns.items()}
    degrees = "q1[deg]" in columns
    joints = np.stack([columns[f"q{i + 1}[{'deg' if degrees else 'rad'}]"] for i in range(n)], -1)
    joints = np.deg2rad(joints) if degrees else joints
    position = np.stack([columns[f"{axis}[mm]"] for axis in "xyz"], -1) / 1e3
    turn = np.stack([columns[f"r{axis}[rad]"] for axis in "xyz"], -1) if "rx[rad]" in columns else None
    arm = Arm(
        a=np.array(keys["a"], float) / 1e3,
        alpha=np.array(keys["alpha"], float),
        d=np.array(keys["d"], float) / 1e3,
        theta=np.array(keys["theta"], float),
        beta=np.zeros(n),
        tool=np.zeros(3),
    )
    return Robot(name, text, joints, position, turn, directions(joints), see(arm, joints, position))


def directions(joints: Floats) -> Floats:
    """Sign of each joint's way from the row before, `s x n`; a joint that stands still keeps its last sign."""
    way = np.sign(np.diff(joints, axis=0, prepend=joints[:1]))
    way[0] = np.where(way[0] == 0, 1, way[0])
    last = np.maximum.accumulate(np.where(way != 0, np.arange(len(way))[:, None], 0), axis=0)
    return np.take_along_axis(way, last, axis=0)
