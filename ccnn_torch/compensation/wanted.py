"""Joints of wanted poses, as a model's mechanism has them, and the poses to command for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.compensation.model_files.metadata import Array
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.branches import EXACT, ROUNDED, arrives, follow
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT
from ccnn_torch.numerics.rotations import homogeneous, matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.records.commanded import commanded_poses
from ccnn_torch.records.headers import JOINT_LIMIT, check_orientation, pose_columns, read_pose, stack_columns
from ccnn_torch.records.joint_map import JointMap
from ccnn_torch.records.table import Table
from ccnn_torch.units import from_si, si_unit_of

# Joints all over the measured region, among which the first row's guess is looked for.
_LOOKED_AT = 2000


class WantedPoses:
    """Joints of tables of poses, one after the other; an arm goes on from the last row of the table before.

    Attributes:
        chooses: whether joints were found without a given branch, where there are several.
        goals: whether poses are as the controller has them, `goal_x` …, not as they are measured.
        lost: the first rows whose pose is not reached, by line, and why; empty without any.
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
        self._first, self._region = torch.from_numpy(loaded.middle), torch.from_numpy(loaded.measured)
        self._before: Tensor | None = None
        self.chooses, self.goals, self.lost = False, goals, ""
        self._form: str | None = None
        self._of_pose: dict[str, str] = {}

    @property
    def sentence(self) -> str:
        """What to know where `chooses`."""
        first, last = self._mechanism.joints[0], self._mechanism.joints[-1]
        return (
            "An arm reaches a pose on several branches (elbow, wrist): these are the joints nearest to those of the "
            "previous row, in the first row and after a jump to what was measured, and may be on another branch than "
            f"intended; give guess_{first.header} to guess_{last.header} near the joints wanted."
        )

    def joints(self, table: Table, shown: JointMap | None = None) -> tuple[NDArray[np.float64], dict[str, str]]:
        """Ideal joints of wanted poses, `rows x n` [SI], and the unit to write each in; guesses are as `shown`.

        Joints of poses that the machine does not reach are NaN; `lost` names the first of them.

        Raises:
            InputError: a column is missing.
        """
        mechanism, within = self._mechanism, ROUNDED if self.goals else EXACT
        if self.goals:
            values, self._form, read = commanded_poses(table, mechanism)
            mechanism = mechanism.controlled()
            poses = torch.from_numpy(values)
        else:
            values, coordinates, self._form, read = read_pose(table, mechanism)
            if isinstance(mechanism, SerialArm) and mechanism.orientation == "none":
                whole = mechanism.with_orientation("rotation_vector")
                if len(coordinates) > len(mechanism.pose):
                    # The orientation was not measured, and is wanted all the same.
                    self._mechanism = mechanism = whole
                else:
                    check_orientation(table, whole, [name for name in table.names if name not in read])
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
            joints = follow(mechanism, poses, before, within, self._region)
            self._before = joints[-1]
        else:
            joints = mechanism.solve_inverse(poses, guess=guess)
        # Of all full turns of a revolute joint the one nearest to the guess, or to the first one.
        joints = nearest_turns(mechanism, joints, guess)
        there = arrives(mechanism, joints, poses, within)
        joints = torch.where(there[:, None], joints, torch.nan)
        lost = np.flatnonzero(~there.numpy())
        if len(lost) and not self.lost:
            self.lost = table.name_rows(lost) + self._beyond(mechanism, poses[lost[0]])
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

    def _beyond(self, mechanism: Mechanism, pose: Tensor) -> str:
        """The coordinate that is farthest beyond the poses of the region, and these; empty where none is."""
        poses = mechanism.forward_kinematics(_all_over(self._region))
        low, high = poses.nan_to_num(nan=torch.inf).amin(0), poses.nan_to_num(nan=-torch.inf).amax(0)
        out = torch.maximum(pose - high, low - pose) / (high - low).clamp_min(1e-12)
        k = int(out.argmax())
        if not out[k] > 0:
            return ""
        unit = mechanism.pose[k].unit
        shown = self._of_pose.get(unit, unit)
        value, least, most = (f"{float(from_si(v[k].item(), unit, shown)):.4g}" for v in (pose, low, high))
        return f" ({mechanism.pose[k].name} = {value} {shown}; in the model's region {least} to {most} {shown})"

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
    joints = _all_over(region)
    error = mechanism.pose_error(mechanism.forward_kinematics(joints), pose)
    turned = 0.0 if error.rotation is None else ROTATION_WEIGHT * error.rotation
    return joints[torch.nan_to_num(error.position + turned, nan=torch.inf).argmin()]


def _all_over(region: Tensor) -> Tensor:
    share = torch.rand(_LOOKED_AT, len(region), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return region[:, 0] + (region[:, 1] - region[:, 0]) * share


def nearest_turns(mechanism: Mechanism, joints: Tensor, guess: Tensor) -> Tensor:
    """Joints `... x n` [SI] by so many full turns elsewhere that revolute ones are nearest to a guess."""
    turning = torch.tensor([c.unit == "rad" for c in mechanism.joints])
    return joints - torch.where(turning, 2 * torch.pi * torch.round((joints - guess) / (2 * torch.pi)), 0.0)
