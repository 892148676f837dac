"""The sum of squares of a problem for whole populations of parameter sets, and its gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.problem import Problem
from ccnn_torch.numerics.least_squares import jacobian_of

FORBIDDEN = 1e100
"""Cost of parameters with which a measured row cannot be reached; finite, so that searches may compare with it."""

# Rows evaluated in one call: intermediate results of the kinematics then stay in the processor's cache.
_ROWS_AT_ONCE = 1 << 15

WIDTH = 3.0
"""Half the width of the box that global searches stay in, in units of `Problem.scale`."""


_HELD = 1e-9


@dataclass(frozen=True)
class Objective:
    """Half the weighted sum of squares and prior terms, in the coordinates u = (values - start) / scale.

    Attributes:
        problem: what is minimised.
        data: as `Problem.data`, one each machine; rows of weight 0 hold the numbers of a row that counts, so that a
            configuration that cannot be reached does not spoil the gradient through 0 · NaN.
        stiffness: `k` [1]; scale / prior_sd, 0 where there is no prior.
    """

    problem: Problem
    data: tuple[Tensor, ...]
    stiffness: Tensor

    @property
    def machines(self) -> int:
        """Number of machines, `r`."""
        return self.problem.start.shape[0]

    def of(self, machine: int) -> Objective:
        """The objective of one machine alone."""
        one = slice(machine, machine + 1)
        data = tuple(d[one] for d in self.data)
        weights = self.problem.weights.expand(self.machines, -1)[one]
        problem = replace(self.problem, start=self.problem.start[one], data=data, weights=weights)
        return Objective(problem, data, self.stiffness)

    def values(self, points: Tensor) -> Tensor:
        """From coordinates to parameters: `r x … x k` [1] to the same [SI]."""
        start = self.problem.start
        start = start.reshape(len(start), *(1,) * (points.dim() - 2), -1)
        return start + points * self.problem.scale

    @torch.no_grad()
    def cost(self, points: Tensor, machines: Tensor | None = None) -> Tensor:
        """Costs of a population.

        Args:
            points: `m x p x k` [1].
            machines: which machine each of the `m` is, `m`, int64; all in order when None.

        Returns:
            `m x p`; `FORBIDDEN` where a residual is not finite.
        """
        machines = torch.arange(self.machines) if machines is None else machines
        rows = self.problem.weights.shape[-1] * max(len(machines), 1)
        parts = torch.split(points, max(1, _ROWS_AT_ONCE // max(rows, 1)), dim=1)
        return torch.cat([self._cost(part, machines) for part in parts], dim=1)

    def cost_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Cost `r` and its gradient `r x k` at `r x k` [1]; `FORBIDDEN` and 0 where a residual is not finite."""
        with torch.enable_grad():
            here = points.detach().clone().requires_grad_()
            cost = self._cost(here[:, None], torch.arange(self.machines))[:, 0]
            (gradient,) = torch.autograd.grad(cost.sum(), here)
        good = (cost < FORBIDDEN) & torch.isfinite(gradient).all(-1)
        return torch.where(good, cost, FORBIDDEN).detach(), torch.where(good[:, None], gradient, 0.0)

    def even_coordinates(self, points: Tensor) -> Tensor:
        """T with T Tᵀ the inverse of the Gauss-Newton Hessian at `r x k`; `r x k x k`.

        Directions that the rows hardly see are held by a share of 1e-9 of the largest curvature.
        """
        problem = self.problem
        count = problem.weights.shape[-1]
        values = self.values(points)[:, None].expand(-1, count, -1)
        slope = jacobian_of(lambda v: problem.residual(v, *self.data), values)[1] * problem.scale
        slope = torch.nan_to_num(slope, posinf=0.0, neginf=0.0) * problem.weights.sqrt()[..., None, None]
        flat = slope.flatten(1, 2)
        hessian = flat.mT @ flat + torch.diag(self.stiffness.square())
        held = _HELD * hessian.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)
        unit = torch.eye(len(problem.scale), dtype=hessian.dtype)
        factor = torch.linalg.cholesky(hessian + held[:, None, None] * unit)
        turn: Tensor = torch.linalg.solve_triangular(factor.mT, unit.expand_as(factor), upper=True)
        return turn

    def _cost(self, points: Tensor, machines: Tensor) -> Tensor:
        values = self.problem.start[machines, None] + points * self.problem.scale
        data = (d[machines, None] for d in self.data)
        square = self.problem.residual(values[:, :, None], *data).square().sum(-1)
        weights = self.problem.weights.expand(self.machines, -1)[machines, None]
        total = (square * weights).sum(-1) / 2 + (points * self.stiffness).square().sum(-1) / 2
        return torch.where(torch.isfinite(total), total, FORBIDDEN)


def make_objective(problem: Problem) -> Objective:
    """The objective of a problem."""
    r = problem.start.shape[0]
    weights = problem.weights.expand(r, -1)
    counts = weights > 0
    if not bool(counts.any(-1).all()):
        machine = int((~counts.any(-1)).nonzero()[0])
        raise InputError(f"machine {machine} has no row to identify from: all its weights are 0")
    data = tuple(d.expand(r, *d.shape[1:]) for d in problem.data)
    if not bool(counts.all()):
        # Each row that does not count becomes the first that does.
        place = torch.where(counts, torch.arange(weights.shape[-1]), counts.int().argmax(-1, keepdim=True))
        data = tuple(d.gather(1, place[..., None].expand_as(d)) for d in data)
    stiffness = problem.scale / problem.prior_sd
    objective = Objective(problem, data, torch.where(torch.isfinite(problem.prior_sd), stiffness, 0.0))
    lost = (objective.cost(torch.zeros(r, 1, len(problem.scale), dtype=torch.float64))[:, 0] >= FORBIDDEN).nonzero()
    if len(lost):
        raise InputError(
            f"machine {int(lost[0])}: a measured row cannot be reached with the parameters that the search starts "
            "from; leave the row out or correct it"
        )
    return objective
