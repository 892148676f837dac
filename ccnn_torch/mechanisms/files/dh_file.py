"""A serial arm from a YAML file with its maker's Denavit-Hartenberg table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ccnn_torch.display import visible
from ccnn_torch.errors import InputError
from ccnn_torch.files.read import CONFIG_LIMIT, read_text
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms.machines.serial import MOST_JOINTS, SerialArm
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
    `theta`. Optional: `joint_types` (revolute), `joint_sign` (+1), `parallel_axes`, `base_frame` and `tool_frame`
    (a text with "unknown", "identity", or [x, y, z, rx, ry, rz]; unknown when missing), `tool_offset` (likewise, but
    [x, y, z]; replaces the tool frame for records without orientation), `frame_per`, `tool_per`, `robot` (its name).

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


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise InputError(f"{where} must be a finite number, got {visible(repr(value))}")
    return float(value)
