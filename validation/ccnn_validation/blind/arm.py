"""The six-joint arm of the blind check: nominal geometry, masses of its links, poses, and the torque of its weight."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

__all__ = ["draw_arm_poses", "link_weight_torque", "mass_of_links", "nominal_arm"]

_GRAVITY = 9.80665
# Standard Denavit-Hartenberg a, alpha, d, theta [m, rad] of an arm with an offset wrist, 1.2 m of reach.
_LINKS = (
    (0.0, math.pi / 2, 0.16, 0.0),
    (-0.56, 0.0, 0.0, 0.0),
    (-0.48, 0.0, 0.0, 0.0),
    (0.0, math.pi / 2, 0.15, 0.0),
    (0.0, -math.pi / 2, 0.11, 0.0),
    (0.0, 0.0, 0.10, 0.0),
)
# Mass [kg] of each link, and its centre in the frame that turns with the joint [m].
_MASSES = (8.0, 13.0, 5.0, 2.0, 2.0, 4.0)
_CENTRES = (
    (0.0, -0.03, 0.0),
    (-0.28, 0.0, 0.14),
    (-0.24, 0.0, 0.03),
    (0.0, -0.01, 0.0),
    (0.0, 0.01, 0.0),
    (0.02, 0.01, 0.04),
)
_HOME = (0.2, -1.4, 1.9, -2.07, -1.57, 0.0)
# The box of poses: position, tilt of the tool about x and y from straight down, turn about its axis [m, rad].
_LOW = (-0.75, -0.35, 0.1, -0.4, -0.4, -1.0)
_HIGH = (-0.35, 0.35, 0.55, 0.4, 0.4, 1.0)
_LARGEST_CONDITION = 40.0
# Length equivalent to a radian in the condition number of a pose [m].
_LEVER = 0.3


def nominal_arm() -> SerialArm:
    """The nominal arm; base and tool frame are known."""
    return SerialArm("arm", "standard", _LINKS, parallel_axes=[[2, 3, 4]])


def mass_of_links() -> float:
    """Mass of all links [kg]."""
    return sum(_MASSES)


def draw_arm_poses(arm: SerialArm, count: int, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Poses with the tool downwards within the box and the elbow up, and their joints, `s x 6` each [SI]."""
    low, high = (torch.tensor(edge, dtype=torch.float64) for edge in (_LOW, _HIGH))
    home = torch.tensor(_HOME, dtype=torch.float64)
    down = torch.tensor([math.pi, 0.0, 0.0], dtype=torch.float64)
    found: list[tuple[Tensor, Tensor]] = []
    while sum(len(joints) for _, joints in found) < count:
        at = low + (high - low) * torch.as_tensor(generator.random((count, 6)))
        tilt, turn = at[:, 3:].clone(), torch.zeros(count, 3, dtype=torch.float64)
        turn[:, 2], tilt[:, 2] = tilt[:, 2], 0.0
        rotation = rotation_vector_to_matrix(tilt) @ rotation_vector_to_matrix(down) @ rotation_vector_to_matrix(turn)
        wanted = torch.cat([at[:, :3], matrix_to_rotation_vector(rotation)], dim=-1)
        joints = arm.nearest_joints(wanted, None, home, _LEVER)
        kept = ((arm.forward_frame(joints)[0] - at[:, :3]).norm(dim=-1) < 1e-9) & (
            (joints - home).abs().amax(-1) < math.pi / 2
        )
        kept &= arm.condition_number(joints, _LEVER) < _LARGEST_CONDITION
        found.append((arm.forward_kinematics(joints)[kept], joints[kept]))
    pose, joints = (torch.cat(parts)[:count] for parts in zip(*found, strict=True))
    return pose, joints


def link_weight_torque(joints: Tensor) -> Tensor:
    """Torque about each axis of the weights of the links behind it, `... x 6` [N·m]."""
    frames = _FREE_FRAMES.link_frames(joints, _FREE_FRAMES.nominal)[1:]
    axes = torch.stack([rotation[..., 2] for rotation, _ in frames], dim=-2)
    points = torch.stack([position for _, position in frames], dim=-2)
    centres = torch.tensor(_CENTRES, dtype=torch.float64)
    masses = torch.tensor(_MASSES, dtype=torch.float64)
    at = torch.stack([p + (r @ c[:, None])[..., 0] for (r, p), c in zip(frames, centres, strict=True)], -2)
    arms = torch.linalg.cross(axes[..., :, None, :], at[..., None, :, :] - points[..., :, None, :])
    carried = torch.triu(torch.ones(6, 6, dtype=torch.float64))
    torque: Tensor = -(arms[..., 2] * carried * masses).sum(-1) * _GRAVITY
    return torque


def _free_frames() -> SerialArm:
    """The same chain with a frame at each joint that turns with it, where the centres of the links are given."""
    origins = [(0.0,) * 6] + [(a, 0.0, d, alpha, 0.0, 0.0) for a, alpha, d, _ in _LINKS]
    return SerialArm("arm as a chain of frames", "urdf", origins[:-1], tool=origins[-1])


_FREE_FRAMES = _free_frames()
