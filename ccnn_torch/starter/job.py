"""`ccnn new`: a first config for records, with comments on what was guessed."""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.mechanisms.frames.judge import coupled_count
from ccnn_torch.mechanisms.registry import REGISTRY
from ccnn_torch.records.load import load_records
from ccnn_torch.records.sources import read_source
from ccnn_torch.records.table import Table
from ccnn_torch.starter.recognise import (
    Recognised,
    choose_split,
    is_covariate,
    is_unit,
    recognise,
    suitable_mechanisms,
    unit_pair,
)
from ccnn_torch.units import to_si

Ask = Callable[[str], str]
_ORIENTATION = {"rx": "a rotation vector, as Universal Robots gives it", "kuka_a": "KUKA's A, B, C (Rz Ry Rx)",
                "fanuc_w": "Fanuc's W, P, R (fixed axes x, y, z)", "staubli_rx": "Stäubli's Rx, Ry, Rz",
                "qw": "a quaternion"}  # fmt: skip


def starter_config(
    records: Path, out: Path, mechanism: str | None = None, units: str | None = None, ask: Ask | None = None
) -> tuple[str, bool]:
    """Text of a commented config for records, and whether it can be run as it is.

    Args:
        records: the file.
        out: path of the config; paths in it are relative to its folder.
        mechanism: name or file; guessed where one built-in mechanism has just these columns.
        units: such as `mm,deg`, for columns without a unit.
        ask: asks the user a question; None without a terminal.

    Raises:
        InputError: the file cannot be read, has no joints or no pose, or columns lack units and `ask` is None.
    """
    table = read_source(records)
    found = recognise(table)
    if not found.joints or not found.pose:
        what = "joint (q1, J1, A1, joint_1 …)" if not found.joints else "measured pose (x, y, z …)"
        raise InputError(
            f"{records}: no column looks like a {what}; it has {', '.join(table.names)}: rename columns, or write the "
            "config by hand (docs/how_to/records.md)"
        )
    machine, name, why = _machine(found, table, mechanism, ask)
    columns = _columns(found, table, machine, units, ask)
    split, reason = _split(found, table, columns)
    lines = [
        _plain(f"# Written by `ccnn new` for {records.name}, {len(table)} rows: check what it guessed."),
        "# `ccnn keys` lists every key.",
        f"records: {json.dumps(_relative(records, out), ensure_ascii=False)}",
        *_mechanism_lines(name, why, out),
        *_column_lines(columns, found, table),
        *_count_lines(columns, found, table, machine, records),
        f"split: {split}   # {reason}",
        *_other_lines(found, table),
    ]
    return "\n".join(lines) + "\n", name is not None


def _machine(
    found: Recognised, table: Table, given: str | None, ask: Ask | None
) -> tuple[Mechanism | None, str | None, str]:
    """The mechanism, its name or file, and why it is taken."""
    why = "given"
    if given is None:
        fitting = suitable_mechanisms(found, table)
        if len(fitting) == 1:
            given, why = fitting[0], "the built-in one with just these joints and this pose"
        elif ask is not None:
            choices = f" (these fit: {', '.join(fitting)})" if fitting else ""
            given = ask(f"Mechanism: a name, or a file of the arm's geometry (.yaml, .urdf){choices}").strip() or None
    if given is None:
        return None, None, ", ".join(suitable_mechanisms(found, table))
    machine = load_mechanism(given)
    if len(machine.joints) != found.joints:
        raise InputError(
            f"--mechanism {given}: it has {len(machine.joints)} joints, and {table.path} has columns for "
            f"{found.joints}; give the mechanism of these records"
        )
    return machine, given, why


def _columns(
    found: Recognised, table: Table, machine: Mechanism | None, units: str | None, ask: Ask | None
) -> dict[str, str]:
    """Header in the file -> `name[unit]`, of every column that has a meaning."""
    bare = [name for name in found.meaning if not is_unit(table.units[name])]
    if bare and units is None and ask is not None:
        units = ask(f"Units of lengths and angles (columns {', '.join(bare)} have none), e.g. mm,deg")
    if bare and units is None:
        raise InputError(
            f"{table.path}: {', '.join(bare)} {'has' if len(bare) == 1 else 'have'} no unit that is known; add the "
            "units of lengths and of angles: --units mm,deg"
        )
    pair = unit_pair(units) if units is not None else {}
    return {
        name: f"{ours}[{pair[found.unit_kind(ours, machine)] if name in bare else table.units[name]}]"
        for name, ours in found.meaning.items()
    }


def _split(found: Recognised, table: Table, columns: dict[str, str]) -> tuple[str, str]:
    """Split as YAML and why."""
    places = [name for name, ours in found.meaning.items() if ours in ("x", "y", "z")]
    values = [to_si(table.raw(n), columns[n].rpartition("[")[2].rstrip("]"), where=n) for n in places]
    goals = [name for name in found.unknown if name.startswith("goal_")]
    return choose_split(
        np.stack(values, axis=-1) if values else None,
        goals,
        np.stack([table.raw(name) for name in goals], axis=-1) if goals else None,
    )


def _mechanism_lines(name: str | None, why: str, out: Path) -> list[str]:
    if name is not None:
        path = _relative(Path(name), out) if Path(name).is_file() else name
        return [f"mechanism: {json.dumps(path, ensure_ascii=False)}   # {why}", *_dimension_lines(name)]
    fitting = f" ({why} would fit)" if why else ""
    return [
        f"# FILL IN the machine{fitting}: a built-in name, or an arm's geometry as a DH file (.yaml) or URDF;",
        "# docs/how_to/mechanisms.md shows both. `ccnn run` refuses this config until it is given.",
        "# mechanism: my_arm.yaml",
    ]


def _dimension_lines(name: str) -> list[str]:
    """The dimensions that a built-in machine is taken to have."""
    parameters = inspect.signature(REGISTRY[name]).parameters.values() if name in REGISTRY else ()
    sizes = [f"{p.name}: {p.default:g}" for p in parameters if isinstance(p.default, float)]
    if not sizes:
        return []
    return ["# Its dimensions [m, rad]; write those of your machine:", f"# mechanism_keys: {{{', '.join(sizes)}}}"]


def _column_lines(columns: dict[str, str], found: Recognised, table: Table) -> list[str]:
    """The map of columns, without those that need no entry; a covariate without unit is left out."""
    targets = {**columns, **found.inputs}
    needed = {table.header(name): target for name, target in targets.items() if table.header(name) != target}
    bare = [name for name in found.unknown if is_covariate(name) and not table.units[name]]
    lines = [f"# Orientation: {text}." for name, text in _ORIENTATION.items() if name in found.pose]
    if not needed and not bare:
        return lines
    entries = [f"  {_quoted(header)}: {json.dumps(target, ensure_ascii=False)}" for header, target in needed.items()]
    entries += [f'  {_quoted(n)}: ignore   # no unit: write "{n}[unit]" to have it as an input' for n in bare]
    return [*lines, "columns:", *entries]


def _count_lines(
    columns: dict[str, str], found: Recognised, table: Table, machine: Mechanism | None, records: Path
) -> list[str]:
    """The map of joints of a Fanuc, whose third joint may be counted from the horizontal: by what fits the rows."""
    if not isinstance(machine, SerialArm) or "fanuc_w" not in found.pose:
        return []
    try:
        rows = load_records(
            records, machine, [], learns=False, columns={table.header(name): target for name, target in columns.items()}
        )
        counted = coupled_count(machine, rows.joints, rows.pose)
    except InputError:
        # What is wrong with the rows is told by the command that reads them.
        return []
    if counted is None:
        return []
    shown = {ours: name if name.isidentifier() else f"'{name}'" for name, ours in found.meaning.items()}
    text = " ".join(shown.get(word, word) for word in counted.split())
    return [f"joint_map: {{q3: {_quoted(text)}}}   # J3 counts from the horizontal: so the rows fit far better"]


def _other_lines(found: Recognised, table: Table) -> list[str]:
    inputs = [name for name in found.unknown if is_covariate(name) and table.units[name]]
    inputs += [target.partition("[")[0] for target in found.inputs.values()]
    ignored = [name for name in found.unknown if not is_covariate(name)]
    lines = [f"# Inputs beside the joints, by their names: {', '.join(inputs)}."] if inputs else []
    if ignored:
        lines.append(f"# Not used: {', '.join(ignored)}. `covariates: [NAME]` makes one an input.")
    return [_plain(line) for line in lines]


def _quoted(header: str) -> str:
    return json.dumps(header, ensure_ascii=False)


def _plain(line: str) -> str:
    """A comment on one line, with blanks for characters that are not printable."""
    return "".join(mark if mark.isprintable() else " " for mark in line)


def _relative(path: Path, out: Path) -> str:
    """From the config's folder where the file is below it, else the whole path."""
    folder, file = out.absolute().parent, path.absolute()
    return os.path.relpath(file, folder) if file.is_relative_to(folder) else str(file)
