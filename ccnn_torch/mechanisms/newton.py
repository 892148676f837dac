"""Roots of a loop closure: damped Newton, with the right first derivative."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.numerics.least_squares import Solution, jacobian_of, levenberg_marquardt

# Residual left [SI] above which a settled search is a least-squares minimum and not a root.
_ROOT = 1e-9


def solve(
    closure: Callable[..., Tensor],
    start: Tensor,
    data: tuple[Tensor, ...],
    both: Callable[..., tuple[Tensor, Tensor]] | None = None,
    closest: bool = False,
) -> Tensor:
    """The root that damped Newton reaches from `start`.

    Args:
        closure: `(x, *data)` -> `... x c`.
        start: `... x k`, broadcasts with the data.
        data: what the closure needs besides x, `... x d` each.
        both: `(x, *data)` -> the closure and its derivative by x, `... x c` and `... x c x k`, which share most of
            their work; by differentiation when not given.
        closest: take the least squares of a closure that has no root.

    Returns:
        `... x k`; NaN in rows without a root. Differentiable in the data by the implicit function theorem (first
        derivatives, forward and reverse mode).
    """
    lead = leading_shape(start, *data)
    plain = tuple(d.detach() for d in data)
    found = levenberg_marquardt(closure, start.detach().expand(*lead, start.shape[-1]), None, plain, both=both)
    root = torch.isfinite(found.cost) if closest else (2 * found.cost).sqrt() <= _ROOT
    # A row without a root takes part from its start on, so that its NaN stays out of the others' derivatives.
    x = torch.where(root[..., None], found.value, start.detach())
    if both is None:
        residual, slope = closure(x, *data), jacobian_of(lambda point: closure(point, *plain), x)[1]
    else:
        residual, slope = both(x, *data)
    return torch.where(root[..., None], carry_derivative(x, slope, residual), torch.nan)


def carry_derivative(x: Tensor, slope: Tensor, residual: Tensor) -> Tensor:
    """A root x (frozen) that differentiates as dx = -(dF/dx)⁺ dF, by the implicit function theorem.

    Args:
        x: `... x k`, the root.
        slope: `... x c x k`, dF/dx there; no gradient is taken through it.
        residual: `... x c`, F at the frozen root, differentiable in everything else that F depends on.

    Returns:
        `... x k`, equal to x bit by bit.
    """
    step = _least_norm_solve(slope.detach(), residual)
    return x.detach() - (step - step.detach())


def least_norm(
    residual: Callable[..., Tensor],
    slope: Callable[..., Tensor],
    found: Solution,
    anchor: Tensor,
    data: tuple[Tensor, ...],
) -> Tensor:
    """Slide along the solutions of an underdetermined problem to the one closest to `anchor`, `... x k`.

    Each round takes the minimum-norm solution of the problem linearised at the last point; near the anchor the error
    falls by |x - anchor| times the curvature. A row that would get worse keeps what the solver found.
    """
    x = found.value
    for _ in range(4):
        away = ((slope_here := slope(x, *data)) @ (x - anchor)[..., None])[..., 0]
        x = anchor + _least_norm_solve(slope_here, away - residual(x, *data))
    cost = residual(x, *data).square().sum(-1) / 2
    return torch.where((cost <= found.cost + 1e-24)[..., None], x, found.value)


def _least_norm_solve(slope: Tensor, right: Tensor) -> Tensor:
    """Minimum-norm least squares: slope `... x c x k`, right `... x c`; returns `... x k`.

    By the normal equations in the smaller of the two dims; the ridge at rounding level keeps a singular slope finite.
    """
    c, k = slope.shape[-2:]
    normal = slope.mT @ slope if k <= c else slope @ slope.mT
    ridge = torch.finfo(slope.dtype).eps * normal.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)
    normal = normal + torch.diag_embed(ridge[..., None].expand(normal.shape[:-1]))
    column = right[..., None]
    solved: Tensor = torch.linalg.solve_ex(normal, slope.mT @ column if k <= c else column).result
    return (solved if k <= c else slope.mT @ solved)[..., 0]
