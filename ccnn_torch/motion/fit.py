"""Fits of many sets of effects side by side: Gauss-Newton steps, then the evidence of the model linearised there; and
noise with the form errors of effects and of the nominal model in it, under which sets are weighed again."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.evidence.dictionary import CERTAIN
from ccnn_torch.evidence.form_error import DIRECTIONS, OF_EXACT, OF_FORM, form_variance
from ccnn_torch.evidence.marginal_likelihood import JITTER, Fits, Grams, fit_sets, scaled
from ccnn_torch.motion.descent import Point, descended, lots, padded, renew, sensitivities
from ccnn_torch.motion.effects import EXACT
from ccnn_torch.motion.known import VALUE
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.spec import Fit, Spec
from ccnn_torch.motion.whiten import Whitening

_STEPS = 6
# Sets come near the best one that leave at most so many times its squares.
_NEAR = 1.05
# Share of what an effect does in one run from which the others hardly tell its numbers, and from which not at all.
_ONCE, ALONE = 0.9, 0.99
# Share φ of what the nominal model makes of the command: as of an effect, but most of it is right.
_OF_NOMINAL = 1e-5


def fit_many(
    problem: Problem,
    whitening: Whitening,
    specs: Sequence[tuple[int, Spec]],
    steps: int = _STEPS,
    nuisance: Tensor | None = None,
    reached: Tensor | None = None,
) -> list[Fit]:
    """Fit sets side by side.

    Args:
        problem: what is fitted.
        whitening: of the residual of each axis.
        specs: the axis and the set of each fit.
        steps: how often columns are simulated at most.
        nuisance: whitened, what the nominal values of each axis may be off by, `n x k x v`; nothing when None.
        reached: squares that the best set of each axis leaves, whitened, `n`: of sets that come nowhere near, columns
            are simulated half as often. None = no set is known.
    """
    found: list[Fit] = []
    for lot in lots(problem, specs):
        found += _fit_lot(problem, whitening, lot, steps, nuisance, reached)
    return found


def _fit_lot(
    problem: Problem,
    whitening: Whitening,
    specs: Sequence[tuple[int, Spec]],
    steps: int,
    nuisance: Tensor | None,
    reached: Tensor | None,
) -> list[Fit]:
    axis, places = torch.tensor([i for i, _ in specs]), [s.moved for _, s in specs]
    theta = torch.stack([s.theta for _, s in specs])
    judged, values = problem.judged, problem.values
    goal = torch.full_like(theta[:, 0], math.inf) if reached is None else _NEAR * reached[axis]
    begin = Point(theta, *sensitivities(problem, whitening, theta, axis, places))
    point, is_exact, settled = descended(problem, whitening, begin, axis, places, steps, values, goal)
    renew(problem, whitening, point, axis, places, (~is_exact).nonzero()[:, 0])
    # Here, since the whitened residual does not tell it.
    plain = problem.pooled(problem.residual(point.theta, axis))
    left = (plain.square() * judged).sum((-1, -2)) / values
    folds = [own[:, None].expand(judged.shape).flatten() for own in (problem.fold, problem.part)]
    ended = [spec._replace(theta=now) for (_, spec), now in zip(specs, point.theta, strict=True)]
    beside = theta.new_zeros(len(specs), 0, point.residual.shape[1]) if nuisance is None else nuisance[axis]
    found = _fits_of(ended, point.residual, point.columns, values, left.tolist(), folds, beside)
    return [fit._replace(settled=end) for fit, end in zip(found, settled.tolist(), strict=True)]


def _fits_of(
    specs: Sequence[Spec],
    residual: Tensor,
    columns: Tensor,
    values: float,
    left: Sequence[float],
    folds: Sequence[Tensor],
    nuisance: Tensor,
) -> list[Fit]:
    """The evidence of models linearised at the `theta` of their sets.

    What a linear model would take of the residual beyond that counts as left: the fit has tried that, and found a bound
    there, or that the model is not linear so far.

    Args:
        specs: `p` sets.
        residual, columns, nuisance: whitened, `p x v`, `p x m x v` and `p x k x v`.
        values: how many count.
        left: mean square of the residual itself.
        folds: of each value, `v`: whole runs, and parts of them.
    """
    places, real = padded([spec.flat for spec in specs])
    x = columns[:, : places.shape[1]] * real[..., None]
    own = torch.stack([spec.theta for spec in specs]).gather(-1, places) * real
    groups = [spec.groups for spec in specs]
    shares = [
        max((_in_one(t[g] @ c[g], folds[0]) for g in of_set), default=0.0)
        for t, c, of_set in zip(own, x, groups, strict=True)
    ]
    # Runs of one stretch each have no parts.
    once = shares if int(folds[1].max()) > 0 else [0.0] * len(specs)
    inner = x @ x.mT
    least = 1 - real + JITTER * inner.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True).clamp_min(1.0)
    more = torch.linalg.solve(inner + torch.diag_embed(least), x @ residual[..., None])
    promised = (more.mT @ x)[:, 0]
    y = residual - promised + (own[:, None] @ x)[:, 0]
    grams, beside = products(nuisance, x, y, values), nuisance.shape[1]
    grams = grams._replace(yy=grams.yy + promised.square().sum(-1))
    found = weighed(grams, beside, groups, None)
    unseen = y.new_zeros(len(specs))
    for within, fold in enumerate(folds):
        those = torch.tensor([k for k, share in enumerate(once) if (share > _ONCE) == within], dtype=torch.int64)
        if len(those):
            some = Fits(*(value[those] for value in found))
            unseen[those] = promised[those].square().sum(-1) + squares_unseen(x[those], y[those], some, fold)
    return [
        Fit(
            spec,
            evidence if math.isfinite(evidence) else -math.inf,
            noise,
            found.covariance[k, :m, :m],
            rss,
            held,
            once[k],
            left[k],
            Grams(grams.xx[k, : beside + m, : beside + m], grams.xy[k, : beside + m], grams.yy[k], values),
            False,
        )
        for k, (spec, m, evidence, noise, rss, held) in enumerate(
            zip(
                specs,
                [len(spec.flat) for spec in specs],
                *(v.tolist() for v in (found.log_evidence, found.noise, residual.square().sum(-1), unseen)),
                strict=True,
            )
        )
    ]


def products(nuisance: Tensor, x: Tensor, y: Tensor, values: float) -> Grams:
    """Inner products of what nominal values may be off by, `… k x v`, and after them of columns, `… m x v`.

    y: what they explain, `… v`; values: how many of it count. All are whitened.
    """
    both = torch.cat([nuisance, x], -2)
    return Grams(both @ both.mT, (both @ y[..., None])[..., 0], y.square().sum(-1), values)


def _in_one(does: Tensor, fold: Tensor) -> float:
    """Share of what an effect does, `v`, in the fold where it does most; 0 of nothing, and where there is one fold."""
    squares = does.new_zeros(int(fold.max()) + 1).index_add(0, fold, does.square())
    return float(squares.max() / squares.sum().clamp_min(1e-300)) if len(squares) > 1 else 0.0


def squares_unseen(x: Tensor, y: Tensor, fit: Fits, fold: Tensor) -> Tensor:
    """Squares that linear models leave of runs that they were not fitted to, `p`; their scales are those of all runs.

    Args:
        x, y: whitened columns, `p x m x v`, and what they explain, `p x v`.
        fit: to all runs.
        fold: of each value, `v`.
    """
    scale = fit.scale[:, : x.shape[1]]
    ridge = torch.where(scale > 0, fit.noise[:, None] / scale.square(), 1.0)
    if int(fold.max()) == 0:
        return (y - (fit.mean[:, None, : x.shape[1]] @ x)[:, 0]).square().sum(-1)
    whole, along, found = x @ x.mT + torch.diag_embed(ridge), x @ y[..., None], torch.zeros_like(y[:, 0])
    for f in range(int(fold.max()) + 1):
        a, b = x[..., fold == f], y[:, fold == f]
        mean = torch.linalg.solve(whole - a @ a.mT, along - a @ b[..., None])
        found += (b - (mean.mT @ a)[:, 0]).square().sum(-1)
    return found


def form_errors(
    problem: Problem, whitening: Whitening, nuisance: Tensor, best: Sequence[Sequence[Fit]], least: Sequence[float]
) -> list[float]:
    """Variance in every direction by which the forms of each axis' set and of the nominal model may be wrong.

    Args:
        problem: the data.
        whitening: of the residual.
        nuisance: as of `fit_many`.
        best: sets of each axis, none of which is clearly the best: the one whose forms are known best counts.
        least: the variance of each axis is at least that.
    """
    # The form of a model is known the better, the better its least known value is.
    nominal = _OF_NOMINAL * min(max(problem.unsure.values(), default=VALUE) / VALUE, 1.0) ** 2
    command, names = problem.data.command, problem.library.names
    does, most = (
        problem.whitened(v - command, problem.axes, whitening).square().sum(-1).tolist()
        for v in (problem.positions(problem.nothing, problem.axes), problem.data.position)
    )

    def of_set(axis: int, fit: Fit) -> float:
        shares = [OF_EXACT if names[m] in EXACT else OF_FORM for m in fit.members]
        energy = weighed(fit.grams, nuisance.shape[1], [fit.spec.groups], None).energy[0].tolist()[: len(shares)]
        return form_variance([*shares, nominal], [*energy, does[axis]], max(most[axis], does[axis]))

    return [max(min(of_set(i, fit) for fit in own), least[i]) for i, own in enumerate(best)]


def weighed(grams: Grams, beside: int, sets: Sequence[Sequence[Tensor]], variance: float | None) -> Fits:
    """Sets under a noise that is known, or that each leaves.

    Args:
        grams: of `products`, of all sets or of each.
        beside: how many of its columns, the first ones, nominal values may be off by, with coefficients of standard
            deviation 1: they add to the noise.
        sets: of groups of the other columns.
        variance: of the noise; None = what each set leaves, nominal values being exact.
    """
    own = Grams(grams.xx[..., beside:, beside:], grams.xy[..., beside:], grams.yy, grams.values)
    if variance is None:
        return fit_sets(own, sets, 0.0)
    own, across = scaled(own, variance), torch.cat([grams.xx[..., :beside, beside:], grams.xy[..., :beside, None]], -1)
    inner = grams.xx[..., :beside, :beside] / variance + torch.eye(beside, dtype=across.dtype)
    taken = across.mT @ torch.linalg.solve(inner, across) / variance**2
    own = Grams(own.xx - taken[..., :-1, :-1], own.xy - taken[..., :-1, -1], own.yy - taken[..., -1, -1], own.values)
    return fit_sets(own, sets, CERTAIN * own.values)


def side_by_side(each: Sequence[Grams]) -> Grams:
    """Inner products of `p` models as those of one batch, padded with 0 to the widest."""
    widest = max(len(own.xy) for own in each)

    def wide(values: Tensor) -> Tensor:
        return torch.nn.functional.pad(values, (0, widest - values.shape[-1]) * values.dim())

    xx, xy = (torch.stack([wide(v) for v in own]) for own in ([g.xx for g in each], [g.xy for g in each]))
    return Grams(xx, xy, torch.stack([own.yy for own in each]), each[0].values)


def deviations(fits: Sequence[Fit], beside: int, variances: Sequence[float]) -> list[Tensor]:
    """Standard deviations of the numbers of sets, `m` plausible sizes each, under noises that hold form errors too."""
    each = [
        weighed(fit.grams, beside, [fit.spec.groups], max(variance, fit.noise)).covariance[0]
        for fit, variance in zip(fits, variances, strict=True)
    ]
    return [own.diagonal().clamp_min(0).sqrt() for own in each]


def unseen_errors(found: Sequence[Sequence[Fit]]) -> list[float]:
    """Variance in every direction by which the best of each axis' sets is worse on runs that it was not fitted to."""
    return [max(min(f.unseen for f in own) - min(f.rss for f in own), 0.0) / DIRECTIONS for own in found]
