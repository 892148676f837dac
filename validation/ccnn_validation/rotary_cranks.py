"""A motion platform with six rotary cranks as its user describes it to ccnn_torch.

This file is what the judge `rotary_hexapod.py` hands to the program, and shares no code with it.
"""

import math

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism

# Tolerances of the drawing: joints, axes, cranks, rods, zeros.
TOLERANCES = {"A": 7e-4, "lean": 3e-3, "crank": 2e-4, "rod": 4e-4, "P": 3e-4, "offset": 4e-3}


class RotaryHexapod(Mechanism):
    """Joints q1..q6 [rad], cranks above the level; pose x, y, z [m] and rx, ry, rz [rad] of the platform's joints."""

    def __init__(self, told: bool = False) -> None:
        """told: whether the drawing's tolerances are told."""
        geometry, across = [], []
        for leg in range(6):
            pair, side = math.radians(120 * (leg // 2)), 1 if leg % 2 else -1
            foot = pair + side * math.radians(25)
            head = pair + side * math.radians(48)
            numbers = {"Ax": 0.40 * math.cos(foot), "Ay": 0.40 * math.sin(foot), "Az": 0.0}
            numbers |= {"Px": 0.30 * math.cos(head), "Py": 0.30 * math.sin(head), "Pz": 0.0}
            numbers |= {"crank": 0.12, "rod": 0.45, "lean_u": 0.0, "lean_v": 0.0, "offset": 0.0}
            for name, value in numbers.items():
                kind = "rad" if name in ("lean_u", "lean_v", "offset") else "m"
                size = next(size for start, size in TOLERANCES.items() if name.startswith(start))
                geometry.append(Parameter(f"{name}{leg + 1}", kind, value, leg + 1, scale=size if told else None))
            across.append([side * math.sin(pair), -side * math.cos(pair), 0.0])
        self.across = torch.tensor(across, dtype=torch.float64)
        super().__init__(
            name="rotary_hexapod",
            joints=[Coordinate(f"q{leg}", "rad") for leg in range(1, 7)],
            pose=[Coordinate(a, "m") for a in "xyz"] + [Coordinate(f"r{a}", "rad") for a in "xyz"],
            geometry=geometry,
            low=(-0.04, -0.04, 0.355, -0.09, -0.09, -0.09),
            high=(0.04, 0.04, 0.425, 0.09, 0.09, 0.09),
            home_joints=[0.0] * 6,
        )

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """Angles of the cranks at a pose, `... x 6`."""
        values = self.resolve(parameters)
        values = values.reshape(*values.shape[:-1], 6, 11)
        foot, head = values[..., :3], values[..., 3:6]
        crank, rod, lean_u, lean_v, offset = values[..., 6:].unbind(-1)
        # Directions of a crank at angle 0 and a quarter turn above it, and its axis; it leans about both of them.
        u = self.across
        v = torch.tensor([0.0, 0.0, 1.0], dtype=u.dtype).expand_as(u)
        axis = torch.linalg.cross(u, v)
        level, upright = u - lean_v[..., None] * axis, v + lean_u[..., None] * axis
        place, turn = pose[..., None, :3], pose[..., None, 3:]
        angle = torch.sqrt((turn**2).sum(-1, keepdim=True) + 1e-30)
        shape = torch.broadcast_shapes(turn.shape, head.shape)  # type: ignore[no-untyped-call]
        way, head = (turn / angle).expand(shape), head.expand(shape)
        along = (way * head).sum(-1, keepdim=True)
        turned = head * torch.cos(angle) + torch.linalg.cross(way, head) * torch.sin(angle)
        turned = turned + way * along * (1 - torch.cos(angle))
        spoke = place + turned - foot
        forward, up = (spoke * level).sum(-1), (spoke * upright).sum(-1)
        share = ((spoke**2).sum(-1) + crank**2 - rod**2) / (2 * crank * torch.hypot(forward, up))
        found: Tensor = torch.atan2(up, forward) - torch.acos(share) - offset
        return found
