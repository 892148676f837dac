"""The header of a table: names and units as in the file, or as given by a map of columns."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.display import is_shown, visible
from ccnn_torch.errors import InputError
from ccnn_torch.records.table import Table
from ccnn_torch.spelling import nearest
from ccnn_torch.units import si_unit_of, split_header, to_si

# Characters of a name.
_LONGEST = 100
# Two turns of a joint, rounded up as the limit of a pose angle is.
JOINT_LIMIT = 12.6
IGNORE = "ignore"
"""The entry in a map of columns for a column to leave out."""


@dataclass(frozen=True)
class Header:
    """Names, units and positions of the columns that are kept.

    Attributes:
        units: unit of each column, by name, in the file's order; empty where it has none.
        kept: number of each of these columns among all of the file.
        width: how many columns the file has.
    """

    units: dict[str, str]
    kept: list[int]
    width: int


def read_header(cells: Sequence[str], file: str, columns: Mapping[str, str] | None = None, line: int = 1) -> Header:
    """Read a header.

    Args:
        cells: as in the file; a cell without text gets the name ``column 3`` or the like.
        file: the file, for the error.
        line: of the file, for the error.
        columns: header as in the file (or its name alone) -> ``name[unit]``, or ``ignore``. The unit may be left out
            where the file has it.

    Raises:
        InputError: there is no header, a name is repeated, or the map names no column of the file, lacks a unit or
            contradicts the file's.
    """
    if all(is_number(cell) for cell in cells):
        raise InputError(
            f"{file}: line {line} must be the header, e.g. q1[rad],x[mm], but it holds numbers alone; "
            "write one above them"
        )
    targets = _targets(cells, file, columns or {})
    units: dict[str, str] = {}
    kept: list[int] = []
    first: dict[str, str] = {}
    for k, cell in enumerate(cells):
        if targets.get(k) == IGNORE:
            continue
        name, unit = split_header(cell)
        if k in targets:
            name, unit = _mapped(cell.strip(), unit, targets[k], file)
        elif not name and unit:
            raise InputError(f"{file}: the header '{cell}' has a unit but no name; write name[{unit}]")
        name = name or f"column {k + 1}"
        _check_name(name, k + 1, file)
        if name in units:
            if targets:
                raise InputError(
                    f"{file}: '{first[name]}' and '{cell.strip()}' would both be the column '{name}'; write "
                    f'columns: {{"{cell.strip()}": {IGNORE}}} for the one that is not meant'
                )
            raise InputError(f"{file}: column '{name}' occurs twice in the header; remove or rename one of them")
        units[name] = unit
        first[name] = cell.strip()
        kept.append(k)
    return Header(units, kept, len(cells))


def columns_there(units: Mapping[str, str], columns: Mapping[str, str]) -> dict[str, str]:
    """The entries of a map of columns whose header a table has (its names and units as written), blanks aside."""
    return {key: target for key, target in columns.items() if any(_means(key, pair) for pair in units.items())}


def _means(key: str, pair: tuple[str, str]) -> bool:
    """Whether an entry's key means the column of this name and unit."""
    return pair in (split_header(key), (key.strip(), pair[1]))


def _check_name(name: str, number: int, file: str) -> None:
    """Refuse names that are too long, have control characters, or are formulas to a spreadsheet."""
    wrong = ""
    if len(name) > _LONGEST:
        wrong = f"has {len(name)} characters; is line 1 the header?"
    elif not all(map(is_shown, name)):
        wrong = "has a control character"
    elif name.startswith(("=", "+", "-", "@")):
        wrong = "begins like a formula, which a spreadsheet would run"
    if wrong:
        raise InputError(
            f"{file}: the header '{visible(name, 40)}' of column {number} {wrong}; give it a name such as q1[rad]"
        )


def _targets(cells: Sequence[str], file: str, columns: Mapping[str, str]) -> dict[int, str]:
    """Number of a column -> its entry in the map."""
    whole = [cell.strip() for cell in cells]
    pairs = [split_header(cell) for cell in cells]
    names = [name for name, _ in pairs]
    found: dict[int, str] = {}
    for key, target in columns.items():
        there = [k for k, cell in enumerate(whole) if cell == key.strip()]
        there = there or [k for k, pair in enumerate(pairs) if _means(key, pair)]
        if len(there) != 1:
            near = nearest(key, [*whole, *names])
            hint = f"did you mean '{near}'?" if near else f"it has {', '.join(whole)}"
            what = f"has no column '{key}'; {hint}" if not there else f"has {len(there)} columns '{key}'; rename one"
            raise InputError(f"columns: {file} {what}")
        if there[0] in found:
            raise InputError(f"columns: '{whole[there[0]]}' of {file} is named twice; remove one of the entries")
        found[there[0]] = target.strip()
    return found


def _mapped(cell: str, written: str, target: str, file: str) -> tuple[str, str]:
    """Name and unit that the map gives a column whose unit in the file is `written`."""
    name, unit = split_header(target)
    where = f"columns: '{target}' for '{cell}'"
    if not name or any(mark in name for mark in "[]"):
        raise InputError(f"{where} is not of the form name[unit]; write e.g. q1[deg], or {IGNORE}")
    if name.startswith("direction"):
        unit = unit or "1"
    if not (unit or written):
        raise InputError(f"{where} has no unit; write e.g. {name}[deg], {name}[mm] or {name}[1] (no unit)")
    if unit and written and not _same(unit, written, where):
        raise InputError(f"{where} is in {unit}, but {file} has it in {written}; write {name}[{written}]")
    return name, unit or written


def _same(unit: str, written: str, where: str) -> bool:
    """Whether two units are one, such as deg and °; a unit in the file that is not known is overruled by the map's."""
    si_unit_of(unit, where)
    try:
        kinds = si_unit_of(unit), si_unit_of(written)
    except InputError:
        return True
    return kinds[0] == kinds[1] and bool((to_si([0.0, 1.0], unit) == to_si([0.0, 1.0], written)).all())


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a point or a decimal comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


EULER_ANGLES = {
    "kuka": (("kuka_a", "kuka_b", "kuka_c"), "ZYX"),
    "fanuc": (("fanuc_w", "fanuc_p", "fanuc_r"), "xyz"),
    "staubli": (("staubli_rx", "staubli_ry", "staubli_rz"), "XYZ"),
}
"""Angles as controllers give them: columns, and the axes for scipy (capitals: about the moved axes)."""

ROTATION_VECTOR = ("rx", "ry", "rz")
_QUATERNION = ("qw", "qx", "qy", "qz")
# One turn of a pose angle, rounded up so that 360 degrees written as 6.2832 passes.
_POSE_LIMIT = 6.3

# Letters that are an orientation only together, and how they are most likely meant.
_TOGETHER = {
    ("a", "b", "c"): EULER_ANGLES["kuka"][0],
    ("w", "p", "r"): EULER_ANGLES["fanuc"][0],
    ("u", "v", "w"): None,
    ("o", "a", "t"): None,
    ("alpha", "beta", "gamma"): None,
    ("phi", "theta", "psi"): None,
}
_TURN = re.compile(
    r"r[xyz]|rot[xyz]|rotvec\w*|roll|pitch|yaw|euler\w*|q[wxyz]|quat\w*|orient\w*|(kuka|fanuc|staubli)\w+"
)
# An entry of a matrix by its row and column.
_MATRIX = re.compile(r"(?:r|t|m|rot)[0-3][0-3]")
_JOINT = re.compile(r"(?:q|j|a|e|joint|axis|axe|achse|theta)0*(\d+)")


class HasCoordinates(Protocol):
    """Attributes of a mechanism that records need."""

    @property
    def name(self) -> str: ...
    @property
    def joints(self) -> tuple[Coordinate, ...]: ...
    @property
    def pose(self) -> tuple[Coordinate, ...]: ...
    @property
    def orientations(self) -> tuple[str, ...]: ...


def stack_columns(
    table: Table, coordinates: Sequence[Coordinate], angle_limit: float = np.inf, gaps: bool = False
) -> NDArray[np.float64]:
    """Columns side by side, `rows x len(coordinates)`; refuses angles in rad beyond `angle_limit`.

    With `gaps` cells may be empty, and NaN stands for them.
    """
    values = np.empty((len(table), len(coordinates)))
    for k, coordinate in enumerate(coordinates):
        values[:, k] = table.column(coordinate.name, coordinate.unit, gaps)
        far = np.flatnonzero(np.abs(values[:, k]) > angle_limit)
        if table.units[coordinate.name] == "rad" and len(far):
            raise InputError(
                f"{table.path}: column '{coordinate.name}[rad]' has {values[far[0], k]:g} at "
                f"{table.name_rows(far[:1])}, which looks like degrees; write '{coordinate.name}[deg]'"
            )
    return values


def read_pose(
    table: Table, mechanism: HasCoordinates, partial: bool = False, named: str = "{}"
) -> tuple[NDArray[np.float64], tuple[Coordinate, ...], str | None, tuple[str, ...]]:
    """Pose `rows x p` [SI], its coordinates, how the orientation was measured, and the columns that were read.

    A rotation vector counts before a quaternion, and that before Euler angles, where a file has several.

    Args:
        partial: whether some of the pose coordinates are enough: columns may be missing or empty, and so may cells, for
            which NaN stands; of an orientation all three are NaN then.
        named: what the columns are called, with the coordinate's name in the place of the braces.

    Raises:
        InputError: a column is missing or cannot be used, or a quaternion has not the norm 1.
    """

    def stacked(coordinates: Sequence[Coordinate], limit: float = np.inf) -> NDArray[np.float64]:
        return stack_columns(table, [Coordinate(named.format(c.name), c.unit) for c in coordinates], limit, partial)

    if partial:
        table = _without_empty(table, mechanism)
    names = {c.name for c in mechanism.pose}
    # Any machine that turns about three axes may have its orientation in another form than its own coordinates.
    turns_freely = set(ROTATION_VECTOR) <= names and any(
        named.format(c) in table for c in (*_QUATERNION, *(c for columns, _ in EULER_ANGLES.values() for c in columns))
    )
    if not mechanism.orientations and not turns_freely:
        flat = getattr(mechanism, "flat", False) and named.format("z") not in table
        of = tuple(mechanism.pose)[: 2 if flat else None]
        pose = (tuple(_measured(table, of, mechanism)) if partial else of) or of
        if flat and pose == of:
            both = np.pad(stacked(of, _POSE_LIMIT), ((0, 0), (0, 1)))
            return both, tuple(mechanism.pose), None, tuple(named.format(c.name) for c in of)
        return _together(stacked(pose, _POSE_LIMIT), pose), pose, None, tuple(named.format(c.name) for c in pose)
    position = tuple(c for c in mechanism.pose if c.name not in ROTATION_VECTOR)
    turns = tuple(Coordinate(name, "rad") for name in ROTATION_VECTOR)
    forms = {"rotation_vector": ROTATION_VECTOR, "quaternion": _QUATERNION}
    forms |= {name: columns for name, (columns, _) in EULER_ANGLES.items()}
    form = next((name for name, columns in forms.items() if any(named.format(c) in table for c in columns)), "none")
    if partial:
        there = _measured(table, position, mechanism)
        position = position if form == "none" and not there else there
    read = tuple(named.format(name) for name in (*(c.name for c in position), *forms.get(form, ())))
    full = (*position, *turns)
    if form == "rotation_vector":
        return _together(stacked(full, _POSE_LIMIT), full), full, form, read
    where = stacked(position)
    if form == "none":
        return where, position, form, read
    # Imported here: few files need it, and the import takes long.
    from scipy.spatial.transform import Rotation

    vector = np.full((len(table), 3), np.nan)
    if form == "quaternion":
        values = _quaternions(table, read[-4:], partial)[:, [1, 2, 3, 0]]
        known = np.isfinite(values).all(1)
        turn = Rotation.from_quat(values[known])
    else:
        columns, axes = EULER_ANGLES[form]
        values = stacked([Coordinate(name, "rad") for name in columns], _POSE_LIMIT)
        known = np.isfinite(values).all(1)
        turn = Rotation.from_euler(axes, values[known])
    vector[known] = turn.as_rotvec()
    return np.concatenate([where, vector], axis=1), full, form, read


def _without_empty(table: Table, mechanism: HasCoordinates) -> Table:
    """The table without columns of a pose whose cells are all empty."""
    names = {c.name for c in mechanism.pose}
    names |= {*ROTATION_VECTOR, *_QUATERNION, *(name for columns, _ in EULER_ANGLES.values() for name in columns)}
    return table.without([name for name in table.names if name in names and table.blank(name).all()])


def _together(pose: NDArray[np.float64], coordinates: Sequence[Coordinate]) -> NDArray[np.float64]:
    """The pose with all of rx, ry, rz NaN where one of them is: a rotation vector means nothing in part."""
    names = [c.name for c in coordinates]
    if set(ROTATION_VECTOR) <= set(names):
        turns = [names.index(name) for name in ROTATION_VECTOR]
        # One NaN makes the sum NaN.
        pose[:, turns] += 0 * pose[:, turns].sum(1, keepdims=True)
    return pose


def pose_columns(pose: NDArray[np.float64], form: str | None) -> dict[str, NDArray[np.float64]]:
    """The columns of an orientation that `read_pose` found in this form, `rows` [rad or 1], by name.

    Args:
        pose: its position and rotation vector, `rows x 6` [SI].
        form: as `read_pose` gives it; a rotation vector where it had none.
    """
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(pose[:, 3:])
    if form == "quaternion":
        return dict(zip(_QUATERNION, turn.as_quat()[:, [3, 0, 1, 2]].T, strict=True))
    if form in EULER_ANGLES:
        columns, axes = EULER_ANGLES[form]
        return dict(zip(columns, turn.as_euler(axes).T, strict=True))
    return dict(zip(ROTATION_VECTOR, pose[:, 3:].T, strict=True))


def _measured(table: Table, pose: Sequence[Coordinate], mechanism: HasCoordinates) -> tuple[Coordinate, ...]:
    """The coordinates that the table has; all of them where a column without another use may be one that it lacks."""
    known = {c.name for c in (*mechanism.joints, *mechanism.pose)}
    free = [name for name in table.names if name not in known]
    meant = any(c.name not in table and nearest(c.name, free) for c in pose)
    return tuple(c for c in pose if meant or c.name in table)


def check_joints(table: Table, mechanism: HasCoordinates, commanded: bool = False) -> None:
    """Refuse a table without joints, with the map of columns that look like some, or with a joint more.

    Args:
        commanded: whether commanded poses take the place of the joints.

    Raises:
        InputError: names the joint, and the map to write.
    """
    joints = mechanism.joints
    more = f"q{len(joints) + 1}"
    if more in table and all(joint.name == f"q{k + 1}" and joint.name in table for k, joint in enumerate(joints)):
        raise InputError(
            f"{table.path}: there is a column '{more}', and the machine has {len(joints)} joints: its model lacks one, "
            f"or is another machine's; where the column is no joint of it write columns: {{{more}: ignore}}"
        )
    missing = [joint for joint in joints if joint.name not in table]
    alike = {number: name for name, number in _numbered(table, joints).items()}
    if missing and all(k + 1 in alike for k, joint in enumerate(joints) if joint in missing):
        pairs = {alike[k + 1]: joint for k, joint in enumerate(joints) if joint in missing}
        usual = {"rad": "deg", "m": "mm"}
        entries = (
            f'"{table.header(n)}": "{j.name}[{table.units[n] or usual.get(j.unit, j.unit)}]"' for n, j in pairs.items()
        )
        raise InputError(
            f"{table.path}: there is no column '{missing[0].name}'; these look like joints: {_quoted(pairs)}; write "
            f"columns: {{{', '.join(entries)}}} if they are meant, or rename them"
        )
    if len(missing) == len(joints) > 1 and not commanded:
        goals = ", ".join(f"goal_{c.header}" for c in mechanism.pose)
        raise InputError(
            f"{table.path}: there is no column '{joints[0].name}'; give the joints ({joints[0].header} …), or the "
            f"commanded pose as {goals}"
        )


def check_orientation(table: Table, mechanism: HasCoordinates, unused: Iterable[str]) -> None:
    """Refuse columns that look like an orientation and would not be used, where none was found.

    Raises:
        InputError: names the columns, and the map to write.
    """
    if not any(coordinate.name in ROTATION_VECTOR for coordinate in mechanism.pose):
        return
    folded = {_folded(name): name for name in unused if _may_be_angle(table.units[name])}
    groups = [(letters, [folded[one] for one in letters if one in folded]) for letters in _TOGETHER]
    together, found = next(((letters, names) for letters, names in groups if len(names) == 3), ((), []))
    found = found or [name for key, name in folded.items() if _TURN.fullmatch(key)]
    matrix = [name for key, name in folded.items() if _MATRIX.fullmatch(key)]
    turned = not found and len(matrix) >= 9
    found = matrix if turned else found
    if not found:
        # Two letters are an orientation where they are angles, and known to be a controller's.
        pairs = (one for one in groups if len(one[1]) == 2 and _TOGETHER[one[0]])
        together, found = next((one for one in pairs if not {table.units[n] for n in one[1]} & {"", "1"}), ((), []))
    if not found:
        return
    meant = _TOGETHER.get(together) if together else None
    if meant is not None and len(found) < 3:
        say = f"one of three angles is missing: give all of {', '.join(meant)}"
    elif meant is not None:
        entries = (f'"{table.header(n)}": "{m}[{table.units[n] or "deg"}]"' for n, m in zip(found, meant, strict=True))
        say = f"write columns: {{{', '.join(entries)}}} if they are"
    elif turned:
        say = f"a matrix is not read, give the quaternion {', '.join(_QUATERNION)} (scipy: Rotation.from_matrix)"
    else:
        known = [ROTATION_VECTOR, _QUATERNION, *(columns for columns, _ in EULER_ANGLES.values())]
        say = f"map them with columns: to one of {'; '.join(', '.join(names) for names in known)}"
    ignored = ", ".join(f'"{table.header(name)}": ignore' for name in found)
    raise InputError(
        f"{table.path}: columns {', '.join(found)} look like an orientation and would not be used; {say}, or "
        f"columns: {{{ignored}}} to use positions alone"
    )


def unused_joints(table: Table, joints: Sequence[Coordinate], unused: Iterable[str]) -> list[str]:
    """Columns that look like joints and are not used."""
    alike = _numbered(table, joints)
    return [name for name in unused if name in alike]


def _quaternions(table: Table, names: Sequence[str], gaps: bool) -> NDArray[np.float64]:
    quaternion = stack_columns(table, [Coordinate(name, "1") for name in names], gaps=gaps)
    norm = np.linalg.norm(quaternion, axis=1)
    # Written with three digits a unit quaternion is within 0.001 of norm 1; ten times that is no quaternion.
    wrong = np.flatnonzero(np.abs(norm - 1) > 0.01)
    if len(wrong):
        raise InputError(
            f"{table.path}: the quaternion {', '.join(names)} at {table.name_rows(wrong)} has norm "
            f"{norm[wrong[0]]:.3g} instead of 1; correct it, or give the orientation as rx[rad], ry[rad], rz[rad]"
        )
    return quaternion


def _numbered(table: Table, joints: Sequence[Coordinate]) -> dict[str, int]:
    """Columns that look like joints and are none, with their numbers."""
    known = {joint.name for joint in joints}
    found = {name: _JOINT.fullmatch(_folded(name)) for name in table.names if name not in known}
    return {name: int(match[1]) for name, match in found.items() if match is not None}


def _quoted(names: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)


def _folded(name: str) -> str:
    return re.sub(r"[\s_.\-]", "", name).lower()


def _may_be_angle(unit: str) -> bool:
    """Whether a column in this unit may be a part of an orientation: not where it is a length, a temperature …"""
    try:
        return not unit or si_unit_of(unit) in ("rad", "1")
    except InputError:
        return True
