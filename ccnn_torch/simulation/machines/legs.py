"""Three legs of fixed length on straight guideways, every leg with its own geometry: tripod and machine tool as built.

The closure of leg i is |p + R a_i - f_i - (ρ_i - ρ°) u_i| = l_i: platform joint a_i, base joint f_i, direction u_i of
the guideway, length l_i. The constraints that remove the platform's other degrees of freedom (parallelograms, a passive
leg) are ideal here: their errors would move the platform in directions that the pose does not have.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.mechanisms import MachineTool, Mechanism, Tripod
from ccnn_torch.numerics.batching import stack_last
from ccnn_torch.numerics.least_squares import jacobian_of, levenberg_marquardt
from ccnn_torch.simulation.machines.structure import ANGLE_TOLERANCE, EXPANSION, GRAVITY, LENGTH_TOLERANCE

# Parameters of a leg: base joint, platform joint, length, and two small angles by which the guideway is off.
_PER_LEG = 9
_BENDING = 1.5e-5
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
        self.growth[:, 7:9, 2] = _BENDING
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
    """The tripod of paper 000, case one: guideways along +x, -x and +y through the origin."""
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
    """The parallel machine tool of paper 000, case two."""
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
