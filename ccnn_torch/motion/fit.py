"""Fits of many sets of effects side by side: Gauss-Newton steps, then the evidence of the model linearised there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.evidence.marginal_likelihood import Fits, Grams, fit_sets, grams_of
from ccnn_torch.motion.library import Library, Variant
from ccnn_torch.motion.problem import Problem, Whitening

# Of a difference quotient, in plausible sizes.
_STEP = 1e-3
# Standard deviation of the numbers in plausible sizes while they are fitted; the evidence has scales of its own.
_WIDE = 10.0
_STEPS = 6
# Shares of a Gauss-Newton step that are tried, and what a step is damped by.
_SHARES = (1.0, 0.25)
_DAMPING, _LESS, _MORE = 1e-3, 0.2, 10.0
# Plausible sizes that a number moves at most in a step.
_FARTHEST = 5.0
# Simulated values that are held in memory at a time.
_VALUES = 3e7
# Half deviance for each value that a step must gain for another one to be made.
_GAINED = 1e-4


class Spec(NamedTuple):
    """A set of effects of one axis, and where its fit begins.

    Attributes:
        members: effects, ascending.
        theta: all numbers, `k`; those of other effects 0.
        active: places that are fitted, effect by effect.
        log_prior: of the variants.
        free: places of shapes that are refined beside them; what they cost is in the variants' prior.
    """

    members: tuple[int, ...]
    theta: Tensor
    active: tuple[tuple[int, ...], ...]
    log_prior: float
    free: tuple[int, ...] = ()

    @property
    def moved(self) -> tuple[int, ...]:
        return (*self.flat, *self.free)

    @property
    def flat(self) -> tuple[int, ...]:
        return tuple(j for group in self.active for j in group)

    @property
    def groups(self) -> list[Tensor]:
        """Columns of each effect among those of `flat`."""
        places = iter(range(len(self.flat)))
        return [torch.tensor([next(places) for _ in group]) for group in self.active]


class Fit(NamedTuple):
    """A fitted set of one axis.

    Attributes:
        spec: the set, with `theta` where the fit ended.
        log_evidence: of the linearised model.
        noise: variance of the whitened residual.
        covariance: of the active numbers in plausible sizes, `m x m`.
        rss: squares of the whitened residual.
        unseen: the same on runs that its numbers were not fitted to.
        left: mean square of the residual itself [rad^2 or m^2].
        grams: of the linearised model's whitened columns, in plausible sizes, and of `loose` after them.
    """

    spec: Spec
    log_evidence: float
    noise: float
    covariance: Tensor
    rss: float
    unseen: float
    left: float
    grams: Grams

    @property
    def members(self) -> tuple[int, ...]:
        return self.spec.members


def started(library: Library, spec: Spec, variant: Variant, axis: int) -> Spec:
    """The set with one effect more, which begins as its variant says."""
    theta = spec.theta.clone()
    theta[list(variant.active)] = variant.values[axis]
    if variant.held:
        theta[list(variant.held)] = variant.shapes[axis]
    both = sorted([*zip(spec.members, spec.active, strict=True), (variant.effect, variant.active)])
    return Spec(
        tuple(m for m, _ in both),
        theta,
        tuple(a for _, a in both),
        spec.log_prior + variant.log_prior,
        (*spec.free, *variant.free(library.held)),
    )


def fit_many(
    problem: Problem,
    whitening: Whitening,
    specs: Sequence[Sequence[Spec]],
    steps: int = _STEPS,
    chosen: Tensor | None = None,
    loose: Tensor | None = None,
) -> list[list[Fit]]:
    """Fit sets side by side.

    Args:
        problem: what is fitted.
        whitening: of the residual of each axis.
        specs: for each of `h` sets, one a joint, `n`.
        steps: Gauss-Newton steps.
        chosen: stretches that count; all when None.
        loose: whitened, what the nominal values of each axis may be off by, `n x k x v`; nothing when None.
    """
    wide = max((len(s.moved) for row in specs for s in row), default=0)
    judged = problem.data.judged if chosen is None else problem.data.judged[chosen]
    per = problem.followed.shape[0] * judged.numel() * (wide + 2)
    lot = max(int(_VALUES / per), 1)
    found: list[list[Fit]] = []
    for k in range(0, len(specs), lot):
        found += _fit_lot(problem, whitening, specs[k : k + lot], steps, chosen, loose)
    return found


def places_of(places: Sequence[Sequence[Sequence[int]]]) -> Tensor:
    """Places of the numbers of each axis of each set, `h x n x m`, padded with -1."""
    wide = max((len(own) for row in places for own in row), default=0)
    return torch.tensor([[[*own, *[-1] * (wide - len(own))] for own in row] for row in places], dtype=torch.int64)


def sensitivities(
    problem: Problem, whitening: Whitening, theta: Tensor, active: Tensor, chosen: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Whitened residuals and what the active numbers change in the positions.

    Args:
        theta: `h x n x k`.
        active: places, `h x n x m`, -1 = none.

    Returns:
        `n x h x v` and `n x h x m x v`, `v` values.
    """
    h, n, m = active.shape
    moved = theta[:, None].expand(h, m + 1, n, -1).clone()
    index = active.clamp_min(0).transpose(1, 2)
    step = torch.where(active >= 0, _STEP, 0.0).transpose(1, 2).to(theta.dtype)
    moved[:, 1:].scatter_add_(-1, index[..., None], step[..., None])
    residual = problem.residual(moved.flatten(0, 1), chosen)
    white = problem.whitened(residual, whitening, chosen).reshape(n, h, m + 1, -1)
    return white[:, :, 0], (white[:, :, :1] - white[:, :, 1:]) / _STEP


def _fit_lot(
    problem: Problem,
    whitening: Whitening,
    specs: Sequence[Sequence[Spec]],
    steps: int,
    chosen: Tensor | None,
    loose: Tensor | None,
) -> list[list[Fit]]:
    h, n = len(specs), len(specs[0])
    theta = torch.stack([torch.stack([s.theta for s in row]) for row in specs])
    wide = max(len(s.moved) for row in specs for s in row)
    active = places_of([[s.moved for s in row] for row in specs])
    safe, real = active.clamp_min(0), (active >= 0).to(theta.dtype)
    low, high = problem.library.bounds
    damping = torch.full((h, n), _DAMPING, dtype=theta.dtype)
    residual, columns = sensitivities(problem, whitening, theta, active, chosen)
    judged = problem.judged if chosen is None else problem.judged[chosen]
    values = float(judged.sum())
    for _ in range(steps if wide else 0):
        cost = _cost(residual, theta, values)
        noise = residual.square().sum(-1).mT / values
        gram = (columns @ columns.mT).transpose(0, 1) / noise[..., None, None].clamp_min(1e-300)
        push = (columns @ residual[..., None])[..., 0].transpose(0, 1) / noise[..., None].clamp_min(1e-300)
        own = theta.gather(-1, safe) * real
        push = push - own / _WIDE**2
        diagonal = gram.diagonal(dim1=-2, dim2=-1)
        inner = gram + torch.diag_embed(damping[..., None] * diagonal + 1 / _WIDE**2 + (1 - real))
        move = torch.linalg.solve(inner, push[..., None])[..., 0] * real
        move = move.clamp(-_FARTHEST, _FARTHEST)
        trials = torch.stack([theta.scatter_add(-1, safe, share * move).clamp(low, high) for share in _SHARES])
        left = problem.whitened(problem.residual(trials.flatten(0, 1), chosen), whitening, chosen)
        costs = _cost(left, trials.flatten(0, 1), values).reshape(len(_SHARES), h, n)
        best, which = costs.min(0)
        better = best < cost
        taken = trials.gather(0, which[None, ..., None].expand(1, *theta.shape))[0]
        theta = torch.where(better[..., None], taken, theta)
        damping = torch.where(better & (which == 0), damping * _LESS, damping * _MORE).clamp(1e-8, 1e8)
        residual, columns = sensitivities(problem, whitening, theta, active, chosen)
        if bool(((cost - best) < _GAINED * values).all()):
            break
    # Here, since the whitened residual does not tell it.
    plain = problem.pooled(problem.residual(theta, chosen))
    left = (plain.square() * judged).sum((-1, -2)) / values
    fold = problem.fold if chosen is None else problem.fold[chosen]
    fold = fold[:, None].expand(judged.shape).flatten()
    found = []
    for a, row in enumerate(specs):
        fits = []
        for b, spec in enumerate(row):
            mine = spec._replace(theta=theta[a, b])
            x = columns[b, a, : len(spec.flat)]
            beside = x[:0] if loose is None else loose[b]
            fits.append(_fit_of(mine, residual[b, a], x, values, float(left[a, b]), fold, beside))
        found.append(fits)
    return found


def _fit_of(spec: Spec, residual: Tensor, x: Tensor, values: float, left: float, fold: Tensor, loose: Tensor) -> Fit:
    """The evidence of the model linearised at `spec.theta`; residual `v`, columns `m x v`, fold of each value `v`."""
    y = residual + spec.theta[list(spec.flat)] @ x
    grams = grams_of(torch.cat([x, loose]).mT[:, None, :], y[:, None])._replace(values=values)
    fit = fit_sets(grams, [spec.groups], 0.0)
    m, evidence = len(x), float(fit.log_evidence[0])
    return Fit(
        spec,
        evidence if math.isfinite(evidence) else -math.inf,
        float(fit.noise[0]),
        fit.covariance[0, :m, :m],
        float(residual.square().sum()),
        squares_unseen(x, y, fit, spec.groups, fold),
        left,
        grams,
    )


def squares_unseen(x: Tensor, y: Tensor, fit: Fits, groups: Sequence[Tensor], fold: Tensor) -> float:
    """Squares that a linear model leaves of runs that it was not fitted to; its scales are those of all runs.

    Args:
        x, y: whitened columns, `m x v`, and what they explain, `v`.
        fit: to all runs.
        groups: of columns.
        fold: of each value, `v`.
    """
    size = torch.cat([x.new_zeros(0), *(fit.log_scale[0, g].expand(len(c)) for g, c in enumerate(groups))])
    ridge = torch.diag(torch.exp(-size) * fit.noise[0])
    if int(fold.max()) == 0:
        return float((y - fit.mean[0, : len(x)] @ x).square().sum())
    parts = [(x[:, fold == f], y[fold == f]) for f in range(int(fold.max()) + 1)]
    whole, along = x @ x.mT + ridge, x @ y
    means = [torch.linalg.solve(whole - a @ a.mT, along - a @ b) for a, b in parts]
    return sum(float((b - mean @ a).square().sum()) for mean, (a, b) in zip(means, parts, strict=True))


def _cost(residual: Tensor, theta: Tensor, values: float) -> Tensor:
    """Half the deviance, `h x n`; residual `n x h x v`, theta `h x n x k`."""
    rss = residual.square().sum(-1).mT
    return 0.5 * values * torch.log(rss.clamp_min(1e-300)) + 0.5 * theta.square().sum(-1) / _WIDE**2
