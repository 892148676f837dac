"""Structures of machines: geometry with all its tolerances, statics, and thermal growth."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.mechanisms import MachineTool, Mechanism, SerialArm, Tripod
from ccnn_torch.numerics.batching import stack_last
from ccnn_torch.numerics.least_squares import jacobian_of, levenberg_marquardt
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

GRAVITY = 9.80665
"""[m/s²], along -z of the base frame."""
LENGTH_TOLERANCE, ANGLE_TOLERANCE = 5e-5, 5e-5
"""Standard deviations of geometry at strength 1 [m], [rad]."""
EXPANSION = 1.2e-5
"""Of steel [1/K]."""


class Structure(Protocol):
    """A machine's structure; its parameters are those of the machine as built, more than the nominal ones.

    Attributes:
        mechanism: nominal kinematics, what a controller has.
        parameters: those of the structure that equals the nominal machine, `k` [SI].
        tolerances: of each parameter at strength 1, `k` [SI]; 0 where it has none.
        growth: of each parameter per kelvin, `k x 3` [SI/K]: with the frame's temperature, with that of the legs or
            links, and with the difference between surroundings and frame, which bends (a scale for a random factor).
        drive_compliance: displacement of a drive per force on it at strength 1, `n` [joint's unit per N or N·m].
        drive_growth: share by which a drive's travel grows per kelvin, 0 for revolute joints, `n` [1/K].
        drive_force: typical force on a drive, `n` [N or N·m].
        backlash: of a drive at strength 1, typical, `n` [joint's unit].
        wave: amplitude of a drive's periodic error at strength 1, typical, `n` [joint's unit].
        screw: whether a drive is a screw, with a travel, rather than a gear, with turns, `n` bool.
        travel: lowest and highest joint in the workspace, `n x 2` [SI].
        load: standard deviation of the load along each pose coordinate, `p` [N or N·m]; 0 where there is none.
    """

    mechanism: Mechanism
    parameters: Tensor
    tolerances: Tensor
    growth: Tensor
    drive_compliance: Tensor
    drive_growth: Tensor
    drive_force: Tensor
    backlash: Tensor
    wave: Tensor
    screw: Tensor
    travel: Tensor
    load: Tensor

    def draw(self, count: int, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Poses in the workspace box, all reachable and away from singular ones, and their nominal joints.

        Returns:
            `count x p` and `count x n` [SI].
        """
        ...

    def reach(self, drives: Tensor, parameters: Tensor, guess: Tensor) -> Tensor:
        """Pose of the structure. drives: `... x n`; parameters: `... x k`; guess: `... x p`; returns `... x p` [SI]."""
        ...

    def forces(self, drives: Tensor, parameters: Tensor, pose: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Statics under gravity and a load, at a pose that `reach` gave.

        Args:
            drives: `... x n` [SI].
            parameters: `... x k` [SI].
            pose: `... x p` [SI].
            load: along the pose coordinates, `... x p` [N or N·m].

        Returns:
            Force that pushes each drive along its coordinate, `... x n` [N or N·m], and force in each elastic member,
            `... x e` [N] (e may be 0).
        """
        ...

    def stretched(self, parameters: Tensor, members: Tensor) -> Tensor:
        """Parameters under the forces in the members at strength 1. members: `... x e` [N]; returns `... x k`."""
        ...


# Parameters of a leg: base joint, platform joint, length, and two small angles by which the guideway is off.
_PER_LEG = 9
_LEG_BENDING = 1.5e-5
"""Turn of a guideway per kelvin between surroundings and frame [rad/K]."""


class LegStructure:
    """See `Structure`. Parameters of each leg, `k` = 27: base joint, platform joint, length [m], two angles [rad]."""

    def __init__(
        self,
        mechanism: Mechanism,
        base_joints: Tensor,
        joints: Tensor,
        directions: Tensor,
        length: float,
        mass: float,
        centre: tuple[float, float, float],
        leg_stiffness: float,
        drive_stiffness: float,
        load: tuple[float, float, float],
    ) -> None:
        """Build the structure that equals a nominal machine.

        Args:
            mechanism: nominal machine, pose of three coordinates.
            base_joints, joints, directions: of the guideways in the base, of the legs on the platform, `3 x 3` [m],
                [1].
            length: of the legs [m].
            mass: of the platform with its half of the legs [kg].
            centre: of that mass in the platform [m].
            leg_stiffness, drive_stiffness: of a leg and of a screw with its bearings [N/m].
            load: standard deviations along the pose coordinates [N or N·m].
        """
        self.mechanism = mechanism
        self.directions = directions
        # Two unit vectors across each guideway; a small angle turns it towards either.
        helper = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(3, 3)
        first = _unit(torch.linalg.cross(directions, helper))
        self.across = torch.stack([first, torch.linalg.cross(directions, first)], dim=-2)
        angles = torch.zeros(3, 2, dtype=torch.float64)
        lengths = torch.full((3, 1), length, dtype=torch.float64)
        self.parameters = torch.cat([base_joints, joints, lengths, angles], dim=-1).flatten()
        row = torch.tensor([LENGTH_TOLERANCE] * 7 + [ANGLE_TOLERANCE] * 2, dtype=torch.float64)
        self.tolerances = row.repeat(3)
        self.growth = torch.zeros(3, _PER_LEG, 3, dtype=torch.float64)
        self.growth[:, 0:3, 0] = EXPANSION * base_joints
        self.growth[:, 3:6, 1] = EXPANSION * joints
        self.growth[:, 6, 1] = EXPANSION * length
        self.growth[:, 7:9, 2] = _LEG_BENDING
        self.growth = self.growth.flatten(0, 1)
        self.mass, self.centre = mass, torch.tensor(centre, dtype=torch.float64)
        self.leg_compliance = 1 / leg_stiffness
        self.drive_compliance = torch.full((3,), 1 / drive_stiffness, dtype=torch.float64)
        self.drive_growth = torch.full((3,), EXPANSION, dtype=torch.float64)
        self.backlash = torch.full((3,), 1.5e-4, dtype=torch.float64)
        self.wave = torch.full((3,), 6e-5, dtype=torch.float64)
        self.screw = torch.ones(3, dtype=torch.bool)
        self.load = torch.tensor(load, dtype=torch.float64)
        pose, drives = self.draw(500, np.random.default_rng(0))
        self.travel = torch.stack([drives.amin(0), drives.amax(0)], dim=-1)
        force = self.forces(drives, self.parameters, pose, torch.zeros(3, dtype=torch.float64))[0]
        self.drive_force = force.square().mean(0).sqrt()

    def draw(self, count: int, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        """See `Structure`; uniform in the mechanism's box, all of which it reaches."""
        low, high = self.mechanism.bounds
        pose = low + (high - low) * torch.as_tensor(generator.random((count, len(low))))
        return pose, self.mechanism.solve_inverse(pose)

    def closure(self, pose: Tensor, drives: Tensor, parameters: Tensor) -> Tensor:
        """Distance between the ends of each leg less its length, `... x 3` [m]."""
        legs = parameters.reshape(*parameters.shape[:-1], 3, _PER_LEG)
        distance: Tensor = torch.linalg.vector_norm(self._leg(pose, drives, legs), dim=-1)
        gap: Tensor = distance - legs[..., 6]
        return gap

    def reach(self, drives: Tensor, parameters: Tensor, guess: Tensor) -> Tensor:
        """See `Structure`; damped Newton from the guess. A row without a solution is NaN."""
        lead = torch.broadcast_shapes(drives.shape[:-1], parameters.shape[:-1])  # type: ignore[no-untyped-call]
        found = levenberg_marquardt(self.closure, guess.expand(*lead, -1), self._slope, (drives, parameters))
        return torch.where((found.cost <= 1e-24)[..., None], found.value, torch.nan)

    def forces(self, drives: Tensor, parameters: Tensor, pose: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """See `Structure`. Virtual work: the tensions t of the legs hold the load Q along the pose, Q = Jᵀ t."""
        weight = jacobian_of(self._height, pose)[1][..., 0, :] * (-self.mass * GRAVITY)
        slope = self._slope(pose, drives, parameters)
        tension: Tensor = torch.linalg.solve(slope.mT, (weight + load)[..., None])[..., 0]
        legs = parameters.reshape(*parameters.shape[:-1], 3, _PER_LEG)
        along = _unit(self._leg(pose, drives, legs))
        force: Tensor = tension * (along * self._guideways(legs)).sum(-1)
        return force, tension

    def stretched(self, parameters: Tensor, members: Tensor) -> Tensor:
        """See `Structure`; a member is a leg."""
        longer = torch.zeros(*members.shape, _PER_LEG, dtype=members.dtype)
        longer[..., 6] = members * self.leg_compliance
        return parameters + longer.flatten(-2)

    def _height(self, pose: Tensor) -> Tensor:
        """Of the platform's centre of mass, `... x 1` [m]."""
        position, rotation = self.mechanism.frame(pose)
        assert rotation is not None
        centre: Tensor = position + rotation @ self.centre
        return centre[..., 2:]

    def _guideways(self, legs: Tensor) -> Tensor:
        """Unit vectors along the guideways, `... x 3 x 3`."""
        off = (legs[..., 7:9, None] * self.across).sum(-2)
        return _unit(self.directions + off)

    def _leg(self, pose: Tensor, drives: Tensor, legs: Tensor) -> Tensor:
        """From slider to platform joint, `... x 3 x 3` [m]."""
        position, rotation = self.mechanism.frame(pose)
        assert rotation is not None
        joint = position[..., None, :] + (rotation[..., None, :, :] @ legs[..., 3:6, None])[..., 0]
        slider: Tensor = legs[..., :3] + drives[..., None] * self._guideways(legs)
        return joint - slider

    def _slope(self, pose: Tensor, drives: Tensor, parameters: Tensor) -> Tensor:
        """Derivative of the closure by the pose, `... x 3 x p`."""
        return jacobian_of(lambda x: self.closure(x, drives, parameters), pose)[1]


def _unit(vector: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    return vector / length


def tripod_structure() -> LegStructure:
    """The tripod of the paper, case one: guideways along +x, -x and +y through the origin."""
    mechanism = Tripod()
    length, radius = mechanism.nominal.tolist()
    out = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    return LegStructure(
        mechanism,
        base_joints=torch.zeros(3, 3, dtype=torch.float64),
        joints=radius * out,
        directions=out,
        length=length,
        mass=25.0,
        centre=(0.01, 0.02, -0.05),
        leg_stiffness=1.6e7,
        drive_stiffness=8e6,
        load=(80.0, 80.0, 8.0),
    )


def machine_tool_structure() -> LegStructure:
    """The parallel machine tool of the paper, case two."""
    mechanism = MachineTool()
    l_e, l_b, z_0, length, gamma = mechanism.nominal[:5].tolist()
    alpha, beta = mechanism.nominal[5:8], mechanism.nominal[8:11]
    slide = math.cos(gamma)
    rise = torch.full_like(alpha, math.sin(gamma))
    return LegStructure(
        mechanism,
        base_joints=stack_last(l_b * alpha.cos(), l_b * alpha.sin(), torch.zeros_like(alpha)),
        joints=stack_last(l_e * beta.cos(), l_e * beta.sin(), torch.full_like(beta, z_0)),
        directions=stack_last(-slide * alpha.cos(), -slide * alpha.sin(), rise),
        length=length,
        mass=40.0,
        centre=(0.01, -0.02, 0.15),
        leg_stiffness=1e7,
        drive_stiffness=5e6,
        load=(30.0, 30.0, 200.0),
    )


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
