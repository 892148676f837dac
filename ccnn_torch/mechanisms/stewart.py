"""The Gough-Stewart platform, 6-UPS (Gough and Whitehall 1962, Stewart 1965)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms._mechanism import Mechanism
from ccnn_torch.mechanisms._numeric import solve
from ccnn_torch.rotations import rotation_vector_rate, rotation_vector_to_matrix

__all__ = ["Stewart"]


class Stewart(Mechanism):
    """Six legs that change their length; joints q1..q6 [m], pose x, y, z [m] and rotation vector rx, ry, rz [rad].

    Leg i has the parameters Bix, Biy, Biz (its joint on the base), Pix, Piy, Piz (on the platform, in its frame) [m],
    offseti [m] and gaini [1] of the drive: its length is gain * q + offset. Nominally the joints stand in pairs on two
    circles, the base's pairs around 0°, 120° and 240°, the platform's between them, and the joints are the lengths. The
    workspace is the assembly mode of the middle of the sampling box: x, y ±0.1 m, z height ±0.1 m, rotation ±0.25 rad
    about each axis.
    """

    closed_form = "inverse"

    def __init__(
        self,
        base_radius: float = 0.5,
        platform_radius: float = 0.3,
        base_spread: float = math.radians(15.0),
        platform_spread: float = math.radians(15.0),
        height: float = 0.6,
    ) -> None:
        """Radii and height of the middle of the workspace [m]; half the angle between the joints of a pair [rad]."""
        geometry = []
        for i in range(6):
            pair, side = math.radians(120.0) * ((i + 1) // 2), 1.0 if i % 2 == 0 else -1.0
            between = math.radians(60.0) + math.radians(120.0) * (i // 2)
            on_base, on_platform = pair + side * base_spread, between - side * platform_spread
            places = (("B", base_radius, on_base), ("P", platform_radius, on_platform))
            for letter, radius, angle in places:
                point = (radius * math.cos(angle), radius * math.sin(angle), 0.0)
                geometry += [Parameter(f"{letter}{i + 1}{c}", "m", v, i + 1) for c, v in zip("xyz", point, strict=True)]
            geometry += [Parameter(f"offset{i + 1}", "m", 0.0, i + 1), Parameter(f"gain{i + 1}", "1", 1.0, i + 1)]
        tilt = 0.25
        super().__init__(
            name="stewart",
            joints=[Coordinate(f"q{i + 1}", "m") for i in range(6)],
            pose=[Coordinate(c, "m") for c in ("x", "y", "z")] + [Coordinate(c, "rad") for c in ("rx", "ry", "rz")],
            geometry=geometry,
            low=(-0.1, -0.1, height - 0.1, -tilt, -tilt, -tilt),
            high=(0.1, 0.1, height + 0.1, tilt, tilt, tilt),
        )
        if type(self) is Stewart:
            self.recipe = {"spec": "stewart", "keys": {"height": height}}

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Distances between the joints of each leg, less the offset, by the gain; closed form, for every pose."""
        values = self.resolve(parameters)
        legs = values.reshape(*values.shape[:-1], 6, 8)
        length: Tensor = torch.linalg.vector_norm(self._arms_and_legs(pose, values)[1], dim=-1)
        return (length - legs[..., 6]) / legs[..., 7]

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Newton from the middle of the workspace (or `guess`); NaN where it leaves the assembly mode."""
        values = self.resolve(parameters)

        def closure(pose: Tensor, joints: Tensor, values: Tensor) -> Tensor:
            return self.solve_inverse(pose, values) - joints

        def slope(pose: Tensor, joints: Tensor, values: Tensor) -> Tensor:
            rows = self._joint_rates(pose, values)
            return torch.cat([rows[..., :3], rows[..., 3:] @ rotation_vector_rate(pose[..., 3:])], dim=-1)

        pose = solve(closure, self.home_pose if guess is None else guess, (joints, values), slope)
        return torch.where(self.reachable(pose.detach(), values.detach())[..., None], pose, torch.nan)

    def jacobian(self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Closed form at the pose of the joints; see `Mechanism.jacobian`."""
        values = self.resolve(parameters)
        pose = self.forward_kinematics(joints, values, guess)
        known = torch.isfinite(pose).all(-1)[..., None, None]
        rows = torch.where(known, self._joint_rates(pose, values), torch.eye(6, dtype=pose.dtype, device=pose.device))
        return torch.where(known, torch.linalg.inv(rows), torch.nan)

    def parameter_jacobian(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Closed form, -∂X/∂q ∂q/∂θ at the pose of the joints; see `Mechanism.parameter_jacobian`."""
        values = self.resolve(parameters)
        pose = self.forward_kinematics(joints, values, guess)
        known = torch.isfinite(pose).all(-1)[..., None, None]
        leg = self._arms_and_legs(pose, values)[1]
        direction = leg / torch.linalg.vector_norm(leg, dim=-1, keepdim=True)
        on_platform = direction @ rotation_vector_to_matrix(pose[..., 3:])
        gain = values.reshape(*values.shape[:-1], 6, 8)[..., 7, None]
        length = joints.unsqueeze(-1).expand(*direction.shape[:-1], 1)
        # By the joint on the base and on the platform, offset and gain of a leg: what its own joint's value goes by.
        own = torch.cat([-direction, on_platform, -torch.ones_like(length), -length], -1) / gain
        rows = torch.where(known, self._joint_rates(pose, values), torch.eye(6, dtype=pose.dtype, device=pose.device))
        slope = -(torch.linalg.inv(rows)[..., None] * own.unsqueeze(-3)).flatten(-2)
        return torch.where(known, slope, torch.nan)

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """The assembly mode: det(∂q/∂X) has the sign that it has in the middle of the workspace; `...`, bool."""
        values = self.resolve(parameters)
        here, home = (torch.linalg.det(self._joint_rates(x, values)) for x in (pose, self.home_pose))
        same: Tensor = here * home > 0
        return same

    def _joint_rates(self, pose: Tensor, values: Tensor) -> Tensor:
        """Joints' rates per velocity and rate of rotation of the platform, `... x 6 x 6`.

        One row (u, R p x u) / gain per leg, u its direction and R p its joint on the platform.
        """
        arm, leg = self._arms_and_legs(pose, values)
        direction = leg / torch.linalg.vector_norm(leg, dim=-1, keepdim=True)
        gain = values.reshape(*values.shape[:-1], 6, 8)[..., 7, None]
        return torch.cat([direction, torch.linalg.cross(arm, direction, dim=-1)], dim=-1) / gain

    def _arms_and_legs(self, pose: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """From the platform's origin to its joints, and from base to platform joint, `... x 6 x 3` [m] in base axes."""
        legs = values.reshape(*values.shape[:-1], 6, 8)
        rotation = rotation_vector_to_matrix(pose[..., 3:])
        arm = (rotation[..., None, :, :] @ legs[..., 3:6, None])[..., 0]
        return arm, pose[..., None, :3] + arm - legs[..., :3]
