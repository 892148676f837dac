"""The sum of squares of a problem for whole populations of parameter sets, and its gradient."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.linear import WeightedRows
from ccnn_torch.identification.problems.problem import Problem

FORBIDDEN = 1e100
"""Cost of parameters with which a measured row cannot be reached; finite, so that searches may compare with it."""

# Rows evaluated in one call: intermediate results of the kinematics then stay in the processor's cache.
_ROWS_AT_ONCE = 1 << 15

WIDTH = 3.0
"""Half the width of the box that global searches stay in, in units of `Problem.scale`."""


_HELD = 1e-9


class Objective:
    """Half the weighted sum of squares and prior terms of a problem, in the coordinates u = (values - start) / scale.

    Raises:
        InputError: a machine without a row that counts, or whose start does not reach one.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.rows = WeightedRows(problem)
        for empty in (~(problem.weights > 0).any(-1)).nonzero():
            raise InputError(f"machine {int(empty)} has no row to identify from: all its weights are 0")
        start = torch.zeros(self.machines, 1, len(problem.scale), dtype=torch.float64)
        for lost in (self.cost(start)[:, 0] >= FORBIDDEN).nonzero():
            raise InputError(
                f"machine {int(lost)}: a measured row cannot be reached with the parameters that the search starts "
                "from; leave the row out or correct it"
            )

    @property
    def machines(self) -> int:
        """Number of machines, `r`."""
        return self.problem.start.shape[0]

    def of(self, machine: int) -> Objective:
        """The objective of one machine alone."""
        problem, one = self.problem, slice(machine, machine + 1)
        data = tuple(d if len(d) == 1 else d[one] for d in problem.data)
        return Objective(
            dataclasses.replace(problem, start=problem.start[one], data=data, weights=problem.weights[one])
        )

    def values(self, points: Tensor, machines: Tensor | None = None) -> Tensor:
        """From coordinates to parameters: `m x … x k` [1] of these machines to the same [SI]."""
        start = self.problem.start if machines is None else self.problem.start[machines]
        return start.reshape(len(start), *(1,) * (points.dim() - 2), -1) + points * self.problem.scale

    def cost(self, points: Tensor, machines: Tensor | None = None) -> Tensor:
        """Costs of a population.

        Args:
            points: `m x p x k` [1].
            machines: which machine each of the `m` is, `m`, int64; all in order when None.

        Returns:
            `m x p`; `FORBIDDEN` where a residual is not finite.
        """
        machines = torch.arange(self.machines) if machines is None else machines
        count = self.problem.weights.shape[-1] * max(len(machines), 1)
        parts = torch.split(self.values(points, machines), max(1, _ROWS_AT_ONCE // max(count, 1)), dim=1)
        return torch.cat([self.rows.cost(part, machines) for part in parts], dim=1).clamp_max(FORBIDDEN)

    def cost_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Cost `r` and its gradient `r x k` at `r x k` [1]; `FORBIDDEN` and 0 where a residual is not finite."""
        cost, gradient, _ = self._normal(points)
        good = (cost < FORBIDDEN) & torch.isfinite(gradient).all(-1)
        return torch.where(good, cost, FORBIDDEN), torch.where(good[:, None], gradient, 0.0)

    def even_coordinates(self, points: Tensor) -> Tensor:
        """T with T Tᵀ the inverse of the Gauss-Newton Hessian at `r x k`; `r x k x k`.

        Directions that the rows hardly see are held by a share of 1e-9 of the largest curvature.
        """
        hessian = torch.nan_to_num(self._normal(points)[2], posinf=0.0, neginf=0.0)
        held = _HELD * hessian.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)
        unit = torch.eye(len(self.problem.scale), dtype=hessian.dtype)
        factor = torch.linalg.cholesky(hessian + held[:, None, None] * unit)
        turn: Tensor = torch.linalg.solve_triangular(factor.mT, unit.expand_as(factor), upper=True)
        return turn

    def _normal(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost `r`, gradient `r x k` and Gauss-Newton matrix `r x k x k`."""
        found = self.rows.normal(self.values(points)[:, None], torch.arange(self.machines))
        cost, gradient, matrix = (part[:, 0] for part in found)
        return cost, gradient, matrix
