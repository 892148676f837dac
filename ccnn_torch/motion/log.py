"""Logs of a machine in motion: time, commands and positions of each joint, and what was recorded beside them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.display import count_text
from ccnn_torch.errors import InputError
from ccnn_torch.motion.mistakes import refuse_mistakes
from ccnn_torch.records.read_table import Frame, read_frame, read_table
from ccnn_torch.records.table import Table
from ccnn_torch.units import si_unit_of

Array = NDArray[np.float64]
_RUN, _POSITION, _COMMAND = "run", re.compile(r"q(\d+)"), re.compile(r"command(\d+)")
_SHARED = {"supply": "V", "temperature": "K", "torque_on": "1"}
_EACH = {"speed": None, "torque": "N*m", "current": "A", "pwm": "1"}
# Steps longer than this many usual ones are gaps; longer than so many, late samples that the simulation can bridge.
_GAP, _LATE = 6.0, 1.6
# A jump of the position this many times the largest usual step is no motion.
_JUMP, _USUAL = 12.0, 0.995
# A position that jumps by a whole turn, to this share, was wrapped by its counter.
_TURN, _TURN_SLACK = 2 * np.pi, 0.1
# Whole numbers from here on are counts.
_COUNTS = 1000.0
# Samples with no output of the drive at all from which it is taken to be off, and the error that it then must have, as
# a share of the motion.
_OFF, _OFF_ERROR = 20, 0.1


@dataclass(frozen=True)
class Log:
    """One run: `s` samples of `n` joints.

    Attributes:
        name: file, and the run in it.
        time: `s` [s], increasing.
        command, position: `s x n` [rad or m].
        units: `rad` or `m` of each joint.
        beside: columns that were recorded beside them, in SI, by name: `supply`, `temperature`, `speed1`, `pwm1`, …
        on: whether the drive was on and the sample is usable, `s`.
        cut: whether something is missing before the sample, so that it begins anew, `s`.
        notes: what was recognised and left out, one sentence each without a full stop.
        words: what the source calls its joints, `q1` …; {} where it has no other names.
    """

    name: str
    time: Array
    command: Array
    position: Array
    units: tuple[str, ...]
    beside: Mapping[str, Array]
    on: NDArray[np.bool_]
    cut: NDArray[np.bool_]
    notes: tuple[str, ...] = ()
    words: Mapping[str, str] = field(default_factory=dict)


def load_logs(
    sources: Sequence[str | Path | Frame | Table],
    columns: Mapping[str, str] | None = None,
    keys: Mapping[str, Any] | None = None,
) -> list[Log]:
    """Read logs; every file is a run, or several where it has a column `run[1]`.

    Args:
        sources: CSV files (or .xlsx, or data frames) with `time[s]`, `command1[rad]…`, `q1[rad]…` and optional columns;
            or data sets of `ccnn_torch.records.formats`.
        columns: other headers -> ours, as for `read_table`.
        keys: what is said of a data set, as for `read_table`.

    Raises:
        InputError: a column is missing or in a wrong unit, time does not increase, commands and positions do not fit
            each other, the drive was off throughout, or nothing moves.
    """
    if not sources:
        raise InputError("motion: name at least one log with --motion LOG.csv")
    logs = [log for source in sources for log in _of_source(source, columns, keys)]
    first = logs[0]
    for log in logs[1:]:
        if log.units != first.units:
            raise InputError(
                f"{log.name}: has joints in {', '.join(log.units)}, and {first.name} in {', '.join(first.units)}; "
                "diagnose logs of one machine together"
            )
    refuse_mistakes(logs)
    return logs


def _of_source(
    source: str | Path | Frame | Table, columns: Mapping[str, str] | None, keys: Mapping[str, Any] | None
) -> list[Log]:
    if isinstance(source, Table):
        table = source
    else:
        table = read_table(source, columns, keys) if isinstance(source, str | Path) else read_frame(source, columns)
    count = _joints(table)
    units = tuple(_unit(table, f"q{i}", f"command{i}") for i in range(1, count + 1))
    command, position = (
        np.stack([table.column(f"{kind}{i + 1}", units[i]) for i in range(count)], -1) for kind in ("command", "q")
    )
    _refuse_counts(table, units, position)
    time = table.column("time", "s")
    beside = {n: table.column(n, unit) for n, unit in _SHARED.items() if n in table}
    for kind, unit in _EACH.items():
        for i in range(1, count + 1):
            if (name := f"{kind}{i}") in table:
                beside[name] = table.column(name, unit if kind != "speed" else f"{units[i - 1]}/s")
    found = []
    for name, rows in runs_of(table):
        refuse_time(table, rows, time[rows])
        own = {n: v[rows] for n, v in beside.items()}
        found.append(_log(name, time[rows], command[rows], position[rows], units, own))
        if rows[-1] - rows[0] >= len(rows):
            apart = f"{name}: its rows are not one after the other; they were gathered in their order"
            found[-1] = replace(found[-1], notes=(apart, *found[-1].notes))
    found[0] = replace(found[0], notes=(*table.notes, *found[0].notes), words=table.words)
    return found


def runs_of(table: Table) -> list[tuple[str, NDArray[np.int64]]]:
    """Name and rows of each run in a table, in the order in which they begin."""
    if _RUN not in table:
        return [(str(table.path), np.arange(len(table)))]
    number = table.column(_RUN, "1")
    runs = dict.fromkeys(number.tolist())
    return [(f"{table.path} run {run:g}", np.flatnonzero(number == run)) for run in runs]


def _joints(table: Table) -> int:
    """How many joints there are; every one has a command and a position."""
    found = {
        kind: {int(m[1]) for n in table.names if (m := pattern.fullmatch(n))}
        for kind, pattern in (("command", _COMMAND), ("q", _POSITION))
    }
    count = max(*found["command"], *found["q"], 1) if found["command"] | found["q"] else 1
    wanted = ["time", *(f"{kind}{i}" for kind in found for i in range(1, count + 1))]
    for name in (name for name in wanted if name not in table):
        others = [table.header(own) for own in table.names if own not in wanted]
        unit = "s" if name == "time" else "rad"
        first, some = (others or ["header"])[0], ", ".join(others)
        raise InputError(
            f"{table.path}: there is no column '{name}'; a log has time[s], command1[rad] and q1[rad] (or deg, mm): "
            f"rename its headers ({some}), or say what each is: columns={{'{first}': '{name}[{unit}]'}}"
        )
    return count


def _unit(table: Table, position: str, command: str) -> str:
    units = []
    for name in (position, command):
        table.column(name)
        unit = table.units[name]
        si = si_unit_of(unit, f"{table.path}: column '{name}'") if unit else ""
        if si not in ("rad", "m"):
            raise InputError(
                f"{table.path}: column '{name}' must be an angle or a length; write '{name}[rad]', '{name}[deg]' or "
                f"'{name}[mm]'"
            )
        units.append(si)
    if units[0] != units[1]:
        raise InputError(
            f"{table.path}: '{command}' is in {units[1]} and '{position}' in {units[0]}; a command and the position "
            "that follows it have one unit"
        )
    return units[0]


def _refuse_counts(table: Table, units: tuple[str, ...], position: Array) -> None:
    """Raise `InputError` where an encoder's counts stand under the name of a unit."""
    for i, values in enumerate(position.T):
        if np.abs(values).max(initial=0.0) >= _COUNTS and not np.any(values % 1):
            turn = "2 pi over its counts in a turn" if units[i] == "rad" else "the length of a count"
            raise InputError(
                f"{table.path}: q{i + 1} has whole numbers up to {np.abs(values).max():.0f} {units[i]}, which are "
                f"counts of an encoder; multiply it, and command{i + 1} if it is in counts, by {turn}"
            )


def _log(
    name: str, time: Array, command: Array, position: Array, units: tuple[str, ...], own: Mapping[str, Array]
) -> Log:
    steps = np.diff(time)
    notes: list[str] = []
    cut = np.zeros(len(time), dtype=np.bool_)
    usual = float(np.median(steps)) if len(steps) else 1.0
    gaps, late = steps > _GAP * usual, (steps > _LATE * usual) & (steps <= _GAP * usual)
    cut[1:] |= gaps
    if gaps.any():
        notes.append(f"{name}: {count_text(int(gaps.sum()), 'gap')} of {steps[gaps].sum():.3g} s in all, left out")
    if late.any():
        notes.append(f"{name}: {count_text(int(late.sum()), 'sample')} came late; the simulation uses their own times")
    for i, unit in enumerate(units):
        if unit == "rad":
            command[:, i], position[:, i], times = unwrapped(command[:, i], position[:, i])
            notes += [
                f"{name}: {what}{i + 1} wrapped {count_text(count, 'time')}, unwrapped"
                for what, count in zip(("command", "the counter of q"), times, strict=True)
                if count
            ]
        size = np.abs(np.diff(position[:, i]))
        span = float(np.ptp(position[:, i]))
        jump = size > max(_JUMP * float(np.quantile(size, _USUAL)), 0.1 * span) if len(size) > 10 else size < 0
        if jump.any():
            cut[1:] |= jump
            notes.append(f"{name}: q{i + 1} jumps {count_text(int(jump.sum()), 'time')}; the log is cut there")
    on = drive_on(name, time, command, position, own, notes)
    cut[1:] |= on[1:] & ~on[:-1]
    return Log(name, time, command, position, units, own, on, cut, tuple(notes))


def refuse_time(table: Table, rows: NDArray[np.int64], time: Array) -> None:
    """Raise `InputError` where the time of some rows of a table does not increase."""
    steps = np.diff(time)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        more = f", and {len(back) - 1} times more" if len(back) > 1 else ""
        raise InputError(
            f"{table.path}: time does not increase at {table.name_rows([int(rows[back[0] + 1])])}{more}; sort the "
            "rows, and write one row for each time"
        )


def unwrapped(command: Array, position: Array) -> tuple[Array, Array, tuple[int, int]]:
    """A command and a position without jumps by whole turns, and how many each had."""
    jump = np.diff(command)
    turns = _turns(jump, jump)
    whole = command - _TURN * np.cumsum(np.r_[0.0, turns])
    # A command may jump by a turn, and the position then goes there.
    tried = [(u, _followed(u, position)) for u in ((command, whole) if turns.any() else (command,))]
    u, (q, count) = min(reversed(tried), key=lambda one: round(float(np.std(one[0] - one[1][0])), 6))
    if u is whole or count:
        # One of them may have wrapped before the log began.
        q = q + _TURN * np.round(np.median(u - q) / _TURN)
    return u, q, (int(np.count_nonzero(turns)) if u is whole else 0, count)


def _followed(command: Array, position: Array) -> tuple[Array, int]:
    """The position without jumps by whole turns beside those of its command, and how many it had."""
    moved = np.diff(position)
    # Beside what the command moves, which across a gap may be much.
    turns = _turns(moved - np.diff(command), moved)
    q = position - _TURN * np.cumsum(np.r_[0.0, turns])
    return q, int(np.count_nonzero(turns))


def _turns(beyond: Array, moved: Array) -> Array:
    """Whole turns of each step, 0 where it moves less than half a turn or is no whole turn but what is beyond them."""
    turns = np.round(beyond / _TURN)
    near = (np.abs(beyond - turns * _TURN) < _TURN_SLACK * _TURN) & (np.abs(moved) > _TURN / 2)
    return np.where(near, turns, 0.0)


def drive_on(
    name: str, time: Array, command: Array, position: Array, beside: Mapping[str, Array], notes: list[str]
) -> NDArray[np.bool_]:
    """Where the drive was on: as recorded; else where it gives no output at all although the position is off."""
    on = np.ones(len(time), dtype=np.bool_)
    if "torque_on" in beside:
        on = beside["torque_on"] > 0.5
        source = "torque_on"
    else:
        source = ""
        for i in range(command.shape[1]):
            for kind in ("pwm", "current", "torque"):
                output = beside.get(f"{kind}{i + 1}")
                error = np.abs(command[:, i] - position[:, i])
                if output is None or not np.any(output):
                    continue
                # Slow to import, and seldom needed.
                from scipy.ndimage import binary_opening

                off = binary_opening((output == 0) & (error > _OFF_ERROR * np.ptp(command[:, i])), np.ones(_OFF))
                if off.any():
                    on &= ~off
                    source = f"{kind}{i + 1}, which is 0 although the position is off"
    if not on.all() and on.any():
        lost = float(np.diff(time, append=time[-1])[~on].sum())
        notes.append(f"{name}: the drive was off for {lost:.3g} s ({source}), left out")
    return on
