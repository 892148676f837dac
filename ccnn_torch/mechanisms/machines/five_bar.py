"""The planar symmetrical 5R mechanism (five-bar) of the divide-and-conquer identification paper."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms.machines.closed_forms import real_acos, real_sqrt, upward_angle
from ccnn_torch.mechanisms.machines.inscribed_circle import inscribed_circle
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.batching import stack_last

# The paper's real machine (its Table 2) is off by 4.6e-3 m, rad or 1 on average.
_SCALE = 5e-3
# Of the two solutions for a crank, the one that puts the elbow outward: left of leg 1, right of leg 2.
_OUTWARD = (1.0, -1.0)


class FiveBar(Mechanism):
    """Two cranks and two couplers in a plane; joints q1, q2 [rad], pose x, y [m] of the joint between the couplers.

    Leg i has the parameters of eq. 10: crank l, coupler L, foot Ax, Ay [m], and of the drive the gain k [1] and the
    offset gamma [rad]. The joints are the commanded angles ψ of eq. 9: θ1 = k1 ψ1 + γ1 and θ2 = k2 (π - ψ2) + γ2, with
    θ1 the angle of crank 1 from +x, counter-clockwise, and θ2 that of crank 2 from -x, clockwise: with gain 1 and
    offset 0 both joints are the angle of their crank from +x, counter-clockwise. So a positive γ1 turns crank 1
    counter-clockwise and a positive γ2 turns crank 2 clockwise. Eq. 12 prints l_1 for l_2 in its
    second line. Elbows point outward (working mode) and the tool is above the line from elbow 1 to elbow 2 (assembly
    mode). Joint angles are continuous over all poses that are not straight below their crank's foot.

    Samples are drawn from the maximal inscribed circle of the nominal machine (`maximal_inscribed_circle`); the box
    `bounds` is the square around it.
    """

    closed_form = "forward"

    def __init__(self, l: float = 0.75, L: float = 1.1, a: float = 0.5) -> None:
        """l, L: lengths of cranks and couplers; a: distance of the cranks' axes from the origin, at (∓a, 0) [m].

        Raises:
            InputError: the lengths leave no workspace.
        """
        geometry = []
        for leg, x in ((1, -a), (2, a)):
            lengths = [(f"l{leg}", l), (f"L{leg}", L), (f"A{leg}x", x), (f"A{leg}y", 0.0)]
            geometry += [Parameter(name, "m", value, leg, _SCALE) for name, value in lengths]
            way = "clockwise" if leg == 2 else ""
            geometry.append(Parameter(f"k{leg}", "1", 1.0, leg, _SCALE))
            geometry.append(Parameter(f"gamma{leg}", "rad", 0.0, leg, _SCALE, sense=way))
        nominal = torch.tensor([g.nominal for g in geometry], dtype=torch.float64)
        centre, radius = inscribed_circle(*_geometry(nominal)[:3])
        super().__init__(
            name="five_bar",
            joints=[Coordinate(q, "rad") for q in ("q1", "q2")],
            pose=[Coordinate("x", "m"), Coordinate("y", "m")],
            geometry=geometry,
            low=(centre - radius).tolist(),
            high=(centre + radius).tolist(),
        )
        if type(self) is FiveBar:
            self.recipe = {"spec": "five_bar", "keys": {}}

    def _follow_nominal(self) -> None:
        centre, radius = inscribed_circle(*_geometry(self.nominal)[:3])
        self.low.copy_(centre - radius)
        self.high.copy_(centre + radius)
        self.home_pose.copy_(centre)
        self.home_joints.copy_(self.solve_inverse(centre))

    def maximal_inscribed_circle(self) -> tuple[Tensor, Tensor]:
        """Largest circle of poses without singularity, of the nominal machine; centre, `2` [m], and radius, `` [m].

        Inside it every pose is reached with the elbows outward and the tool above them, and neither leg is stretched or
        folded (singularity of the first kind) nor the two couplers in line (second kind).
        """
        return (self.low + self.high) / 2, (self.high[0] - self.low[0]) / 2

    def sample_workspace(self, count: int, generator: torch.Generator) -> Tensor:
        """Poses uniform over the maximal inscribed circle, `count x 2` [m]."""
        centre, radius = self.maximal_inscribed_circle()
        draw = torch.rand(count, 2, generator=generator, dtype=torch.float64)
        turn = 2 * torch.pi * draw[:, 1]
        # Half a millionth of the radius inside, so that rounding does not put a sample onto the singular edge.
        away = (1 - 1e-6) * radius * torch.sqrt(draw[:, 0])
        return centre + away[:, None] * stack_last(torch.cos(turn), torch.sin(turn))

    def solve_inverse(self, pose: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None) -> Tensor:
        """Eq. 12 solved for the cranks, elbows outward, and eq. 9 for the joints; NaN out of reach of a leg."""
        crank, coupler, foot, gain, offset = _geometry(self.resolve(parameters))
        to_tool = pose[..., None, :] - foot
        distance = torch.linalg.vector_norm(to_tool, dim=-1)
        at_foot, real = real_acos((crank**2 + distance**2 - coupler**2) / (2 * crank * distance))
        angle = upward_angle(*to_tool.unbind(-1)) + torch.tensor(_OUTWARD, dtype=pose.dtype) * at_foot
        theta = stack_last(angle[..., 0], torch.pi - angle[..., 1])
        psi = (theta - offset) / gain
        return torch.where(real, stack_last(psi[..., 0], torch.pi - psi[..., 1]), torch.nan)

    def forward_kinematics(
        self, joints: Tensor, parameters: Tensor | None = None, guess: Tensor | None = None
    ) -> Tensor:
        """Where the couplers meet, above the line from elbow 1 to elbow 2; closed form, NaN where they cannot."""
        values = self.resolve(parameters)
        coupler = _geometry(values)[1]
        elbow = self._elbows(joints, values)
        across = elbow[..., 1, :] - elbow[..., 0, :]
        square = (across**2).sum(-1)
        share = (coupler[..., 0] ** 2 - coupler[..., 1] ** 2 + square) / (2 * square)
        height, real = real_sqrt(coupler[..., 0] ** 2 / square - share**2)
        upward = stack_last(-across[..., 1], across[..., 0])
        tool = elbow[..., 0, :] + share[..., None] * across + height[..., None] * upward
        return torch.where(real[..., None], tool, torch.nan)

    def reachable(self, pose: Tensor, parameters: Tensor | None = None) -> Tensor:
        """Within reach of both legs, and above the line from elbow 1 to elbow 2; `...`, bool."""
        values = self.resolve(parameters)
        joints = self.solve_inverse(pose, values)
        elbow = self._elbows(joints, values)
        across, to_tool = elbow[..., 1, :] - elbow[..., 0, :], pose - elbow[..., 0, :]
        above: Tensor = across[..., 0] * to_tool[..., 1] - across[..., 1] * to_tool[..., 0] > 0
        return torch.isfinite(joints).all(-1) & above

    def skeleton(self, pose: Tensor, joints: Tensor, parameters: Tensor | None = None) -> dict[str, Tensor]:
        """Crank and coupler of each leg; see `Mechanism.skeleton`."""
        values = self.resolve(parameters)
        corners = torch.stack([_geometry(values)[2], self._elbows(joints, values), pose.expand(2, 2)], -2)
        return {f"leg {i + 1}": torch.nn.functional.pad(leg, (0, 1)) for i, leg in enumerate(corners)}

    def _elbows(self, joints: Tensor, values: Tensor) -> Tensor:
        """Ends of the cranks, `... x 2 x 2` [m]: leg, then x and y."""
        crank, _, foot, gain, offset = _geometry(values)
        theta = gain * stack_last(joints[..., 0], torch.pi - joints[..., 1]) + offset
        angle = stack_last(theta[..., 0], torch.pi - theta[..., 1])
        return foot + crank[..., None] * torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)


def _geometry(values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Of both legs: crank and coupler `... x 2` [m], foot `... x 2 x 2` [m], gain [1] and offset [rad] `... x 2`."""
    legs = values.reshape(*values.shape[:-1], 2, 6)
    return legs[..., 0], legs[..., 1], legs[..., 2:4], legs[..., 4], legs[..., 5]
