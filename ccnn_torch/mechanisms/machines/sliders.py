"""Parallel machines with legs on guideways: the tripod and the machine tool of the paper."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.newton import solve
from ccnn_torch.numerics.batching import stack_last


class Tripod(Mechanism):
    """Two parallelogram legs along x, one bar along y; joints q1, q2, q3 [m] (ρ1..ρ3), pose y, z [m], phi [rad].

    The printed eq. 15 has 15b twice; the first of the two is ρ2. The platform turns about -y by phi. The workspace is
    the assembly mode det(∂ρ/∂X) < 0, which Newton from (0, 0.55 m, 0) does not leave; the sampling box is
    y ±0.2 m, z 0.4..0.7 m, phi ±0.3 rad.
    """

    closed_form = "inverse"

    def __init__(self, L: float = 1.0, r: float = 0.3, per_leg: bool = False) -> None:
        """L: length of the legs [m]; r: radius of the platform [m].

        per_leg: leg i has parameters of its own, for identification: its length Li, the radius ri of its joint on the
        platform and the offset di of its drive [m] (its carriage is at the joint plus this); else L and r are
        common.
        """
        geometry = [Parameter("L", "m", L), Parameter("r", "m", r)]
        if per_leg:
            parts = (("L", L), ("r", r), ("d", 0.0))
            geometry = [Parameter(f"{n}{i}", "m", v, i) for i in (1, 2, 3) for n, v in parts]
        super().__init__(
            name="tripod",
            joints=[Coordinate(q, "m") for q in ("q1", "q2", "q3")],
            pose=[Coordinate("y", "m"), Coordinate("z", "m"), Coordinate("phi", "rad")],
            geometry=geometry,
            low=(-0.2, 0.4, -0.3),
            high=(0.2, 0.7, 0.3),
            home_pose=(0.0, 0.55, 0.0),
            keys={"per_leg": True} if per_leg else {},
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Eq. 15, closed form; NaN where a root is not real."""
        length, radius, offset = self._legs(self.resolve(parameters))
        y, z, phi = pose.unbind(-1)
        (l1, l2, l3), (r1, r2, r3) = length.unbind(-1), radius.unbind(-1)
        s, c = torch.sin(phi), torch.cos(phi)
        rho1 = torch.sqrt(l1**2 - y**2 - (z + r1 * s) ** 2) + r1 * c
        rho2 = torch.sqrt(l2**2 - y**2 - (z - r2 * s) ** 2) + r2 * c
        rho3 = torch.sqrt(l3**2 - z**2) + y + r3
        return stack_last(rho1, rho2, rho3) - offset

    def _inverse_slope(self, pose: Tensor, values: Tensor) -> Tensor:
        """Derivative of eq. 15 by the pose, `... x 3 x 3`; NaN where a root is not real."""
        length, radius, _ = self._legs(values)
        y, z, phi = pose.unbind(-1)
        (l1, l2, l3), (r1, r2, _) = length.unbind(-1), radius.unbind(-1)
        s, c = torch.sin(phi), torch.cos(phi)
        height1, height2 = z + r1 * s, z - r2 * s
        root1, root2 = torch.sqrt(l1**2 - y**2 - height1**2), torch.sqrt(l2**2 - y**2 - height2**2)
        rho1 = [-y / root1, -height1 / root1, -height1 * r1 * c / root1 - r1 * s]
        rho2 = [-y / root2, -height2 / root2, height2 * r2 * c / root2 - r2 * s]
        slope3 = -z / torch.sqrt(l3**2 - z**2)
        rho3 = [torch.ones_like(slope3), slope3, torch.zeros_like(slope3)]
        rows: Tensor = stack_last(*rho1, *rho2, *rho3)
        return rows.reshape(*rows.shape[:-1], 3, 3)

    def _legs(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Length, radius and offset of each leg, `... x 3` [m]."""
        if len(self.geometry) == 2:
            length, radius = (values[..., i, None].expand(*values.shape[:-1], 3) for i in (0, 1))
            return length, radius, torch.zeros_like(length)
        legs = values.reshape(*values.shape[:-1], 3, 3)
        return legs[..., 0], legs[..., 1], legs[..., 2]

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Newton on eq. 15; NaN where it leaves the assembly mode (beyond the edge of the workspace)."""

        def closure(pose: Tensor, joints: Tensor, values: Tensor) -> Tensor:
            return joints - self.solve_inverse(pose, values)

        def both(pose: Tensor, joints: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
            return closure(pose, joints, values), -self._inverse_slope(pose, values)

        start = self.home_pose if guess is None else guess
        pose = solve(closure, start, (joints, self.resolve(parameters)), both=both)
        return torch.where(self.reachable(pose.detach(), parameters)[..., None], pose, torch.nan)

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """From the carriage of each leg to its joint on the platform; see `Mechanism.skeleton`."""
        _, radius, offset = self._legs(self.resolve(parameters))
        centre, rotation = self.frame(pose)
        assert rotation is not None
        # Legs 1 and 2 run along x, leg 3 along y.
        side = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=pose.dtype)
        carriage, on_platform = side * (joints + offset)[:, None], centre + (side * radius[:, None]) @ rotation.mT
        return {f"leg {i + 1}": torch.stack([carriage[i], on_platform[i], centre]) for i in range(3)}

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor | None]:
        """Centre of the platform (0, y, z) and its rotation about -y by phi."""
        y, z, phi = pose.unbind(-1)
        zero, one = torch.zeros_like(phi), torch.ones_like(phi)
        s, c = torch.sin(phi), torch.cos(phi)
        rotation = torch.stack([c, zero, -s, zero, one, zero, s, zero, c], dim=-1).reshape(*phi.shape, 3, 3)
        return torch.stack([zero, y, z], dim=-1), rotation

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Real roots, and det(∂ρ/∂X) < 0: the assembly mode of the machine as built."""
        values = self.resolve(parameters)
        joints, slope = self.solve_inverse(pose, values), self._inverse_slope(pose, values)
        real = torch.isfinite(joints).all(-1)
        determinant: Tensor = torch.linalg.det(torch.where(real[..., None, None], slope, 0.0))
        return real & (determinant < 0)


_ATTACHMENTS = tuple(math.radians(a) for a in (90.0, 210.0, 330.0))


class MachineTool(Mechanism):
    """Three legs on inclined guideways; joints q1..q3 [m] (u1..u3), pose theta_x, theta_y [rad], z [m].

    Eq. 18 is a quadratic in u_i; the smaller root is the machine as built. The paper leaves the dimensions out: the
    defaults are ours. The sampling box is theta ±15°, z 0.5..0.7 m.
    """

    closed_form = "inverse"

    def __init__(
        self,
        l_e: float = 0.2,
        l_b: float = 0.7,
        z_0: float = 0.1,
        l: float = 0.6,
        gamma: float = math.radians(45.0),
        per_leg: bool = False,
    ) -> None:
        """Radii of platform and base, height of the spherical joints, leg length [m]; slope of the guideways [rad].

        per_leg: leg i has all parameters of its own, for identification: l_ei, l_bi, z_0i, li, gammai, alphai, betai
        and the offset u_0i of its drive [m] (its carriage is at the joint plus this); else only alphai and betai.
        """
        common = [("l_e", "m", l_e), ("l_b", "m", l_b), ("z_0", "m", z_0), ("l", "m", l), ("gamma", "rad", gamma)]
        geometry = [] if per_leg else [Parameter(*part) for part in common]
        if per_leg:
            parts = [*common, ("u_0", "m", 0.0)]
            geometry = [Parameter(f"{n}{i}", u, v, i) for n, u, v in parts for i in (1, 2, 3)]
        for letter in ("alpha", "beta"):
            geometry += [Parameter(f"{letter}{i + 1}", "rad", a, leg=i + 1) for i, a in enumerate(_ATTACHMENTS)]
        tilt = math.radians(15.0)
        super().__init__(
            name="machine_tool",
            joints=[Coordinate(q, "m") for q in ("q1", "q2", "q3")],
            pose=[Coordinate("theta_x", "rad"), Coordinate("theta_y", "rad"), Coordinate("z", "m")],
            geometry=geometry,
            low=(-tilt, -tilt, 0.5),
            high=(tilt, tilt, 0.7),
            keys={"per_leg": True} if per_leg else {},
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Eq. 18: |c_i - u_i d_i| = l with d_i the guideway's direction; the smaller root, NaN where it is not real."""
        values = self.resolve(parameters)
        foot, along, joint = self._points(pose, values)
        l, u_0 = self._legs(values)[3], self._legs(values)[5]
        c = joint - foot
        middle = (c * along).sum(-1)
        return middle - torch.sqrt(middle**2 - (c**2).sum(-1) + l**2) - u_0

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """Guideway, leg and platform of each leg; see `Mechanism.skeleton`."""
        values = self.resolve(parameters)
        foot, along, joint = self._points(pose, values)
        carriage = foot + (joints + self._legs(values)[5])[:, None] * along
        centre = self.frame(pose)[0]
        return {f"leg {i + 1}": torch.stack([foot[i], carriage[i], joint[i], centre]) for i in range(3)}

    def _points(self, pose: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of each leg the foot and the direction of its guideway, and its joint on the platform, `... x 3 x 3`."""
        l_e, l_b, z_0, _, gamma, _, alpha, beta = self._legs(values)
        position, rotation = self.frame(pose)
        joint = stack_last(l_e * torch.cos(beta), l_e * torch.sin(beta), z_0)
        foot = stack_last(l_b * torch.cos(alpha), l_b * torch.sin(alpha), torch.zeros_like(l_b))
        slide = torch.cos(gamma)
        along = stack_last(-slide * torch.cos(alpha), -slide * torch.sin(alpha), torch.sin(gamma))
        return foot, along, position[..., None, :] + (rotation[..., None, :, :] @ joint[..., None])[..., 0]

    def _legs(self, values: Tensor) -> tuple[Tensor, ...]:
        """l_e, l_b, z_0, l, gamma, u_0, alpha, beta of the legs, `... x 3` each (the common ones `... x 1`)."""
        if len(self.geometry) == 11:
            common = values[..., :5, None].unbind(-2)
            return (*common, torch.zeros_like(common[0]), values[..., 5:8], values[..., 8:11])
        return values.reshape(*values.shape[:-1], 8, 3).unbind(-2)

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Point (0, 0, z) on the axis and the rotation Rx(theta_x) Ry(theta_y) that eq. 18 spells out."""
        theta_x, theta_y, z = pose.unbind(-1)
        zero = torch.zeros_like(z)
        sx, cx, sy, cy = torch.sin(theta_x), torch.cos(theta_x), torch.sin(theta_y), torch.cos(theta_y)
        rows = [cy, zero, sy, sx * sy, cx, -sx * cy, -cx * sy, sx, cx * cy]
        return torch.stack([zero, zero, z], dim=-1), torch.stack(rows, dim=-1).reshape(*z.shape, 3, 3)
