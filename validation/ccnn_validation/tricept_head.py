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

    def __init__(self, base: float = 0.45, platform: float = 0.2, tool: float = 0.25, central: bool = False) -> None:
        """Describe the drawing.

        Args:
            base, platform: radii of the legs' joints [m].
            tool: from the platform's joints down to the tool [m].
            central: whether errors of the central leg's joint are numbers, too.
        """
        geometry = []
        for leg, angle in enumerate((math.radians(a) for a in (90.0, 210.0, 330.0)), start=1):
            across, up = math.cos(angle), math.sin(angle)
            places = {"Ax": base * across, "Ay": base * up, "Az": 0.0}
            places |= {"Px": platform * across, "Py": platform * up, "Pz": 0.0}
            geometry += [Parameter(f"{name}{leg}", "m", value, leg, scale=2e-4) for name, value in places.items()]
            geometry.append(Parameter(f"offset{leg}", "m", 0.0, leg, scale=4e-4))
        geometry += [Parameter(f"point_{axis}", "m", 0.0, scale=5e-4) for axis in "xy"]
        geometry.append(Parameter("point_h", "m", tool, scale=5e-4))
        self.central = central
        if central:
            geometry.append(Parameter("axes_apart", "m", 0.0, scale=1.5e-4))
            geometry += [Parameter(name, "rad", 0.0, scale=2e-4) for name in ("axes_skew", "slide_skew")]
        home = math.hypot(1.4 - tool, base - platform)
        super().__init__(
            name="tricept",
            joints=[Coordinate(q, "m") for q in ("q1", "q2", "q3")],
            pose=[Coordinate(axis, "m") for axis in "xyz"],
            geometry=geometry,
            low=(-0.4, -0.4, -1.65),
            high=(0.4, 0.4, -1.15),
            home_joints=[home] * 3,
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Distance of the joints of each leg less its length; `... x 3` [m]."""
        values = self.resolve(parameters)
        legs = values[..., :21].reshape(*values.shape[:-1], 3, 7)
        point_x, point_y, point_h = values[..., 21:24].unbind(-1)
        none = torch.zeros_like(point_x)
        apart, skew, lean = values[..., 24:27].unbind(-1) if self.central else (none, none, none)
        x, y, z = pose.unbind(-1)
        # The central joint turns about y, then about an axis near x; the slide carries the platform.
        side = point_x
        for _ in range(3):
            across = (y - side * torch.sin(skew)) / torch.cos(skew)
            first = side * torch.cos(skew) - across * torch.sin(skew)
            deep = -torch.sqrt(x**2 + z**2 - first**2) - apart
            down = -torch.sqrt(across**2 + deep**2 - point_y**2)
            length = -(down + torch.sin(lean) * point_x) / torch.cos(lean)
            side = torch.cos(lean) * point_x - torch.sin(lean) * length
        a = (torch.atan2(x, z) - torch.atan2(first, deep + apart))[..., None]
        b = (torch.atan2(deep, across) - torch.atan2(down, point_y))[..., None]
        skew, lean = skew[..., None], lean[..., None]
        px, py, pz = legs[..., 3], legs[..., 4], legs[..., 5] + (point_h - length)[..., None]
        px, pz = torch.cos(lean) * px + torch.sin(lean) * pz, torch.cos(lean) * pz - torch.sin(lean) * px
        py, pz = torch.cos(b) * py - torch.sin(b) * pz, torch.sin(b) * py + torch.cos(b) * pz
        px, py = torch.cos(skew) * px - torch.sin(skew) * py, torch.sin(skew) * px + torch.cos(skew) * py
        pz = pz + apart[..., None]
        px, pz = torch.cos(a) * px + torch.sin(a) * pz, torch.cos(a) * pz - torch.sin(a) * px
        gaps = torch.stack([px, py, pz], -1) - legs[..., :3]
        lengths: Tensor = torch.linalg.vector_norm(gaps, dim=-1)
        return lengths - joints - legs[..., 6]
