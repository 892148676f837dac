"""The Gough-Stewart platform, 6-UPS (Gough and Whitehall 1962, Stewart 1965)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.newton import solve
from ccnn_torch.numerics.rotations import rotation_vector_rate, rotation_vector_to_matrix


class Stewart(Mechanism):
    """Six legs that change their length; joints q1..q6 [m], pose x, y, z [m] and rotation vector rx, ry, rz [rad].

    Leg i has the parameters Bix, Biy, Biz (its joint on the base), Pix, Piy, Piz (on the platform, in its frame) [m],
    offseti [m] and gaini [1] of the drive: its length is gain * q + offset. Nominally the joints are placed in pairs on
    two circles, the base's pairs around 0°, 120° and 240°, the platform's between them, and the joints are the lengths.
    The workspace is the assembly mode of the middle of the sampling box: x, y ±0.1 m, z height ±0.1 m, rotation ±0.25
    rad about each axis.
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
            keys={"height": height},
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Distances between the joints of each leg, less the offset, by the gain; closed form, for every pose."""
        return self._legs(pose, self.resolve(parameters)).joints()

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Newton from the middle of the workspace (or `guess`); NaN where it leaves the assembly mode."""
        values, own = self.resolve(parameters), type(self).solve_inverse is Stewart.solve_inverse

        def closure(pose: Tensor, joints: Tensor, values: Tensor) -> Tensor:
            return self.solve_inverse(pose, values) - joints

        def both(pose: Tensor, joints: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
            legs = self._legs(pose, values)
            rows = legs.rates()
            slope = torch.cat([rows[..., :3], rows[..., 3:] @ rotation_vector_rate(pose[..., 3:])], dim=-1)
            # A class of its own may have drives of another kind.
            reached = legs.joints() if own else self.solve_inverse(pose, values)
            return reached - joints, slope

        pose = solve(closure, self.home_pose if guess is None else guess, (joints, values), both=both)
        return torch.where(self.reachable(pose.detach(), values.detach())[..., None], pose, torch.nan)

    def jacobian(self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Closed form at the pose of the joints; see `Mechanism.jacobian`."""
        return self.jacobian_at(self.forward_kinematics(joints, parameters, guess), joints, parameters)

    def jacobian_at(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Closed form; see `Mechanism.jacobian_at`."""
        rates, known = _inverted(self._legs(pose, self.resolve(parameters)).rates(), pose)
        return torch.where(known, rates, torch.nan)

    def parameter_jacobian(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Closed form, -∂X/∂q ∂q/∂θ at the pose of the joints; see `Mechanism.parameter_jacobian`."""
        return self.parameter_jacobian_at(self.forward_kinematics(joints, parameters, guess), joints, parameters)

    def parameter_jacobian_at(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Closed form; see `Mechanism.parameter_jacobian_at`."""
        legs = self._legs(pose, self.resolve(parameters))
        on_platform = legs.direction @ legs.rotation
        length = joints.unsqueeze(-1).expand(*on_platform.shape[:-1], 1)
        # By the joint on the base and on the platform, offset and gain of a leg, which change its own joint's value.
        own = torch.cat([-legs.direction, on_platform, -torch.ones_like(length), -length], -1) / legs.gain
        rates, known = _inverted(legs.rates(), pose)
        return torch.where(known, -(rates[..., None] * own.unsqueeze(-3)).flatten(-2), torch.nan)

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """The assembly mode: det(∂q/∂X) has the sign that it has in the middle of the workspace; `...`, bool."""
        values = self.resolve(parameters)
        here, home = (torch.linalg.det(self._legs(x, values).rates()) for x in (pose, self.home_pose))
        same: Tensor = here * home > 0
        return same

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """The legs, and the outlines of base and platform; see `Mechanism.skeleton`."""
        values = self.resolve(parameters)
        base = values.reshape(6, 8)[:, :3]
        platform = pose[:3] + self._legs(pose, values).arm
        legs = {f"leg {i + 1}": torch.stack([base[i], platform[i]]) for i in range(6)}
        return legs | {"base": torch.cat([base, base[:1]]), "platform": torch.cat([platform, platform[:1]])}

    def _legs(self, pose: Tensor, values: Tensor) -> _Legs:
        legs = values.reshape(*values.shape[:-1], 6, 8)
        rotation = rotation_vector_to_matrix(pose[..., 3:])
        arm = legs[..., 3:6] @ rotation.mT
        leg = pose[..., None, :3] + arm - legs[..., :3]
        length = torch.linalg.vector_norm(leg, dim=-1, keepdim=True)
        return _Legs(rotation, arm, length, leg / length, legs[..., 6:7], legs[..., 7:])


class _Legs(NamedTuple):
    """The legs of poses `...`.

    Attributes:
        rotation: of the platform, `... x 3 x 3`.
        arm: from the platform's origin to its joints, in base axes, `... x 6 x 3` [m].
        length: `... x 6 x 1` [m].
        direction: from the joint on the base to that on the platform, `... x 6 x 3`.
        offset, gain: of the drives, `... x 6 x 1` [m], [1].
    """

    rotation: Tensor
    arm: Tensor
    length: Tensor
    direction: Tensor
    offset: Tensor
    gain: Tensor

    def joints(self) -> Tensor:
        """`... x 6` [m]."""
        return ((self.length - self.offset) / self.gain)[..., 0]

    def rates(self) -> Tensor:
        """Joints' rates per velocity and rate of rotation of the platform, `... x 6 x 6`.

        One row (u, R p x u) / gain per leg, u its direction and R p its joint on the platform.
        """
        turned = torch.linalg.cross(self.arm, self.direction, dim=-1)
        return torch.cat([self.direction, turned], dim=-1) / self.gain


def _inverted(rates: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """The platform's velocities per rate of the joints, `... x 6 x 6`; and where there is a pose, `... x 1 x 1`."""
    known = torch.isfinite(pose).all(-1)[..., None, None]
    return torch.linalg.inv(torch.where(known, rates, torch.eye(6, dtype=pose.dtype, device=pose.device))), known
