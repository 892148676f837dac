"""Guess joints, pose and units from the headers of a table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.mechanisms.registry import REGISTRY
from ccnn_torch.records import DEFAULT_COVARIATES
from ccnn_torch.records.pose_columns import EULER_ANGLES
from ccnn_torch.records.table import Table
from ccnn_torch.units import si_unit_of

_JOINT = re.compile(r"(q|j|a|joint|axis|achse|theta)0*(\d+)")
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
# Mechanisms whose number of joints or frames does not follow from headers.
_OPEN = ("serial", "framed")


@dataclass(frozen=True)
class Recognised:
    """Columns that have a meaning, and the rest.

    Attributes:
        meaning: name in the file -> our name, joints first.
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
        return {name for name in self.meaning.values() if not re.fullmatch(r"q\d+", name)}

    def unit_kind(self, name: str, machine: Mechanism | None) -> str:
        """SI unit that a column of ours is in: `m`, `rad` or `1`."""
        known = {} if machine is None else {c.name: c.unit for c in (*machine.joints, *machine.pose)}
        if name in known:
            return known[name]
        return "m" if name in _POSITION else "1" if name in ("qw", "qx", "qy", "qz") else "rad"


def recognise(table: Table) -> Recognised:
    """Find joints (q1, J1, A1, joint_1, axis1, …) and pose columns by their names, ignoring case."""
    folded = {name: re.sub(r"[\s_.\-]", "", name).lower() for name in table.names}
    families: dict[str, dict[int, str]] = {}
    for name, plain in folded.items():
        match = _JOINT.fullmatch(plain)
        if match is not None:
            families.setdefault(match[1], {}).setdefault(int(match[2]), name)
    numbered = [f for f in families.values() if set(f) == set(range(1, len(f) + 1))]
    family = families["q"] if families.get("q") in numbered else max(numbered, key=len, default={})
    meaning = {family[k]: f"q{k}" for k in sorted(family)}
    wanted = _POSITION | {c.name for name in REGISTRY if name not in _OPEN for c in load_mechanism(name).pose}
    wanted -= {"rx", "ry", "rz"}
    by_plain = {plain: name for name, plain in reversed(folded.items()) if name not in meaning}
    meaning |= {by_plain[plain]: ours for ours in sorted(wanted) if (plain := ours.replace("_", "")) in by_plain}
    for theirs, ours in _TURNS:
        plains = [name.replace("_", "") for name in theirs]
        if all(plain in by_plain for plain in plains):
            meaning |= dict(zip((by_plain[plain] for plain in plains), ours, strict=True))
            break
    inputs = _inputs(table, {name: plain for name, plain in folded.items() if name not in meaning}, len(family))
    known = meaning.keys() | inputs.keys()
    return Recognised(meaning, len(family), [name for name in table.names if name not in known], inputs)


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
        wanted = {c.name: c.unit for c in (*machine.joints, *machine.pose)}
        if set(wanted) == set(theirs) and all(_fits(theirs[ours], unit) for ours, unit in wanted.items()):
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


def is_covariate(name: str, patterns: Sequence[str] = DEFAULT_COVARIATES) -> bool:
    """Whether a run takes a column of this name as an input by default."""
    from fnmatch import fnmatchcase

    return any(fnmatchcase(name, pattern) for pattern in patterns)


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
    distinct = len(np.unique(rows, axis=0))
    return 10 <= distinct <= 0.8 * len(rows)


def _fits(unit: str, si_unit: str) -> bool:
    return not unit or _kind(unit) == si_unit


def _kind(unit: str) -> str | None:
    try:
        return si_unit_of(unit)
    except InputError:
        return None
