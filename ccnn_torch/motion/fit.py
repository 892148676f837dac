"""Fits of many sets of effects side by side: Gauss-Newton steps, then the evidence of the model linearised there; and
noise with the form errors of effects and of the nominal model in it, under which sets are weighed again."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.evidence.dictionary import CERTAIN
from ccnn_torch.evidence.form_error import DIRECTIONS, OF_EXACT, OF_FORM, form_variance
from ccnn_torch.evidence.marginal_likelihood import Fits, Grams, fit_sets, grams_of, scaled
from ccnn_torch.evidence.priors import WIDE
from ccnn_torch.motion.effects import EXACT
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.spec import Fit, Spec
from ccnn_torch.motion.whiten import Whitening

# Of a difference quotient, in plausible sizes.
_STEP = 1e-3
_STEPS = 6
# Shares of a Gauss-Newton step that are tried, and what a step is damped by.
_SHARES = (1.0, 0.25)
_DAMPING, _LESS, _MORE = 1e-3, 0.2, 10.0
# A set whose step fails at this damping has ended.
_STIFF = 10.0
# Plausible sizes that a number moves at most in a step.
_FARTHEST = 5.0
# Simulated values that are held in memory at a time.
_VALUES = 3e7
# Half deviance for each value that a step must gain for another one to be made.
_GAINED = 1e-4
# Share of what an effect does in one run from which the others hardly tell its numbers, and from which not at all.
_ONCE, ALONE = 0.9, 0.99
# Share φ of what the nominal model makes of the command: as of an effect, but most of it is right.
_OF_NOMINAL = 1e-5


def fit_many(
    problem: Problem,
    whitening: Whitening,
    specs: Sequence[tuple[int, Spec]],
    steps: int = _STEPS,
    chosen: Tensor | None = None,
    nuisance: Tensor | None = None,
) -> list[Fit]:
    """Fit sets side by side.

    Args:
        problem: what is fitted.
        whitening: of the residual of each axis.
        specs: the axis and the set of each fit.
        steps: Gauss-Newton steps.
        chosen: stretches that count; all when None.
        nuisance: whitened, what the nominal values of each axis may be off by, `n x k x v`; nothing when None.
    """
    judged = problem.data.judged if chosen is None else problem.data.judged[chosen]
    found: list[Fit] = []
    lot: list[tuple[int, Spec]] = []
    for k, (axis, spec) in enumerate(specs):
        lot.append((axis, spec))
        simulated = sum(len(one.moved) + 2 for _, one in lot) * judged.numel()
        if simulated > _VALUES or k == len(specs) - 1:
            found += _fit_lot(problem, whitening, lot, steps, chosen, nuisance)
            lot = []
    return found


def sensitivities(
    problem: Problem,
    whitening: Whitening,
    theta: Tensor,
    axis: Tensor,
    places: Sequence[Sequence[int]],
    chosen: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Whitened residuals and what numbers change in the positions.

    Args:
        theta: `p x k`.
        axis: of each row, `p`.
        places: of the numbers of each row.

    Returns:
        `p x v` and `p x m x v`, `v` values; beyond a row's own numbers 0.
    """
    counts = torch.tensor([len(own) for own in places], dtype=torch.int64)
    # One row for every number that is moved, after those where none is.
    which = torch.repeat_interleave(torch.arange(len(places)), counts)
    moved = theta[which]
    if len(which):
        moved[torch.arange(len(which)), torch.tensor([j for own in places for j in own])] += _STEP
    both = torch.cat([axis, axis[which]])
    residual = problem.residual(torch.cat([theta, moved]), both, chosen)
    white = problem.whitened(residual, both, whitening, chosen)
    base, changed = white[: len(theta)], white[len(theta) :]
    columns = white.new_zeros(len(theta), int(counts.max()) if len(counts) else 0, white.shape[1])
    if len(which):
        column = torch.cat([torch.arange(int(c)) for c in counts])
        columns[which, column] = (base[which] - changed) / _STEP
    return base, columns


def _fit_lot(
    problem: Problem,
    whitening: Whitening,
    specs: Sequence[tuple[int, Spec]],
    steps: int,
    chosen: Tensor | None,
    nuisance: Tensor | None,
) -> list[Fit]:
    axis = torch.tensor([i for i, _ in specs])
    theta = torch.stack([s.theta for _, s in specs])
    places = [s.moved for _, s in specs]
    low, high = problem.library.bounds
    damping = torch.full((len(specs),), _DAMPING, dtype=theta.dtype)
    residual, columns = sensitivities(problem, whitening, theta, axis, places, chosen)
    judged = problem.judged if chosen is None else problem.judged[chosen]
    values = float(judged.sum())
    # Those whose last step gained something, or whose next one may be shorter.
    run = torch.tensor([k for k, own in enumerate(places) if own], dtype=torch.int64)
    for _ in range(steps):
        if not len(run):
            break
        active, real = _padded([places[k] for k in run.tolist()])
        x, y = columns[run, : active.shape[1]], residual[run]
        cost = _cost(y, theta[run], values)
        own = theta[run].gather(-1, active)
        move = _step(x, y, own * real, real, damping[run], values)
        most, least = (bound[axis[run]].gather(-1, active) for bound in (high, low))
        taken = [torch.maximum(torch.minimum(own + share * move, most), least) - own for share in _SHARES]
        trials = torch.stack([theta[run].scatter_add(-1, active, real * step) for step in taken])
        both = axis[run].repeat(len(_SHARES))
        left = problem.whitened(problem.residual(trials.flatten(0, 1), both, chosen), both, whitening, chosen)
        best, which = _cost(left, trials.flatten(0, 1), values).reshape(len(_SHARES), -1).min(0)
        better = best < cost
        theta[run[better]] = trials[which[better], better.nonzero()[:, 0]]
        damping[run] = torch.where(better & (which == 0), damping[run] * _LESS, damping[run] * _MORE).clamp(1e-8, 1e8)
        moved = run[better]
        if len(moved):
            residual[moved], new = sensitivities(
                problem, whitening, theta[moved], axis[moved], [places[k] for k in moved.tolist()], chosen
            )
            columns[moved, : new.shape[1]] = new
        gained = torch.where(better, cost - best, 0.0) >= _GAINED * values
        run = run[gained | (~better & (damping[run] < _STIFF))]
    # Here, since the whitened residual does not tell it.
    plain = problem.pooled(problem.residual(theta, axis, chosen))
    left = (plain.square() * judged).sum((-1, -2)) / values
    folds = [
        (own if chosen is None else own[chosen])[:, None].expand(judged.shape).flatten()
        for own in (problem.fold, problem.part)
    ]
    ended = [spec._replace(theta=now) for (_, spec), now in zip(specs, theta, strict=True)]
    beside = residual.new_zeros(len(specs), 0, residual.shape[1]) if nuisance is None else nuisance[axis]
    return _fits_of(ended, residual, columns, values, left.tolist(), folds, beside)


def _padded(places: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor]:
    """Places of the numbers of each row, `p x m`, padded with 0, and 1 where there is one, else 0."""
    wide = max(map(len, places))
    active = torch.tensor([[*own, *[0] * (wide - len(own))] for own in places])
    real = torch.tensor([[k < len(own) for k in range(wide)] for own in places])
    return active, real.double()


def _step(x: Tensor, y: Tensor, own: Tensor, real: Tensor, damping: Tensor, values: float) -> Tensor:
    """Damped Gauss-Newton steps, `p x m`.

    Args:
        x, y: columns `p x m x v` and residuals `p x v`.
        own: the numbers, `p x m`.
        real: 1 where there is a number, else 0.
        damping: share of the diagonal, `p`.
        values: how many count.
    """
    noise = (y.square().sum(-1) / values).clamp_min(1e-300)[:, None]
    gram, push = (x @ x.mT) / noise[..., None], (x @ y[..., None])[..., 0] / noise - own / WIDE**2
    diagonal = gram.diagonal(dim1=-2, dim2=-1)
    inner = gram + torch.diag_embed(damping[:, None] * diagonal + 1 / WIDE**2 + (1 - real))
    move: Tensor = torch.linalg.solve(inner, push[..., None])[..., 0] * real
    return move.clamp(-_FARTHEST, _FARTHEST)


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

    Args:
        specs: `p` sets.
        residual, columns, nuisance: whitened, `p x v`, `p x m x v` and `p x k x v`.
        values: how many count.
        left: mean square of the residual itself.
        folds: of each value, `v`: whole runs, and parts of them.
    """
    places, real = _padded([spec.flat for spec in specs])
    x = columns[:, : places.shape[1]] * real[..., None]
    own = torch.stack([spec.theta for spec in specs]).gather(-1, places) * real
    groups = [spec.groups for spec in specs]
    shares = [
        max((_in_one(t[g] @ c[g], folds[0]) for g in of_set), default=0.0)
        for t, c, of_set in zip(own, x, groups, strict=True)
    ]
    # Runs of one stretch each have no parts.
    once = shares if int(folds[1].max()) > 0 else [0.0] * len(specs)
    y = residual + (own[:, None] @ x)[:, 0]
    both = torch.cat([x, nuisance], 1)
    grams = Grams(both @ both.mT, (both @ y[..., None])[..., 0], y.square().sum(-1), values)
    found = fit_sets(grams, groups, 0.0)
    unseen = y.new_zeros(len(specs))
    for within, fold in enumerate(folds):
        those = torch.tensor([k for k, share in enumerate(once) if (share > _ONCE) == within], dtype=torch.int64)
        if len(those):
            some = Fits(*(value[those] for value in found))
            unseen[those] = squares_unseen(x[those], y[those], some, [groups[k] for k in those.tolist()], fold)
    counts, beside = [len(spec.flat) for spec in specs], torch.arange(x.shape[1], both.shape[1])
    kept = [torch.cat([torch.arange(m), beside]) for m in counts]
    return [
        Fit(
            spec,
            evidence if math.isfinite(evidence) else -math.inf,
            float(found.noise[k]),
            found.covariance[k, : counts[k], : counts[k]],
            float(residual[k].square().sum()),
            float(unseen[k]),
            once[k],
            left[k],
            Grams(grams.xx[k][at[:, None], at], grams.xy[k, at], grams.yy[k], values),
        )
        for k, (spec, evidence, at) in enumerate(zip(specs, found.log_evidence.tolist(), kept, strict=True))
    ]


def products(x: Tensor, nuisance: Tensor, y: Tensor, values: float) -> Grams:
    """Inner products of whitened columns, `m x v`, and after them of what nominal values may be off by, `k x v`.

    y: what they explain, `v`; values: how many of it count.
    """
    return grams_of(torch.cat([x, nuisance]).mT[:, None, :], y[:, None])._replace(values=values)


def _in_one(does: Tensor, fold: Tensor) -> float:
    """Share of what an effect does, `v`, in the fold where it does most; 0 of nothing, and where there is one fold."""
    squares = does.new_zeros(int(fold.max()) + 1).index_add(0, fold, does.square())
    return float(squares.max() / squares.sum().clamp_min(1e-300)) if len(squares) > 1 else 0.0


def squares_unseen(x: Tensor, y: Tensor, fit: Fits, groups: Sequence[Sequence[Tensor]], fold: Tensor) -> Tensor:
    """Squares that linear models leave of runs that they were not fitted to, `p`; their scales are those of all runs.

    Args:
        x, y: whitened columns, `p x m x v`, and what they explain, `p x v`.
        fit: to all runs.
        groups: of each model's columns.
        fold: of each value, `v`.
    """
    ridge = torch.ones_like(x[..., 0])
    for k, own in enumerate(groups):
        for g, columns in enumerate(own):
            ridge[k, columns] = torch.exp(-fit.log_scale[k, g]) * fit.noise[k]
    if int(fold.max()) == 0:
        return (y - (fit.mean[:, None, : x.shape[1]] @ x)[:, 0]).square().sum(-1)
    whole, along, found = x @ x.mT + torch.diag_embed(ridge), x @ y[..., None], torch.zeros_like(y[:, 0])
    for f in range(int(fold.max()) + 1):
        a, b = x[..., fold == f], y[:, fold == f]
        mean = torch.linalg.solve(whole - a @ a.mT, along - a @ b[..., None])
        found += (b - (mean.mT @ a)[:, 0]).square().sum(-1)
    return found


def _cost(residual: Tensor, theta: Tensor, values: float) -> Tensor:
    """Half the deviance, `p`; residual `p x v`, theta `p x k`."""
    rss = residual.square().sum(-1)
    return 0.5 * values * torch.log(rss.clamp_min(1e-300)) + 0.5 * theta.square().sum(-1) / WIDE**2


def form_errors(problem: Problem, whitening: Whitening, best: list[Fit], least: Sequence[float]) -> list[float]:
    """Variance in every direction by which the forms of each axis' set and of the nominal model may be wrong.

    Args:
        problem: the data.
        whitening: of the residual.
        best: a set of each axis.
        least: the variance of each axis is at least that.
    """
    theta = torch.zeros(len(best), problem.library.size, dtype=torch.float64)
    # Of a model each of whose values was told how well it is known, that is all that it may be off by.
    is_told = problem.unsure and problem.unsure.keys() <= problem.known.keys()
    nominal = 0.0 if is_told else _OF_NOMINAL
    command, names = problem.data.command, problem.library.names
    does, most = (
        problem.whitened(v - command, problem.axes, whitening).square().sum(-1).tolist()
        for v in (problem.positions(theta, problem.axes), problem.data.position)
    )
    found = []
    for i, fit in enumerate(best):
        shares = [OF_EXACT if names[m] in EXACT else OF_FORM for m in fit.members]
        energy = fit_sets(fit.grams, [fit.spec.groups], 0.0).energy[0].tolist()[: len(shares)]
        form = form_variance([*shares, nominal], [*energy, does[i]], max(most[i], does[i]))
        found.append(max(form, least[i]))
    return found


def weighed(grams: Grams, sets: Sequence[Sequence[Tensor]], columns: int, variance: float | None) -> Fits:
    """Sets under a noise that is known, or that each leaves.

    Args:
        grams: of the columns, and after them of those by which the nominal values may be off, coefficients of standard
            deviation 1: they add to the noise.
        sets: of groups of columns.
        columns: how many are fitted.
        variance: of the noise; None = what each set leaves, nominal values being exact.
    """
    if variance is None:
        return fit_sets(grams, sets, 0.0)
    return fit_sets(_under_noise(grams, columns, variance), sets, CERTAIN * grams.values)


def evidences(models: Sequence[tuple[Grams, Sequence[Tensor]]], variance: float) -> list[float]:
    """Log evidence of models that have columns of their own, all at once.

    Args:
        models: inner products as `weighed` takes them, and the groups of the columns that are fitted.
        variance: of the noise.
    """
    apart = [_under_noise(grams, sum(map(len, groups)), variance) for grams, groups in models]
    widest = max(len(own.xy) for own in apart)

    def wide(values: Tensor) -> Tensor:
        return torch.nn.functional.pad(values, (0, widest - values.shape[-1]) * values.dim())

    grams = Grams(
        torch.stack([wide(own.xx) for own in apart]),
        torch.stack([wide(own.xy) for own in apart]),
        torch.stack([own.yy for own in apart]),
        apart[0].values,
    )
    found: list[float] = fit_sets(grams, [groups for _, groups in models], CERTAIN * grams.values).log_evidence.tolist()
    return found


def _under_noise(grams: Grams, columns: int, variance: float) -> Grams:
    """Of the columns that are fitted alone, in units of a noise to which the others add."""
    g = scaled(grams, variance)
    across = torch.cat([g.xx[columns:, :columns], g.xy[columns:, None]], -1)
    inner = g.xx[columns:, columns:] + torch.eye(len(across), dtype=across.dtype)
    taken = across.mT @ torch.linalg.solve(inner, across)
    return Grams(
        g.xx[:columns, :columns] - taken[:-1, :-1], g.xy[:columns] - taken[:-1, -1], g.yy - taken[-1, -1], g.values
    )


def deviations(fit: Fit, variance: float) -> Tensor:
    """Standard deviations of a set's numbers, `m` in plausible sizes, under a noise that holds form errors as well.

    The values of the nominal model are taken for exact here.
    """
    m, grams = len(fit.spec.flat), fit.grams
    own = grams._replace(xx=grams.xx[:m, :m], xy=grams.xy[:m])
    found = weighed(own, [fit.spec.groups], m, max(variance, fit.noise))
    return found.covariance[0, :m, :m].diagonal().clamp_min(0).sqrt()


def unseen_errors(found: Sequence[Sequence[Fit]]) -> list[float]:
    """Variance in every direction by which the best of each axis' sets is worse on runs that it was not fitted to."""
    return [max(min(f.unseen for f in own) - min(f.rss for f in own), 0.0) / DIRECTIONS for own in found]
