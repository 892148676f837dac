"""Two serial arms in one model: a head with a camera and an arm, two arms that touch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.machines.serial import FRAME, SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

_BASE = 6


class Pair(Mechanism):
    """The second arm's tool as the first one's tool sees it: x, y, z [m], rx, ry, rz [rad] (a rotation vector).

    The base frames of both arms are in one frame, and that of the first is taken as it is: it is no parameter. Joints
    and parameters are the first one's, then the second one's, with `first_` and `second_` before their names. Where
    the tools are held together the pose is constant.
    """

    closed_form = "forward"

    def __init__(self, first: SerialArm, second: SerialArm) -> None:
        """Take two arms whose frames are known, at least roughly.

        Raises:
            InputError: one is no serial arm, or has an unknown frame.
        """
        arms = {"first": first, "second": second}
        for which, arm in arms.items():
            if not isinstance(arm, SerialArm):
                raise InputError(f"mechanism 'pair': {which}: write the file of a serial arm; {arm.name} is none")
            if arm.unknown_frames or arm.grouped:
                raise InputError(
                    f"mechanism 'pair': {which}: the frames of {arm.name} are not known; give base_frame and "
                    "tool_frame in its file as [x, y, z, rx, ry, rz], at least roughly"
                )
        named = [
            replace(p, name=f"{which}_{p.name}", nominal=v)
            for which, arm in arms.items()
            for p, v in zip(arm.geometry, arm.nominal.tolist(), strict=True)
        ]
        start = torch.cat([first.home_joints, second.home_joints])
        home = _apart(first, second, start, first.nominal, second.nominal)
        super().__init__(
            name=f"{first.name}_{second.name}",
            joints=[replace(j, name=f"{which}_{j.name}") for which, arm in arms.items() for j in arm.joints],
            pose=[Coordinate(name, unit) for name, unit in FRAME],
            geometry=named[_BASE:],
            low=(home - 1e-6).tolist(),
            high=(home + 1e-6).tolist(),
            home_pose=home.tolist(),
            home_joints=start.tolist(),
        )
        self.first, self.second = first, second
        told = [arm.gears or (None,) * len(arm.joints) for arm in (first, second)]
        self.gears = (*told[0], *told[1])
        if first.motors or second.motors:
            n = len(first.joints)
            turns = np.eye(len(self.joints))
            for arm, at in ((first, slice(None, n)), (second, slice(n, None))):
                turns[at, at] = arm.motors or turns[at, at]
            self.motors = tuple(map(tuple, turns.tolist()))

    def _own_file(self) -> dict[str, Any]:
        return {"spec": "pair", "keys": {"first": self.first.describe(), "second": self.second.describe()}}

    def _follow_nominal(self) -> None:
        self.home_pose.copy_(self.forward_kinematics(self.home_joints))

    def sample_joints(self, count: int, generator: torch.Generator) -> Tensor:
        """Of each arm within its joint limits, `count x n` [SI]."""
        return torch.cat([arm.sample_joints(count, generator) for arm in (self.first, self.second)], -1)

    def sample_workspace(self, count: int, generator: torch.Generator) -> Tensor:
        """Poses of such joints, `count x 6` [SI]."""
        return self.forward_kinematics(self.sample_joints(count, generator))

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """All that is finite: arms that reach each other anywhere do so in many ways; `...`, bool."""
        return torch.isfinite(pose).all(-1).expand(leading_shape(pose, self.resolve(parameters)))

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Closed form; see `Mechanism.forward_kinematics`."""
        values = self.resolve(parameters)
        base = self.first.nominal[:_BASE].expand(*values.shape[:-1], -1)
        count = len(self.first.geometry) - _BASE
        first, second = torch.cat([base, values[..., :count]], -1), values[..., count:]
        return _apart(self.first, self.second, joints, first, second)


def _apart(first: SerialArm, second: SerialArm, joints: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """The pose of the second tool in the frame of the first, `... x 6` [m, rad]."""
    count = len(first.joints)
    here, turned = first.forward_frame(joints[..., :count], one)
    there, rotation = second.forward_frame(joints[..., count:], other)
    place = (turned.mT @ (there - here)[..., None])[..., 0]
    return torch.cat([place, matrix_to_rotation_vector(turned.mT @ rotation)], -1)
