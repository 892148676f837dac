"""The linearised problem with Tikhonov's regularisation, its weight from the corner of the L-curve (Hansen 1992)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.identification.problems.problem import Fit, Problem, Progress, WeightedRows

# Weights tried, from the largest singular value down to this share of it.
_TRIED, _LEAST = 200, 1e-10


@dataclass(frozen=True)
class LCurve:
    """Residual against size of the change, of `r` machines and `w` regularisation weights.

    Attributes:
        weight: α, falling, `r x w` [1].
        misfit: |J du + residual|, `r x w` [1], rows of the priors included.
        size: |du| of the parameters in plausible errors, `r x w` [1].
        corner: index of the weight taken, `r`.
        step: du at the corner, `r x k`.
    """

    weight: Tensor
    misfit: Tensor
    size: Tensor
    corner: Tensor
    step: Tensor


def l_curve(problem: Problem, values: Tensor) -> LCurve:
    """Minimise |J du + residual|² + α² |du|² for a range of α, the parameters in plausible errors.

    The corner is where log size against log misfit bends most (Hansen and O'Leary 1993); all derivatives are exact.

    Args:
        problem: with or without priors, which are rows of J like others.
        values: where to linearise, `r x k` [SI].

    Raises:
        InputError: the residual is not finite there.
    """
    rows = WeightedRows(problem)
    residual, slope = rows.linearised(values)
    if rows.has_prior:
        pull = rows.pull.sqrt()
        residual = torch.cat([residual, pull * (values - problem.start) / problem.scale], dim=-1)
        slope = torch.cat([slope, torch.diag(pull).expand(len(values), -1, -1)], dim=-2)
    left, singular, right = torch.linalg.svd(slope, full_matrices=False)
    share = -(left.mT @ residual[..., None])[..., 0]
    beyond = (residual.square().sum(-1) - share.square().sum(-1)).clamp_min(0)
    exponents = torch.linspace(0, 1, _TRIED, dtype=values.dtype, device=values.device)
    weight = singular[:, :1] * _LEAST**exponents
    squared = singular[:, None].square()
    # Filter factors `r x w x k`: how much of each singular direction a weight lets through.
    passed = squared / (squared + weight[..., None].square()).clamp_min(1e-300)
    part = passed * (share / singular.clamp_min(1e-300))[:, None]
    size2 = part.square().sum(-1)
    misfit2 = beyond[:, None] + ((1 - passed) * share[:, None]).square().sum(-1)
    corner = _curvature(weight, passed, part, size2, misfit2).argmax(-1)
    pick = torch.arange(len(values), device=values.device), corner
    step = (part[pick][:, None] @ right)[:, 0]
    return LCurve(weight, misfit2.sqrt(), size2.sqrt(), corner, step)


def solve_tikhonov(problem: Problem, seed: int = 0, progress: Progress | None = None) -> Fit:
    """One regularised linear step from the start, as the regularisation methods of the literature take it.

    It is biased towards the start along what the rows hardly see, and the equations are not linear: it is here to
    compare with. The seed is not needed.

    Returns:
        Fit; `converged` where the residual at the new values is finite. Where it is not, the start is kept.

    Raises:
        InputError: the residual is not finite at the start.
    """
    curve = l_curve(problem, problem.start)
    values = problem.start + problem.scale * curve.step
    rows = WeightedRows(problem)
    everyone = torch.arange(len(values), device=values.device)
    cost = rows.cost(values[:, None], everyone)[:, 0]
    within = torch.isfinite(cost)
    values = torch.where(within[:, None], values, problem.start)
    cost = torch.where(within, cost, rows.cost(problem.start[:, None], everyone)[:, 0])
    if progress is not None:
        progress(1.0)
    message = ""
    if not bool(within.all()):
        first = int(torch.nonzero(~within)[0]) + 1
        lost = int((~within).sum())
        message = f"{lost} of {len(within)} machines: the step leads out of reach; the first is number {first}"
    return Fit(values, cost, within, 2 * len(values), message)


def _curvature(weight: Tensor, passed: Tensor, part: Tensor, size2: Tensor, misfit2: Tensor) -> Tensor:
    """Of (log misfit, log size) along the weights, `r x w`; -inf where there is nothing to take the logarithm of."""
    eta, rho = size2.clamp_min(1e-300), misfit2.clamp_min(1e-300)
    # d(size²)/dα, and d(misfit²)/dα = -α² d(size²)/dα (Hansen 1998, section 4.6).
    slope = -4 / weight * ((1 - passed) * part.square()).sum(-1)
    bend = -2 * eta * rho / slope.clamp_max(-1e-300)
    top = weight.square() * slope * rho + 2 * weight * eta * rho + weight**4 * eta * slope
    value = bend * top / (weight**4 * eta.square() + rho.square()).pow(1.5)
    known = (slope < -1e-290) & (misfit2 > 0) & torch.isfinite(value)
    return torch.where(known, value, -torch.inf)
