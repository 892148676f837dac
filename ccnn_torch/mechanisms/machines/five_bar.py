"""The planar symmetrical 5R mechanism (five-bar) of the divide-and-conquer identification paper."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.machines.closed_forms import real_acos, real_sqrt, upward_angle
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.numerics.batching import stack_last

# Points on each singular curve: the radius is right to about (spacing)²/8 over it, 1e-7 of the size of the mechanism.
_POINTS = 4000
_GRID, _ROUNDS = 17, 20


def inscribed_circle(crank: Tensor, coupler: Tensor, foot: Tensor) -> tuple[Tensor, Tensor]:
    """Largest circle above the cranks' axes with the elbows outward and no singularity of either kind inside.

    First kind, a leg stretched or folded: circles around its foot with radius L + l and |L - l|. Second kind, the
    couplers in line: a curve, sampled. The centre is searched on ever finer grids.

    Args:
        crank, coupler: lengths of legs 1 and 2, `2` each [m].
        foot: `2 x 2` [m].

    Returns:
        Centre, `2` [m], and radius, `` [m].
    """
    numbers = (tuple(crank.tolist()), tuple(coupler.tolist()), tuple(map(tuple, foot.tolist())))
    x, y, radius = _inscribed_circle(*numbers)
    return crank.new_tensor([x, y]), crank.new_tensor(radius)


@lru_cache(maxsize=64)
def _inscribed_circle(*numbers: tuple[Any, ...]) -> tuple[float, float, float]:
    """x, y and radius; most five-bars of a process have the same lengths."""
    crank, coupler, foot = (torch.tensor(part, dtype=torch.float64) for part in numbers)
    edge = _couplers_in_line(crank, coupler, foot)
    size = (crank + coupler).amin()
    centre, half = foot.mean(0) + torch.stack([torch.zeros_like(size), size / 2]), size
    offsets = torch.linspace(-1.0, 1.0, _GRID, dtype=torch.float64)
    square = torch.cartesian_prod(offsets, offsets)
    for _ in range(_ROUNDS):
        points = centre + half * square
        margin = _margin(points, crank, coupler, foot, edge)
        best = margin.argmax()
        if not margin[best] > 0:
            raise InputError(
                "five_bar: with these lengths no pose has both elbows outward and the tool above them; "
                f"cranks {crank.tolist()}, couplers {coupler.tolist()}, feet {foot.tolist()}"
            )
        centre, half = points[best], half / 4
        # The margin rises by no more than the way gone: farther edge points cannot be the nearest any more.
        near = torch.linalg.vector_norm(edge - centre, dim=-1) < margin[best] + 3 * half
        edge = edge[near]
    return float(centre[0]), float(centre[1]), float(margin[best])


def _margin(points: Tensor, crank: Tensor, coupler: Tensor, foot: Tensor, edge: Tensor) -> Tensor:
    """Distance to the nearest singular pose, `s`; -inf where the branch has no pose. points: `s x 2`."""
    distance = torch.linalg.vector_norm(points[:, None] - foot, dim=-1)
    legs = torch.minimum(crank + coupler - distance, distance - (coupler - crank).abs()).amin(-1)
    inside = (legs > 0) & (points[:, 1] > foot[:, 1].amax())
    elbow = _outward_elbows(points, crank, coupler, foot)
    across, to_tool = elbow[:, 1] - elbow[:, 0], points - elbow[:, 0]
    inside &= across[:, 0] * to_tool[:, 1] - across[:, 1] * to_tool[:, 0] > 0
    # The mechanism must keep its side of the cranks' axes: below them the cranks' angles jump.
    nearest = torch.minimum(legs, points[:, 1] - foot[:, 1].amax())
    if len(edge):
        nearest = torch.minimum(nearest, torch.cdist(points, edge).amin(-1))
    return torch.where(inside, nearest, -torch.inf)


def _outward_elbows(points: Tensor, crank: Tensor, coupler: Tensor, foot: Tensor) -> Tensor:
    """Elbows that point outward, `s x 2 x 2`; points `s x 2`."""
    to_tool = points[:, None] - foot
    distance = torch.linalg.vector_norm(to_tool, dim=-1)
    along = (crank**2 + distance**2 - coupler**2) / (2 * distance)
    aside = torch.sqrt(crank**2 - along**2) * torch.tensor([1.0, -1.0], dtype=points.dtype)
    unit = to_tool / distance[..., None]
    normal = torch.stack([-unit[..., 1], unit[..., 0]], dim=-1)
    elbows: Tensor = foot + along[..., None] * unit + aside[..., None] * normal
    return elbows


def _couplers_in_line(crank: Tensor, coupler: Tensor, foot: Tensor) -> Tensor:
    """Poses with the couplers in line, stretched or folded, and the elbows outward, `m x 2`."""
    turn = torch.linspace(0.0, 2 * torch.pi, _POINTS + 1, dtype=torch.float64)[:-1]
    around = torch.stack([torch.cos(turn), torch.sin(turn)], dim=-1)
    folded = coupler[0] - coupler[1]
    # By the direction of the line; where its points lie far apart (cranks parallel), by that of crank 1.
    first, line = [], []
    for gap in (coupler.sum(), folded):
        first.append(_on_two_circles(foot[0], crank[0], foot[1] - gap * around, crank[1]))
        line.append(around.expand(2, -1, 2))
    elbow = (foot[0] + crank[0] * around).expand(2, -1, 2)
    first.append(elbow)
    line.append((_on_two_circles(elbow[0], coupler.sum(), foot[1], crank[1]) - elbow) / coupler.sum())
    start, unit = torch.cat(first, dim=1).reshape(-1, 2), torch.cat(line, dim=1).reshape(-1, 2)
    points = start + coupler[0] * unit
    gap = torch.cat([coupler.sum().expand(_POINTS), folded.expand(_POINTS), coupler.sum().expand(_POINTS)]).repeat(2)
    elbows = torch.stack([start, start + gap[:, None] * unit], dim=1)
    same = (_outward_elbows(points, crank, coupler, foot) - elbows).abs().amax((-2, -1)) < 1e-6 * coupler.sum()
    return points[same]


def _on_two_circles(first: Tensor, first_radius: Tensor, second: Tensor, second_radius: Tensor) -> Tensor:
    """Both meeting points of two circles, `2 x m x 2`; NaN where they do not meet. first, second: `m x 2` or `2`."""
    across = second - first
    square = (across**2).sum(-1)
    share = (first_radius**2 - second_radius**2 + square) / (2 * square)
    height = torch.sqrt(first_radius**2 / square - share**2)
    middle, normal = first + share[:, None] * across, torch.stack([-across[:, 1], across[:, 0]], dim=-1)
    return torch.stack([middle + height[:, None] * normal, middle - height[:, None] * normal])


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
