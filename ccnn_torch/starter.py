"""A commented config to start from, for a table of measurements whose columns are recognised."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ccnn_torch.display import count_text
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.mechanisms.dh_file import urdf_joints
from ccnn_torch.mechanisms.frames.judge import coupled_count
from ccnn_torch.mechanisms.registry import REGISTRY, dimensions
from ccnn_torch.motion.log import load_logs
from ccnn_torch.plugins import is_plugin
from ccnn_torch.records import DEFAULT_COVARIATES
from ccnn_torch.records.commanded import GOAL
from ccnn_torch.records.formats import form_of
from ccnn_torch.records.headers import EULER_ANGLES
from ccnn_torch.records.load import load_records, read_source
from ccnn_torch.records.table import PAYLOAD, Table
from ccnn_torch.spelling import matching
from ccnn_torch.units import si_unit_of, to_si

_quoted = partial(json.dumps, ensure_ascii=False)
_JOINT = re.compile(r"(q|j|a|joint|axis|achse|theta|leg)0*(\d+)")
# As drivers write them: actual_q_0, arm_1_joint, left_joint3.
_OTHER_JOINT = re.compile(
    r"(?=.*(?:joint|axis|q\d))(?!.*(?:target|goal|com|cmd|desired|soll|guess|speed|vel|torque|effort|cur|temp|dir))"
    r"(\D*)(\d+)(?:joint|axis|pos|position)*"
)
_POSITION = {"x", "y", "z"}
# Names of conditions in German, French, Italian and Spanish; taken only where unit and values fit, too.
_TIME = re.compile(r"(mess)?(zeit|time|temps|tempo|tiempo)")
_TEMPERATURE = re.compile(r".*(temp|temperatura?|temperature|température)")
_DIRECTION = re.compile(r"(?:anfahrt|(?:anfahr|dreh|fahr)?richtung|sens|direzione|dirección|sentido)[a-z]?0*(\d+)")
# Usual names -> names of this package; only as a complete set, because a single letter is ambiguous.
_TURNS = (
    (("rx", "ry", "rz"), ("rx", "ry", "rz")),
    (("qw", "qx", "qy", "qz"), ("qw", "qx", "qy", "qz")),
    *((columns, columns) for columns, _ in EULER_ANGLES.values()),
    (("a", "b", "c"), EULER_ANGLES["kuka"][0]),
    (("w", "p", "r"), EULER_ANGLES["fanuc"][0]),
)
# How others call the coordinates of a commanded pose, before or after the coordinate.
_GOALS = ("goal", "commanded", "command", "cmd", "target", "soll")
# How others call what was measured, before or after the coordinate; where it is no joint.
_MEASURED = re.compile(r"(?:measured|meas|actual|act|ist)?(.+?)(?:measured|meas|actual|act|ist)?")
# Mechanisms whose number of joints or frames does not follow from headers.
_OPEN = ("serial", "framed", "partial", "instrument", "pair", "machine")


@dataclass(frozen=True)
class Recognised:
    """Columns that have a meaning, and the rest.

    Attributes:
        meaning: name in the file -> our name, joints first; where there are none, with the commanded pose, `goal_x` ….
        joints: how many joints.
        unknown: names in the file that mean nothing here.
        inputs: name in the file -> our header of a time, a temperature and directions under another name.
    """

    meaning: dict[str, str]
    joints: int
    unknown: list[str] = field(default_factory=list)
    inputs: dict[str, str] = field(default_factory=dict)

    @property
    def pose(self) -> set[str]:
        """Our names of the pose columns that are there."""
        return {name for name in self.meaning.values() if not re.fullmatch(r"q\d+|goal_.+", name)}

    @property
    def goals(self) -> dict[str, str]:
        """Columns of a commanded pose: name in the file -> our name."""
        return {name: ours for name, ours in self.meaning.items() if ours.startswith(GOAL)}

    def unit_kind(self, name: str, machine: Mechanism | None) -> str:
        """SI unit that a column of ours is in: `m`, `rad` or `1`."""
        name = name.removeprefix(GOAL)
        known = {} if machine is None else {c.name: c.unit for c in (*machine.joints, *machine.pose)}
        if name in known:
            return known[name]
        return "m" if name in _POSITION else "1" if name in ("qw", "qx", "qy", "qz") else "rad"


def recognise(table: Table, joints: Sequence[str] = (), pose: Iterable[str] = ()) -> Recognised:
    """Find joints (q1, J1, A1, joint_1, axis1, …) and pose columns by their names, ignoring case.

    joints: what the mechanism's file calls them; a column may say after it that it is a position.
    pose: names of the mechanism's own coordinates.
    """
    folded = {name: _folded(name) for name in table.names}
    families: dict[str, dict[int, str]] = {}
    for pattern in (_JOINT, _OTHER_JOINT):
        for name, plain in folded.items() if not families else ():
            match = pattern.fullmatch(plain)
            if match is not None:
                families.setdefault(match[1], {}).setdefault(int(match[2]), name)
    # Some count from 0.
    families = {word: {k + (0 in f): n for k, n in f.items()} for word, f in families.items()}
    numbered = [f for f in families.values() if set(f) == set(range(1, len(f) + 1))]
    family = families["q"] if families.get("q") in numbered else max(numbered, key=len, default={})
    own = [
        next((n for n, plain in folded.items() if plain in (j, f"{j}pos", f"{j}position")), "")
        for j in map(_folded, joints)
    ]
    if not family and all(own):
        family = dict(enumerate(own, 1))
    meaning = {family[k]: f"q{k}" for k in sorted(family)}
    wanted = _POSITION | {c.name for name in REGISTRY if name not in _OPEN for c in load_mechanism(name).pose}
    wanted = (wanted | {*pose}) - {"rx", "ry", "rz"}
    by_plain = {plain: name for name, plain in reversed(folded.items()) if name not in meaning}
    by_plain = {m[1]: name for plain, name in by_plain.items() if (m := _MEASURED.fullmatch(plain))} | by_plain
    meaning |= {by_plain[plain]: ours for ours in sorted(wanted) if (plain := ours.replace("_", "")) in by_plain}
    for theirs, ours in _TURNS:
        plains = [name.replace("_", "") for name in theirs]
        if all(plain in by_plain for plain in plains):
            meaning |= dict(zip((by_plain[plain] for plain in plains), ours, strict=True))
            break
    if not family:
        meaning |= _goals(by_plain, wanted)
    inputs = _inputs(table, {name: plain for name, plain in folded.items() if name not in meaning}, len(family))
    known = meaning.keys() | inputs.keys()
    return Recognised(meaning, len(family), [name for name in table.names if name not in known], inputs)


def _folded(name: str) -> str:
    return re.sub(r"[\s_.\-]", "", name).lower()


def _goals(by_plain: Mapping[str, str], wanted: set[str]) -> dict[str, str]:
    """Name in the file -> our name of the coordinates of a commanded pose; by_plain: plain name -> name in the file."""
    single = {ours.replace("_", ""): ours for ours in sorted(wanted)}
    for word in _GOALS:
        there = {
            plain.removeprefix(word) if plain.startswith(word) else plain.removesuffix(word): name
            for plain, name in by_plain.items()
            if plain.startswith(word) or plain.endswith(word)
        }
        found = {there[plain]: GOAL + ours for plain, ours in single.items() if plain in there}
        for theirs, ours in _TURNS:
            if all(name.replace("_", "") in there for name in theirs):
                names = (there[name.replace("_", "")] for name in theirs)
                return found | {name: GOAL + own for name, own in zip(names, ours, strict=True)}
        if found:
            return found
    return {}


def _inputs(table: Table, folded: Mapping[str, str], joints: int) -> dict[str, str]:
    """The one time, the one temperature, and a direction (-1, 0 or 1) of every joint; folded: name -> plain name."""
    found = {}
    for ours, pattern, kind in (("time", _TIME, "s"), ("temperature", _TEMPERATURE, "K")):
        there = [
            name for name, plain in folded.items() if pattern.fullmatch(plain) and _kind(table.units[name]) == kind
        ]
        if len(there) == 1 and ours not in table:
            found[there[0]] = f"{ours}[{table.units[there[0]]}]"
    matches = {name: _DIRECTION.fullmatch(plain) for name, plain in folded.items()}
    signs = sorted((int(match[1]), name) for name, match in matches.items() if match and _is_sign(table, name))
    if [k for k, _ in signs] == [*range(1, joints + 1)] and not any(f"direction{k}" in table for k, _ in signs):
        found |= {name: f"direction{k}[1]" for k, name in signs}
    return found


def _is_sign(table: Table, name: str) -> bool:
    return table.units[name] in ("", "1", "-") and bool(np.isin(table.raw(name), (-1.0, 0.0, 1.0)).all())


def suitable_mechanisms(found: Recognised, table: Table) -> list[str]:
    """Built-in mechanisms whose joints and pose are exactly those of the table, units included where it has them."""
    theirs = {ours: table.units[name] for name, ours in found.meaning.items()}
    fitting = []
    for name in REGISTRY:
        if name in _OPEN:
            continue
        machine = load_mechanism(name)
        wanted = {c.name: c.unit for c in (*(() if found.goals else machine.joints), *machine.pose)}
        wanted |= {GOAL + c.name: c.unit for c in machine.pose} if found.goals else {}
        if set(wanted) == set(theirs) and all(_kind(theirs[n]) == u for n, u in wanted.items() if theirs[n]):
            fitting.append(name)
    return fitting


def unit_pair(text: str) -> dict[str, str]:
    """Of `mm,deg`: SI unit -> unit of the lengths and of the angles.

    Raises:
        InputError: it is not a length and an angle.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 2 or [_kind(part) for part in parts] != ["m", "rad"]:
        raise InputError(f"--units {text}: write the unit of lengths and that of angles, e.g. mm,deg or m,rad")
    return {"m": parts[0], "rad": parts[1], "1": "1"}


def is_unit(text: str) -> bool:
    """Whether a unit is there and known."""
    return bool(text) and _kind(text) is not None


def choose_split(positions: np.ndarray[tuple[int, int], np.dtype[np.float64]] | None, names: Sequence[str],
                 goals: np.ndarray[tuple[int, int], np.dtype[np.float64]] | None) -> tuple[str, str]:  # fmt: skip
    """Split of a config, as YAML, and why: whole targets are held out where targets repeat.

    Args:
        positions: `s x d` [m], or None where the pose has none.
        names: of the columns `goals`, which hold the commanded targets, `s x g`; None without.
    """
    if goals is not None and _repeats(np.round(goals, 9)):
        return f"{{kind: group, by: [{', '.join(names)}], test: 0.3, validation: 0.2}}", (
            "targets repeat: all rows of one target (goal columns) are on one side"
        )
    if positions is not None and _repeats(np.round(positions / 5e-3)):
        return "{kind: group, by: position:5mm, test: 0.3, validation: 0.2}", (
            "positions repeat: all rows of one 5 mm cell are on one side"
        )
    return "{kind: random, test: 0.3, validation: 0.2}", "targets do not repeat: single rows are held out"


def _repeats(rows: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> bool:
    """Whether at least a fifth of the rows repeats the position of another one, at 10 positions or more."""
    return 10 <= len(np.unique(rows, axis=0)) <= 0.8 * len(rows)


def _kind(unit: str) -> str | None:
    try:
        return si_unit_of(unit)
    except InputError:
        return None


# Bytes in which a program says what it is; beyond this length no vector is a rotation vector, rounding aside [rad].
_HEAD, _VECTOR = 4096, 1.01 * np.pi
Ask = Callable[[str], str]
_ORIENTATION = {"rx": "a rotation vector, as Universal Robots gives it", "kuka_a": "KUKA's A, B, C (Rz Ry Rx)",
                "fanuc_w": "Fanuc's W, P, R (fixed axes x, y, z)", "staubli_rx": "Stäubli's Rx, Ry, Rz",
                "qw": "a quaternion"}  # fmt: skip


def starter_config(
    records: Path, out: Path, mechanism: str | None = None, units: str | None = None, ask: Ask | None = None
) -> tuple[str, bool]:
    """Text of a commented config for records or a log, and whether it can be run as it is; `command_of` runs it.

    Args:
        records: the file or folder.
        out: path of the config; paths in it are relative to its folder.
        mechanism: name or file; guessed where one built-in mechanism has just these columns.
        units: such as `mm,deg`, for columns without a unit; of a log the unit of its joints.
        ask: asks the user a question; None without a terminal.

    Raises:
        InputError: the file cannot be read, has no joints or no pose, or columns lack units and `ask` is None.
    """
    form = form_of(records)
    if form is not None and form.motion:
        return _motion_config(
            records, out, mechanism, {} if units is None else {"units": units.rpartition(",")[2].strip()}
        )
    table = read_source(records)
    if {"time", "command1", "q1"} <= {*table.names}:
        return _motion_config(records, out, mechanism, {})
    given = None if mechanism is None else load_mechanism(mechanism)
    named = urdf_joints(mechanism) if mechanism and mechanism.lower().endswith(".urdf") else ()
    found = recognise(table, named, () if given is None else [c.name for c in given.pose])
    if not (found.joints or found.goals) or not found.pose:
        if {"time", "command"} <= {name.lower().rstrip("0123456789_ ") for name in table.names}:
            raise InputError(
                f"{records}: looks like a motion's log; name its columns time[s], command1[rad], q1[rad] (or deg, mm) "
                f"and current1[A] if there is one, then ccnn diagnose --motion {records} --mechanism servo reads it"
            )
        what, own = "measured pose (x, y, z …)", "x"
        if not (found.joints or found.goals):
            what, own = "joint (q1, J1, A1, joint_1 …) or a commanded pose (goal_x, goal_y …)", "q1"
        first = next((n for n in table.names if _kind(table.units[n]) in ("rad", "m")), table.names[0])
        told = f'columns: {{"{table.header(first)}": "{own}[{table.units[first] or "deg"}]", …}}'
        raise InputError(
            f"{records}: no column looks like a {what}; it has {', '.join(table.names)}: rename, or give {told}"
        )
    machine, name, why = _machine(found, table, mechanism, ask, given)
    columns = _columns(found, table, machine, units, ask)
    columns, why_turned = _turned(columns, table, records)
    split, reason = _split(found, table, columns)
    lines = [
        _plain(f"# Written by `ccnn new` for {records.name}, {len(table)} rows: check what it guessed."),
        "# `ccnn keys` lists every key.",
        f"records: {_quoted(_relative(records, out))}",
        *_mechanism_lines(name, why, out),
        *_column_lines(columns, found, table, why_turned),
        *(["# No joints: they are the nominal inverse kinematics of the commanded pose."] if found.goals else []),
        *_count_lines(columns, found, table, machine, records),
        *(form.config if form and form.config else [f"split: {split}   # {reason}"]),
        *([] if form and form.config else _other_lines(found, table)),
    ]
    return "\n".join(lines) + "\n", name is not None


def command_of(text: str, config: Path) -> str:
    """The command line for a config that `starter_config` wrote."""
    keys = parse_yaml(text, str(config))
    if isinstance(keys, dict) and "constraint" in keys:
        return f"ccnn identify {config} out=runs/{config.stem}"
    return f"ccnn diagnose --config {config} --out runs/{config.stem}"


def _motion_config(records: Path, out: Path, mechanism: str | None, keys: Mapping[str, Any]) -> tuple[str, bool]:
    """As `starter_config`, of a log of a machine in motion."""
    logs = load_logs([records], keys=keys)
    samples, notes = sum(len(log.time) for log in logs), [note for log in logs for note in log.notes]
    servo = "each joint follows its command; keys of the drives, or an MJCF of the arm: docs/how_to/motion.md"
    lines = [
        _plain(f"# Written by `ccnn new` for {records.name}, {count_text(len(logs), 'run')}, {samples} samples."),
        *(_plain(f"# {note.removeprefix(f'{records}: ')}.") for note in notes),
        f"motion: {_quoted(_relative(records, out))}",
        *([f"motion_keys: {_quoted(dict(keys))}"] if keys else []),
        *(_mechanism_lines(mechanism, "given", out) if mechanism else [f"mechanism: servo   # {servo}"]),
    ]
    return "\n".join(lines) + "\n", True


def _machine(
    found: Recognised, table: Table, given: str | None, ask: Ask | None, loaded: Mechanism | None
) -> tuple[Mechanism | None, str | None, str]:
    """The mechanism, its name or file, and why it is taken."""
    why = "given"
    if given is None:
        fitting = suitable_mechanisms(found, table)
        # Joints of which no unit is told may be those of an arm as well.
        bare = any(not table.units[name] for name, ours in found.meaning.items() if re.fullmatch(r"q\d+", ours))
        if len(fitting) == 1 and not (bare and found.pose >= _POSITION):
            given, why = fitting[0], "the built-in one with just these joints and this pose"
        elif ask is not None:
            choices = f" (these fit: {', '.join(fitting)})" if fitting else ""
            given = ask(f"Mechanism: a name, or a file of the arm's geometry (.yaml, .urdf){choices}").strip() or None
    if given is None:
        return None, None, ", ".join(suitable_mechanisms(found, table))
    machine = load_mechanism(given) if loaded is None else loaded
    if not found.goals and len(machine.joints) != found.joints:
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
    kinds = {name: found.unit_kind(found.meaning[name], machine) for name in bare}
    pair = {"1": "1", **table.declared}
    told = {*kinds.values()} <= {*pair}
    if not told and units is None and ask is not None:
        units = ask(f"Units of lengths and angles (columns {', '.join(bare)} have none), e.g. mm,deg")
    if not told and units is None:
        raise InputError(
            f"{table.path}: {', '.join(bare)} {'has' if len(bare) == 1 else 'have'} no unit that is known; add the "
            "units of lengths and of angles: --units mm,deg"
        )
    pair = unit_pair(units) if units is not None else pair
    return {
        name: f"{ours}[{pair[kinds[name]] if name in bare else table.units[name]}]"
        for name, ours in found.meaning.items()
    }


def _turned(columns: dict[str, str], table: Table, records: Path) -> tuple[dict[str, str], str]:
    """Rx, Ry, Rz as angles about fixed axes where the file or its values say that they are no rotation vector; why.

    SpatialAnalyzer's are such unless another convention was chosen there.
    """
    named = {ours.partition("[")[0]: name for name, ours in columns.items()}
    if not {"rx", "ry", "rz"} <= named.keys():
        return columns, ""
    names = [named[axis] for axis in ("rx", "ry", "rz")]
    turns = np.stack([to_si(table.raw(n), columns[n].rpartition("[")[2].rstrip("]"), where=n) for n in names], -1)
    largest = float(np.nanmax(np.linalg.norm(turns, axis=-1), initial=0.0))
    with records.open("rb") as file:
        theirs = re.search(rb"spatial\s*analyzer|new river kinematics", file.read(_HEAD), re.IGNORECASE)
    if theirs:
        why = f"the file is of {theirs[0].decode()}, whose usual convention this is"
    elif largest > _VECTOR:
        why = f"a rotation vector is not longer than 180 deg, and here it would be {np.degrees(largest):.0f} deg"
    else:
        return columns, ""
    fixed = dict(zip(names, EULER_ANGLES["fanuc"][0], strict=True))
    return {n: ours if n not in fixed else f"{fixed[n]}[{ours.partition('[')[2]}" for n, ours in columns.items()}, why


def _split(found: Recognised, table: Table, columns: dict[str, str]) -> tuple[str, str]:
    """Split as YAML and why."""
    places = [name for name, ours in found.meaning.items() if ours in ("x", "y", "z")]
    values = [to_si(table.raw(n), columns[n].rpartition("[")[2].rstrip("]"), where=n) for n in places]
    goals = {name: name for name in found.unknown if name.startswith(GOAL)} | found.goals
    return choose_split(
        np.stack(values, axis=-1) if values else None,
        [*goals.values()],
        np.stack([table.raw(name) for name in goals], axis=-1) if goals else None,
    )


def _mechanism_lines(name: str | None, why: str, out: Path) -> list[str]:
    if name is not None:
        file, colon, of = name.rpartition(":") if is_plugin(name) else (name, "", "")
        path = _relative(Path(file), out) + colon + of if Path(file).is_file() else name
        keys = ["mechanism_keys: {allow_code: true}   # it is Python code"] if colon else _dimension_lines(name)
        return [f"mechanism: {_quoted(path)}   # {why}", *keys]
    fitting = f" ({why} would fit)" if why else ""
    return [
        f"# FILL IN the machine{fitting}: a built-in name, or an arm's geometry as a DH file (.yaml) or URDF;",
        "# docs/how_to/mechanisms.md shows both. `ccnn run` refuses this config until it is given.",
        "# mechanism: my_arm.yaml",
    ]


def _dimension_lines(name: str) -> list[str]:
    """The dimensions that a built-in machine is taken to have."""
    sizes = dimensions(name)
    keys = ["# Its dimensions [m, rad]; write those of your machine:", f"# mechanism_keys: {{{sizes}}}"]
    return keys if sizes else []


def _column_lines(columns: dict[str, str], found: Recognised, table: Table, why: str) -> list[str]:
    """The map of columns, without those that need no entry; a covariate without unit is left out.

    why: Rx, Ry, Rz are taken for angles about fixed axes.
    """
    targets = {**columns, **found.inputs}
    needed = {table.header(name): target for name, target in targets.items() if table.header(name) != target}
    bare = [name for name in matching(found.unknown, DEFAULT_COVARIATES) if not table.units[name]]
    lines = [f"# Orientation: {text}." for name, text in _ORIENTATION.items() if name in found.pose]
    if why:
        lines = [
            f"# Orientation: angles about the fixed axes x, y, z in turn: {why}.",
            "# For another one write rx, ry, rz (a rotation vector) below columns, or names of docs/how_to/records.md.",
        ]
    if not needed and not bare:
        return lines
    entries = [f"  {_quoted(header)}: {_quoted(target)}" for header, target in needed.items()]
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
    inputs = [name for name in matching(found.unknown, DEFAULT_COVARIATES) if table.units[name]]
    inputs += [target.partition("[")[0] for target in found.inputs.values()]
    read = [*DEFAULT_COVARIATES, *([PAYLOAD] if "load_z" in inputs else [])]
    ignored = [name for name in found.unknown if not matching([name], read)]
    lines = [f"# Inputs beside the joints, by their names: {', '.join(inputs)}."] if inputs else []
    if ignored:
        lines.append(f"# Not used: {', '.join(ignored)}. `covariates: [NAME]` makes one an input.")
    warm = [name for name in ignored if table.units[name] and si_unit_of(table.units[name]) == "K"]
    for name in warm[: "temperature" not in inputs]:
        meant = _quoted(f"temperature[{table.units[name]}]")
        lines.append(f"# columns: {{{_quoted(name)}: {meant}}} makes it the temperature that growth follows.")
    return [_plain(line) for line in lines]


def _plain(line: str) -> str:
    """A comment on one line, with blanks for characters that are not printable."""
    return "".join(mark if mark.isprintable() else " " for mark in line)


def _relative(path: Path, out: Path) -> str:
    """From the config's folder where the file is below it, else the whole path."""
    folder, file = out.absolute().parent, path.absolute()
    return str(file.relative_to(folder) if file.is_relative_to(folder) else file)
