"""Bootstrap over rows: intervals that do not rely on the linearised problem."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.linear import WeightedRows
from ccnn_torch.identification.problems.problem import Fit, Problem, Solver


@dataclass(frozen=True)
class Bootstrap:
    """Fits to redrawn rows.

    Attributes:
        values: `count x r x k` [SI].
        converged: `count x r`, bool.
    """

    values: Tensor
    converged: Tensor

    def sd(self) -> Tensor:
        """Standard deviation over the draws, `r x k` [SI]."""
        return self.values.std(0)

    def interval(self, level: float = 0.95) -> tuple[Tensor, Tensor]:
        """Percentiles over the draws that hold the share `level`, low and high, `r x k` each [SI]."""
        tails = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=self.values.dtype, device=self.values.device)
        low, high = torch.quantile(self.values, tails, dim=0)
        return low, high


def bootstrap(
    problem: Problem, fit: Fit, solver: Solver, count: int = 200, seed: int = 0, redraw: str = "residuals"
) -> Bootstrap:
    """Solve the problem again with redrawn rows, all draws as machines side by side in one call of the solver.

    Args:
        problem: as it was solved.
        fit: what the solver found; searches begin there.
        solver: the one to try.
        count: draws.
        seed: of the draws; the solver gets it too.
        redraw: `residuals`: the residual rows that the fit leaves are drawn with replacement and put to the fitted
            ones (Efron 1979), raised by sqrt(N / (N - k)) for the parameters fitted; it keeps the poses. `rows`: the
            rows get random weights of mean 1 (the Bayesian bootstrap, Rubin 1981, which unlike drawing rows never
            leaves too few of them); it also holds where the noise differs between rows.

    Raises:
        InputError: another `redraw`, or fewer than two draws.
    """
    if redraw not in ("residuals", "rows") or count < 2:
        raise InputError(f"redraw is 'residuals' or 'rows', with at least 2 draws; got '{redraw}', {count}")
    generator = torch.Generator().manual_seed(seed)
    r, s = problem.weights.shape
    device = problem.start.device
    uniform = torch.rand(count, r, s, generator=generator, dtype=torch.float64).to(device)

    def repeated(table: Tensor) -> Tensor:
        """`count * r x …` from `r x …`; what all machines share stays one."""
        return table if len(table) == 1 else table.repeat(count, *[1] * (table.dim() - 1))

    data = tuple(repeated(d) for d in problem.data)
    if redraw == "rows":
        used = problem.weights > 0
        drawn = torch.where(used, -torch.log(uniform.clamp_min(1e-300)), 0.0)
        weights = problem.weights * drawn * used.sum(-1, keepdim=True) / drawn.sum(-1, keepdim=True)
        again = dataclasses.replace(problem, weights=weights.flatten(0, 1), data=data)
    else:
        again = dataclasses.replace(
            problem,
            weights=problem.weights.repeat(count, 1),
            data=(*data, _redrawn(problem, fit.values, uniform)),
            residual=lambda values, *rows: problem.residual(values, *rows[:-1]) + rows[-1],
        )
    # The prior pulls to where it pulled before.
    start = problem.start if bool(torch.isfinite(problem.prior_sd).any()) else fit.values
    again = dataclasses.replace(again, start=start.repeat(count, 1))
    found = solver(again, seed)
    return Bootstrap(found.values.reshape(count, r, -1), found.converged.reshape(count, r))


def _redrawn(problem: Problem, values: Tensor, uniform: Tensor) -> Tensor:
    """What to add to the residual so that at `values` it is one drawn from those left there: `count * r x s x c`."""
    rows = WeightedRows(dataclasses.replace(problem, weights=(problem.weights > 0).to(values)))
    everyone = torch.arange(len(values), device=values.device)
    kept = (problem.weights > 0).any(0)
    left = values.new_zeros(*problem.weights.shape, len(problem.channels))
    left[:, kept] = rows.residuals(values[:, None], everyone)[:, 0]
    root = problem.weights.sqrt()[..., None]
    equations = (problem.weights > 0).sum(-1) * len(problem.channels)
    raised = (equations / (equations - values.shape[-1]).clamp_min(1)).sqrt()[:, None, None]
    pool = left * root
    pool = (pool - pool.sum(-2, keepdim=True) / (root > 0).sum(-2, keepdim=True)) * raised
    # The n-th used row of a machine, n drawn uniformly.
    order = torch.argsort((problem.weights == 0).to(torch.int8), dim=-1, stable=True)
    number = (uniform * (problem.weights > 0).sum(-1)[:, None]).long()
    chosen = torch.take_along_dim(order.expand_as(number), number, dim=-1)
    drawn = torch.take_along_dim(pool.expand(*number.shape, -1), chosen[..., None], dim=-2)
    offset = torch.where(root > 0, drawn / root.clamp_min(1e-300), 0.0) - left
    return offset.flatten(0, 1)
