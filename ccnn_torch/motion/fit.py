"""Fits of many sets of effects side by side: Gauss-Newton steps, then the evidence of the model linearised there; and
noise with the form errors of effects and of the nominal model in it, under which sets are weighed again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

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
# How often numbers at an end of what they may be are looked for in a step.
_HELD = 3
# Shares of a Gauss-Newton step that are tried, the whole one first, and what a step is damped by.
_SHARES = (1.0, 0.25)
_DAMPING, _LESS, _MORE = 1e-3, 0.2, 10.0
# Trials for each time that columns are simulated, and share of a promised gain from which columns still hold.
_TRIALS, _AS_PROMISED = 3, 0.5
# Share of the steps of a set that leaves so many times the squares of the best one.
_FAR, _NEAR = 0.5, 1.05
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
    for lot in _lots(problem, specs):
        found += _fit_lot(problem, whitening, lot, steps, nuisance, reached)
    return found


def _lots(problem: Problem, specs: Sequence[tuple[int, Spec]]) -> Iterator[Sequence[tuple[int, Spec]]]:
    """Sets, one lot after the other, that are simulated at a time."""
    first, simulated = 0, 0
    for k, (_, spec) in enumerate(specs):
        simulated += (len(spec.moved) + 2) * problem.data.judged.numel()
        if simulated > _VALUES or k == len(specs) - 1:
            yield specs[first : k + 1]
            first, simulated = k + 1, 0


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
    residual = _white(problem, whitening, theta, axis, chosen)
    return residual, _columns(problem, whitening, theta, axis, places, residual, chosen)


def _white(problem: Problem, whitening: Whitening, theta: Tensor, axis: Tensor, chosen: Tensor | None) -> Tensor:
    return problem.whitened(problem.residual(theta, axis, chosen), axis, whitening, chosen)


def _columns(
    problem: Problem,
    whitening: Whitening,
    theta: Tensor,
    axis: Tensor,
    places: Sequence[Sequence[int]],
    residual: Tensor,
    chosen: Tensor | None,
) -> Tensor:
    """As `sensitivities`; residual: whitened, `p x v`."""
    counts = torch.tensor([len(own) for own in places], dtype=torch.int64)
    which = torch.repeat_interleave(torch.arange(len(places)), counts)
    columns = residual.new_zeros(len(theta), int(counts.max()) if len(counts) else 0, residual.shape[1])
    if len(which):
        # One row for every number that is moved.
        moved = theta[which]
        moved[torch.arange(len(which)), torch.tensor([j for own in places for j in own])] += _STEP
        column = torch.cat([torch.arange(int(c)) for c in counts])
        columns[which, column] = (residual[which] - _white(problem, whitening, moved, axis[which], chosen)) / _STEP
    return columns


def refitted(
    problem: Problem, whitening: Whitening, specs: Sequence[tuple[int, Spec]], parts: Sequence[Tensor]
) -> list[Tensor]:
    """Numbers of sets as some stretches alone tell them, `p x k` for each part, from the numbers that all tell.

    Args:
        problem, whitening, specs: as of `fit_many`.
        parts: stretches of each.
    """
    found: list[list[Tensor]] = [[] for _ in parts]
    for lot in _lots(problem, specs):
        axis, places = torch.tensor([i for i, _ in lot]), [s.moved for _, s in lot]
        theta = torch.stack([s.theta for _, s in lot])
        both = sensitivities(problem, whitening, theta, axis, places)
        for own, rows in zip(found, parts, strict=True):
            begin = _Point(theta, *(v.unflatten(-1, (len(problem.judged), -1))[..., rows, :].flatten(-2) for v in both))
            values, goal = float(problem.judged[rows].sum()), torch.full_like(theta[:, 0], math.inf)
            own.append(_descended(problem, whitening, begin, axis, places, 1, values, goal, rows)[0].theta)
    return [torch.cat(own) for own in found]


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
    judged = problem.judged
    values = float(judged.sum())
    goal = torch.full_like(theta[:, 0], math.inf) if reached is None else _NEAR * reached[axis]
    begin = _Point(theta, *sensitivities(problem, whitening, theta, axis, places))
    point, is_exact, settled = _descended(problem, whitening, begin, axis, places, steps, values, goal)
    _renew(problem, whitening, point, axis, places, (~is_exact).nonzero()[:, 0])
    # Here, since the whitened residual does not tell it.
    plain = problem.pooled(problem.residual(point.theta, axis))
    left = (plain.square() * judged).sum((-1, -2)) / values
    folds = [own[:, None].expand(judged.shape).flatten() for own in (problem.fold, problem.part)]
    ended = [spec._replace(theta=now) for (_, spec), now in zip(specs, point.theta, strict=True)]
    beside = theta.new_zeros(len(specs), 0, point.residual.shape[1]) if nuisance is None else nuisance[axis]
    found = _fits_of(ended, point.residual, point.columns, values, left.tolist(), folds, beside)
    return [fit._replace(settled=end) for fit, end in zip(found, settled.tolist(), strict=True)]


class _Point(NamedTuple):
    """Numbers of sets, `p x k`, with residuals and columns there, as of `sensitivities`."""

    theta: Tensor
    residual: Tensor
    columns: Tensor


def _renew(
    problem: Problem,
    whitening: Whitening,
    point: _Point,
    axis: Tensor,
    places: Sequence[Sequence[int]],
    those: Tensor,
    chosen: Tensor | None = None,
) -> None:
    """Simulate the columns of some rows where they are now."""
    if len(those):
        own = [places[k] for k in those.tolist()]
        new = _columns(problem, whitening, point.theta[those], axis[those], own, point.residual[those], chosen)
        point.columns[those, : new.shape[1]] = new


def _descended(
    problem: Problem,
    whitening: Whitening,
    begin: _Point,
    axis: Tensor,
    places: Sequence[Sequence[int]],
    steps: int,
    values: float,
    goal: Tensor,
    chosen: Tensor | None = None,
) -> tuple[_Point, Tensor, Tensor]:
    """Where Gauss-Newton steps end, whether columns are those of there, and whether no step leads further, `p` each.

    From step to step columns follow what the residuals do (Broyden 1965), and are simulated anew where that promised
    another gain than there was, or none.
    """
    point = _Point(*(v.clone() for v in begin))
    theta, residual, columns = point
    active, real = _padded(places)
    bounds = [bound[axis].gather(-1, active) for bound in problem.library.bounds]
    damping = torch.full((len(theta),), _DAMPING, dtype=theta.dtype)
    made, is_exact = torch.ones(len(theta)), torch.ones(len(theta), dtype=torch.bool)
    settled = torch.zeros_like(is_exact)
    run = torch.tensor([k for k, own in enumerate(places) if own and steps], dtype=torch.int64)

    def white(theta: Tensor, those: Tensor) -> Tensor:
        return _white(problem, whitening, theta, axis[those], chosen)

    for _ in range(_TRIALS * steps):
        if not len(run):
            break
        x, y, own, at = columns[run], residual[run], theta[run].gather(-1, active[run]), theta[run]
        low, high = ((bound[run] - own) * real[run] for bound in bounds)
        move = _step(x, y, own * real[run], (low, high), damping[run], values)
        cost = _cost(y, at, values)
        least = _cost(y - (move[:, None] @ x)[:, 0], at.scatter_add(-1, active[run], move), values)
        promised = cost - least
        share, gained = _tried(white, theta, residual, run, active[run], move, promised >= _GAINED * values, values)
        good = (gained > 0).nonzero()[:, 0]
        step = (share[:, None] * move)[good]
        surprise = y[good] - residual[run[good]] - (step[:, None] @ x[good])[:, 0]
        columns[run[good]] += (step / step.square().sum(-1, keepdim=True))[..., None] * surprise[:, None]
        is_exact[run[good]] = False
        damping[run] *= torch.where(share == 1, _LESS, 1.0)
        poor = gained < torch.maximum(_AS_PROMISED * promised, promised.new_tensor(_GAINED * values))
        stale = poor & ~is_exact[run]
        damping[run] *= torch.where((share < 1) & ~(stale & (share == 0)), _MORE, 1.0)
        ended = is_exact[run] & ((promised < _GAINED * values) | (damping[run] >= _STIFF))
        settled[run[ended]] = True
        most = torch.where(residual[run].square().sum(-1) <= goal[run], steps, math.ceil(_FAR * steps))
        ended |= stale & (made[run] >= most)
        anew = run[stale & ~ended]
        _renew(problem, whitening, point, axis, places, anew, chosen)
        made[anew], is_exact[anew] = made[anew] + 1, True
        run = run[~ended]
    return point, is_exact, settled


def _tried(
    white: Callable[[Tensor, Tensor], Tensor],
    theta: Tensor,
    residual: Tensor,
    run: Tensor,
    active: Tensor,
    move: Tensor,
    promising: Tensor,
    values: float,
) -> tuple[Tensor, Tensor]:
    """Take the best share of each step that leaves less, in `theta` and `residual`, all shares simulated at once.

    Args:
        white: whitened residuals of numbers `p x k` of the rows `p`.
        theta, residual: of all rows.
        run, active: the rows that step, `r`, and places of their numbers, `r x m`.
        move: their steps, `r x m`.
        promising: which of these are tried, `r`.
        values: how many count.

    Returns:
        the shares, 0 where no one leaves less, and the half deviance that each gained, `r` each.
    """
    share, gained = torch.zeros_like(move[:, 0]), torch.zeros_like(move[:, 0])
    those = promising.nonzero()[:, 0]
    if not len(those):
        return share, gained
    here, shares = run[those], move.new_tensor(_SHARES)
    moved = theta[here].expand(len(shares), -1, -1)
    moved = moved.scatter_add(-1, active[those].expand(len(shares), -1, -1), shares[:, None, None] * move[those])
    left = white(moved.flatten(0, 1), here.repeat(len(shares))).unflatten(0, (len(shares), -1))
    gain, best = (_cost(residual[here], theta[here], values) - _cost(left, moved, values)).max(0)
    better = (gain > 0).nonzero()[:, 0]
    share[those[better]], gained[those[better]] = shares[best[better]], gain[better]
    theta[here[better]], residual[here[better]] = moved[best[better], better], left[best[better], better]
    return share, gained


def _padded(places: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor]:
    """Places of the numbers of each row, `p x m`, padded with 0, and 1 where there is one, else 0."""
    wide = max(map(len, places))
    active = torch.tensor([[*own, *[0] * (wide - len(own))] for own in places])
    real = torch.tensor([[k < len(own) for k in range(wide)] for own in places])
    return active, real.double()


def _step(x: Tensor, y: Tensor, own: Tensor, ends: tuple[Tensor, Tensor], damping: Tensor, values: float) -> Tensor:
    """Damped Gauss-Newton steps, `p x m`.

    Args:
        x, y: columns `p x m x v` and residuals `p x v`.
        own: the numbers, `p x m`.
        ends: least and largest step of each number, `p x m`; both 0 where there is no number.
        damping: share of the diagonal, `p`.
        values: how many count.
    """
    noise = (y.square().sum(-1) / values).clamp_min(1e-300)[:, None]
    gram, push = (x @ x.mT) / noise[..., None], (x @ y[..., None])[..., 0] / noise - own / WIDE**2
    inner = gram + torch.diag_embed(damping[:, None] * gram.diagonal(dim1=-2, dim2=-1) + 1 / WIDE**2)
    low, high = (end.clamp(-_FARTHEST, _FARTHEST) for end in ends)
    move, held = torch.zeros_like(own), low == high
    for _ in range(_HELD):
        # Numbers that a step would take beyond an end stay there, and the others make the best of that.
        there = torch.where(held, move, 0.0)
        rest = (push - (inner @ there[..., None])[..., 0]) * ~held
        left = inner * (~held[:, :, None] & ~held[:, None, :]) + torch.diag_embed(held.to(inner.dtype))
        free: Tensor = torch.linalg.solve(left, rest[..., None])[..., 0]
        move = torch.maximum(torch.minimum(there + free, high), low)
        held = held | (move != there + free)
    return move


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
            False,
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
    """Half the deviance, `...`; residual `... x v`, theta `... x k`."""
    rss = residual.square().sum(-1)
    return 0.5 * values * torch.log(rss.clamp_min(1e-300)) + 0.5 * theta.square().sum(-1) / WIDE**2


def form_errors(
    problem: Problem, whitening: Whitening, best: Sequence[Sequence[Fit]], least: Sequence[float]
) -> list[float]:
    """Variance in every direction by which the forms of each axis' set and of the nominal model may be wrong.

    Args:
        problem: the data.
        whitening: of the residual.
        best: sets of each axis, none of which is clearly the best: the one whose forms are known best counts.
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

    def of_set(axis: int, fit: Fit) -> float:
        shares = [OF_EXACT if names[m] in EXACT else OF_FORM for m in fit.members]
        energy = fit_sets(fit.grams, [fit.spec.groups], 0.0).energy[0].tolist()[: len(shares)]
        return form_variance([*shares, nominal], [*energy, does[axis]], max(most[axis], does[axis]))

    return [max(min(of_set(i, fit) for fit in own), least[i]) for i, own in enumerate(best)]


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
    apart = side_by_side([_under_noise(grams, sum(map(len, groups)), variance) for grams, groups in models])
    found: list[float] = fit_sets(apart, [groups for _, groups in models], CERTAIN * apart.values).log_evidence.tolist()
    return found


def side_by_side(models: Sequence[Grams]) -> Grams:
    """Inner products of `p` models as those of one batch, padded with 0 to the widest."""
    widest = max(len(own.xy) for own in models)

    def wide(values: Tensor) -> Tensor:
        return torch.nn.functional.pad(values, (0, widest - values.shape[-1]) * values.dim())

    return Grams(
        torch.stack([wide(own.xx) for own in models]),
        torch.stack([wide(own.xy) for own in models]),
        torch.stack([own.yy for own in models]),
        models[0].values,
    )


def _under_noise(grams: Grams, columns: int, variance: float) -> Grams:
    """Of the columns that are fitted alone, in units of a noise to which the others add."""
    g = scaled(grams, variance)
    across = torch.cat([g.xx[columns:, :columns], g.xy[columns:, None]], -1)
    inner = g.xx[columns:, columns:] + torch.eye(len(across), dtype=across.dtype)
    taken = across.mT @ torch.linalg.solve(inner, across)
    return Grams(
        g.xx[:columns, :columns] - taken[:-1, :-1], g.xy[:columns] - taken[:-1, -1], g.yy - taken[-1, -1], g.values
    )


def deviations(fits: Sequence[Fit], variances: Sequence[float]) -> list[Tensor]:
    """Standard deviations of the numbers of sets, `m` in plausible sizes each, under noises that hold form errors too.

    The values of the nominal model are taken for exact here.
    """
    if not fits:
        return []
    own = []
    for fit, variance in zip(fits, variances, strict=True):
        m = len(fit.spec.flat)
        grams = fit.grams._replace(xx=fit.grams.xx[:m, :m], xy=fit.grams.xy[:m])
        own.append(scaled(grams, max(variance, fit.noise)))
    found = fit_sets(side_by_side(own), [fit.spec.groups for fit in fits], CERTAIN * own[0].values)
    spread = found.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    return [sd[: len(fit.spec.flat)] for sd, fit in zip(spread, fits, strict=True)]


def unseen_errors(found: Sequence[Sequence[Fit]]) -> list[float]:
    """Variance in every direction by which the best of each axis' sets is worse on runs that it was not fitted to."""
    return [max(min(f.unseen for f in own) - min(f.rss for f in own), 0.0) / DIRECTIONS for own in found]
