"""A mechanism of your own in one file: a planar 3-RRR, three legs of a crank and a rod each that carry one platform."""

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


class Planar3RRR(Mechanism):
    """Joints q1..q3 [rad], the cranks' angles from +x; pose x, y [m] and rz [rad] of the platform."""

    def __init__(self, base: float = 0.4, platform: float = 0.1, crank: float = 0.2, rod: float = 0.28) -> None:
        """base, platform: radii of the legs' joints; crank, rod: lengths [m]."""
        geometry, home = [], []
        for leg, angle in enumerate((math.radians(a) for a in (-150.0, -30.0, 90.0)), start=1):
            across, up = math.cos(angle), math.sin(angle)
            # A joint on the base, P on the platform, in its frame. `leg` makes identification leg by leg possible.
            places = {"Ax": base * across, "Ay": base * up, "Px": platform * across, "Py": platform * up}
            lengths = {**places, "crank": crank, "rod": rod}
            geometry += [Parameter(f"{name}{leg}", "m", value, leg) for name, value in lengths.items()]
            geometry.append(Parameter(f"offset{leg}", "rad", 0.0, leg))
            home.append(angle + math.pi + 1.1)
        super().__init__(
            name="planar_3rrr",
            joints=[Coordinate(q, "rad") for q in ("q1", "q2", "q3")],
            pose=[Coordinate("x", "m"), Coordinate("y", "m"), Coordinate("rz", "rad")],
            geometry=geometry,
            low=(-0.06, -0.06, -0.3),
            high=(0.06, 0.06, 0.3),
            home_joints=home,  # near a configuration of the middle of the box: it says which way the elbows point
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Distance from each crank's end to its joint on the platform, less the rod; `... x 3` [m]."""
        values = self.resolve(parameters)
        ax, ay, px, py, crank, rod, offset = values.reshape(*values.shape[:-1], 3, 7).unbind(-1)
        x, y, rz = (c[..., None] for c in pose.unbind(-1))
        across = x + px * torch.cos(rz) - py * torch.sin(rz) - ax - crank * torch.cos(joints + offset)
        up = y + px * torch.sin(rz) + py * torch.cos(rz) - ay - crank * torch.sin(joints + offset)
        return torch.hypot(across, up) - rod
