"""Damped Gauss-Newton steps of many problems at once, from their normal equations."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.identification.problems.linear import OPEN

Normal = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""Values `r x m x k` and which machines these are -> cost `r x m`, gradient `… x k`, matrix `… x k x k`, in units of
the plausible errors; an infinite cost where the values are out of reach."""

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-8, 1e-14, 1e6
_FAR = 30.0  # Plausible errors in one step that make one ask whether its direction is seen at all.
_ROUNDING = 1e-9  # Step in plausible errors that is nothing: 1e-12 m.


def descend(
    normal: Normal, start: Tensor, scale: Tensor, free: Tensor, max_iterations: int, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Search from many starts at once.

    Args:
        start: `r x m x k` [SI].
        scale: plausible errors, `k` [SI].
        free: equations less parameters, at least 1, `r x 1`.
        max_iterations: bound on the trials.
        tolerance: in standard deviations of the estimate, see `solve_lm`.

    Returns:
        values `r x m x k`, cost `r x m`, converged `r x m`, and how often `normal` was evaluated.
    """
    x = start
    everyone = torch.arange(len(x), device=x.device)
    cost, gradient, matrix = normal(x, everyone)
    count = cost.numel()
    done = torch.isinf(cost)
    converged = torch.zeros_like(done)
    # Of the cost: what the tolerance and rounding make of it; and of the first cost, for data without noise.
    enough = tolerance**2 / free + 1e-13
    least = 1e-24 * cost
    damping = torch.full_like(cost, _FIRST_DAMPING)
    before = torch.zeros_like(cost)
    everything: slice | Tensor = slice(None)
    for _ in range(max_iterations):
        step, promised = _step(matrix, gradient, damping)
        size = step.abs().amax(-1)
        far = size > _FAR
        if bool(far.any()):
            unseen = (2 * cost / free / OPEN**2)[far]
            step[far], promised[far] = _seen_step(matrix[far], gradient[far], damping[far], unseen)
        # Steps that fall from one to the next by a ratio leave about the last times that ratio.
        left = promised * (promised / before).clamp_max(1)
        near = (left <= enough * cost + least) | (size <= _ROUNDING) & (damping <= 1e-2)
        trial = x + scale * step
        index, here = everyone, everything
        if bool((near | done).any()):
            # So small a step keeps its promise: no need to look.
            near &= ~done
            x = torch.where(near[..., None], trial, x)
            cost = torch.where(near, cost - promised, cost)
            converged, done = converged | near, done | near
            index = here = torch.nonzero(~done.all(-1)).squeeze(-1)
            if not len(index):
                break
        new_cost, new_gradient, new_matrix = normal(trial[here], index)
        count += new_cost.numel()
        better = (new_cost <= cost[here]) & ~done[here]
        eased = damping[here] * _change((cost[here] - new_cost) / promised[here], better)
        eased = eased.clamp_min(_LEAST_DAMPING)
        if len(index) == len(x) and bool(better.all()):
            x, cost, gradient, matrix = trial, new_cost, new_gradient, new_matrix
            before, damping = promised, eased
            continue
        x = _put(x, here, better, trial[here])
        cost = _put(cost, here, better, new_cost)
        gradient = _put(gradient, here, better, new_gradient)
        matrix = _put(matrix, here, better, new_matrix)
        before = _put(torch.zeros_like(before), here, better, promised[here])
        damping = _put(damping, here, ~done[here], eased)
        done = done | (damping >= _MOST_DAMPING)
    return x, cost, converged, count


def _seen_step(matrix: Tensor, gradient: Tensor, damping: Tensor, unseen: Tensor) -> tuple[Tensor, Tensor]:
    """As `_step`, within the eigenvectors of the matrix whose eigenvalue is above `unseen`, `…`."""
    values, vectors = torch.linalg.eigh(torch.nan_to_num(matrix))
    largest = values[..., -1:]
    along = (vectors.mT @ gradient[..., None])[..., 0]
    curvature = values + (damping[..., None] * largest).clamp_min(1e-100)
    part = torch.where(values > torch.maximum(unseen[..., None], 1e-14 * largest), -along / curvature, 0.0)
    step = (vectors @ part[..., None])[..., 0]
    return step, (part * ((curvature - values) * part - along)).sum(-1) / 2


def _change(kept: Tensor, better: Tensor) -> Tensor:
    """Factor of the damping, from the share of the promised fall that a step kept."""
    if bool((kept > 0.9).all()):
        return torch.where(better, 1e-3, 10.0)
    factor = torch.where(kept > 0.9, 1e-3, torch.where(kept > 0.5, 0.1, torch.where(kept > 0.1, 1.0, 4.0)))
    return torch.where(better, factor, 10.0)


def _put(table: Tensor, index: Tensor | slice, chosen: Tensor, values: Tensor) -> Tensor:
    """The table with the chosen entries of some machines replaced."""
    mask = chosen.reshape(*chosen.shape, *[1] * (values.dim() - chosen.dim()))
    table = table.clone()
    table[index] = torch.where(mask, values, table[index])
    return table


def _step(matrix: Tensor, gradient: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Step `… x k` and the fall of the cost that it promises, `…`."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    ridge = (damping * diagonal.amax(-1)).clamp_min(1e-100)
    damped = matrix + torch.diag_embed(ridge[..., None].expand_as(diagonal))
    step = torch.cholesky_solve(-gradient[..., None], torch.linalg.cholesky_ex(damped).L)[..., 0]
    promised = (step * (ridge[..., None] * step - gradient)).sum(-1) / 2
    # Without a factor there is no step: a trial that is not a number is refused, and the damping grows.
    return torch.where((promised >= 0)[..., None], step, torch.nan), promised
