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
        A sentence for each joint: what its error is predicted to be; and what was assumed.

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
    for name, rows in runs:
        refuse_time(table, rows, time[rows])
        if len(rows) < _FEWEST:
            raise InputError(f"{name}: {len(rows)} rows are no motion; give at least {_FEWEST}")
        own = corrected_command(found.nominal, found.axes, time[rows], wanted[rows], around.at(rows), found.errors)
        _refuse_absurd(model, name, found, wanted[rows], own.plain)
        command[rows], position[rows], plain[rows] = own.command, own.position, own.plain

    def errs(q: Array) -> Array:
        # What the model leaves stays, and adds to what the correction does.
        return np.asarray(np.hypot(np.sqrt(np.square(wanted - q).mean(0)), found.left))

    before, after = errs(plain), errs(position)
    useless = after > (1 - _GAINED) * before
    if useless.any():
        command[:, useless] = wanted[:, useless]
        for _, rows in runs:
            position[rows] = moved(found.nominal, found.axes, time[rows], command[rows][None], around.at(rows))[0]
        after = errs(position)
    added: dict[str, Array | list[str]] = {}
    for what, values in (("corrected", command), ("predicted", position)):
        for i, name in enumerate(names):
            unit = table.units[name]
            added[f"{what}{i + 1}[{unit}]"] = from_si(values[:, i], found.units[i], unit)
    kept: dict[str, Array | list[str]] = {
        table.header(n): table.cells(n) for n in table.names if not n.startswith(("corrected", "predicted"))
    }
    write_table(output, kept | added)
    said = []
    for i, unit in enumerate(found.units):
        change = f"predicted {number_text(before[i], 3)}"
        beside = f"{number_text(found.left[i], 2)} of it the model's own error"
        if useless[i]:
            said.append(
                f"q{i + 1}: {change} {unit} RMS ({beside}), of which a correction would take away less than a "
                "tenth: the wanted motion is sent as it is"
            )
        else:
            said.append(f"q{i + 1}: {change} -> {number_text(after[i], 3)} {unit} RMS ({beside})")
    return said + [s for name, rows in runs for s in _begun(name, time[rows], wanted[rows])] + sentences


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
