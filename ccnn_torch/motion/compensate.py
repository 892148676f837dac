"""`ccnn compensate` with a model of a motion: commands, corrected so that the machine follows what is wanted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.display import number_text
from ccnn_torch.errors import InputError
from ccnn_torch.motion.feed_forward import Around, corrected_command, moved
from ccnn_torch.motion.identified import Identified, load_identified
from ccnn_torch.motion.log import refuse_time, runs_of
from ccnn_torch.records import Table, read_table, write_table
from ccnn_torch.units import from_si

Array = NDArray[np.float64]
_FEWEST = 20
# An error without correction that is so many times the largest one in the logs, and larger than the motion, is none of
# the machine's.
_ABSURD = 3.0
# Share of the error that a correction must take away to be sent.
_GAINED = 0.1
# Share of a run's error above which most of it stays.
_MOST = 0.5
# Share of the largest speed above which a motion does not begin at rest.
_MOVING = 0.1


def compensate_motion(model: Path, input: Path, output: Path, allow_code: bool = False) -> list[str]:
    """Write the input's columns with `corrected1[unit]…`, the commands to send, and `predicted1[unit]…`, the positions.

    Args:
        model: `identified_motion.json`.
        input: CSV with `time[s]` and `command1[unit]…`, where the machine shall be; `run[1]` where it has several,
            `supply[V]` and `temperature[degC]` where the model follows them.
        output: CSV.
        allow_code: as of `load_identified`.

    Returns:
        A sentence for each joint: what its error is predicted to be; for each of several runs, where most of it stays;
        and what was assumed.

    Raises:
        InputError: a file is not there or not in this form, or the model errs by more than any machine would.
    """
    found = load_identified(model, allow_code)
    table = read_table(input)
    names = [f"command{i + 1}" for i in range(len(found.units))]
    time = table.column("time", "s")
    wanted = np.stack([table.column(n, unit) for n, unit in zip(names, found.units, strict=True)], -1)
    around, sentences = _around(found, table)
    runs = runs_of(table)
    command, position, plain = (np.empty_like(wanted) for _ in range(3))
    useless = np.zeros((len(runs), len(names)), dtype=np.bool_)
    for k, (name, rows) in enumerate(runs):
        refuse_time(table, rows, time[rows])
        if len(rows) < _FEWEST:
            raise InputError(f"{name}: {len(rows)} rows are no motion; give at least {_FEWEST}")
        own = corrected_command(found.nominal, found.axes, time[rows], wanted[rows], around.at(rows), found.errors)
        _refuse_absurd(model, name, found, wanted[rows], own.plain)
        command[rows], position[rows], plain[rows] = own.command, own.position, own.plain
        before, after = (_errors(found, wanted[rows], q) for q in (own.plain, own.position))
        useless[k] = after > (1 - _GAINED) * before
        if useless[k].any():
            command[rows] = np.where(useless[k], wanted[rows], own.command)
            position[rows] = moved(found.nominal, found.axes, time[rows], command[rows][None], around.at(rows))[0]
    added: dict[str, Array | list[str]] = {}
    for what, values in (("corrected", command), ("predicted", position)):
        for i, name in enumerate(names):
            unit = table.units[name]
            added[f"{what}{i + 1}[{unit}]"] = from_si(values[:, i], found.units[i], unit)
    kept: dict[str, Array | list[str]] = {
        table.header(n): table.cells(n) for n in table.names if not n.startswith(("corrected", "predicted"))
    }
    write_table(output, kept | added)
    said = _told(found, runs, wanted, plain, position, useless)
    return said + [s for name, rows in runs for s in _begun(name, time[rows], wanted[rows])] + sentences


def _errors(found: Identified, wanted: Array, position: Array) -> Array:
    """RMS of each joint; what the model leaves stays, and adds to what the correction does."""
    return np.asarray(np.hypot(np.sqrt(np.square(wanted - position).mean(0)), found.left))


def _told(
    found: Identified,
    runs: list[tuple[str, NDArray[np.int64]]],
    wanted: Array,
    plain: Array,
    position: Array,
    useless: NDArray[np.bool_],
) -> list[str]:
    """A sentence for each joint on all runs, and where there are several one for each in which most of the error stays.

    `useless`, runs `x n`: where a joint is not corrected.
    """
    said: list[str] = []
    nowhere: NDArray[np.bool_] = np.asarray(useless.all(0))
    before, after = (_errors(found, wanted, q) for q in (plain, position))
    for i, unit in enumerate(found.units):
        change = f"predicted {number_text(before[i], 3)}"
        beside = f"{number_text(found.left[i], 2)} of it the model's own error"
        if nowhere[i]:
            said.append(
                f"q{i + 1}: {change} {unit} RMS ({beside}), of which a correction would take away less than a "
                "tenth: the wanted motion is sent as it is"
            )
        else:
            said.append(f"q{i + 1}: {change} -> {number_text(after[i], 3)} {unit} RMS ({beside})")
    for uncorrected, (name, rows) in zip(useless, runs, strict=True):
        before, after = (_errors(found, wanted[rows], q[rows]) for q in (plain, position))
        # Where the model's own error is the larger part, as at rest, there is little to correct.
        much = np.square(before) > 2 * np.square(found.left)
        parts = []
        for i in np.flatnonzero(much & (after > _MOST * before) & ~nowhere & (len(runs) > 1)).tolist():
            sizes = number_text(before[i], 3) + ("" if uncorrected[i] else f" -> {number_text(after[i], 3)}")
            then = "; the wanted motion is sent as it is" if uncorrected[i] else ""
            parts.append(f"q{i + 1} ({sizes} {found.units[i]} RMS{then})")
        said += [f"{name}: most of the error stays at {', '.join(parts)}"] if parts else []
    return said


def _around(found: Identified, table: Table) -> tuple[Around, list[str]]:
    """What surrounds the motion, of all rows, and sentences on what is assumed."""
    said = []
    # Column, unit, parameter of an axis that follows it, where that holds, and the unit that it is said in.
    kinds = (
        ("supply", "V", "supply", found.nominal.supply, "V"),
        ("temperature", "K", "thermal", found.temperature, "degC"),
    )
    values: dict[str, Array | None] = {}
    for name, unit, parameter, usual, shown in kinds:
        needed = any(axis.get(parameter) for axis in found.axes)
        values[name] = table.column(name, unit) if needed and name in table else None
        if needed and name not in table:
            size = "the usual" if usual is None else number_text(float(from_si(usual, unit, shown)), 3)
            said.append(
                f"{table.path} has no column {name}[{shown}], which the model follows: {size} {shown} is assumed"
            )
        elif not needed and name in table:
            said.append(f"{name}[{shown}] changes nothing: the model does not follow it")
    supply, warm = values["supply"], values["temperature"]
    if supply is not None:
        supply = supply / (found.nominal.supply or float(np.median(supply)) or 1.0) - 1
    if warm is not None:
        warm = warm - (float(warm[0]) if found.temperature is None else found.temperature)
    return Around(supply, warm), said


def _begun(name: str, time: Array, wanted: Array) -> list[str]:
    """A sentence where a motion does not begin at rest."""
    speed = np.abs(np.diff(wanted, axis=0) / np.diff(time)[:, None])
    moving = [f"q{i + 1}" for i in np.flatnonzero(speed[0] > _MOVING * speed.max(0))]
    if not moving:
        return []
    return [
        f"{name}: {', '.join(moving)} begins with a speed, and the machine at rest at the first position: its first "
        "moment differs"
    ]


def _refuse_absurd(model: Path, name: str, found: Identified, wanted: Array, plain: Array) -> None:
    error, span = np.abs(wanted - plain).max(0), np.ptp(wanted, 0)
    for i, unit in enumerate(found.units):
        if error[i] > max(span[i], _ABSURD * found.errors[i]):
            e, s, logged = (number_text(float(v[i]), 2) for v in (error, span, np.asarray(found.errors)))
            raise InputError(
                f"{model}: on {name}, a motion over {s} {unit}, its q{i + 1} errs by {e} {unit} (the machine in its "
                f"logs by at most {logged} {unit}): it is not that machine; diagnose it again, with more motions"
            )
