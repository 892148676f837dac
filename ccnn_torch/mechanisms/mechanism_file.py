"""Mechanism files: our own, with every parameter's nominal and identified value; an arm as DH table, URDF and MJCF.

mechanism: five_bar
keys: {}
parameters:
  A1x: {value: -0.5057, nominal: -0.5, unit: m}
  …
columns: {A1: "q1[deg]"}   # where the records had other headers
joint_map: {q3: "J3 - J2"}   # where the controller counts its joints otherwise
measured: {q1: [0.2, 1.4]}   # lowest and highest joints of its records [SI]
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement
from xml.parsers import expat

import torch
from torch import Tensor

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_bytes, read_text, read_xml
from ccnn_torch.files.write import write_whole
from ccnn_torch.files.yaml_file import dump_yaml, parse_yaml
from ccnn_torch.mechanisms.dh_file import IDENTITY, URDF_LIMIT, Transform, axis_of, link_of, origin_of, triple
from ccnn_torch.mechanisms.machines.links import compose, transform_of
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.rotations import matrix_to_euler_zyx, matrix_to_rotation_vector, nearest_euler
from ccnn_torch.units import LARGEST

_FORM = "a mechanism file has mechanism, keys and parameters: {NAME: {value: …, nominal: …, unit: …}}"


class MechanismFile:
    """A mechanism file: `spec` and `keys` build the mechanism; the rest is of its records."""

    def __init__(self, path: str, content: Mapping[str, Any]) -> None:
        """Check the form; names and units are checked against the mechanism by `parameters_of`."""
        self.path = path
        spec, keys, parameters = (content.get(k) for k in ("mechanism", "keys", "parameters"))
        if not isinstance(spec, str) or not isinstance(keys, Mapping) or not isinstance(parameters, Mapping):
            raise InputError(f"{path}: {_FORM}")
        maps = [content.get(key) or {} for key in ("columns", "joint_map")]
        for key, found, example in zip(("columns", "joint_map"), maps, ("A1: 'q1[deg]'", "q3: 'J3 - J2'"), strict=True):
            if not isinstance(found, Mapping) or not all(isinstance(v, str) for pair in found.items() for v in pair):
                raise InputError(f"{path}: {key}: must map texts to texts, e.g. {{{example}}}")
        self.columns, self.joint_map = (dict(found) for found in maps)
        self.measured = content.get("measured") or {}
        ends = self.measured.values() if isinstance(self.measured, Mapping) else [None]
        if not all(isinstance(pair, list) and len(pair) == 2 and all(map(_is_number, pair)) for pair in ends):
            raise InputError(
                f"{path}: measured: must map joints to their lowest and highest number, e.g. {{q1: [0, 1]}}"
            )
        self.spec, self.keys = spec, dict(keys)
        self._entries: Mapping[str, Any] = parameters

    def parameters_of(self, mechanism: Mechanism, what: str) -> dict[str, float]:
        """Values by name, `what` being "value" or "nominal" [SI]."""
        known = {p.name: p.unit for p in mechanism.geometry}
        wrong = sorted(set(known) ^ set(self._entries))
        if wrong:
            raise InputError(
                f"{self.path}: parameters: {mechanism.name} has {', '.join(known)}; check {', '.join(map(str, wrong))}"
            )
        found = {}
        for name, unit in known.items():
            entry = self._entries[name]
            value = entry.get(what) if isinstance(entry, Mapping) else None
            if not _is_number(value):
                shown = visible(repr(value))
                raise InputError(f"{self.path}: parameters.{name}.{what}: must be a finite number, not {shown}")
            if entry.get("unit") != unit:
                raise InputError(f"{self.path}: parameters.{name}.unit: must be {unit}, not {entry.get('unit')!r}")
            found[name] = float(value)
        return found


def _is_number(value: Any) -> TypeGuard[float]:
    return not isinstance(value, bool) and isinstance(value, int | float) and abs(value) <= LARGEST


def read_mechanism_file(path: str, content: bytes | None = None) -> MechanismFile | None:
    """Contents of the file, or None where it is no mechanism file: has no key `mechanism`, or cannot be read at all."""
    try:
        text = read_text(path, CONFIG_LIMIT) if content is None else content.decode("utf-8")
        tree = parse_yaml(text, path)
    except (InputError, UnicodeDecodeError):
        # The caller knows what else the file should have been, and reports it.
        return None
    if not isinstance(tree, Mapping) or "mechanism" not in tree:
        return None
    return MechanismFile(path, tree)


def mechanism_text(
    mechanism: Mechanism,
    nominal: Mapping[str, float],
    columns: Mapping[str, str] | None = None,
    joint_map: Mapping[str, str] | None = None,
    measured: Mapping[str, Sequence[float]] | None = None,
) -> str:
    """A mechanism file's text; `load_mechanism` of it gives the same mechanism with the same parameters, bit by bit.

    Args:
        nominal: what was there before, by name [SI].
        columns: the headers that its records mapped.
        joint_map: the joints as sums of its records' columns.
        measured: lowest and highest joint of its records, by name [SI].
    """
    about = mechanism.describe()
    tree = {
        "mechanism": about["spec"],
        "keys": about["keys"],
        "parameters": {
            p.name: {"value": about["parameters"][p.name], "nominal": nominal[p.name], "unit": p.unit}
            for p in mechanism.geometry
        },
        **({"columns": dict(columns)} if columns else {}),
        **({"joint_map": dict(joint_map)} if joint_map else {}),
        **({"measured": {name: list(pair) for name, pair in measured.items()}} if measured else {}),
    }
    return dump_yaml(tree, width=120)


_STANDARD = "standard Denavit-Hartenberg; link i = Rz(q_i + theta_i) * Tz(d_i) * Tx(a_i) * Rx(alpha_i)"
_MODIFIED = "Rx(alpha_i) * Tx(a_i) * Rz(q_i + theta_i) * Tz(d_i)"
_OF_THE_SHEET = ("limits", "masses", "centres", "gears", "motors")
# As they stand in the file, without and with leans.
_CONVENTIONS = {
    "standard": (_STANDARD, f"{_STANDARD} * Ry(beta_i)"),
    "modified": tuple(f"modified Denavit-Hartenberg (Craig); link i = {by}{_MODIFIED}" for by in ("", "Ry(beta_i) * ")),
}


def dh_text(arm: SerialArm) -> str:
    """The arm's nominal parameters as a DH file in m and rad; `read_dh_file` gives the same floats back.

    Frames that are per group of rows stay unknown, as they are no one transform.
    """
    if arm.convention not in _CONVENTIONS:
        raise InputError(f"arm '{arm.name}' is described by a URDF and has no Denavit-Hartenberg table; write a URDF")
    values = arm.nominal.tolist()
    links = arm.links(arm.nominal).T.tolist()
    tree: dict[str, Any] = {
        "robot": visible(arm.name),
        "dof": len(arm.joints),
        "convention": _CONVENTIONS[arm.convention][bool(arm.leans)],
        "units": {"length": "m", "angle": "rad"},
        "joint_types": ["revolute" if r else "prismatic" for r in arm.revolute.tolist()],
        "joint_sign": arm.signs.tolist(),
        **dict(zip(("a", "alpha", "d", "theta"), links, strict=True)),
        **({"beta": arm.lean_of_links(arm.nominal).tolist()} if arm.leans else {}),
        "parallel_axes": [list(group) for group in arm.parallel_axes],
        **{key: value for key in _OF_THE_SHEET if (value := arm.recipe["keys"].get(key))},
        "base_frame": "unknown" if arm.frame_per else values[:6],
        "tool_frame": "unknown" if arm.tool_per else values[-6:],
        "frame_per": list(arm.frame_per),
        "tool_per": list(arm.tool_per),
    }
    if arm.orientation != "rotation_vector" and arm.recipe["keys"]["tool_offset"] is not None:
        tree["tool_offset"] = "unknown" if arm.tool_per else values[-6:-3]
    return dump_yaml(tree, width=200)


def urdf_text(arm: SerialArm) -> str:
    """The arm's nominal parameters as a URDF chain `measurement`, `base_link` … `tool`, frames as fixed joints.

    Each link's fixed transform becomes the origin of the joint behind it (standard DH: the motion comes first) or of
    its own joint (modified DH, URDF). Roll, pitch and yaw are the file's form of a rotation, so a number may differ
    from ours in its last digit. Limits are those that joints are sampled from; URDF wants an effort and a speed, which
    a calibration does not know and which are written as 0.
    """
    base, origins, last = chain_of(arm)
    root = Element("robot", name=visible(arm.name))
    names = ["base_link", *(f"link{i + 1}" for i in range(len(origins))), "tool"]
    for name in ("measurement", *names):
        SubElement(root, "link", name=name)
    _joint(root, "base_frame", "fixed", "measurement", names[0], base)
    for i, origin in enumerate(origins):
        kind = "revolute" if bool(arm.revolute[i]) else "prismatic"
        joint = _joint(root, arm.joints[i].name, kind, names[i], names[i + 1], origin)
        SubElement(joint, "axis", xyz=_numbers(arm.axes[i] * arm.signs[i]))
        low, high = arm.limits[i].tolist()
        SubElement(joint, "limit", lower=repr(low), upper=repr(high), effort="0", velocity="0")
    _joint(root, "tool_frame", "fixed", names[-2], names[-1], last)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def patched_urdf(path: str, before: SerialArm, after: SerialArm) -> str:
    """A user's own URDF with corrected origins of an arm's joints; all else stays as it is, byte by byte.

    What an origin was stands in a comment behind it, and where the base and the measured tool are at the end: these
    are no part of a robot's own file.

    Args:
        path: the URDF.
        before: the arm of its numbers.
        after: the arm of the numbers wanted.

    Raises:
        InputError: as `moved_origins`, or the file is not UTF-8, or names two joints alike.
    """
    moved = {name: (was, now) for name, was, now in moved_origins(path, before, after)}
    content = read_bytes(path, URDF_LIMIT)
    parser, stack, begun, origins = (
        expat.ParserCreate(),
        list[tuple[str, str]](),
        list[tuple[str, int]](),
        dict[str, int](),
    )

    def opened(tag: str, attributes: Mapping[str, str]) -> None:
        stack.append((tag, attributes.get("name", "")))
        if tag == "joint" and len(stack) == 2 and stack[1][1] in moved:
            begun.append((stack[1][1], parser.CurrentByteIndex))
        if tag == "origin" and len(stack) == 3 and stack[1][0] == "joint":
            origins[stack[1][1]] = parser.CurrentByteIndex

    parser.StartElementHandler = opened
    parser.EndElementHandler = lambda _: stack.pop()
    parser.Parse(content, True)
    if len(begun) > len(moved):
        raise InputError(f"{path}: has {len(begun)} joints of the names {', '.join(moved)}; give each its own name")
    edits = []
    for name, at in begun:
        was, now = moved[name]
        if max(abs(a - b) for a, b in zip(was, now, strict=True)) <= _SAME:
            continue
        tag = _TAG.match(content, origins.get(name, at))
        assert tag is not None
        there = name in origins
        end = b">" if there and not tag[0].endswith(b"/>") else b"/>"
        told = (" ".join(map(repr, part)) for part in (now[:3], now[3:], was[:3], was[3:]))
        made = '<origin xyz="{}" rpy="{}"%s<!-- corrected by ccnn_torch; was xyz="{}" rpy="{}" -->'.format(*told)
        edits.append((tag.start() if there else tag.end(), tag.end(), made.encode() % end))
    base, _, tool = chain_of(after)
    places = (f"xyz {_numbers(at)} rpy {_numbers(_angles(turn))}" for turn, at in (base, tool))
    base_said, tool_said = places
    said = (
        f"<!-- ccnn_torch corrected origins of joints. Not in this file: the base in the frame of the measurement, "
        f"{base_said}; the measured tool behind the last of these joints, {tool_said}. -->\n"
    )
    last = content.rindex(b"</")
    edits.append((last, last, said.encode()))
    for start, stop, new in sorted(edits, reverse=True):
        content = content[:start] + new + content[stop:]
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: the file is not UTF-8 text; save it as UTF-8") from None


def _urdf_from(source: str, before: SerialArm, after: SerialArm) -> str:
    """`patched_urdf` where the source is a URDF; where it cannot be used, `urdf_text` that says why."""
    if not source.lower().endswith(".urdf"):
        return urdf_text(after)
    try:
        return patched_urdf(source, before, after)
    except InputError as reason:
        return urdf_text(after) + f"<!-- A chain of its own: {visible(str(reason)).replace('--', '- -')} -->\n"


_TAG = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""")
# Differences of origins that are rounding [m or rad].
_SAME = 1e-12


def moved_origins(path: str, before: SerialArm, after: SerialArm) -> list[tuple[str, list[float], list[float]]]:
    """Of the joints of a URDF that are those of an arm the names, and x, y, z, roll, pitch, yaw before and after.

    Fixed joints before a joint stay, so that its own origin takes what changed.

    Raises:
        InputError: as `joints_of`.
    """
    found = []
    origins = zip(joints_of(path, before), chain_of(before)[1], chain_of(after)[1], strict=True)
    for joint, was, now in origins:
        own = origin_of(path, joint)
        turn, at = compose(compose(own, _inverse(was)), now)
        angles = triple(path, joint, "origin", "rpy", "0 0 0").tolist()
        told = [*at.tolist(), *nearest_euler(_angles(turn).tolist(), angles)]
        found.append((joint.get("name", "?"), [*own[1].tolist(), *angles], told))
    return found


def joints_of(path: str, arm: SerialArm) -> list[Element]:
    """The joints of a URDF that are those of an arm, by their axes and origins.

    Raises:
        InputError: the file cannot be read, or has no such joints.
    """
    root = read_xml(path, URDF_LIMIT, "give the URDF of the robot")
    above = {link_of(path, joint, "child"): joint for joint in root.findall("joint")}
    parents = {link_of(path, joint, "parent") for joint in above.values()}
    wanted, n = chain_of(arm)[1], len(arm.joints)
    for link in [link for link in above if link not in parents]:
        joints: list[Element] = []
        while link in above and len(joints) <= len(above):
            joints.append(above[link])
            link = link_of(path, above[link], "parent")
        moving, merged = [], []
        fixed = IDENTITY
        for joint in joints[::-1]:
            fixed = compose(fixed, origin_of(path, joint))
            if joint.get("type") in ("revolute", "continuous", "prismatic"):
                moving.append(joint)
                merged.append(fixed)
                fixed = IDENTITY
        for k in range(len(moving) - n + 1):
            same = [_apart(a, b) < _EQUAL for a, b in zip(merged[k + 1 : k + n], wanted[1:], strict=True)]
            axes = torch.tensor([axis_of(path, joint) for joint in moving[k : k + n]], dtype=torch.float64)
            if all(same) and (axes - arm.axes * arm.signs[:, None]).abs().max() < _EQUAL:
                return moving[k : k + n]
    raise InputError(
        f"{path}: has no {n} joints one after the other with the axes and origins of '{visible(arm.name)}'; give the "
        "URDF that the records were identified with"
    )


# Differences of numbers that are the same ones, written by other programs [m, rad].
_EQUAL = 1e-6


def _apart(first: Transform, second: Transform) -> float:
    return max(float((a - b).abs().max()) for a, b in zip(first, second, strict=True))


def _inverse(frame: Transform) -> Transform:
    return frame[0].mT, -(frame[0].mT @ frame[1])


def mjcf_text(arm: SerialArm) -> str:
    """The arm's nominal parameters as a MuJoCo model: nested bodies, joints without friction, a site `tool`.

    MuJoCo wants masses, which a calibration does not know: each link has 1 kg and 0.01 kg m², without gravity.
    """
    base, origins, last = chain_of(arm)
    origins[0] = compose(base, origins[0])
    root = Element("mujoco", model=visible(arm.name))
    SubElement(root, "compiler", angle="radian", autolimits="true")
    SubElement(root, "option", gravity="0 0 0")
    body = SubElement(root, "worldbody")
    for i, origin in enumerate(origins):
        body = SubElement(body, "body", {"name": f"link{i + 1}", **_placed(origin)})
        SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia="0.01 0.01 0.01")
        kind = "hinge" if bool(arm.revolute[i]) else "slide"
        axis, limits = _numbers(arm.axes[i] * arm.signs[i]), _numbers(arm.limits[i])
        SubElement(body, "joint", name=arm.joints[i].name, type=kind, axis=axis, range=limits)
    SubElement(body, "site", {"name": "tool", **_placed(last)})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def chain_of(arm: SerialArm) -> tuple[Transform, list[Transform], Transform]:
    """Base; fixed transforms before each joint's motion; and that behind the last, tool included."""
    n = len(arm.joints)
    values = arm.nominal
    rotations, translations = arm.link_transforms(torch.zeros(n, dtype=torch.float64), values)
    fixed = [(rotations[i], translations[i]) for i in range(n)]
    base, tool = transform_of(values[:6]), transform_of(values[-6:])
    if not arm._axis_before:
        return base, fixed, tool
    none = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    return base, [none, *fixed[:-1]], compose(fixed[-1], tool)


def _placed(frame: Transform) -> dict[str, str]:
    turn = matrix_to_rotation_vector(frame[0])
    half = torch.linalg.vector_norm(turn) / 2
    # sin(x) / x, also at 0.
    quaternion = torch.cat([torch.cos(half)[None], turn / 2 * torch.sinc(half / torch.pi)])
    return {"pos": _numbers(frame[1]), "quat": _numbers(quaternion)}


def _joint(root: Element, name: str, kind: str, parent: str, child: str, origin: tuple[Tensor, Tensor]) -> Element:
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=_numbers(origin[1]), rpy=_numbers(_angles(origin[0])))
    return joint


def _angles(turn: Tensor) -> Tensor:
    """Roll, pitch and yaw [rad]."""
    return matrix_to_euler_zyx(turn).flip(-1)


def _numbers(values: Tensor) -> str:
    return " ".join(repr(v) for v in values.tolist())


def write_machine(
    mechanism: Mechanism,
    nominal: Mapping[str, float],
    folder: Path,
    stem: str,
    columns: Mapping[str, str] | None = None,
    joint_map: Mapping[str, str] | None = None,
    measured: Mapping[str, Sequence[float]] | None = None,
    alone: SerialArm | None = None,
    source: str = "",
) -> list[Path]:
    """Write `STEM.yaml`, of a serial arm also `STEM.urdf` and, where it is one of DH parameters, `STEM_dh.yaml`.

    An arm whose drives have leads or couplings of their own has no URDF.

    Args:
        mechanism: with the values found.
        nominal: what was there before, by name [SI].
        folder: where to.
        stem: of the files' names.
        columns, joint_map, measured: as of `mechanism_text`.
        alone: what a URDF and a DH table hold, where the mechanism's numbers belong beside effects; else the mechanism.
        source: what the mechanism was read from; a URDF is written again with other origins, see `patched_urdf`.
    """
    texts = {f"{stem}.yaml": mechanism_text(mechanism, nominal, columns, joint_map, measured)}
    # A URDF has no word for what a drive moves beside its joint, or too far.
    if isinstance(mechanism, SerialArm) and not mechanism.drives:
        arm = alone or mechanism
        before = mechanism.with_nominal(mechanism.nominal.new_tensor([nominal[p.name] for p in mechanism.geometry]))
        assert isinstance(before, SerialArm)
        texts[f"{stem}.urdf"] = _urdf_from(source, before, arm)
        if mechanism.convention != "urdf":
            texts[f"{stem}_dh.yaml"] = dh_text(arm)
    for name, text in texts.items():
        write_whole(folder / name, text)
    return [folder / name for name in texts]
