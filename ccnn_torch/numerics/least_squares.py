"""Batched damped least squares (Levenberg 1944, Marquardt 1963): many small problems side by side in one call."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_EPS = torch.finfo(torch.float64).eps
_DAMPING_FLOOR, _DAMPING_CEILING = 1e-15, 1e15


@dataclass(frozen=True)
class Solution:
    """What the solver found. A problem that failed is a value here, not an exception.

    Attributes:
        value: best point found, `... x k`.
        cost: half the sum of squared residuals there, `...`; not finite where the start itself was outside the domain.
        iterations: steps tried by the slowest problem.
        converged: `...`, bool.
        message: one sentence that names the first problem that failed; empty when all converged.
    """

    value: Tensor
    cost: Tensor
    iterations: int
    converged: Tensor
    message: str


def jacobian_of(
    function: Callable[[Tensor], Tensor], point: Tensor, combined: Callable[[Tensor], Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Value and Jacobian of a function that treats its leading dims independently.

    One backward pass per output, or one double-backward pass (the transpose of the transpose) per input, whichever is
    fewer. Not torch's forward mode: that compiles a set of decompositions with the deprecated `torch.jit.script` when
    first used, and takes about twice as long here. Nor `torch.func.vjp`: that loads torch's compiler, a second.

    Args:
        function: `... x k` -> `... x c`.
        point: `... x k`.
        combined: of the value, which combinations of the outputs are asked for, `... x r x c`; None = each output.

    Returns:
        value `... x c` and Jacobian `... x c x k`, or that of the combinations, `... x r x k`.
    """
    with torch.enable_grad():
        point = point.detach().requires_grad_()
        value = function(point)
        c, k = value.shape[-1], point.shape[-1]
        outputs = torch.eye(c, dtype=value.dtype, device=value.device)
        outputs = outputs if combined is None else combined(value.detach())
        if outputs.shape[-2] <= 2 * k:
            rows = [_pulled(value, point, e.expand_as(value)) for e in outputs.unbind(-2)]
            return value.detach(), torch.stack(rows, dim=-2) if rows else value.new_zeros(*value.shape, k)
        cotangent = torch.zeros_like(value, requires_grad=True)
        pulled = _pulled(value, point, cotangent, create_graph=True)
        columns = [
            _pulled(pulled, cotangent, e.expand_as(point)) for e in torch.eye(k, dtype=point.dtype, device=point.device)
        ]
        slope = torch.stack(columns, dim=-1)
        return value.detach(), slope if combined is None else outputs @ slope


def _pulled(value: Tensor, point: Tensor, cotangent: Tensor, create_graph: bool = False) -> Tensor:
    """Derivative of the sum of `cotangent` times `value` by `point`, like `point`."""
    if not value.requires_grad:
        return torch.zeros_like(point)
    # Of a sum: given the cotangent apart, torch loads its compiler's algebra to compare two shapes.
    total = (value * cotangent).sum()
    return torch.autograd.grad(total, point, retain_graph=True, create_graph=create_graph, materialize_grads=True)[0]


def levenberg_marquardt(
    residual: Callable[..., Tensor],
    start: Tensor,
    jacobian: Callable[..., Tensor] | None = None,
    data: tuple[Tensor, ...] = (),
    *,
    max_iterations: int = 60,
    tolerance: float = 1e-12,
    damping: float = 1e-4,
    both: Callable[..., tuple[Tensor, Tensor]] | None = None,
) -> Solution:
    """Minimise |residual(x)|² / 2 for every leading index at once.

    The step solves (JᵀJ + λ max diag(JᵀJ) I) s = -Jᵀr, or its dual where there are fewer residuals than unknowns: as λ
    falls this is the minimum-norm Gauss-Newton step, so that directions that the residuals do not see stay where they
    were. A trial with a worse or non-finite residual is refused and λ grows, which keeps the path inside the domain.

    Args:
        residual: `(x, *data)` -> `... x c`; treats leading dims independently.
        start: `... x k`.
        jacobian: `(x, *data)` -> `... x c x k`; by differentiation when not given.
        data: tensors `... x d` that broadcast against the leading dims of `start`. Problems that are done are left out
            of later calls; with no data the functions always see all problems.
        max_iterations: bound on the steps tried.
        tolerance: a problem is done when its step is below `tolerance * (1 + |x|)`, or when the decrease that the
            linear model promises is below rounding.
        damping: first λ, relative.
        both: `(x, *data)` -> residual and Jacobian at once, in the place of both functions, where they share most of
            their work; needs data.

    Returns:
        Solution; no gradient flows through it.
    """
    lead, k = start.shape[:-1], start.shape[-1]
    count = math.prod(lead)
    x = start.detach().reshape(count, k).clone()
    rows = tuple(d.detach().expand(*lead, d.shape[-1]).reshape(count, d.shape[-1]) for d in data)

    def call(function: Callable[..., Tensor], values: Tensor, active: Tensor) -> Tensor:
        if rows:
            return function(values, *(d[active] for d in rows))
        everything = x.clone()
        everything[active] = values
        answer = function(everything.reshape(*lead, k))
        return answer.reshape(count, *answer.shape[len(lead) :])[active]

    def differentiate(values: Tensor, active: Tensor) -> Tensor:
        if jacobian is not None:
            return call(jacobian, values, active)

        def by_autodiff(point: Tensor, *point_rows: Tensor) -> Tensor:
            return jacobian_of(lambda p: residual(p, *point_rows), point)[1]

        return call(by_autodiff, values, active)

    def evaluate(values: Tensor, active: Tensor) -> tuple[Tensor, Tensor | None]:
        if both is None:
            return call(residual, values, active).detach(), None
        value, slope = both(values, *(d[active] for d in rows))
        return value.detach(), slope.detach()

    active = torch.arange(count, device=x.device)
    r, slope = evaluate(x, active)
    cost = r.square().sum(-1) / 2
    converged = torch.zeros(count, dtype=torch.bool, device=x.device)
    active = torch.nonzero(torch.isfinite(cost)).squeeze(-1)
    r, slope = r[active], None if slope is None else slope[active]
    lam = torch.full((len(active),), damping, dtype=x.dtype, device=x.device)
    iterations = 0
    while len(active) and iterations < max_iterations:
        iterations += 1
        here = x[active]
        step, promised = _damped_step(differentiate(here, active).detach() if slope is None else slope, r, lam)
        trial = here + step
        trial_r, trial_slope = evaluate(trial, active)
        trial_cost = trial_r.square().sum(-1) / 2
        # A rise within rounding counts as no rise: at the minimum neighbouring costs are equal to rounding.
        better = trial_cost <= cost[active] * (1 + 4 * _EPS)
        size = torch.linalg.vector_norm(step, dim=-1)
        done = size <= tolerance * (1 + torch.linalg.vector_norm(here, dim=-1))
        done |= promised <= _EPS * cost[active]
        x[active] = torch.where(better[:, None], trial, here)
        cost[active] = torch.where(better, trial_cost, cost[active])
        r = torch.where(better[:, None], trial_r, r)
        if slope is not None and trial_slope is not None:
            slope = torch.where(better[:, None, None], trial_slope, slope)[~done]
        lam = torch.where(better, lam / 20, lam * 8).clamp(_DAMPING_FLOOR, _DAMPING_CEILING)
        converged[active] = done
        active, r, lam = active[~done], r[~done], lam[~done]
    converged = converged.reshape(lead)
    cost = cost.reshape(lead)
    return Solution(x.reshape(start.shape), cost, iterations, converged, _message(converged, cost, max_iterations))


def _damped_step(j: Tensor, r: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """j: `b x c x k`, r: `b x c`, lam: `b`; returns the step `b x k` and the decrease it promises, `b`."""
    c, k = j.shape[-2:]
    normal = j.mT @ j if k <= c else j @ j.mT
    scale = normal.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)  # a zero Jacobian gives a zero step
    damped = normal + torch.diag_embed((lam * scale)[:, None].expand(-1, normal.shape[-1]))
    gradient = (j.mT @ r[..., None])[..., 0]
    factor = torch.linalg.cholesky_ex(damped).L
    if k <= c:
        step = -torch.cholesky_solve(gradient[..., None], factor)[..., 0]
    else:
        step = -(j.mT @ torch.cholesky_solve(r[..., None], factor))[..., 0]
    promised = ((lam * scale) * step.square().sum(-1) - (step * gradient).sum(-1)) / 2
    return step, promised


def _message(converged: Tensor, cost: Tensor, max_iterations: int) -> str:
    failed = torch.nonzero(~converged)
    if len(failed) == 0:
        return ""
    first = tuple(int(i) for i in failed[0])
    why = f"did not settle in {max_iterations} steps"
    if not bool(torch.isfinite(cost[first])):
        why = "has a residual that is not finite at its start"
    where = f" (index {', '.join(map(str, first))})" if first else ""
    return f"{len(failed)} of {converged.numel()} problems failed; the first{where} {why}"
