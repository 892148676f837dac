"""`ccnn compensate`: a table of joints, poses or commands with what a model makes of it, part by part."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.compensation.routines import DAMPED
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import FallbackWarning, InputError
from ccnn_torch.files.read import parse_json, read_text
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.branches import EXACT, ROUNDED, arrives, follow
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT
from ccnn_torch.numerics.rotations import homogeneous, matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.records.commanded import commanded_poses, is_commanded
from ccnn_torch.records.headers import columns_there, pose_columns, read_pose, stack_columns
from ccnn_torch.records.joint_map import JointMap, read_joint_map
from ccnn_torch.records.load import JOINT_LIMIT
from ccnn_torch.records.read_table import mapped, read_parts
from ccnn_torch.records.table import Table, writing_table
from ccnn_torch.units import from_si, si_unit_of

# Joints all over the measured region, among which the first row's guess is looked for.
_LOOKED_AT = 2000
_LARGEST = 500_000_000
ROWS = 4096
"""Rows that a model takes at once: its calls count for little then, and it takes a hundred MB."""


Array: TypeAlias = NDArray[Any]


class WantedPoses:
    """Joints of tables of poses, one after the other; an arm goes on from the last row of the table before.

    Attributes:
        chooses: whether joints were found without a given branch, where there are several.
        goals: whether poses are as the controller has them, `goal_x` …, not as they are measured.
    """

    def __init__(
        self,
        loaded: LoadedModel,
        allow_code: bool = False,
        tool: Sequence[float] | None = None,
        base: Sequence[float] | None = None,
        goals: bool = False,
    ) -> None:
        """Take the mechanism that the model was made for.

        Args:
            loaded: the model.
            allow_code: run the Python file that the model names as its mechanism.
            tool: of an arm, x, y, z and rotation vector of the tool's frame from the end of the last link [m, rad]; the
                measured one when None.
            base: of an arm, the same of the frame in which poses are given, in the measured one; that itself when None.

        Raises:
            InputError: `tool` or `base` of a machine that is no arm with orientation.
        """
        self._mechanism = loaded.mechanism(allow_code)
        self._same = tool is None and base is None
        machine = self._mechanism
        if not (self._same or (isinstance(machine, SerialArm) and len(machine.pose) == 6)):
            raise InputError(
                f"{'--tool' if base is None else '--base'}: {loaded.path} was made for {machine.name}; only an arm "
                "whose orientation was measured takes another tool or workpiece frame; leave it out"
            )
        self._before_pose = self._behind_pose = torch.eye(4, dtype=torch.float64)
        if base is not None:
            self._before_pose = frames_of(torch.tensor([*base], dtype=torch.float64))
        if tool is not None:
            measured = (machine if loaded.machine is None else loaded.machine.identified).nominal[-6:]
            wanted = torch.tensor([*tool], dtype=torch.float64)
            self._behind_pose = torch.linalg.inv(frames_of(wanted)) @ frames_of(measured)
        self._first, self._region = torch.from_numpy(loaded.middle), torch.from_numpy(loaded.region)
        self._before: Tensor | None = None
        self.chooses, self.goals = False, goals
        self._form: str | None = None
        self._of_pose: dict[str, str] = {}

    @property
    def sentence(self) -> str:
        """What to know where `chooses`."""
        first, last = self._mechanism.joints[0], self._mechanism.joints[-1]
        return (
            "An arm reaches a pose on several branches (elbow, wrist): these are the joints nearest to those of the "
            "previous row, in the first row to what was measured, and may be on another branch than intended; give "
            f"guess_{first.header} to "
            f"guess_{last.header} near the joints wanted."
        )

    def joints(self, table: Table, shown: JointMap | None = None) -> tuple[NDArray[np.float64], dict[str, str]]:
        """Ideal joints of wanted poses, `rows x n` [SI], and the unit to write each in; guesses are as `shown`.

        Raises:
            InputError: a column is missing, or poses cannot be reached (named by line).
        """
        mechanism, within = self._mechanism, ROUNDED if self.goals else EXACT
        if self.goals:
            values, self._form, read = commanded_poses(table, mechanism)
            mechanism = mechanism.controlled()
            poses = torch.from_numpy(values)
        else:
            values, coordinates, self._form, read = read_pose(table, mechanism)
            if len(coordinates) != len(mechanism.pose):
                missing = [c.header for c in mechanism.pose if c.name not in {k.name for k in coordinates}]
                raise InputError(
                    f"{table.path}: the poses of {mechanism.name} need the columns {', '.join(missing)}, too"
                )
            poses = self._of_the_measured_tool(torch.from_numpy(values))
        self._of_pose = _units(table, read)
        guess = self._first
        guesses = tuple(Coordinate(f"guess_{c.name}", c.unit) for c in mechanism.joints)
        guided = any(c.name in table for c in guesses)
        if guided:
            near = stack_columns(table, guesses, JOINT_LIMIT)
            guess = torch.from_numpy(near if shown is None else shown.of_shown(near))
        self.chooses = bool(mechanism.orientations) and not guided
        if self.chooses:
            before = nearest_measured(mechanism, self._region, poses[0]) if self._before is None else self._before
            joints = follow(mechanism, poses, before, within)
            self._before = joints[-1]
        else:
            joints = mechanism.solve_inverse(poses, guess=guess)
        # Of all full turns of a revolute joint the one nearest to the guess, or to the first one.
        joints = nearest_turns(mechanism, joints, guess)
        lost = np.flatnonzero(~arrives(mechanism, joints, poses, within).numpy())
        if len(lost):
            raise InputError(
                f"{table.path}: no joints of {mechanism.name} were found for the pose at {table.name_rows(lost)}; "
                f"correct or remove it, or give guess_q1[{mechanism.joints[0].unit}]… near the solution"
            )
        units = {g.name: table.units[g.name] for g in guesses} if guided else self._of_pose
        keys = [g.name if guided else c.unit for g, c in zip(guesses, mechanism.joints, strict=True)]
        return joints.detach().numpy(), {
            c.name: units.get(key, c.unit) for c, key in zip(mechanism.joints, keys, strict=True)
        }

    def commanded(self, command: Array) -> dict[str, ArrayLike]:
        """Columns of the poses to command where a controller takes no joints: the nominal ones of the commands.

        In the machine's own base, of an arm at the tool of its file; in the form and units in which poses were wanted.
        Empty where poses do not determine the joints.
        """
        machine = self._mechanism.controlled()
        if len(machine.joints) > len(machine.pose):
            return {}
        pose = machine.forward_kinematics(torch.from_numpy(np.asarray(command))).numpy()
        units = {c.name: c.unit for c in machine.pose}
        columns = dict(zip(units, pose.T, strict=True))
        if machine.orientations:
            turns = pose_columns(pose, self._form)
            columns = {name: columns[name] for name in ("x", "y", "z")} | turns
            units |= dict.fromkeys(turns, "1" if self._form == "quaternion" else "rad")
        shown = {name: self._of_pose.get(unit, unit) for name, unit in units.items()}
        return {f"command_{n}[{shown[n]}]": from_si(values, units[n], shown[n]) for n, values in columns.items()}

    def _of_the_measured_tool(self, poses: Tensor) -> Tensor:
        """Poses of the tool and in the frame with which the model was made, `s x p`."""
        if self._same:
            return poses
        found = self._before_pose @ frames_of(poses) @ self._behind_pose
        return torch.cat([found[:, :3, 3], matrix_to_rotation_vector(found[:, :3, :3])], -1)


def frames_of(poses: Tensor) -> Tensor:
    """`... x 4 x 4` of x, y, z and rotation vectors `... x 6` [m, rad]."""
    return homogeneous(rotation_vector_to_matrix(poses[..., 3:]), poses[..., :3])


def _units(table: Table, read: Sequence[str]) -> dict[str, str]:
    """SI unit -> the one unit in which the table has its pose columns of that kind."""
    kinds: dict[str, set[str]] = {}
    for unit in (table.units[name] for name in read):
        kinds.setdefault(si_unit_of(unit), set()).add(unit)
    return {kind: units.pop() for kind, units in kinds.items() if len(units) == 1}


def nearest_measured(mechanism: Mechanism, region: Tensor, pose: Tensor) -> Tensor:
    """Joints in the region, lowest and highest `n x 2`, whose pose is among the nearest to one, `n` [SI]."""
    share = torch.rand(_LOOKED_AT, len(region), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    joints = region[:, 0] + (region[:, 1] - region[:, 0]) * share
    error = mechanism.pose_error(mechanism.forward_kinematics(joints), pose)
    turned = 0.0 if error.rotation is None else ROTATION_WEIGHT * error.rotation
    return joints[torch.nan_to_num(error.position + turned, nan=torch.inf).argmin()]


def nearest_turns(mechanism: Mechanism, joints: Tensor, guess: Tensor) -> Tensor:
    """Joints `... x n` [SI] by so many full turns elsewhere that revolute ones are nearest to a guess."""
    turning = torch.tensor([c.unit == "rad" for c in mechanism.joints])
    return joints - torch.where(turning, 2 * torch.pi * torch.round((joints - guess) / (2 * torch.pi)), 0.0)


@dataclass
class Compensated:
    """What became of the rows.

    Attributes:
        rows: how many were written.
        outside: how many are outside the domain.
        damped: how many have a damped command.
        fallback: how many violate the limits of the model's card; `first` names the first.
        branch: how the branch of an arm was chosen, where that was left open.
    """

    rows: int = 0
    outside: int = 0
    damped: int = 0
    fallback: int = 0
    first: str = ""
    branch: str = ""


def is_of_motion(path: Path) -> bool:
    """Whether a file is one that `ccnn diagnose --motion` writes for commands to be corrected by."""
    if path.suffix != ".json" or not path.is_file():
        return False
    content = parse_json(read_text(path, _LARGEST), str(path))
    return isinstance(content, dict) and {"axes", "mechanism", "left"} <= content.keys()


def compensate_table(
    loaded: LoadedModel,
    input: Path,
    output: Path,
    pose: bool = False,
    back: bool = False,
    sd: bool = False,
    allow_code: bool = False,
    tool: Sequence[float] | None = None,
    base: Sequence[float] | None = None,
) -> tuple[list[str], str]:
    """Write the input's columns with commands, deviations and flags; see `ccnn compensate --help` for the columns.

    Args:
        loaded: as `load_compensation` gives it.
        input, output: CSV files (`input` also .xlsx).
        pose, back, sd: as the options of `ccnn compensate`.
        allow_code, tool, base: as of `WantedPoses`.

    Returns:
        Sentences on what was written; and one on rows in which the model violates the limits in its card, else empty.

    Raises:
        InputError: a file cannot be read or is not in this form; nothing is written then.
    """
    poses = WantedPoses(loaded, allow_code, tool, base) if pose else None
    found = write_compensated(loaded, input, output, poses, back, sd, allow_code=allow_code)
    said = sentences(output, found, loaded)
    refused = (
        f"{output}: in {found.fallback} of {found.rows} rows, the first from {found.first} of {input}, {loaded.path} "
        "violates the limits in its card (finite numbers, |deviation| within the limit); they were written without any "
        "correction and with inside_domain = 0: do not use this model"
    )
    return said, refused if found.fallback else ""


def write_compensated(
    loaded: LoadedModel,
    input: Path,
    output: Path,
    poses: WantedPoses | None = None,
    back: bool = False,
    sd: bool = False,
    rows: int = ROWS,
    allow_code: bool = False,
) -> Compensated:
    """The table of `compensate_table`, read, computed and written in parts of so many rows."""
    result = Compensated()
    counted = read_joint_map(loaded.joint_map, loaded.joints, loaded.columns)
    with writing_table(output) as write:
        for original in read_parts(input, rows):
            # Headers that the model's run mapped are mapped alike; OUT repeats them as they are.
            table = mapped(original, columns_there(original.units, loaded.columns))
            if poses is None and not back and is_commanded(table, loaded.joints):
                poses = WantedPoses(loaded, allow_code, goals=True)
            # A file of poses or commands alone is of the controller as well; one with the mechanism's joints is not.
            own = poses is None and all(c.name in original for c in loaded.joints)
            shown = counted if counted is not None and (counted.is_in(original.names, table) or not own) else None
            joints, units = poses.joints(table, shown) if poses is not None else _joints(loaded, table, back, shown)
            covariates = stack_columns(table, loaded.covariates) if loaded.covariates else None
            with warnings.catch_warnings():
                # Reported at the end, with the line of the table.
                warnings.simplefilter("ignore", FallbackWarning)
                found = loaded(joints, covariates, ("back",) if back else ("command", "sd") if sd else ("command",))
            if sd and "deviation_sd" not in found:
                raise InputError(
                    f"--sd: {loaded.path} is identified geometry, which has no standard deviation of a command"
                )
            added = _added(loaded, found, units, back, sd, shown)
            added |= {} if poses is None else poses.commanded(found["command"])
            names = {header.partition("[")[0] for header in added}
            write({original.header(n): original.cells(n) for n in original.names if n not in names} | added)
            _count(result, table, found, back)
    if poses is not None and poses.chooses:
        result.branch = poses.sentence
    return result


def _joints(loaded: LoadedModel, table: Table, back: bool, shown: JointMap | None) -> tuple[Array, dict[str, str]]:
    """Joints `rows x n` [SI], and the unit of each as written."""
    own = [c.name for c in loaded.joints] if shown is None else shown.columns
    names = {c.name: column for c, column in zip(loaded.joints, own, strict=True)}
    if back and all(f"command_{name}" in table for name in names):
        names = {name: f"command_{name}" for name in names}
    _check_joint_columns(loaded, table)
    columns = tuple(Coordinate(names[c.name], c.unit) for c in loaded.joints)
    values = stack_columns(table, columns, JOINT_LIMIT)
    units = {c.name: table.units[names[c.name]] for c in loaded.joints}
    return values if shown is None else shown.of_shown(values), units


def _check_joint_columns(loaded: LoadedModel, table: Table) -> None:
    """Raise `InputError` for a file with more joints than the model, or with poses alone."""
    known = {c.name for c in loaded.joints}
    if not known & {*table.names} and {"x", "y"} & {*table.names}:
        raise InputError(f"{table.path}: has no joints ({loaded.joints[0].header} …) but poses; add --pose")
    other = [name for name in table.names if name[:1] == "q" and name[1:].isdigit() and name not in known]
    if other:
        mechanism = loaded.facts["mechanism"]["name"]
        raise InputError(
            f"{table.path}: column '{other[0]}' is no joint of this model, which was made for {mechanism} "
            f"({', '.join(c.header for c in loaded.joints)}); take the model of the other machine, or rename the column"
        )


def _added(
    loaded: LoadedModel, found: dict[str, Array], units: dict[str, str], back: bool, sd: bool, shown: JointMap | None
) -> dict[str, ArrayLike]:
    """The columns that OUT gets, in the units and in the count that the joints were written in."""

    def named(what: str, values: Array) -> dict[str, ArrayLike]:
        return {
            f"{what}_{c.name}[{units[c.name]}]": from_si(values[:, k], c.unit, units[c.name])
            for k, c in enumerate(loaded.joints)
        }

    if shown is not None:
        kinds = {"command": shown.shown, "ideal": shown.shown, "deviation": shown.change_shown}
        kinds["deviation_sd"] = shown.spread_shown
        found = found | {name: show(found[name]) for name, show in kinds.items() if name in found}
    if back:
        flags = {"inside_domain[1]": found["ideal_inside_domain"], "status[1]": found["ideal_status"]}
        return named("ideal", found["ideal"]) | flags
    added = named("command", found["command"]) | named("deviation", found["deviation"])
    added["inside_domain[1]"] = found["inside_domain"]
    added["status[1]"] = found["status"]
    return added | (named("deviation_sd", found["deviation_sd"]) if sd else {})


def _count(result: Compensated, table: Table, found: dict[str, Array], back: bool) -> None:
    bad = np.flatnonzero(found["fallback"])
    if len(bad) and not result.fallback:
        result.first = table.name_rows(bad[:1])
    result.rows += len(table)
    result.fallback += len(bad)
    result.outside += int((~found["ideal_inside_domain" if back else "inside_domain"]).sum())
    result.damped += int((found["ideal_status" if back else "status"] == DAMPED).sum())


def sentences(output: Path, found: Compensated, model: LoadedModel) -> list[str]:
    """What was written, and how many rows are outside the domain or damped."""
    said = [f"{output}: {found.rows} rows written."]
    if found.outside:
        what, then = "what was measured", "what was learned fades there, geometry and effects hold"
        if model.machine is not None:
            # The file of geometry alone does not say where it was measured.
            measured = len(model.machine.joints) > 0
            what = what if measured else "the joints of the identified machine"
            then = "geometry and effects hold there too" if measured else "its geometry holds there too"
        ends, names = model.facts.get("machine", {}).get("ends", {}), [c.name for c in model.covariates]
        held, told = ([name for name in names if (name in ends) == wide] for wide in (False, True))
        if held:
            then += f", with {', '.join(held)} held at the ends of what was measured"
        if told:
            then += f"{' and' if held else ', with'} {', '.join(told)} at the ends told in compensation.ends"
        said.append(f"{found.outside} of them {_is(found.outside)} outside {what} (inside_domain = 0): {then}.")
    if found.damped:
        said.append(
            f"{found.damped} of them {_is(found.damped)} near a singular pose or at a limit of the joints "
            f"(key limits of the machine's file; status = {DAMPED}), with the nearest safe command."
        )
    return [*said, found.branch] if found.branch else said


def _is(count: int) -> str:
    return "is" if count == 1 else "are"
