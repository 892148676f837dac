"""Ideal joints of wanted poses, on the mechanism that a model was made for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.compensation.model_files.identified import IdentifiedGeometry
from ccnn_torch.compensation.model_files.load import LoadedModel
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm, mechanism_from_description
from ccnn_torch.mechanisms.frames.fit import ROTATION_WEIGHT
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.plugins import code_refused
from ccnn_torch.records.headers import read_pose, stack_columns
from ccnn_torch.records.joint_map import JointMap
from ccnn_torch.records.load import JOINT_LIMIT
from ccnn_torch.records.table import Table
from ccnn_torch.units import si_unit_of

# Largest pose error of the nominal machine at the joints found [m, rad].
_CLOSE = 1e-8
# Initial guesses solved at once where that of the previous row does not converge.
_STARTS = 64
# Joints all over the measured region, among which the first row's guess is looked for.
_LOOKED_AT = 2000


class WantedPoses:
    """Joints of tables of poses, one after the other; an arm goes on from the last row of the table before.

    Attributes:
        chooses: whether joints were found without a given branch, where there are several.
    """

    def __init__(
        self,
        loaded: LoadedModel | IdentifiedGeometry,
        allow_code: bool = False,
        tool: Sequence[float] | None = None,
        base: Sequence[float] | None = None,
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
        with code_refused(f"{loaded.path}: its mechanism", allow_code):
            self._mechanism = mechanism_from_description(loaded.facts["mechanism"], allow_code=True)
        self._same = tool is None and base is None
        machine = self._mechanism
        if not (self._same or (isinstance(machine, SerialArm) and len(machine.pose) == 6)):
            raise InputError(
                f"{'--tool' if base is None else '--base'}: {loaded.path} was made for {machine.name}; only an arm "
                "whose orientation was measured takes another tool or workpiece frame; leave it out"
            )
        self._before_pose = torch.eye(4, dtype=torch.float64) if base is None else _frame(base)
        self._behind_pose = torch.eye(4, dtype=torch.float64)
        if tool is not None:
            self._behind_pose = torch.linalg.inv(_frame(tool)) @ _frame(_measured_tool(loaded, self._mechanism))
        self._first, self._region = torch.from_numpy(loaded.middle), torch.from_numpy(loaded.region)
        self._before: Tensor | None = None
        self.chooses = False

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
        mechanism = self._mechanism
        values, coordinates, _, read = read_pose(table, mechanism)
        if len(coordinates) != len(mechanism.pose):
            missing = [c.header for c in mechanism.pose if c.name not in {k.name for k in coordinates}]
            raise InputError(f"{table.path}: the poses of {mechanism.name} need the columns {', '.join(missing)}, too")
        poses = self._of_the_measured_tool(torch.from_numpy(values))
        guess = self._first
        guesses = tuple(Coordinate(f"guess_{c.name}", c.unit) for c in mechanism.joints)
        guided = any(c.name in table for c in guesses)
        if guided:
            near = stack_columns(table, guesses, JOINT_LIMIT)
            guess = torch.from_numpy(near if shown is None else shown.of_shown(near))
        self.chooses = bool(mechanism.orientations) and not guided
        if self.chooses:
            before = _nearest(mechanism, self._region, poses[0]) if self._before is None else self._before
            joints = _follow(mechanism, poses, before)
            self._before = joints[-1]
        else:
            joints = mechanism.solve_inverse(poses, guess=guess)
        # Of all full turns of a revolute joint the one nearest to the guess, or to the first one.
        turning = torch.tensor([c.unit == "rad" for c in mechanism.joints])
        joints = joints - torch.where(turning, 2 * torch.pi * torch.round((joints - guess) / (2 * torch.pi)), 0.0)
        lost = np.flatnonzero(~_reached(mechanism, joints, poses).numpy())
        if len(lost):
            raise InputError(
                f"{table.path}: no joints of {mechanism.name} were found for the pose at {table.name_rows(lost)}; "
                f"correct or remove it, or give guess_q1[{mechanism.joints[0].unit}]… near the solution"
            )
        units = {g.name: table.units[g.name] for g in guesses} if guided else _units(table, read)
        keys = [g.name if guided else c.unit for g, c in zip(guesses, mechanism.joints, strict=True)]
        return joints.detach().numpy(), {
            c.name: units.get(key, c.unit) for c, key in zip(mechanism.joints, keys, strict=True)
        }

    def _of_the_measured_tool(self, poses: Tensor) -> Tensor:
        """Poses of the tool and in the frame with which the model was made, `s x p`."""
        if self._same:
            return poses
        found = self._before_pose @ _frames(poses) @ self._behind_pose
        return torch.cat([found[:, :3, 3], matrix_to_rotation_vector(found[:, :3, :3])], -1)


def _measured_tool(loaded: LoadedModel | IdentifiedGeometry, mechanism: Mechanism) -> Sequence[float]:
    """The tool's frame with which the model was made, x, y, z and rotation vector from the end of the last link."""
    machine = loaded.identified if isinstance(loaded, IdentifiedGeometry) else mechanism
    tool: list[float] = machine.nominal[-6:].tolist()
    return tool


def _frame(numbers: Sequence[float]) -> Tensor:
    """`4 x 4` of x, y, z and a rotation vector [m, rad]."""
    values = torch.tensor(list(numbers), dtype=torch.float64)
    return _frames(values[None])[0]


def _frames(poses: Tensor) -> Tensor:
    """`s x 4 x 4` of poses `s x 6`."""
    found = torch.eye(4, dtype=torch.float64).repeat(len(poses), 1, 1)
    found[:, :3, :3] = rotation_vector_to_matrix(poses[:, 3:])
    found[:, :3, 3] = poses[:, :3]
    return found


def _units(table: Table, read: Sequence[str]) -> dict[str, str]:
    """SI unit -> the one unit in which the table has its pose columns of that kind."""
    kinds: dict[str, set[str]] = {}
    for unit in (table.units[name] for name in read):
        kinds.setdefault(si_unit_of(unit), set()).add(unit)
    return {kind: units.pop() for kind, units in kinds.items() if len(units) == 1}


def _nearest(mechanism: Mechanism, region: Tensor, pose: Tensor) -> Tensor:
    """Joints in the region, lowest and highest `n x 2`, whose pose is among the nearest to one, `n` [SI]."""
    share = torch.rand(_LOOKED_AT, len(region), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    joints = region[:, 0] + (region[:, 1] - region[:, 0]) * share
    error = mechanism.pose_error(mechanism.forward_kinematics(joints), pose)
    turned = 0.0 if error.rotation is None else ROTATION_WEIGHT * error.rotation
    return joints[torch.nan_to_num(error.position + turned, nan=torch.inf).argmin()]


def _follow(mechanism: Mechanism, poses: Tensor, guess: Tensor) -> Tensor:
    """Joints of successive poses, each on the branch of the previous row, the first on that of the guess.

    Where that branch has no solution, take the one nearest to the previous row, out of many initial guesses.
    """
    starts = mechanism.sample_joints(_STARTS, torch.Generator().manual_seed(0))
    rows = []
    for pose in poses:
        joints = mechanism.solve_inverse(pose, guess=guess)
        if not bool(_reached(mechanism, joints, pose)):
            found = mechanism.solve_inverse(pose.expand(_STARTS, -1), guess=starts)
            distance = mechanism.wrap(found - guess).norm(dim=-1)
            good = _reached(mechanism, found, pose.expand(_STARTS, -1))
            joints = found[torch.where(good, distance, torch.inf).argmin()]
        rows.append(joints)
        guess = torch.where(_reached(mechanism, joints, pose), joints, guess)
    return torch.stack(rows)


def _reached(mechanism: Mechanism, joints: Tensor, poses: Tensor) -> Tensor:
    """Whether joints bring the nominal machine to the poses, `...`; an arm's solver stops at the nearest one."""
    error = mechanism.pose_error(mechanism.forward_kinematics(joints, guess=poses), poses)
    # A comparison with NaN is false, so a pose without joints is not reached either.
    reached = error.position < _CLOSE
    return reached if error.rotation is None else reached & (error.rotation < _CLOSE)
