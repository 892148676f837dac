"""Levenberg-Marquardt over machines and starts at once (Levenberg 1944, Marquardt 1963); robust loss, priors."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification._linear import WeightedRows
from ccnn_torch.identification.problem import Fit, Problem, Progress
from ccnn_torch.identification.robust import LOSSES, loss_weights

__all__ = ["solve_lm"]

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-14, 1e6
_ROUNDING = 1e-9  # Step in plausible errors that is nothing: 1e-12 m.
_BLOCK = 8_000_000  # Numbers in the Jacobian of the machines that are worked on at once.
_REACH = 3.0  # Starts lie within so many plausible errors.
_ROUNDS = 30  # Of reweighting.
_SETTLED = 1e-4  # Change of the weights below which reweighting ends.

Normal = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


def solve_lm(
    problem: Problem,
    seed: int = 0,
    progress: Progress | None = None,
    *,
    starts: int = 1,
    loss: str = "squared",
    max_iterations: int = 60,
    tolerance: float = 1e-5,
) -> Fit:
    """Minimise the problem of every machine from several starts, all in one batch; the best start counts.

    The step solves (JᵀJ + prior + λ max diag(JᵀJ) I) du = -gradient, u being the values in plausible errors: a
    direction that the rows do not see stays where it was. A trial that is worse, or not finite (out of reach), is
    refused and λ grows.

    Args:
        problem: what to minimise.
        seed: of the starts after the first, which is `problem.start`; they are uniform within three plausible errors.
        progress: told the share of the machines that is done.
        starts: searches of each machine.
        loss: `squared`, `huber` or `cauchy`, by reweighting whole rows (`robust.loss_weights`).
        max_iterations: bound on the trials.
        tolerance: a search ends when what is left to go, as the fall of its steps tells, is below so many standard
            deviations of the estimate.

    Returns:
        Fit; its cost is the squared loss with the problem's weights, and its `evaluations` count a residual and its
        Jacobian as one.

    Raises:
        InputError: an unknown loss, or not one start.
    """
    if loss not in LOSSES or starts < 1:
        raise InputError(f"loss is one of {', '.join(LOSSES)} and starts at least 1; got '{loss}', {starts}")
    rows = WeightedRows(problem)
    machines, k = problem.start.shape
    size = max(1, starts * rows.weights.shape[1] * rows.channels * k)
    everyone = torch.arange(machines, device=problem.start.device)
    blocks = torch.split(everyone, max(1, _BLOCK // size))
    begin = _starts(rows, starts, seed)
    values, cost, converged, count = torch.empty_like(problem.start), [], [], 0
    for block in blocks:
        found = _solve_block(rows, begin[block], block, loss, max_iterations, tolerance)
        values[block] = found[0]
        cost.append(found[1])
        converged.append(found[2])
        count += found[3]
        if progress is not None:
            progress(float(block[-1] + 1) / machines)
    settled = torch.cat(converged)
    total = torch.cat(cost)
    return Fit(values, total, settled, count, _message(settled, total, max_iterations))


def _starts(rows: WeightedRows, starts: int, seed: int) -> Tensor:
    """`r x m x k`: the problem's start and draws around it, drawn in halfway until every row is within reach."""
    generator = torch.Generator().manual_seed(seed)
    r, k = rows.start.shape
    draw = torch.rand(r, starts - 1, k, generator=generator, dtype=torch.float64).to(rows.start.device)
    away = torch.cat([torch.zeros_like(rows.start)[:, None], (2 * draw - 1) * (_REACH * rows.scale)], dim=1)
    if starts == 1:
        return rows.start[:, None]
    everyone = torch.arange(r, device=rows.start.device)
    for _ in range(10):
        lost = torch.isinf(rows.cost(rows.start[:, None] + away, everyone))
        if not bool(lost[:, 1:].any()):
            break
        away = torch.where(lost[..., None], away / 2, away)
    return rows.start[:, None] + away


def _solve_block(
    rows: WeightedRows, begin: Tensor, block: Tensor, loss: str, max_iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Values `r x k`, cost `r`, converged `r` and evaluations of some machines."""
    free = rows.equations[block] - begin.shape[-1]

    def search(point: Tensor, extra: Tensor | None) -> tuple[Tensor, Tensor, Tensor, int]:
        def normal(values: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return rows.normal(values, block[index], None if extra is None else extra[index])

        return _descend(normal, point, rows.scale, free.clamp_min(1)[:, None], max_iterations, tolerance)

    x, cost, converged, count = search(begin, None)
    best = cost.argmin(-1)
    pick = torch.arange(len(x), device=x.device), best
    x, cost, converged = x[pick], cost[pick], converged[pick]
    if loss == "squared":
        return x, cost, converged, count
    weights = x.new_ones(len(x), 1, rows.weights.shape[1])
    # Cauchy's loss has several minima: it begins where Huber's has settled.
    for kind in ("huber", "cauchy") if loss == "cauchy" else (loss,):
        for _ in range(_ROUNDS):
            fresh = loss_weights(rows.residuals(x[:, None], block), rows.weights[block][:, None], kind, x.shape[-1])
            change = float((fresh - weights).abs().max())
            weights = fresh
            found, _, settled, more = search(x[:, None], weights)
            x, converged, count = found[:, 0], settled[:, 0], count + more
            if change < _SETTLED:
                break
    return x, rows.cost(x[:, None], block)[:, 0], converged, count


def _descend(
    normal: Normal, start: Tensor, scale: Tensor, free: Tensor, max_iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Search from `r x m x k`; returns values, cost and converged (`r x m`), and the number of evaluations."""
    x = start.clone()
    everyone = torch.arange(len(x), device=x.device)
    cost, gradient, matrix = normal(x, everyone)
    count = cost.numel()
    converged = torch.zeros_like(cost, dtype=torch.bool)
    done = torch.isinf(cost)
    least = 1e-24 * cost
    damping = torch.full_like(cost, _FIRST_DAMPING)
    before = torch.zeros_like(cost)
    for _ in range(max_iterations):
        step, promised = _step(matrix, gradient, damping)
        # Steps that fall from one to the next by a ratio leave about the last times that ratio.
        left = promised * (promised / before.clamp_min(1e-300)).clamp_max(1)
        variance = 2 * cost / free
        near = (left <= tolerance**2 / 2 * variance) | (promised <= least) | (promised <= 1e-13 * cost)
        near |= (step.abs().amax(-1) <= _ROUNDING) & (damping <= 1e-2)
        near &= ~done
        # So small a step keeps its promise: no need to look.
        x = torch.where(near[..., None], x + scale * step, x)
        cost = torch.where(near, cost - promised, cost)
        stuck = ~near & (damping >= _MOST_DAMPING)
        converged |= near
        done = done | near | stuck
        index = torch.nonzero(~done.all(-1)).squeeze(-1)
        if not len(index):
            break
        everything = len(index) == len(x)
        trial = x + scale * torch.where(done[..., None], 0.0, step)
        new = normal(trial if everything else trial[index], index)
        count += new[0].numel()
        if everything:
            new_cost, new_gradient, new_matrix = new
        else:
            new_cost, new_gradient, new_matrix = cost.clone(), gradient.clone(), matrix.clone()
            new_cost[index], new_gradient[index], new_matrix[index] = new
        better = ~done & (new_cost <= cost)
        worse = ~done & ~better
        x = torch.where(better[..., None], trial, x)
        cost = torch.where(better, new_cost, cost)
        gradient = torch.where(better[..., None], new_gradient, gradient)
        matrix = torch.where(better[..., None, None], new_matrix, matrix)
        before = torch.where(better, promised, torch.where(worse, 0.0, before))
        damping = torch.where(
            better, (damping / 1000).clamp_min(_LEAST_DAMPING), torch.where(worse, damping * 30, damping)
        )
    return x, cost, converged, count


def _step(matrix: Tensor, gradient: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Step `… x k` and the fall of the cost that it promises, `…`."""
    ridge = damping * matrix.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)
    damped = matrix.clone()
    damped.diagonal(dim1=-2, dim2=-1).add_(ridge[..., None])
    step = -torch.cholesky_solve(gradient[..., None], torch.linalg.cholesky_ex(damped).L)[..., 0]
    promised = (ridge * step.square().sum(-1) - (step * gradient).sum(-1)) / 2
    lost = ~torch.isfinite(promised) | (promised < 0)
    return torch.where(lost[..., None], 0.0, step), torch.where(lost, torch.inf, promised)


def _message(converged: Tensor, cost: Tensor, max_iterations: int) -> str:
    failed = torch.nonzero(~converged).squeeze(-1)
    if not len(failed):
        return ""
    first = int(failed[0])
    why = f"did not settle in {max_iterations} steps"
    if not bool(torch.isfinite(cost[first])):
        why = "has a residual that is not finite at its start"
    return f"{len(failed)} of {len(converged)} machines failed; the first, number {first + 1}, {why}"
