"""Joints of a table: as it has them, as its controller counts them, or of the poses that were commanded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.records.headers import HasCoordinates, check_joints, read_pose, stack_columns
from ccnn_torch.records.joint_map import read_joint_map, with_joints
from ccnn_torch.records.table import Table

if TYPE_CHECKING:
    from torch import Generator, Tensor

GOAL = "goal_"
"""Prefix of the columns of a commanded pose."""
SECOND = "_b"
"""What the columns of the second place of a distance end with."""
# Poses that show which coordinates a machine cannot move, and the change that is rounding [m, rad].
_SAMPLES, _STILL = 64, 1e-9


class Controlled(HasCoordinates, Protocol):
    """A machine as its controller has it."""

    def sample_workspace(self, count: int, generator: Generator) -> Tensor: ...
    def commanded_joints(self, pose: Tensor, guess: Tensor | None = None) -> Tensor: ...


class Moving(HasCoordinates, Protocol):
    """What a mechanism needs so that joints of its poses are found."""

    def controlled(self) -> Controlled: ...


def read_joints(
    table: Table,
    mechanism: Moving,
    joint_map: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
) -> Table:
    """The table with columns of the mechanism's joints, also those of the second place (`q1_b` …) of a distance.

    Where there are none, the columns `goal_x`, `goal_y` … are poses that were commanded, and the joints their nominal
    inverse kinematics, as the controller has them: in the machine's own base, of an arm at the tool of its file (at the
    flange where that is unknown). Of several solutions that of the branch of the previous row is taken, of the columns
    `guess_q1` … where these are there.

    Raises:
        InputError: a column is missing or cannot be used, or a commanded pose is out of reach (named by line).
    """
    counted = read_joint_map(joint_map or {}, mechanism.joints, columns)
    shown = counted is not None and any(name in table for name in counted.columns)
    if not shown and is_commanded(table, mechanism.joints):
        check_joints(table, mechanism, commanded=True)
        table = _with_commanded(table, mechanism)
    else:
        table = with_joints(table, counted)
        check_joints(table, mechanism)
    return _with_commanded(table, mechanism, SECOND) if is_commanded(table, mechanism.joints, SECOND) else table


def is_commanded(table: Table, joints: Sequence[Coordinate], ending: str = "") -> bool:
    """Whether a table has columns of a commanded pose, and none of a joint."""
    goals = any(n.startswith(GOAL) and n.endswith(ending) and n.removesuffix(ending) in table for n in table.names)
    return goals and not any(f"{joint.name}{ending}" in table for joint in joints)


def is_open(table: Table, joints: Sequence[Coordinate]) -> bool:
    """Whether joints are those of commanded poses, and no columns `guess_q1` … say near which."""
    return is_commanded(table, joints) and not any(f"guess_{joint.name}" in table for joint in joints)


def commanded_poses(
    table: Table, mechanism: Moving, ending: str = ""
) -> tuple[NDArray[np.float64], str | None, tuple[str, ...]]:
    """Commanded poses of `mechanism.controlled()`, `rows x p` [SI], the form of an orientation, and the columns read.

    A coordinate that the machine cannot move needs no column.

    Raises:
        InputError: a column is missing or cannot be used, or they do not determine the joints.
    """
    import torch

    machine, named = mechanism.controlled(), f"{GOAL}{{}}{ending}"
    samples = machine.sample_workspace(_SAMPLES, torch.Generator().manual_seed(0))
    still = [
        (Coordinate(named.format(c.name), c.unit), float(samples[0, k]))
        for k, c in enumerate(machine.pose)
        if named.format(c.name) not in table and float(samples[:, k].max() - samples[:, k].min()) < _STILL
    ]
    whole = _with_columns(table, [c for c, _ in still], np.tile([value for _, value in still], (len(table), 1)))
    poses, coordinates, form, read = read_pose(whole, machine, named=named)
    if len(machine.joints) > len(coordinates):
        more = [named.format(c.name) for c in machine.pose if c not in coordinates]
        give = f"{', '.join(more)}, too, or its joints" if more else f"its joints {machine.joints[0].name} …"
        raise InputError(
            f"{table.path}: {', '.join(read)} do not determine the {len(machine.joints)} joints of {machine.name}; "
            f"give {give}"
        )
    return poses, form, tuple(name for name in read if name in table)


def _with_columns(table: Table, coordinates: Sequence[Coordinate], values: NDArray[np.float64]) -> Table:
    """The table with further columns, `rows x len(coordinates)` [SI]."""
    units = table.units | {c.name: c.unit for c in coordinates}
    return replace(table, units=units, values=np.concatenate([table.values, values], axis=1))


def _with_commanded(table: Table, mechanism: Moving, ending: str = "") -> Table:
    """The table with the joints of the commanded poses, and a note on them."""
    import torch

    machine = mechanism.controlled()
    poses, _, read = commanded_poses(table, mechanism, ending)
    guesses = [Coordinate(f"guess_{joint.name}{ending}", joint.unit) for joint in machine.joints]
    guided = any(c.name in table for c in guesses)
    guess = torch.from_numpy(stack_columns(table, guesses)) if guided else None
    joints = machine.commanded_joints(torch.from_numpy(poses), guess)
    lost = np.flatnonzero(~torch.isfinite(joints).all(-1).numpy())
    if len(lost):
        pose = ", ".join(f"{name} = {table.cell(name, int(lost[0]))}" for name in read)
        raise InputError(
            f"{table.path}: {machine.name} has no joints for the pose {pose} that was commanded at "
            f"{table.name_rows(lost)}; correct or remove {'it' if len(lost) == 1 else 'them'}, or check the units and "
            "the machine's dimensions"
        )
    said = f"the joints are the nominal inverse kinematics of the commanded poses {', '.join(read)}"
    if machine.orientations and not guided:
        said += "; of several solutions those with which the rows fit far better, else the one nearest to the previous "
        said += "row's, in the first row to the home joints"
    found = _with_columns(table, [Coordinate(f"{j.name}{ending}", j.unit) for j in machine.joints], joints.numpy())
    return replace(found, notes=(*table.notes, said))
