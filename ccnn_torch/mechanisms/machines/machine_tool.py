"""The parallel robotic machine tool of the paper's second case study (Zhang and Gao 2012, section IV-B)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.batching import stack_last

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
        )
        if type(self) is MachineTool:
            self.recipe = {"spec": "machine_tool", "keys": {"per_leg": True} if per_leg else {}}

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
