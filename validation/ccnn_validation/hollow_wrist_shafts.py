"""The robot with the hollow wrist for the program: its joints 4 to 6 are turns of motors, each over its gear."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism

POINT = (0.05, 0.02, 0.25)
CELLS = ((4, 3), (5, 3), (5, 4))
RATIOS = (2 / 3, 3 / 7, -4 / 9)
A, D = (0.25, 0.85, 0.05, 0.0, 0.0, 0.0), (0.6, 0.0, 0.0, 0.95, 0.11, 0.1)
ALPHA, THETA = (-90.0, 0.0, -90.0, 60.0, -60.0, 0.0), (0.0, -90.0, 0.0, 0.0, 0.0, 0.0)


def about(axis: int, angle: Tensor) -> Tensor:
    """Turn about x (0) or y (1) or z (2), `... x 4 x 4`."""
    c, s, one, zero = torch.cos(angle), torch.sin(angle), torch.ones_like(angle), torch.zeros_like(angle)
    rows = {
        0: (one, zero, zero, zero, zero, c, -s, zero, zero, s, c, zero),
        1: (c, zero, s, zero, zero, one, zero, zero, -s, zero, c, zero),
        2: (c, -s, zero, zero, s, c, zero, zero, zero, zero, one, zero),
    }[axis]
    return torch.stack([*rows, zero, zero, zero, one], -1).reshape(*angle.shape, 4, 4)


def along(x: Tensor, z: Tensor) -> Tensor:
    """Shift along x and z, `... x 4 x 4`."""
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    cells = (one, zero, zero, x, zero, one, zero, zero, zero, zero, one, z, zero, zero, zero, one)
    return torch.stack(cells, -1).reshape(*x.shape, 4, 4)


def vector(matrix: Tensor) -> Tensor:
    """Rotation vector of a matrix, by its quaternion, `... x 3`."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    four = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    p, q, r = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    w, x, y, z = four.unbind(-1)
    every = torch.stack([w, a, b, c, a, x, p, q, b, p, y, r, c, q, r, z], -1).reshape(*w.shape, 4, 4)
    best = four.argmax(-1)[..., None, None].expand(*four.shape[:-1], 1, 4)
    quaternion = torch.nn.functional.normalize(every.gather(-2, best)[..., 0, :], dim=-1)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    half = quaternion[..., 1:].square().sum(-1, keepdim=True).clamp_min(1e-24).sqrt()
    return quaternion[..., 1:] / half * 2 * torch.atan2(half, quaternion[..., :1])


class Wrist(Mechanism):
    """Joints q1 .. q6 [rad]; pose of the flange."""

    def __init__(self) -> None:
        geometry = []
        for k in range(6):
            geometry += [Parameter(f"a{k + 1}", "m", A[k]), Parameter(f"d{k + 1}", "m", D[k])]
            geometry += [Parameter(f"alpha{k + 1}", "rad", torch.pi / 180 * ALPHA[k])]
            geometry += [Parameter(f"theta{k + 1}", "rad", torch.pi / 180 * THETA[k])]
        geometry.append(Parameter("lean3", "rad", 0.0))
        geometry += [
            Parameter(f"ratio{i + 1}{k + 1}", "1", r, scale=3e-4) for (i, k), r in zip(CELLS, RATIOS, strict=True)
        ]
        geometry += [Parameter(f"stand_{k}", "m", 0.0, scale=1e-3) for k in "xyz"]
        geometry += [Parameter(f"stand_r{k}", "rad", 0.0, scale=1e-3) for k in "xyz"]
        geometry += [Parameter(f"point_{k}", "m", p) for k, p in zip("xyz", POINT, strict=True)]
        super().__init__(
            name="hollow_wrist",
            joints=[Coordinate(f"q{k}", "rad") for k in range(1, 7)],
            pose=[Coordinate(k, "m") for k in ("x", "y", "z")] + [Coordinate(k, "rad") for k in ("rx", "ry", "rz")],
            geometry=geometry,
            low=(1.337, -0.072, 0.78, -2.707, 0.308, -0.645),
            high=(1.837, 0.528, 1.28, -2.147, 0.868, -0.045),
            home_pose=[1.587226, 0.228194, 1.029985, -2.426897, 0.587557, -0.344742],
            home_joints=[0.0, 0.2, 0.0, 0.3, 1.4, -0.5],
        )

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Pose, `... x 6`, by the turns of the motors: the controller's own ratios of the shafts take them apart."""
        values = self.resolve(parameters)
        links, lean = values[..., :24].reshape(*values.shape[:-1], 6, 4), values[..., 24]
        q = list(joints.unbind(-1))
        q[4] = q[4] - values[..., 25] * q[3]
        q[5] = q[5] - values[..., 26] * q[3] - values[..., 27] * q[4]
        frame = torch.eye(4, dtype=joints.dtype)
        for k in range(6):
            a, d, alpha, theta = links[..., k, :].unbind(-1)
            one = torch.ones_like(q[k])
            a, d, alpha, theta, angle = a * one, d * one, alpha * one, theta * one, q[k] + 0 * a
            frame = frame @ about(2, angle + theta) @ along(a, d) @ about(0, alpha)
            if k == 1:
                frame = frame @ about(1, lean.expand_as(angle))
        turns = [about(axis, values[..., 31 + axis]) for axis in range(3)]
        stand = turns[0][..., :3, :3] @ turns[1][..., :3, :3] @ turns[2][..., :3, :3]
        point = frame[..., :3, 3] + (frame[..., :3, :3] @ values[..., 34:37, None])[..., 0]
        place = (stand @ point[..., None])[..., 0] + values[..., 28:31]
        return torch.cat([place, vector(stand @ frame[..., :3, :3])], -1)
