"""A Tricept-like head as its user describes it to ccnn_torch: three extensible legs and a central leg without a drive.

This file is what the judge `tricept.py` hands to the program, and shares no code with it.
"""

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


class Tricept(Mechanism):
    """Joints q1..q3 [m], lengths of the legs; pose x, y, z [m] of the tool, below the joint of the central leg."""

    def __init__(self, base: float = 0.45, platform: float = 0.2, tool: float = 0.25) -> None:
        """base, platform: radii of the legs' joints; tool: from the platform's joints down to the tool [m]."""
        geometry = []
        for leg, angle in enumerate((math.radians(a) for a in (90.0, 210.0, 330.0)), start=1):
            across, up = math.cos(angle), math.sin(angle)
            places = {"Ax": base * across, "Ay": base * up, "Az": 0.0}
            places |= {"Px": platform * across, "Py": platform * up, "Pz": 0.0}
            geometry += [Parameter(f"{name}{leg}", "m", value, leg, scale=2e-4) for name, value in places.items()]
            geometry.append(Parameter(f"offset{leg}", "m", 0.0, leg, scale=4e-4))
        point = {"point_x": 0.0, "point_y": 0.0, "point_h": tool}
        geometry += [Parameter(name, "m", value, scale=5e-4) for name, value in point.items()]
        super().__init__(
            name="tricept",
            joints=[Coordinate(q, "m") for q in ("q1", "q2", "q3")],
            pose=[Coordinate(axis, "m") for axis in "xyz"],
            geometry=geometry,
            low=(-0.4, -0.4, -1.65),
            high=(0.4, 0.4, -1.15),
            home_joints=[math.hypot(1.4 - tool, base - platform)] * 3,
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Distance of the joints of each leg less its length; `... x 3` [m]."""
        values = self.resolve(parameters)
        ax, ay, az, px, py, pz, offset = values[..., :21].reshape(*values.shape[:-1], 3, 7).unbind(-1)
        point_x, point_y, point_h = values[..., 21:].unbind(-1)
        x, y, z = pose.unbind(-1)
        # The central leg turns by a about y, then by b about the moved x; the tool is `down` along it, and beside it.
        depth = -torch.sqrt(x**2 + z**2 - point_x**2)
        down = -torch.sqrt(y**2 + depth**2 - point_y**2)
        a = (torch.atan2(x, z) - torch.atan2(point_x, depth))[..., None]
        b = (torch.atan2(depth, y) - torch.atan2(down, point_y))[..., None]
        pz = pz + (point_h + down)[..., None]
        py, pz = torch.cos(b) * py - torch.sin(b) * pz, torch.sin(b) * py + torch.cos(b) * pz
        px, pz = torch.cos(a) * px + torch.sin(a) * pz, torch.cos(a) * pz - torch.sin(a) * px
        lengths: Tensor = torch.linalg.vector_norm(torch.stack([px - ax, py - ay, pz - az]), dim=0)
        return lengths - joints - offset
