"""A six-joint arm as built: free frames at all joints, compliant gears, the weight of its links."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.simulation.machines.structure import ANGLE_TOLERANCE, EXPANSION, GRAVITY, LENGTH_TOLERANCE

# Standard Denavit-Hartenberg a, alpha, d, theta [m, rad] of an arm with an offset wrist, 1.2 m of reach.
_LINKS = (
    (0.0, math.pi / 2, 0.16, 0.0),
    (-0.56, 0.0, 0.0, 0.0),
    (-0.48, 0.0, 0.0, 0.0),
    (0.0, math.pi / 2, 0.15, 0.0),
    (0.0, -math.pi / 2, 0.11, 0.0),
    (0.0, 0.0, 0.10, 0.0),
)
# Mass [kg] of what moves with each joint, and its centre in the frame that turns with the joint [m].
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
_BENDING = 1e-5
"""Turn of a link per kelvin between surroundings and frame [rad/K]."""
# The box of poses: position, tilt of the tool about x and y from straight down, turn about its axis [m, rad].
_LOW = (-0.75, -0.35, 0.1, -0.4, -0.4, -1.0)
_HIGH = (-0.35, 0.35, 0.55, 0.4, 0.4, 1.0)
_CONDITION = 40.0


def nominal_arm() -> SerialArm:
    """The arm as its controller knows it; base and tool frame known."""
    return SerialArm("arm", "standard", _LINKS, parallel_axes=[[2, 3, 4]])


class ArmStructure:
    """See `Structure`. The same chain with a free frame (x, y, z [m], roll, pitch, yaw [rad]) at every joint and at the
    tool, so that also errors that Denavit-Hartenberg parameters do not have (parallel axes) are there."""

    def __init__(self) -> None:
        self._nominal = nominal_arm()
        self.mechanism: Mechanism = self._nominal
        origins = [(0.0,) * 6] + [(a, 0.0, d, alpha, 0.0, 0.0) for a, alpha, d, _ in _LINKS]
        self.built = SerialArm("arm as built", "urdf", origins[:-1], tool=origins[-1])
        self.parameters = self.built.nominal.clone()
        row = torch.tensor([LENGTH_TOLERANCE] * 3 + [ANGLE_TOLERANCE] * 3, dtype=torch.float64)
        # The base frame is where the arm is mounted: known.
        self.tolerances = torch.cat([torch.zeros(6, dtype=torch.float64), row.repeat(7)])
        length = torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(8)
        grown = EXPANSION * self.parameters * length
        bent = _BENDING * (1 - length)
        bent[:6] = 0
        self.growth = torch.stack([torch.zeros_like(grown), grown, bent], dim=-1)
        stiffness = torch.tensor([6e5, 6e5, 4e5, 1e5, 1e5, 1e5], dtype=torch.float64)
        self.drive_compliance = 1 / stiffness
        self.drive_growth = torch.zeros(6, dtype=torch.float64)
        self.backlash = torch.full((6,), 2e-4, dtype=torch.float64)
        self.wave = torch.tensor([8e-5, 8e-5, 1e-4, 1.5e-4, 1.5e-4, 1.5e-4], dtype=torch.float64)
        self.screw = torch.zeros(6, dtype=torch.bool)
        self.load = torch.tensor([40.0, 40.0, 40.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        self.masses = torch.tensor(_MASSES, dtype=torch.float64)
        self.centres = torch.tensor(_CENTRES, dtype=torch.float64)
        pose, joints = self.draw(500, np.random.default_rng(0))
        self.travel = torch.stack([joints.amin(0), joints.amax(0)], dim=-1)
        torque = self.forces(joints, self.parameters, pose, torch.zeros(6, dtype=torch.float64))[0]
        rms = torque.square().mean(0).sqrt()
        # An axis along gravity carries nothing of it, but friction and backlash have a scale there too.
        self.drive_force = rms.clamp_min(0.1 * float(rms.max()))

    def draw(self, count: int, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        """See `Structure`; tool downwards within the box, elbow up."""
        low, high = (torch.tensor(edge, dtype=torch.float64) for edge in (_LOW, _HIGH))
        home = torch.tensor(_HOME, dtype=torch.float64)
        down = torch.tensor([math.pi, 0.0, 0.0], dtype=torch.float64)
        found: list[tuple[Tensor, Tensor]] = []
        while sum(len(joints) for _, joints in found) < count:
            at = low + (high - low) * torch.as_tensor(generator.random((count, 6)))
            tilt, turn = at[:, 3:].clone(), torch.zeros(count, 3, dtype=torch.float64)
            turn[:, 2], tilt[:, 2] = tilt[:, 2], 0.0
            rotation = rotation_vector_to_matrix(tilt) @ rotation_vector_to_matrix(down)
            wanted = at[:, :3], rotation @ rotation_vector_to_matrix(turn)
            joints = self._inverse(*wanted, home)
            there = self._nominal.forward_frame(joints)
            near = ((there[0] - wanted[0]).norm(dim=-1) < 1e-9) & ((joints - home).abs().amax(-1) < math.pi / 2)
            near &= self.mechanism.condition_number(joints, 0.3) < _CONDITION
            found.append((self.mechanism.forward_kinematics(joints)[near], joints[near]))
        pose, joints = (torch.cat(parts)[:count] for parts in zip(*found, strict=True))
        return pose, joints

    def _inverse(self, position: Tensor, rotation: Tensor, home: Tensor) -> Tensor:
        pose = torch.cat([position, matrix_to_rotation_vector(rotation)], dim=-1)
        return self.mechanism.nearest_joints(pose, None, home, 0.3)

    def reach(self, drives: Tensor, parameters: Tensor, guess: Tensor) -> Tensor:
        """See `Structure`; closed form, the guess is not needed."""
        return self.built.forward_kinematics(drives, parameters)

    def forces(self, drives: Tensor, parameters: Tensor, pose: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """See `Structure`. Torque about each axis of the weights behind it and of the load at the tool, by Jᵀ.

        The moment of a load turns about the axes of the base frame.
        """
        frames = self.built.link_frames(drives, parameters)[1:]
        axes = torch.stack([rotation[..., 2] for rotation, _ in frames], dim=-2)
        points = torch.stack([position for _, position in frames], dim=-2)
        # A mass is where its centre is; it turns with all joints up to its own.
        tips = torch.stack([p + (r @ c[:, None])[..., 0] for (r, p), c in zip(frames, self.centres, strict=True)], -2)
        swept = torch.linalg.cross(axes[..., :, None, :], tips[..., None, :, :] - points[..., :, None, :])
        carried = torch.triu(torch.ones(6, 6, dtype=torch.float64))
        torque = -(swept[..., 2] * carried * self.masses).sum(-1) * GRAVITY
        jacobian = self.built.jacobian(drives, parameters)
        torque = torque + (jacobian.mT @ load[..., None])[..., 0]
        return torque, torque.new_zeros(*torque.shape[:-1], 0)

    def stretched(self, parameters: Tensor, members: Tensor) -> Tensor:
        """See `Structure`; links are stiff relative to gears."""
        return parameters
