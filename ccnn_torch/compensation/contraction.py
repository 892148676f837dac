"""Lipschitz constant of a deviation, and the number of iterations that the command needs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.compensation.domain import Domain

# A unique command exists below a slope of 1. At this one the fixed point takes 40 steps, and
# a slope that sampling missed still has room.
STEEPEST_DEVIATION = 0.5
# What is left of the equation q + δ(q) = q*, as a share of the limit.
TOLERANCE = 1e-12

_POINTS = 2048
_AT_ONCE = 256
_CLIMBERS = 64
_ROUNDS = 12
# The steepest of the points tried is not the steepest of all.
_SAFETY = 1.25


class Steepness(NamedTuple):
    """`lipschitz`: bound of the slope in units of the limits; `largest`: max|δ| in the same, at most 1."""

    lipschitz: float
    largest: float


def steepest(
    deviation: Callable[[Tensor, Tensor | None], Tensor],
    inputs: Tensor,
    domain: Domain,
    limit: Tensor,
    count: int = _POINTS,
    at_once: int = _AT_ONCE,
) -> Steepness:
    """Find the steepest slope of δ over the domain and the transition around it, by sampling and hill climbing.

    Joints are measured in units of their limits, so that metres and radians, and joints of large and small deviations,
    count alike; the norm is the maximum row sum, which bounds the error of every joint.

    Args:
        deviation: (joints `s x n`, covariates `s x m` or None) -> δ `s x n` [SI].
        inputs: training inputs, `s x (n + m)` [SI].
        domain: fitted to them.
        limit: `n` [SI].
        count: inputs that are compared; of points between and around them there are six times as many.
        at_once: points that one pass takes; a geometry's many small operations take hardly longer for more of them.
    """
    n = len(limit)
    positive = limit[limit > 0]
    scale = torch.where(limit > 0, limit, positive.min() if len(positive) else torch.ones_like(limit))

    def slope(points: Tensor) -> tuple[Tensor, Tensor]:
        # In pieces: a network that compares each point with thousands of rows keeps a matrix for every operation.
        slopes, sizes = zip(*(slope_of_few(part) for part in torch.split(points, at_once)), strict=True)
        return torch.cat(slopes), torch.cat(sizes)

    def slope_of_few(points: Tensor) -> tuple[Tensor, Tensor]:
        joints = points[:, :n].clone().requires_grad_()
        value = deviation(joints, points[:, n:])
        # One row of the Jacobian of every point at once, since the points do not know of each other.
        rows = [torch.autograd.grad(value[:, i].sum(), joints, retain_graph=True)[0] for i in range(n)]
        jacobian = torch.stack(rows, 1) * scale / scale.unsqueeze(-1)
        return jacobian.abs().sum(-1).amax(-1), (value.detach().abs() / scale).amax(-1)

    generator = torch.Generator().manual_seed(0)
    points = spread_points(inputs, domain, generator, count)
    slopes, sizes = slope(points)
    chosen = slopes.topk(min(_CLIMBERS, len(points))).indices
    points, best = points[chosen], slopes[chosen]
    step = domain.half_range * 0.2
    for _ in range(_ROUNDS):
        draw = torch.randn(points.shape, generator=generator, dtype=points.dtype)
        candidates = domain.cage(points + step * draw)
        found, _ = slope(candidates)
        better = found > best
        points = torch.where(better.unsqueeze(-1), candidates, points)
        best = torch.maximum(best, found)
        step = step * 0.7
    return Steepness(_SAFETY * float(best.max()), min(1.0, float(sizes.max())))


def iterations_needed(found: Steepness, tolerance: float = TOLERANCE) -> int:
    """Smallest k, at least 1, with lipschitzᵏ · max|δ| ≤ tolerance, both in units of the limit."""
    if found.lipschitz == 0 or found.largest <= tolerance:
        return 1
    exact = math.log(tolerance / found.largest) / math.log(found.lipschitz)
    # A slope of exactly 1e-4 takes 3 steps, also where the quotient of the logarithms comes out as 3 + 4e-16.
    return max(1, math.ceil(exact - 1e-9))


def spread_points(inputs: Tensor, domain: Domain, generator: torch.Generator, count: int = _POINTS) -> Tensor:
    """The training inputs, points between them, and points all through the transition around them, `s x d` [SI]."""
    rows = inputs[torch.randperm(len(inputs), generator=generator)[:count]]
    pick = torch.randint(len(inputs), (2, 2 * count), generator=generator)
    share = torch.rand(3, 2 * count, 1, generator=generator, dtype=inputs.dtype)
    between = inputs[pick[0]] + share[0] * (inputs[pick[1]] - inputs[pick[0]])
    d = len(domain.centre)
    widest = float((1 + domain.width[:d] / domain.radius[:d]).max()) * 1.1
    outward = domain.centre + (between - domain.centre) * (1 + share[1] * (widest - 1))
    noise = torch.randn(outward.shape, generator=generator, dtype=inputs.dtype)
    around = inputs[pick[1]] + noise * share[2] * domain.half_range * domain.width[:d]
    return domain.cage(torch.cat([rows, between, outward, around]))
