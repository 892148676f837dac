"""What logs with named joints have in common: which joints are meant, their units, and their table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.records.table import Table
from ccnn_torch.spelling import hint

Array = NDArray[np.float64]
# They hold things, which is no free motion, and have units of their own.
_GRIPPER = re.compile(r".*(gripper|finger|jaw|claw)", re.IGNORECASE)


class Joints(NamedTuple):
    """The joints of a diagnosis.

    Attributes:
        names: of the joints.
        state, command: their places among the positions and among the commands.
        units: that were given; None where none were.
        grippers: which of them are grippers.
    """

    names: list[str]
    state: list[int]
    command: list[int]
    units: list[str] | None
    grippers: list[bool]


def chosen_joints(
    state: Sequence[str], command: Sequence[str], keys: Mapping[str, Any], path: Path
) -> tuple[Joints, list[str]]:
    """The joints that have a position and a command, and what was left out.

    Args:
        state, command: names of the positions and of the commands.
        keys: `joints`, names of those that are meant; by default all but grippers. `units`, one for all or by name.
        path: of the log.

    Raises:
        InputError: no joint has both, or a key names none.
    """
    # In the order of the commands: that of joint states is often the alphabet's.
    common = [name for name in command if name in state]
    if not common:
        raise InputError(
            f"{path}: no joint has a position and a command: positions are of {', '.join(state)}, and commands of "
            f"{', '.join(command)}"
        )
    wanted = keys.get("joints")
    if wanted is None:
        names = [name for name in common if not _GRIPPER.match(name)] or common
    else:
        names = [str(name) for name in (wanted if isinstance(wanted, list) else [wanted])]
        _refuse_unknown(names, common, "joints", path)
    left = [name for name in common if name not in names]
    notes = (
        [f"{', '.join(left)} left out; motion_keys={{joints: […]}} names those to take"] if left and not wanted else []
    )
    given = keys.get("units")
    units = None
    if given is not None:
        _refuse_unknown([*given] if isinstance(given, dict) else [], common, "units", path)
        units = [str(given.get(name, "rad")) if isinstance(given, dict) else str(given) for name in names]
    grippers = [_GRIPPER.match(name) is not None for name in names]
    return Joints(names, [state.index(n) for n in names], [command.index(n) for n in names], units, grippers), notes


def _refuse_unknown(names: Sequence[str], known: Sequence[str], key: str, path: Path) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"motion_keys: {key}: {path} has no joint '{visible(name)}'; {hint(name, known)}")


def motion_table(
    path: Path,
    joints: Joints,
    units: Sequence[str],
    time: Array,
    command: Array,
    position: Array,
    run: Array,
    notes: Sequence[str],
    beside: Mapping[str, tuple[str, Array]] | None = None,
) -> Table:
    """The table of a log.

    Args:
        path: of the log.
        joints: of `n` joints.
        units: of each.
        time: `s` [s].
        command, position: `s x n`.
        run: `s`.
        notes: one sentence each without a full stop.
        beside: unit and values `s x n` of what else was recorded of each joint, by our name.
    """
    listed = ", ".join(f"q{i + 1} is {name}" for i, name in enumerate(joints.names))
    columns = {"time": ("s", time), "run": ("1", run)}
    for i, unit in enumerate(units):
        columns |= {f"command{i + 1}": (unit, command[:, i]), f"q{i + 1}": (unit, position[:, i])}
        columns |= {f"{name}{i + 1}": (own, values[:, i]) for name, (own, values) in (beside or {}).items()}
    return Table(
        str(path),
        {name: unit for name, (unit, _) in columns.items()},
        np.stack([values for _, values in columns.values()], -1),
        np.arange(len(time), dtype=np.int64) + 1,
        notes=(f"{path}: {listed}", *(f"{path}: {note}" for note in notes)),
        words={f"q{i + 1}": name for i, name in enumerate(joints.names)},
    )
