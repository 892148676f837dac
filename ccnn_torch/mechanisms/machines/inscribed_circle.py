"""Largest circle of poses of a five-bar that holds no singularity (Liu et al. 2006, "maximal inscribed workspace")."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.errors import InputError

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
    return centre, margin[best]


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
