"""A serial arm from a YAML file with its maker's Denavit-Hartenberg table, or from a URDF."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text, read_xml
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms.gears import read_gears, read_motors
from ccnn_torch.mechanisms.machines.links import compose
from ccnn_torch.mechanisms.machines.serial import MOST_JOINTS, SerialArm
from ccnn_torch.numerics.rotations import euler_zyx_to_matrix, matrix_to_euler_zyx, matrix_to_rotation_vector
from ccnn_torch.units import LARGEST

_CONVENTIONS = {
    "standard Denavit-Hartenberg": "standard",
    "modified Denavit-Hartenberg": "modified",
}
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
_ANGLES = {"rad": 1.0, "deg": 0.017453292519943295, "mrad": 1e-3}


def read_dh_file(path: str, orientation: str = "rotation_vector") -> SerialArm:
    """Read a serial arm; keys that this does not know are ignored.

    Needed: `dof`, `convention` (starts with one of the two known), `units: {length, angle}`, `a`, `alpha`, `d`,
    `theta`. Optional: `beta` (leans of the links, see `SerialArm.leans`; 0), `joint_types` (revolute), `joint_sign`
    (+1), `parallel_axes`, `base_frame` and `tool_frame`
    (a text with "unknown", "identity", or [x, y, z, rx, ry, rz]; unknown when missing), `tool_offset` (likewise, but
    [x, y, z]; replaces the tool frame for records without orientation), `goal_tool` (the frame that commanded poses are
    of, where it is not the measured one), `frame_per`, `tool_per`, `robot` (its name), `limits` of the joints
    (each [lowest, highest] in the file's units; a full turn or a metre), `masses` of the links [kg],
    `centres` of these (each [x, y, z] in the frame at the link's end; [] or missing: halfway to the next axis),
    `gears` (of each joint turns of the motor for one of the joint, the lead of a screw in the file's length, or null),
    and `motors` (of those that turn with other joints as well, as `{q5: {q4: 0.667}}`, see `read_motors`).

    Args:
        path: the file.
        orientation: "rotation_vector", or "none" for records of positions only.

    Raises:
        InputError: one sentence that names the file and the key.
    """
    table = _Table(path)
    dof = table.number("dof")
    if dof != int(dof) or not 1 <= dof <= MOST_JOINTS:
        raise InputError(f"{path}: key 'dof' must be a whole number of joints, 1 to {MOST_JOINTS}, got {dof:g}")
    n = int(dof)
    stated = table.text("convention")
    convention = next((short for long, short in _CONVENTIONS.items() if stated.startswith(long)), "")
    if not convention:
        known = "' or '".join(_CONVENTIONS)
        raise InputError(f"{path}: key 'convention' must start with '{known}', got '{stated}'")
    length, angle = table.unit("length", _LENGTHS), table.unit("angle", _ANGLES)
    types = table.words("joint_types", ["revolute"] * n)
    if len(types) != n or not set(types) <= {"revolute", "prismatic"}:
        raise InputError(f"{path}: key 'joint_types' must list {n} times revolute or prismatic")
    signs = table.numbers("joint_sign", n, default=[1.0] * n)
    if any(abs(s) != 1.0 for s in signs):
        raise InputError(f"{path}: key 'joint_sign' must list {n} times 1 or -1, got {signs}")
    columns = [(key, unit) for key, unit in (("a", length), ("alpha", angle), ("d", length), ("theta", angle))]
    links = zip(*([v * unit for v in table.numbers(key, n)] for key, unit in columns), strict=True)
    scales = [length] * 3 + [angle] * 3
    base, tool = table.frame("base_frame", scales), table.frame("tool_frame", scales)
    offset = table.frame("tool_offset", scales[:3]) if "tool_offset" in table.content else None
    goal = table.frame("goal_tool", scales) if "goal_tool" in table.content else None
    return SerialArm(
        name=visible(str(table.content.get("robot", Path(path).stem)), 60),
        convention=convention,
        links=[list(row) for row in links],
        joint_types=types,
        joint_sign=signs,
        base=base or [0.0] * 6,
        tool=tool or [0.0] * 6,
        tool_offset=(offset or "unknown") if "tool_offset" in table.content else None,
        unknown_frames=[name for name, frame in (("base", base), ("tool", tool)) if frame is None],
        frame_per=table.words("frame_per", []),
        tool_per=table.words("tool_per", []),
        parallel_axes=table.groups("parallel_axes", n),
        orientation=orientation,
        goal_tool=goal,
        limits=table.limits(types, length, angle),
        masses=table.masses(n),
        centres=table.centres(n, length),
        gears=table.gears(types, length),
        motors=table.motors(types),
        leans=[[i, v * angle] for i, v in enumerate(table.numbers("beta", n, default=[0.0] * n), 1) if v],
    )


class _Table:
    """The file's content, with readers that turn what is wrong into one sentence."""

    def __init__(self, path: str) -> None:
        self.path = path
        content = parse_yaml(read_text(path, CONFIG_LIMIT, "give the path of the arm's geometry"), path)
        if not isinstance(content, Mapping):
            raise InputError(f"{path}: must hold keys such as dof, convention, a, alpha, d, theta")
        self.content: Mapping[str, Any] = content

    def need(self, key: str) -> Any:
        if key not in self.content:
            raise InputError(
                f"{self.path}: key '{key}' is missing; a DH file has dof, convention, units, a, alpha, d, theta"
            )
        return self.content[key]

    def text(self, key: str) -> str:
        value = self.need(key)
        if not isinstance(value, str):
            raise InputError(f"{self.path}: key '{key}' must be a text, got {value!r}")
        return value

    def number(self, key: str) -> float:
        return _number(self.need(key), f"{self.path}: key '{key}'")

    def numbers(self, key: str, count: int, default: list[float] | None = None) -> list[float]:
        value = self.need(key) if default is None else self.content.get(key, default)
        if not isinstance(value, list) or len(value) != count:
            got = f"{len(value)}" if isinstance(value, list) else repr(value)
            raise InputError(f"{self.path}: key '{key}' must list {count} numbers, one per joint, got {got}")
        return [_number(v, f"{self.path}: key '{key}', entry {i + 1}") for i, v in enumerate(value)]

    def limits(self, types: Sequence[str], length: float, angle: float) -> list[list[float]] | None:
        """Lowest and highest value of each joint [m, rad]; None where the file does not tell them."""
        if "limits" not in self.content:
            return None
        value = self.content["limits"]
        where = f"{self.path}: key 'limits'"
        if not isinstance(value, list) or [len(one) if isinstance(one, list) else 0 for one in value] != [2] * len(
            types
        ):
            raise InputError(f"{where} must list {len(types)} times [lowest, highest]")
        scales = [angle if kind == "revolute" else length for kind in types]
        found = [[_number(v, where) * s for v in one] for one, s in zip(value, scales, strict=True)]
        if any(low >= high for low, high in found):
            raise InputError(f"{where} must have the lowest value of each joint before the highest")
        return found

    def gears(self, types: Sequence[str], length: float) -> list[float | None]:
        """As of `read_gears`; none where the file does not tell them."""
        if "gears" not in self.content:
            return []
        where = f"{self.path}: key 'gears'"
        return read_gears(
            self.content["gears"],
            _joints(types),
            where,
            lambda v, unit: _number(v, where) * (length if unit == "m" else 1.0),
        )

    def motors(self, types: Sequence[str]) -> Mapping[str, Mapping[str, float]] | None:
        """As the file has them, checked; None where it does not tell them."""
        told = self.content.get("motors")
        if told is not None:
            read_motors(told, _joints(types), f"{self.path}: key 'motors'")
        return told

    def masses(self, count: int) -> list[float]:
        """[kg]; none where the file does not tell them."""
        values = self.numbers("masses", count) if "masses" in self.content else []
        if values and not min(values) >= 0 < sum(values):
            raise InputError(f"{self.path}: key 'masses' must list {count} masses [kg] of at least 0, got {values}")
        return values

    def centres(self, count: int, length: float) -> list[list[float]]:
        """[m]; none, or an empty one, where the file does not tell them."""
        if "centres" not in self.content:
            return []
        value = self.content["centres"]
        if "masses" not in self.content or not isinstance(value, list) or len(value) != count:
            raise InputError(f"{self.path}: key 'centres' must list {count} times [x, y, z] or [], beside 'masses'")
        where = f"{self.path}: key 'centres', entry"
        for i, one in enumerate(value, 1):
            if not isinstance(one, list) or len(one) not in (0, 3):
                raise InputError(f"{where} {i} must be [x, y, z] or [], got {visible(repr(one))}")
        return [[_number(v, f"{where} {i}") * length for v in one] for i, one in enumerate(value, 1)]

    def unit(self, kind: str, known: Mapping[str, float]) -> float:
        units = self.need("units")
        name = units.get(kind) if isinstance(units, Mapping) else None
        if not isinstance(name, str) or name not in known:
            raise InputError(f"{self.path}: key 'units.{kind}' must be one of {', '.join(known)}, got {name!r}")
        return known[name]

    def words(self, key: str, default: list[str]) -> list[str]:
        value = self.content.get(key, default)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise InputError(f"{self.path}: key '{key}' must be a list of names, got {value!r}")
        return list(value)

    def groups(self, key: str, joints: int) -> list[list[int]]:
        value = self.content.get(key, [])
        if not isinstance(value, list) or not all(
            isinstance(g, list) and all(isinstance(j, int) and 1 <= j <= joints for j in g) for g in value
        ):
            raise InputError(f"{self.path}: key '{key}' must list groups of joints from 1 to {joints}, as [[2, 3, 4]]")
        return [list(g) for g in value]

    def frame(self, key: str, scales: list[float]) -> list[float] | None:
        """The frame in SI, None when unknown; the cell may hold other text before and after."""
        value = self.content.get(key, "unknown")
        if isinstance(value, str) and "unknown" in value.split(";")[0]:
            return None
        if value == "identity":
            return [0.0] * len(scales)
        if not isinstance(value, list) or len(value) != len(scales):
            form = "[x, y, z, rx, ry, rz]" if len(scales) == 6 else "[x, y, z]"
            raise InputError(f"{self.path}: key '{key}' must be 'unknown', 'identity' or {form}, got {value!r}")
        where = f"{self.path}: key '{key}'"
        return [_number(v, f"{where}, entry {i + 1}") * s for i, (v, s) in enumerate(zip(value, scales, strict=True))]


def _joints(types: Sequence[str]) -> list[Coordinate]:
    return [Coordinate(f"q{i}", "m" if kind == "prismatic" else "rad") for i, kind in enumerate(types, 1)]


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise InputError(f"{where} must be a finite number, got {visible(repr(value))}")
    return float(value)


# Bytes; with inertias and meshes named, a robot has some 100 kB.
URDF_LIMIT = 20_000_000

_MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


def read_urdf(
    path: str, base: str | None = None, tip: str | None = None, orientation: str = "rotation_vector"
) -> SerialArm:
    """Read the chain base → tip. Base and tool frame are unknown: measured data has its own.

    A fixed joint before a moving one becomes part of its origin; those behind the last moving joint become the tool.

    Args:
        path: the file.
        base: first link; the only link without a parent when None.
        tip: last link; needed where the chain branches.
        orientation: "rotation_vector", or "none" for records of positions only.

    Raises:
        InputError: one sentence that names the file and the joint or link: a branch without `tip`, an unknown link, a
            mimic, floating or planar joint in the chain, a number that is none.
    """
    root = read_xml(path, URDF_LIMIT, "give the path of a URDF")
    chain = _chain(path, root, base, tip)
    if len(chain) > 2 * MOST_JOINTS:
        raise InputError(f"{path}: the chain has {len(chain)} joints; up to {MOST_JOINTS} that move can be handled")
    links: list[list[float]] = []
    bodies: list[list[_Body]] = []
    inertials = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    axes: list[list[float]] = []
    types: list[str] = []
    limits: list[list[float]] = []
    fixed = IDENTITY
    for joint in chain:
        name, kind = joint.get("name", "?"), joint.get("type", "")
        fixed = compose(fixed, origin_of(path, joint))
        body = inertials.get(link_of(path, joint, "child"))
        if kind == "fixed":
            if bodies and body is not None:
                bodies[-1].append(_body(path, joint, body, fixed))
            continue
        if kind not in _MOVING or joint.find("mimic") is not None:
            what = "follows another joint (mimic)" if kind in _MOVING else f"is of type '{kind}'"
            raise InputError(
                f"{path}: joint '{name}' {what}; a chain has revolute, continuous, prismatic and fixed ones"
            )
        links.append(_link_row(fixed))
        axes.append(axis_of(path, joint))
        types.append(_MOVING[kind])
        limits.append(_limit(path, joint, kind))
        fixed = IDENTITY
        bodies.append([] if body is None else [_body(path, joint, body, fixed)])
    if not links:
        raise InputError(f"{path}: the chain has no joint that moves; give base=LINK and tip=LINK")
    masses = [sum(mass for mass, _ in body) for body in bodies]
    weighs = any(masses)
    return SerialArm(
        name=visible(root.get("name", Path(path).stem), 60),
        convention="urdf",
        links=links,
        joint_types=types,
        axes=axes,
        tool=[*fixed[1].tolist(), *matrix_to_rotation_vector(fixed[0]).tolist()],
        limits=limits,
        unknown_frames=["base", "tool"],
        orientation=orientation,
        masses=masses if weighs else (),
        centres=[_centre(body) for body in bodies] if weighs else (),
    )


def urdf_joints(path: str) -> list[str]:
    """The names of the joints of a URDF's only chain that move, from the base on; raises as `read_urdf`."""
    chain = _chain(path, read_xml(path, URDF_LIMIT, "give the path of a URDF"), None, None)
    return [joint.get("name", "?") for joint in chain if joint.get("type") != "fixed"]


Transform = tuple[Tensor, Tensor]
_Body = tuple[float, Tensor]
IDENTITY: Transform = (torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


def _chain(path: str, root: Element, base: str | None, tip: str | None) -> list[Element]:
    """Joints from base to tip, found from the tip upwards."""
    joints = root.findall("joint")
    parent_joint = {link_of(path, j, "child"): j for j in joints}
    if len(parent_joint) < len(joints):
        twice = Counter(link_of(path, j, "child") for j in joints).most_common(1)[0][0]
        raise InputError(f"{path}: link '{twice}' is the child of several joints; a chain has one")
    parents = {link_of(path, j, "parent") for j in joints}
    known = [str(link.get("name")) for link in root.findall("link")]
    for link in (base, tip):
        if link is not None and link not in known:
            raise InputError(f"{path}: has no link '{link}'; it has {', '.join(known)}")
    if base is None:
        _check_one_piece(path, known, joints)
    if tip is None:
        tips = [link for link in known if link in parent_joint and link not in parents]
        if not tips:
            raise InputError(f"{path}: has no joint at the end of a chain; it needs those from link to link")
        if len(tips) != 1:
            raise InputError(f"{path}: the chain branches; give the last link as tip=, one of {', '.join(tips)}")
        tip = tips[0]
    chain: list[Element] = []
    link = tip
    while link != base and link in parent_joint and len(chain) <= len(joints):
        chain.append(parent_joint[link])
        link = link_of(path, parent_joint[link], "parent")
    if len(chain) > len(joints):
        raise InputError(f"{path}: the joints above link '{tip}' form a loop; a chain begins at a link with no parent")
    if base is not None and link != base:
        raise InputError(f"{path}: link '{tip}' does not hang on link '{base}'; give another base= or tip=")
    return chain[::-1]


def _check_one_piece(path: str, known: list[str], joints: list[Element]) -> None:
    """Refuse links that hang in several trees with joints that move: the joint between them is missing."""
    top = {link_of(path, j, "child"): link_of(path, j, "parent") for j in joints}
    # Each time twice as far up; one link at a time takes a minute for a hostile file.
    for _ in range(len(joints).bit_length()):
        top = {link: top.get(above, above) for link, above in top.items()}
    roots = {top.get(link, link) for link in (link_of(path, j, "parent") for j in joints if j.get("type") in _MOVING)}
    pieces = [link for link in known if link in roots]
    if len(pieces) > 1:
        raise InputError(
            f"{path}: no joint leads to link '{pieces[1]}', so that the chain is in {len(pieces)} pieces: a joint is "
            f"missing; add it, or give base={pieces[1]} where the piece from there is meant"
        )


def link_of(path: str, joint: Element, role: str) -> str:
    """Name of the link that is `parent` or `child` of a joint of a URDF."""
    element = joint.find(role)
    name = None if element is None else element.get("link")
    if name is None:
        raise InputError(f"{path}: joint '{joint.get('name', '?')}' lacks <{role} link=…>")
    return name


def _body(path: str, joint: Element, inertial: Element, held: Transform) -> _Body:
    """Mass [kg] and its centre [m] in the frame of the link that moves, which holds the joint's child so."""
    name, element = f"link '{link_of(path, joint, 'child')}'", inertial.find("mass")
    text = "" if element is None else element.get("value", "")
    try:
        mass = float(text)
    except ValueError:
        mass = math.nan
    if not 0 <= mass <= LARGEST:
        raise InputError(f"{path}: {name} needs a mass of at least 0 kg, <mass value=…>, got '{visible(text)}'")
    return mass, held[0] @ triple(path, inertial, "origin", "xyz", "0 0 0", name) + held[1]


def _centre(bodies: list[_Body]) -> list[float]:
    """Of all of them [m]."""
    weighed = sum((m * at for m, at in bodies), torch.zeros(3, dtype=torch.float64))
    found: list[float] = (weighed / max(sum(m for m, _ in bodies), 1e-300)).tolist()
    return found


def triple(path: str, joint: Element, tag: str, attribute: str, default: str, name: str = "") -> Tensor:
    """Three numbers of a joint of a URDF, as they are written; name: of what is no joint, for a message."""
    element = joint.find(tag)
    text = default if element is None else element.get(attribute, default)
    try:
        values = [float(v) for v in text.split()]
    except ValueError:
        values = []
    if len(values) != 3 or not all(abs(v) <= LARGEST for v in values):
        raise InputError(
            f"{path}: {name or 'joint ' + repr(joint.get('name', '?'))} needs three numbers in {tag} {attribute}, got "
            f"'{text}'"
        )
    return torch.tensor(values, dtype=torch.float64)


def origin_of(path: str, joint: Element) -> Transform:
    """Rotation and place [m] of the origin of a joint of a URDF."""
    roll_pitch_yaw = triple(path, joint, "origin", "rpy", "0 0 0")
    return euler_zyx_to_matrix(roll_pitch_yaw.flip(-1)), triple(path, joint, "origin", "xyz", "0 0 0")


def axis_of(path: str, joint: Element) -> list[float]:
    """Direction of the axis of a joint of a URDF, of length 1."""
    axis = triple(path, joint, "axis", "xyz", "1 0 0")
    if axis.norm() == 0:
        raise InputError(f"{path}: joint '{joint.get('name', '?')}' has the axis 0 0 0; give its direction")
    values: list[float] = (axis / axis.norm()).tolist()
    return values


def _limit(path: str, joint: Element, kind: str) -> list[float]:
    """Travel for sampling; a full turn where the file states none, since limits do not matter to a calibration."""
    element = joint.find("limit")
    default = (0.0, 1.0) if kind == "prismatic" else (-math.pi, math.pi)
    if element is None or kind == "continuous":
        return list(default)
    try:
        low, high = (float(element.get(k, d)) for k, d in zip(("lower", "upper"), default, strict=True))
    except ValueError:
        low = high = math.nan
    if not -LARGEST <= low <= high <= LARGEST:
        name = joint.get("name", "?")
        raise InputError(f"{path}: joint '{name}' has limits that are no numbers, or the upper one below the lower one")
    return [low, high]


def _link_row(transform: Transform) -> list[float]:
    """x, y, z, roll, pitch, yaw."""
    return [*transform[1].tolist(), *matrix_to_euler_zyx(transform[0]).flip(-1).tolist()]
