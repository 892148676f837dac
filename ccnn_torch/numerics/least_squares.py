"""Batched damped least squares (Levenberg 1944, Marquardt 1963): many small problems side by side in one call."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.numerics.trees import chosen, picked

_EPS = torch.finfo(torch.float64).eps
_DAMPING_FLOOR, _DAMPING_CEILING = 1e-15, 1e15
# Numbers in the copies of a point below which one backward pass through all of them beats a pass for each output.
_SMALL = 20_000


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
    function: Callable[[Tensor], Tensor],
    point: Tensor,
    combined: Callable[[Tensor], Tensor] | None = None,
    copies: int = 1,
) -> tuple[Tensor, Tensor]:
    """Value and Jacobian of a function that treats its leading dims independently.

    One backward pass per output, or one double-backward pass (the transpose of the transpose) per input, whichever is
    fewer. Not torch's forward mode: that compiles a set of decompositions with the deprecated `torch.jit.script` when
    first used, and takes about twice as long here. Nor `torch.func.vjp`: that loads torch's compiler, a second.

    Args:
        function: `... x k` -> `... x c`.
        point: `... x k`.
        combined: of the value, which combinations of the outputs are asked for, `... x r x c`; None = each output.
        copies: `c` or `r`, where the function takes one more leading dim. Few small rows then go through one backward
            pass, in a copy for each output: there the time goes with the number of operations.

    Returns:
        value `... x c` and Jacobian `... x c x k`, or that of the combinations, `... x r x k`.
    """
    with torch.enable_grad():
        lead = (copies,) if copies > 1 and copies * point.numel() <= _SMALL else ()
        point = point.detach().expand(*lead, *point.shape).clone().requires_grad_()
        value = function(point)
        c, k = value.shape[-1], point.shape[-1]
        first = value.expand(*point.shape[:-1], c)[0].detach() if lead else value.detach()
        outputs = torch.eye(c, dtype=value.dtype, device=value.device)
        outputs = outputs if combined is None else combined(first)
        if lead:
            each = outputs.expand(*first.shape[:-1], -1, -1).movedim(-2, 0)
            return first, _pulled(value, point, each).movedim(0, -2)
        if outputs.shape[-2] <= 2 * k:
            rows = [_pulled(value, point, e.expand_as(value)) for e in outputs.unbind(-2)]
            return first, torch.stack(rows, dim=-2) if rows else value.new_zeros(*value.shape, k)
        cotangent = torch.zeros_like(value, requires_grad=True)
        pulled = _pulled(value, point, cotangent, create_graph=True)
        columns = [
            _pulled(pulled, cotangent, e.expand_as(point)) for e in torch.eye(k, dtype=point.dtype, device=point.device)
        ]
        slope = torch.stack(columns, dim=-1)
        return first, slope if combined is None else outputs @ slope


def _pulled(value: Tensor, point: Tensor, cotangent: Tensor, create_graph: bool = False) -> Tensor:
    """Derivative of the sum of `cotangent` times `value` by `point`, like `point`."""
    if not value.requires_grad:
        return torch.zeros_like(point)
    # Of a sum: given the cotangent apart, torch loads its compiler's algebra to compare two shapes.
    total = (value * cotangent).sum()
    return torch.autograd.grad(total, point, retain_graph=True, create_graph=create_graph, materialize_grads=True)[0]


class Trial(NamedTuple):
    """A step that was not evaluated yet, of the `b` problems still searched.

    Attributes:
        problem: which problems these are, `b`, int64.
        point, cost: where they are, `b x k` and `b`.
        step: `b x k`.
        promised: fall of the cost that the linear model promises, `b`.
        before: what it promised for the last step, `b`; 0 where that was refused, and for the first.
        damping: `b`.
    """

    problem: Tensor
    point: Tensor
    cost: Tensor
    step: Tensor
    promised: Tensor
    before: Tensor
    damping: Tensor


class Descent(NamedTuple):
    """Where `descend` ended.

    Attributes:
        value: `b x k`.
        cost: `b`.
        converged: `b`, bool.
        iterations: steps tried by the slowest problem.
        evaluations: points evaluated, of all problems together, starts included.
    """

    value: Tensor
    cost: Tensor
    converged: Tensor
    iterations: int
    evaluations: int


def descend(
    evaluate: Callable[[Tensor, Tensor], tuple[Tensor, ...]],
    step_of: Callable[..., tuple[Tensor, Tensor]],
    settled: Callable[[Trial], Tensor],
    start: Tensor,
    *,
    damping: float,
    max_iterations: int,
    trusting: bool = False,
) -> Descent:
    """Damped Gauss-Newton steps of many problems side by side, each with its own damping λ.

    A trial with a worse or non-finite cost is refused and λ grows, which keeps the path inside the domain.

    Args:
        evaluate: points `b x k` and the problems that they are of -> cost `b` and the tensors of the linear model
            there, `b x …` each.
        step_of: those tensors and λ, `b` -> step `b x k` and the fall of the cost that it promises, `b`.
        settled: which of the problems end with this step, `b`.
        start: `b x k`.
        damping: first λ.
        max_iterations: bound on the steps tried.
        trusting: whether the last step of a problem is taken without a look at its cost.

    Returns:
        Descent; a problem whose cost is not finite at its start stays there.
    """
    x = start.clone()
    cost, *model = evaluate(x, torch.arange(len(x), device=x.device))
    evaluations, iterations = len(x), 0
    converged = torch.zeros_like(cost, dtype=torch.bool)
    active = torch.nonzero(torch.isfinite(cost)).squeeze(-1)
    model = picked(model, active)
    lam = torch.full_like(cost[active], damping)
    before = torch.zeros_like(lam)
    while len(active) and iterations < max_iterations:
        iterations += 1
        here = x[active]
        step, promised = step_of(*model, lam)
        trial = here + step
        done = settled(Trial(active, here, cost[active], step, promised, before, lam))
        if trusting and bool(done.any()):
            last, left = active[done], ~done
            x[last], cost[last], converged[last] = trial[done], cost[last] - promised[done], True
            active, lam, promised, trial, done, model = picked((active, lam, promised, trial, done, model), left)
            if not len(active):
                break
        new_cost, *new_model = evaluate(trial, active)
        evaluations += len(active)
        # A rise within rounding counts as no rise: at the minimum neighbouring costs are equal to rounding.
        better = new_cost <= cost[active] * (1 + 4 * _EPS)
        x[active], cost[active], model = chosen(better, (trial, new_cost, new_model), (x[active], cost[active], model))
        converged[active] = done
        lam = torch.where(better, lam / 20, lam * 8).clamp(_DAMPING_FLOOR, _DAMPING_CEILING)
        before = torch.where(better, promised, 0.0)
        if bool(done.any()):
            active, lam, before, model = picked((active, lam, before, model), ~done)
    return Descent(x, cost, converged, iterations, evaluations)


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
    were.

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
            their work.

    Returns:
        Solution; no gradient flows through it.
    """
    lead, k = start.shape[:-1], start.shape[-1]
    count = math.prod(lead)
    begin = start.detach().reshape(count, k)
    rows = tuple(d.detach().expand(*lead, d.shape[-1]).reshape(count, d.shape[-1]) for d in data)

    def linearised(point: Tensor, *point_rows: Tensor) -> tuple[Tensor, Tensor]:
        if both is not None:
            return both(point, *point_rows)
        if jacobian is not None:
            return residual(point, *point_rows), jacobian(point, *point_rows)
        return jacobian_of(lambda p: residual(p, *point_rows), point)

    def evaluate(values: Tensor, active: Tensor) -> tuple[Tensor, ...]:
        if rows:
            value, slope = linearised(values, *(d[active] for d in rows))
        else:
            everything = begin.clone()
            everything[active] = values
            whole = linearised(everything.reshape(*lead, k))
            value, slope = (part.reshape(count, *part.shape[len(lead) :])[active] for part in whole)
        value, slope = value.detach(), slope.detach()
        return value.square().sum(-1) / 2, value, slope

    def settled(trial: Trial) -> Tensor:
        size, away = (torch.linalg.vector_norm(part, dim=-1) for part in (trial.step, trial.point))
        done: Tensor = (size <= tolerance * (1 + away)) | (trial.promised <= _EPS * trial.cost)
        return done

    found = descend(evaluate, _least_squares_step, settled, begin, damping=damping, max_iterations=max_iterations)
    converged, cost = found.converged.reshape(lead), found.cost.reshape(lead)
    message = failures(converged, cost, max_iterations)
    return Solution(found.value.reshape(start.shape), cost, found.iterations, converged, message)


def damped_step(matrix: Tensor, gradient: Tensor, ridge: Tensor) -> tuple[Tensor, Tensor]:
    """Solve (matrix + ridge I) s = -gradient.

    Args:
        matrix: `… x k x k`, positive semidefinite.
        gradient: `… x k`.
        ridge: `…`.

    Returns:
        The step `… x k` and the fall of the cost that it promises, `…`.
    """
    damped = matrix + torch.diag_embed(ridge[..., None].expand_as(gradient))
    step = -torch.cholesky_solve(gradient[..., None], torch.linalg.cholesky_ex(damped).L)[..., 0]
    return step, (step * (ridge[..., None] * step - gradient)).sum(-1) / 2


def _least_squares_step(r: Tensor, j: Tensor, lam: Tensor) -> tuple[Tensor, Tensor]:
    """r: `b x c`, j: `b x c x k`, lam: `b`; as `damped_step`."""
    c, k = j.shape[-2:]
    normal = j.mT @ j if k <= c else j @ j.mT
    ridge = lam * normal.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)  # a zero Jacobian gives a zero step
    gradient = (j.mT @ r[..., None])[..., 0]
    if k <= c:
        return damped_step(normal, gradient, ridge)
    step = (j.mT @ damped_step(normal, r, ridge)[0][..., None])[..., 0]
    return step, (step * (ridge[..., None] * step - gradient)).sum(-1) / 2


def failures(converged: Tensor, cost: Tensor, max_iterations: int, what: str = "problems") -> str:
    """One sentence on how many of a descent did not converge and why the first did not; empty where all did."""
    failed = torch.nonzero(~converged)
    if len(failed) == 0:
        return ""
    first = tuple(int(i) for i in failed[0])
    why = f"did not settle in {max_iterations} steps"
    if not bool(torch.isfinite(cost[first])):
        why = "has a residual that is not finite at its start"
    where = f", number {', '.join(str(i + 1) for i in first)}," if first else ""
    return f"{len(failed)} of {converged.numel()} {what} failed; the first{where} {why}"
