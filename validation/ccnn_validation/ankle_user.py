"""A parallel ankle as its user describes it to ccnn_torch: two motors with cranks, two rods, a foot on two axes.

This file is what the judge `ankle.py` hands to the program, and shares no code with it.
"""

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism

SIDES, HEIGHTS = (0.04, -0.04), (0.26, 0.19)


def turn(axis: int, angle: Tensor) -> Tensor:
    """Matrices of turns about x (0), y (1) or z (2), `... x 3 x 3`."""
    c, s, o, i = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    rows = {0: (i, o, o, o, c, -s, o, s, c), 1: (c, o, s, o, i, o, -s, o, c), 2: (c, -s, o, s, c, o, o, o, i)}[axis]
    return torch.stack(rows, -1).reshape(*angle.shape, 3, 3)


class Ankle(Mechanism):
    """Joints q1, q2 [rad], the cranks' angles, up = toe down; pose pitch, roll [rad] as the inclinometer shows them."""

    def __init__(self, axes: bool = False) -> None:
        """axes: whether motors, axes of the foot, stand and inclinometer may be askew."""
        geometry, self.axes = [], axes
        for leg, (side, height) in enumerate(zip(SIDES, HEIGHTS, strict=True), start=1):
            lengths = {"Ax": 0.0, "Ay": side, "Az": height, "Px": -0.05, "Py": side, "Pz": 0.0}
            geometry += [Parameter(f"{name}{leg}", "m", value, leg, scale=3e-4) for name, value in lengths.items()]
            geometry.append(Parameter(f"crank{leg}", "m", 0.05, leg, scale=1e-4))
            geometry.append(Parameter(f"rod{leg}", "m", height, leg, scale=3e-4))
            geometry.append(Parameter(f"offset{leg}", "rad", 0.0, leg, scale=1e-2))
            if axes:
                geometry += [Parameter(f"lean_{way}{leg}", "rad", 0.0, leg, scale=1.5e-3) for way in "xz"]
        if axes:
            geometry.append(Parameter("apart", "m", 0.0, scale=2e-4))
            names = {"skew": 1.5e-3, "stand_rx": 6e-4, "stand_ry": 6e-4}
            names |= {"mount_rx": 1e-3, "mount_ry": 1e-3, "mount_rz": 2e-3}
            geometry += [Parameter(name, "rad", 0.0, scale=scale) for name, scale in names.items()]
        super().__init__(
            name="ankle",
            joints=[Coordinate(q, "rad") for q in ("q1", "q2")],
            pose=[Coordinate("pitch", "rad"), Coordinate("roll", "rad")],
            geometry=geometry,
            low=(-0.61, -0.31),
            high=(0.61, 0.31),
            home_joints=[0.0, 0.0],
        )

    def frame(self, pose: Tensor) -> tuple[Tensor, Tensor | None]:
        """The foot turns about y, then about its own x; the middle of its axes stays where it is."""
        rotation = turn(1, pose[..., 0]) @ turn(0, pose[..., 1])
        return torch.zeros_like(rotation[..., 0]), rotation

    def pose_near(self, position: Tensor, rotation: Tensor | None) -> Tensor:
        """Pitch and roll of a frame."""
        if rotation is None:
            return torch.zeros_like(position[..., :2])
        flat = torch.hypot(rotation[..., 2, 1], rotation[..., 2, 2])
        return torch.stack(
            [torch.atan2(-rotation[..., 2, 0], flat), torch.atan2(rotation[..., 2, 1], rotation[..., 2, 2])], -1
        )

    def closure(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Distance of the ends of each rod less its length; `... x 2` [m]."""
        values = self.resolve(parameters)
        count = 11 if self.axes else 9
        legs = values[..., : 2 * count].reshape(*values.shape[:-1], 2, count)
        ax, ay, az, px, py, pz, crank, rod, offset = legs[..., :9].unbind(-1)
        angle = joints + offset
        ends = [-crank * torch.cos(angle), torch.zeros_like(angle + crank), crank * torch.sin(angle)]
        pitch, roll = (c[..., None] for c in pose.unbind(-1))
        if self.axes:
            lean_x, lean_z = legs[..., 9], legs[..., 10]
            ends[1] = lean_z * ends[0] - lean_x * ends[2]
            apart, skew, *turns = (v[..., None] for v in values[..., 2 * count :].unbind(-1))
            seen = pose
            for _ in range(4):
                pose = pose + seen - self.pose_near(torch.zeros_like(pose[..., :1]), self.sensed(pose, skew, turns))
            pitch, roll = (c[..., None] for c in pose.unbind(-1))
            px, py, pz = px, torch.cos(roll) * py - torch.sin(roll) * pz, torch.sin(roll) * py + torch.cos(roll) * pz
            px, py = torch.cos(skew) * px - torch.sin(skew) * py, torch.sin(skew) * px + torch.cos(skew) * py
            pz = pz + apart
        else:
            py, pz = torch.cos(roll) * py - torch.sin(roll) * pz, torch.sin(roll) * py + torch.cos(roll) * pz
        px, pz = torch.cos(pitch) * px + torch.sin(pitch) * pz, torch.cos(pitch) * pz - torch.sin(pitch) * px
        along = torch.stack([px - ax - ends[0], py - ay - ends[1], pz - az - ends[2]])
        lengths: Tensor = torch.linalg.vector_norm(along, dim=0)
        return lengths - rod

    def sensed(self, pose: Tensor, skew: Tensor, turns: list[Tensor]) -> Tensor:
        """How the inclinometer stands, `... x 3 x 3`; `turns`: of the stand about x, y, of the inclinometer x, y, z."""
        sx, sy, mx, my, mz = (turn_[..., 0] for turn_ in turns)
        stand = turn(0, sx) @ turn(1, sy)
        foot = turn(1, pose[..., 0]) @ turn(2, skew[..., 0]) @ turn(0, pose[..., 1])
        return stand @ foot @ turn(2, mz) @ turn(1, my) @ turn(0, mx)
