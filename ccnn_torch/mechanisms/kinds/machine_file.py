"""Machine files: a kind of machine and the numbers that people know of it, in the words and units that they use.

machine: gantry
base_frame: unknown
numbers:
  lead_x: 0 um/m +- 300 um/m
  …

Each number is a view: of a serial arm it adds to parameters of links and drives, of another mechanism it stands for one
parameter of each leg. The files beside this one declare the kinds.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms.gears import read_gears, read_motors
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.spelling import hint
from ccnn_torch.units import LARGEST, amount, si_unit_of

_FOLDER = Path(__file__).parent
KINDS = tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))
"""Names of the kinds."""

_BARE = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?\s*")
_TOLERANCE = re.compile(r"\+-|±")
_AXES = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}
_OF_ARMS = (
    *("base_frame", "tool_frame", "tool_offset", "orientation", "frame_per", "tool_per"),
    *("limits", "gears", "motors", "pitch_errors"),
)
_FRAME = ("m", "m", "m", "rad", "rad", "rad")


@dataclass(frozen=True)
class _Number:
    """One value of a machine file: what it is and how well it is known [SI], and the unit that it is told in."""

    value: float | None
    tolerance: float
    shown: str


@cache
def _kind(name: str) -> Mapping[str, Any]:
    found: Mapping[str, Any] = parse_yaml((_FOLDER / f"{name}.yaml").read_text(encoding="utf-8"), name)
    return found


def read_machine_file(path: str) -> dict[str, Any] | None:
    """Contents of the file, or None where it is no machine file: has no key `machine`, or cannot be read at all."""
    try:
        tree = parse_yaml(read_text(path, CONFIG_LIMIT), path)
    except InputError:
        # The caller knows what else the file should have been, and reports it.
        return None
    return dict(tree) if isinstance(tree, Mapping) and "machine" in tree else None


def build_machine(content: Mapping[str, Any], where: str, makers: Mapping[str, Callable[..., Mechanism]]) -> Mechanism:
    """The mechanism of a machine file.

    Args:
        content: of the file.
        where: opens the sentence of an error.
        makers: of mechanisms by name.

    Raises:
        InputError: an unknown kind, key or number (with the nearest), or a value that is none.
    """
    name = content["machine"]
    _check_names([str(name)], list(KINDS), f"{where}: machine:")
    about = _kind(name)
    known = ["machine", "numbers", *(_OF_ARMS if "chain" in about else [])]
    frame = next((key for key in ("base_frame", "tool_frame") if key in content and key not in known), None)
    if frame is not None:
        raise InputError(
            f"{where}: {frame} of a parallel machine is no key of its file; to have frames fitted write "
            "mechanism: framed and mechanism_keys: {mechanism: FILE, base: true, tool: true} into the config"
        )
    _check_names([str(key) for key in content], known, f"{where}: the key")
    given = content.get("numbers") or {}
    if not isinstance(given, Mapping):
        raise InputError(f"{where}: numbers: must have lines such as 'lead_x: 0 um/m +- 300 um/m'")
    _check_names([str(key) for key in given], [*about["numbers"], *about.get("keys", {})], f"{where}: numbers:")
    return (_arm if "chain" in about else _parallel)(content, given, where, makers)


def _check_names(names: list[str], known: list[str], start: str) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"{start} '{visible(name)}' is not known; {hint(name, known)}")


def _arm(content: Mapping[str, Any], given: Mapping[str, Any], where: str, _: Any) -> Mechanism:
    name, about = content["machine"], _kind(content["machine"])
    moves = [move.split() for move in about["chain"]]
    numbers = []
    for key, entry in about["numbers"].items():
        unit = _unit_of(entry)
        (number,) = _numbers(key, entry, given, unit, 1, where)
        numbers.append(_told(entry, key, number, entry.get("same_as", "")) | {"name": key, "unit": unit})
        numbers[-1] |= {"nominal": number.value, "of": dict(entry["of"])}
    frames = {
        key: _frame(content.get(f"{key}_frame", about[f"{key}_frame"]), f"{where}: {key}_frame")
        for key in ("base", "tool")
    }
    if "tool_offset" in content:
        if "tool_frame" in content:
            raise InputError(f"{where}: tool_offset and tool_frame both say where the measured point is; remove one")
        offset = content["tool_offset"]
        point = [*offset, 0, 0, 0] if isinstance(offset, list) else offset
        frames["tool"] = _frame(point, f"{where}: tool_offset")
    joints = [f"q{i + 1}" for i in range(len(moves))]
    known = [Coordinate(joint, "rad" if how == "turn" else "m") for joint, (how, _) in zip(joints, moves, strict=True)]
    if motors := content.get("motors"):
        read_motors(motors, known, f"{where}: motors")
    limits = {**about["limits"], **_by_joint(content, "limits", "{q1: [0 mm, 500 mm]}", joints, where)}
    return SerialArm(
        name=name,
        convention="urdf",
        links=[[0.0] * 6 for _ in moves],
        joint_types=["revolute" if how == "turn" else "prismatic" for how, _ in moves],
        axes=[[(-v if axis.startswith("-") else v) for v in _AXES[axis[-1]]] for _, axis in moves],
        base=frames["base"] or [0.0] * 6,
        tool=frames["tool"] or [0.0] * 6,
        limits=[
            _ends(limits[joint], "rad" if how == "turn" else "m", f"{where}: limits.{joint}")
            for joint, (how, _) in zip(joints, moves, strict=True)
        ],
        unknown_frames=[key for key, frame in frames.items() if frame is None],
        orientation=content.get("orientation", about.get("orientation", "rotation_vector")),
        frame_per=_words(content, "frame_per", where),
        tool_per=_words(content, "tool_per", where),
        drives=[(int(d[5]), int(d[6])) for e in about["numbers"].values() for d in e["of"] if d.startswith("drive")],
        numbers=numbers,
        tables=_tables(content, joints, moves, where),
        gears=_gears(content, known, where),
        motors=motors,
    )


def _by_joint(content: Mapping[str, Any], key: str, form: str, joints: Sequence[str], where: str) -> Mapping[str, Any]:
    """What a key tells of some of the joints, by name."""
    given = content.get(key) or {}
    if not isinstance(given, Mapping):
        raise InputError(f"{where}: {key}: must be as {form}, not {given!r}")
    _check_names([str(name) for name in given], [*joints], f"{where}: {key}:")
    return given


def _gears(content: Mapping[str, Any], joints: Sequence[Coordinate], where: str) -> list[float | None]:
    """As of `read_gears`; none where none is told."""
    given = _by_joint(content, "gears", "{q1: 80, q3: 20 mm}", [joint.name for joint in joints], where)

    def number(text: Any, unit: str) -> float:
        if unit == "m" and _BARE.fullmatch(str(text)):
            raise InputError(f"{where}: gears: '{text}' has no unit; write {text} mm")
        return _amount(text, unit, f"{where}: gears")

    return read_gears([given.get(joint.name) for joint in joints], joints, f"{where}: gears", number) if given else []


def _tables(
    content: Mapping[str, Any], joints: Sequence[str], moves: Sequence[Sequence[str]], where: str
) -> list[list[list[float]] | None] | None:
    """Places and errors of each joint's pitch-error table [SI], None of one without; None where there is none."""
    form = "{q1: {at: [0 mm, 250 mm], error: [0 um, 3 um]}}"
    given = _by_joint(content, "pitch_errors", form, joints, where)
    if not given:
        return None
    found: list[list[list[float]] | None] = []
    for joint, (how, _) in zip(joints, moves, strict=True):
        table, unit = given.get(joint), "rad" if how == "turn" else "m"
        if table is None:
            found.append(None)
            continue
        rows = [table.get(key) or [] for key in ("at", "error")] if isinstance(table, Mapping) else []
        if len(rows) != 2 or not all(isinstance(row, list) for row in rows):
            raise InputError(f"{where}: pitch_errors: must be as {form}, not {joint}: {table!r}")
        found.append([[_amount(v, unit, f"{where}: pitch_errors.{joint}") for v in row] for row in rows])
    return found


def _words(content: Mapping[str, Any], key: str, where: str) -> list[str]:
    value = content.get(key, [])
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise InputError(f"{where}: {key}: must be a list of columns, e.g. [station], not {value!r}")
    return value


def _parallel(
    content: Mapping[str, Any], given: Mapping[str, Any], where: str, makers: Mapping[str, Callable[..., Mechanism]]
) -> Mechanism:
    about = _kind(content["machine"])
    keys = {}
    for key, entry in about.get("keys", {}).items():
        (number,) = _numbers(key, entry, given, _unit_of(entry), 1, where)
        if number.tolerance:
            raise InputError(
                f"{where}: numbers.{key}: takes no tolerance, since it is not fitted; write its value alone"
            )
        keys[key] = number.value
    mechanism = makers[about["mechanism"]](**keys)
    places = {p.name: i for i, p in enumerate(mechanism.geometry)}
    geometry = [*mechanism.geometry]
    for key, entry in about["numbers"].items():
        each = entry["each"]
        unit = geometry[places[each[0]]].unit
        same = entry.get("same_as", [""] * len(each))
        # One number for all legs, unless the file has one for each.
        one = key if entry.get("one") and not isinstance(given.get(key), list) else ""
        for parameter, number, label, alike in zip(
            each, _numbers(key, entry, given, unit, len(each), where), about["names"], same, strict=True
        ):
            i = places[parameter]
            value = geometry[i].nominal if number.value is None else number.value
            told = _told(entry, key, number, alike)
            told["word"] += "" if one else label
            geometry[i] = replace(geometry[i], nominal=value, tied=one, **told)
            mechanism.nominal[i] = value
    mechanism.geometry = tuple(geometry)
    mechanism.name = content["machine"]
    mechanism._follow_nominal()
    mechanism.home_joints.copy_(mechanism.solve_inverse(mechanism.home_pose))
    mechanism.recipe = {"spec": "machine", "keys": {"machine": content["machine"], "numbers": dict(given)}}
    return mechanism


def _told(entry: Mapping[str, Any], key: str, number: _Number, alike: str) -> dict[str, Any]:
    """Fields of a `Parameter` that say how it is told and how well it is known."""
    word = entry.get("word", key.replace("_", " "))
    # An exact number has the scale of its kind all the same, where a config sets it free.
    usual = entry["tolerance"][0] if isinstance(entry["tolerance"], list) else entry["tolerance"]
    scale = number.tolerance or _amount(usual, None, key) or None
    return {"word": word, "shown": number.shown, "scale": scale, "held": number.tolerance == 0, "same_as": alike}


def _unit_of(entry: Mapping[str, Any]) -> str:
    """SI unit of a number of an arm, or of a dimension: that of its value, a slope being an angle."""
    unit = si_unit_of(_shown(entry))
    return "rad" if unit == "1" and not any(name.startswith("drive") for name in entry.get("of", ())) else unit


def _shown(entry: Mapping[str, Any]) -> str:
    first = entry["value"][0] if isinstance(entry.get("value"), list) else entry.get("value")
    return str(entry.get("unit") or str(first).partition(" ")[2] or "1")


def _numbers(
    key: str, entry: Mapping[str, Any], given: Mapping[str, Any], unit: str, count: int, where: str
) -> list[_Number]:
    """The values of a number of a file, one for each of `count` legs; else those of its kind."""
    texts = given.get(key, entry.get("value"))
    texts = texts if isinstance(texts, list) else [texts] * count
    if len(texts) != count:
        raise InputError(f"{where}: numbers.{key}: needs one value, or a list of {count}, not {len(texts)}")
    usual = entry.get("tolerance", 0)
    usual = usual if isinstance(usual, list) else [usual] * count
    found = []
    for text, own in zip(texts, usual, strict=True):
        value, *tolerance = _TOLERANCE.split(str(text)) if text is not None else [None]
        # A tolerance alone is of the place as drawn.
        if tolerance and not value and "value" not in entry:
            value = None
        if len(tolerance) > 1:
            raise InputError(
                f"{where}: numbers.{key}: '{visible(str(text))}' has two tolerances; write 250 mm +- 0.5 mm"
            )
        about = f"{where}: numbers.{key}"
        bare = next((part for part in (value, *tolerance) if part and _BARE.fullmatch(part)), None)
        if bare is not None and float(bare) and _shown(entry) != "1":
            raise InputError(f"{about}: '{bare.strip()}' has no unit; write {bare.strip()} {_shown(entry)}")
        spread = _amount(tolerance[0] if tolerance else own, unit, about)
        if not 0 <= spread <= LARGEST:
            raise InputError(f"{about}: the tolerance {visible(str(tolerance[0]))} is none; write 0 or more after +-")
        found.append(_Number(None if value is None else _amount(value, unit, about), spread, _shown(entry)))
    return found


def _amount(text: Any, unit: str | None, where: str) -> float:
    """A number with its unit [SI]; an angle may be written as a slope, um/m."""
    text = str(text).strip()
    slope = unit == "rad" and "/" in text
    value = amount(text, "1" if slope else unit, where)
    if not abs(value) <= LARGEST:
        raise InputError(f"{where}: must be a finite number, not {visible(text)}")
    return value


def _frame(value: Any, where: str) -> list[float] | None:
    """Position and rotation vector [SI], None where it is to be fitted."""
    if value == "unknown":
        return None
    if value == "identity":
        return [0.0] * 6
    if not isinstance(value, list) or len(value) != len(_FRAME):
        raise InputError(f"{where}: must be unknown, identity or [x, y, z, rx, ry, rz], e.g. 10 mm, not {value!r}")
    return [_amount(v, unit, where) for v, unit in zip(value, _FRAME, strict=True)]


def _ends(value: Any, unit: str, where: str) -> list[float]:
    ends = [_amount(v, unit, where) for v in value] if isinstance(value, list) else []
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise InputError(f"{where}: must be [lowest, highest], e.g. [-90 deg, 90 deg], not {value!r}")
    return ends


def template(kind: str) -> str:
    """Text of a machine file of a kind, with comments, to be filled in.

    Raises:
        InputError: there is no such kind.
    """
    _check_names([kind], list(KINDS), "--mechanism: the kind of machine")
    about = _kind(kind)
    lines = [f"# {line}" for line in textwrap.wrap(about["about"], 110)]
    lines.append(f"machine: {kind}")
    if "chain" in about:
        ends = ", ".join(f"{joint}: [{low}, {high}]" for joint, (low, high) in about["limits"].items())
        lines += [
            "# Frames: unknown (fitted to the records), identity, or [x, y, z, rx, ry, rz], as [10 mm, …, 0 deg].",
            *(f"{key}: {_written(about[key])}" for key in ("base_frame", "tool_frame")),
            "# Travel of the joints.",
            f"limits: {{{ends}}}",
            "# Drives that are known, at whose periods errors are looked for: turns of the motor for one of the joint,",
            "# or the lead of a screw:",
            f"# gears: {{q1: {'10 mm' if about['chain'][0].startswith('slide') else 100}}}",
            "# A table of pitch errors that is known (positive = it goes too far); what is found is then beyond it:",
            "# pitch_errors: {q1: {at: [0 mm, 250 mm, 500 mm], error: [0 um, 3 um, -2 um]}}",
        ]
    lines += [
        "# Each number of the machine as drawn, and after +- its tolerance, one standard deviation; +- 0 is exact.",
        "# What is found comes back in these words and units.",
        "numbers:",
    ]
    for key, entry in {**about.get("keys", {}), **about["numbers"]}.items():
        said = f"   # {entry['about']}" if "about" in entry else ""
        lines.append(f"  {key}: {_written(entry.get('value', ''), entry.get('tolerance')).strip()}{said}")
    return "\n".join(lines) + "\n"


def _written(value: Any, tolerance: Any = None) -> str:
    if isinstance(value, list):
        each = tolerance if isinstance(tolerance, list) else [tolerance] * len(value)
        return f"[{', '.join(map(_written, value, each))}]"
    return str(value) if tolerance is None else f"{value} +- {tolerance}"
