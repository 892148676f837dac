"""What a file tells of the drives of a machine's joints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.spelling import hint

Motors = tuple[tuple[float, ...], ...]
"""How far each motor turns, over its own gear, for one unit of each joint: a row each motor."""
# More turns a turn than any gear between two joints makes.
_MOST = 1e3
# A larger condition number leaves no digits of what a controller shows.
_CONDITION = 1e4
# Rounding of an inverse.
_NONE = 1e-9


def read_gears(
    told: Any, joints: Sequence[Coordinate], where: str, number: Callable[[Any, str], float]
) -> list[float | None]:
    """Of each joint turns of its motor for one of its own [1], or the lead of its screw [m], or None.

    Args:
        told: a list of them.
        joints: those of the machine.
        where: opens the sentence of an error.
        number: one that is told, and its unit, to SI.

    Raises:
        InputError: no list of as many, or one that is not above 0.
    """
    if not isinstance(told, list) or len(told) != len(joints):
        raise InputError(f"{where} must list {len(joints)} numbers, one for each joint, as [121, null, …]")
    found = [
        None if v is None else number(v, "1" if joint.unit == "rad" else joint.unit)
        for v, joint in zip(told, joints, strict=True)
    ]
    if any(v is not None and v <= 0 for v in found):
        raise InputError(f"{where} must be above 0, or null where nothing is known, not {told}")
    return found


def read_motors(told: Any, joints: Sequence[Coordinate], where: str) -> Motors:
    """Of motors that turn with other joints as well, as those of a wrist whose shafts run within each other.

    Args:
        told: ``{q5: {q4: 0.667}}``: the motor of q5 turns q5 + 0.667 q4, over its gear; 1 of its own joint unless told.
        joints: those of the machine.
        where: opens the sentence of an error.

    Raises:
        InputError: no such tree, joints of other units, or motors from which the joints do not follow.
    """
    form, names = f"{where} must be as {{q5: {{q4: 0.667}}}}", [joint.name for joint in joints]
    if not isinstance(told, Mapping) or not all(isinstance(row, Mapping) for row in told.values()):
        raise InputError(f"{form}: of a motor, by its joint, what other joints turn it, got {visible(repr(told))}")
    found = np.eye(len(joints))
    for motor, row in told.items():
        for name in (motor, *row):
            if name not in names:
                near = hint(str(name), names, "they are")
                raise InputError(f"{where}: '{visible(str(name))}' is no joint of the machine; {near}")
        to = names.index(motor)
        for name, value in row.items():
            by = names.index(name)
            if joints[by].unit != joints[to].unit:
                raise InputError(f"{where}: {name} is in {joints[by].unit}, and {motor} in {joints[to].unit}")
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _MOST:
                raise InputError(
                    f"{where}: {motor}: {name}: must be a number of turns a turn, got {visible(repr(value))}"
                )
            found[to, by] = value
    if np.linalg.cond(found) > _CONDITION:
        raise InputError(f"{where}: the joints do not follow from these motors; give every motor its own joint")
    return tuple(map(tuple, found.tolist()))


def moved_by(motors: Motors) -> list[tuple[int, int]]:
    """Pairs of joints, from 1: the first one moves with the second one where a ratio between motors is a little off."""
    if not motors:
        return []
    turns = np.array(motors)
    others = (turns != 0) & ~np.eye(len(turns), dtype=bool)
    moved = np.abs(np.linalg.inv(turns)) @ others > _NONE
    return [(int(i) + 1, int(j) + 1) for i, j in np.argwhere(moved) if i != j]


def turns_of(motors: Motors, joints: Tensor) -> Tensor:
    """How far each motor has turned, over its gear, at joints `... x n`, `... x n`."""
    return joints @ torch.tensor(motors, dtype=joints.dtype).mT if motors else joints
