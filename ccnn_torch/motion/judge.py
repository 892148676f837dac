"""From fitted sets to a verdict on each axis.

The forms of effects, and that of the nominal model, are those of the machine only nearly: sets are weighed again under
a noise with their form errors in it (`evidence.form_error`). Members that take nothing away on runs that were
not fitted are left out of a set before it counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.form_error import LEVELS, OF_SMOOTH
from ccnn_torch.evidence.judge import judge, marginal, posterior
from ccnn_torch.evidence.marginal_likelihood import Grams, fit_sets, grams_of
from ccnn_torch.evidence.priors import OUTSIDE, crowd
from ccnn_torch.motion.drivers import Driver, driver_columns
from ccnn_torch.motion.fit import sensitivities, squares_unseen
from ccnn_torch.motion.form import weighed
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, log_posterior
from ccnn_torch.motion.spec import Fit
from ccnn_torch.motion.whiten import white_noise

# Probability of something outside that takes nothing away on runs that no fit saw, and of nothing where a set leaves
# clearly less, in RMS.
_UNCONFIRMED, _CLEARLY = 0.5, 3.0
# Sets beside which drivers are tried, besides those that lead from the best one to none.
_BASES = 6
# Share of what is left of runs that were not fitted up to which a set without a member is as good.
_NEARLY = 1.02

Members = tuple[int, ...]


class AxisVerdict(NamedTuple):
    """The verdict on one axis.

    Attributes:
        best: the most probable set, without members that do nothing.
        probability: of the set, its members standing for their classes.
        marginal: probability of each effect that was fitted, by its number.
        classes: of each member the effects that can stand in its place.
        driver: what the residual follows outside the library; None where nothing is needed.
        hidden: where nothing is named since models and time stamps are known no better, the effect that explains most;
            None where what is left is no more than what the best set leaves.
    """

    best: Fit
    probability: float
    marginal: dict[int, float]
    classes: Mapping[int, tuple[int, ...]]
    driver: str | None
    hidden: int | None = None


def judge_axes(found: Search) -> list[AxisVerdict]:
    """The verdict on each axis."""
    drivers = driver_columns(found.problem, [fits[0].spec for fits in found.found])
    verdicts = [_judged(found, i, drivers) for i in range(len(found.found))]
    named = {m for v in verdicts for m in v.best.members}
    # What another joint shows clearly is not hidden.
    verdicts = [v._replace(hidden=None) if v.hidden in named else v for v in verdicts]
    return [v if v.hidden is None else v._replace(probability=min(v.probability, _UNCONFIRMED)) for v in verdicts]


def _judged(found: Search, axis: int, drivers: Sequence[Driver]) -> AxisVerdict:
    problem, fits = found.problem, found.found[axis]
    by_members = {f.members: f for f in fits}
    left = {f.members: f.left for f in fits}
    unseen = {f.members: f.unseen for f in fits}
    sets = [Candidate((essential(f.members, left, unseen), None), f.grams, f.spec.groups, prior_of(f)) for f in fits]
    sets += with_drivers(found, axis, drivers, by_members)
    levels = []
    for level in LEVELS:
        weights = _weights(sets, fits[0].noise, level * found.form[axis], level * OF_SMOOTH)
        named = [(frozenset(one.key[0]), () if one.key[1] is None else (one.key[1],)) for one in sets]
        weighed_sets = [(*name, w, one) for name, w, one in zip(named, weights, sets, strict=True)]
        levels.append((1 / len(LEVELS), weighed_sets))
    explanations = posterior(levels)
    verdict = judge(explanations, explanations, of_classes=True)
    best, hidden = by_members[verdict.chosen.best.key[0]], None
    probability = verdict.probability
    if verdict.outside and not holds(problem, verdict.chosen.best):
        probability = min(probability, _UNCONFIRMED)
    if not best.members and not verdict.outside and _after_loose(best, fits[0].noise) > _CLEARLY**2 * fits[0].rss:
        hidden = min((f for f in fits if len(f.members) == 1), key=lambda f: f.left).members[0]
    marginals = {e: marginal(explanations, e) for e in {e for f in fits for e in f.members}}
    driver = verdict.drivers[0] if verdict.outside else None
    return AxisVerdict(best, probability, marginals, verdict.classes, driver, hidden)


def _after_loose(nothing: Fit, noise: float) -> float:
    """Squares that are left of nothing where nominal values and time stamps are off as far as is likely."""
    xx, xy = nothing.grams.xx, nothing.grams.xy
    inner = xx + noise * torch.eye(len(xx), dtype=xx.dtype)
    return float(nothing.grams.yy - xy @ torch.linalg.solve(inner, xy))


def _weights(sets: Sequence[Candidate], noise: float, form: float, smooth: float) -> list[float]:
    """Log posterior of each set under noise and form errors, not normalised.

    What follows a driver is smooth where its cause need not be: beside one, where that is the best, a name has to do
    more than that share of what the driver does.
    """

    def under(variance: float) -> list[float]:
        return [
            float(weighed(one.grams, [one.groups], sum(map(len, one.groups)), variance).log_evidence[0]) + one.log_prior
            for one in sets
        ]

    weights = under(noise + form)
    best = sets[weights.index(max(weights))]
    if best.rows is None:
        return weights
    does = float(fit_sets(best.grams, [best.groups], 0.0).energy[0, len(best.groups) - 1])
    smeared = under(noise + form + smooth * does)
    least = torch.tensor([0.0 if one.rows is not None else -math.inf for one in sets], dtype=torch.float64)
    whole, beside = (torch.logsumexp(torch.tensor(w, dtype=torch.float64) + least, 0) for w in (weights, smeared))
    pairs = zip(sets, weights, smeared, strict=True)
    return [w if one.rows is None else v + float(whole - beside) for one, w, v in pairs]


class Candidate(NamedTuple):
    """A set of effects, with a driver or without, as it is weighed.

    Attributes:
        key: members that do something, and the driver.
        grams, groups, log_prior: of its model linearised.
        rows: with a driver, whitened columns of members and driver, `m x v` each, and what they explain, `v`.
    """

    key: tuple[Members, str | None]
    grams: Grams
    groups: list[Tensor]
    log_prior: float
    rows: tuple[Tensor, Tensor, Tensor] | None = None


def prior_of(fit: Fit) -> float:
    """Log prior of a set."""
    return log_posterior(fit) - fit.log_evidence


def essential(members: Members, left: Mapping[Members, float], unseen: Mapping[Members, float]) -> Members:
    """The set without members that take nothing away, the least first.

    Args:
        members: of the set.
        left: mean square that each set leaves.
        unseen: squares that each set leaves of runs that it was not fitted to, of which a member has to take something
            away as well; where it is not told it has not.
    """
    most = _NEARLY**2 * unseen.get(members, 0.0)
    while members:
        rest = [r for e in members if (r := tuple(m for m in members if m != e)) in left]
        rest = [r for r in rest if left[r] <= left[members] or unseen.get(r, math.inf) <= most]
        if not rest:
            break
        members = min(rest, key=lambda r: left[r])
    return members


def with_drivers(found: Search, axis: int, drivers: Sequence[Driver], fits: Mapping[Members, Fit]) -> list[Candidate]:
    """Drivers beside the most probable sets, and those that lead from the best one to none."""
    problem, plainly = found.problem, white_noise(len(found.problem.axes))
    mine, values = torch.tensor([axis]), float(problem.judged.sum())
    white, plain = (
        [problem.whitened(d.columns[axis], mine.expand(len(d.columns[axis])), whitening) for d in drivers]
        for whitening in (found.whitening, plainly)
    )
    chain = [found.found[axis][0]]
    while chain[-1].members:
        less = [tuple(m for m in chain[-1].members if m != e) for e in chain[-1].members]
        chain.append(min((fits[r] for r in less if r in fits), key=lambda f: f.left, default=fits[()]))
    sets: list[tuple[int, Candidate]] = []
    taken: list[dict[Members, float]] = [{} for _ in drivers]
    left = {members: fit.left for members, fit in fits.items()}
    # What a driver has to take away: a smooth function can follow what is wrong with the form of a model.
    slight = float(problem.stamped[axis][problem.data.judged].square().mean()) * values
    for base in {f.members: f for f in [*found.found[axis][:_BASES], *chain]}.values():
        theta, flat = base.spec.theta, list(base.spec.flat)
        residual, columns = sensitivities(problem, found.whitening, theta[None], mine, [flat])
        own, y = columns[0], residual[0] + theta[flat] @ columns[0]
        # Of the position itself, not of its whitened form.
        left_plain, own_plain = (part[0] for part in sensitivities(problem, plainly, theta[None], mine, [flat]))
        count = len(base.members)
        prior = prior_of(base) + OUTSIDE + crowd(count + 1) - crowd(count)
        for k, (driver, columns, beside) in enumerate(zip(drivers, white, plain, strict=True)):
            x = torch.cat([own, columns])
            grams = grams_of(torch.cat([x, found.loose[axis]]).mT[:, None, :], y[:, None])._replace(values=values)
            groups = [*base.spec.groups, torch.arange(len(flat), len(x))]
            mean = fit_sets(grams, [groups], 0.0).mean[0]
            rest = left_plain - (mean[: len(flat)] - theta[flat]) @ own_plain - mean[len(flat) : len(x)] @ beside
            taken[k][base.members] = float(rest.square().sum())
            gained = float(left_plain.square().sum()) - taken[k][base.members]
            there = driver.name if gained >= slight else None
            sets.append((k, Candidate((base.members, there), grams, groups, prior, (own, columns, y))))
    # Beside a driver a name has to do what the driver does not do as well.
    return [
        one._replace(key=(essential(one.key[0], taken[k] if one.key[1] else left, {}), one.key[1])) for k, one in sets
    ]


def holds(problem: Problem, candidate: Candidate) -> bool:
    """Whether a driver takes something away on runs that no fit saw; the scales are those of all runs."""
    assert candidate.rows is not None
    own, columns, y = candidate.rows
    fold = problem.fold[:, None].expand(problem.judged.shape).flatten()
    less, more = (
        squares_unseen(x, y, fit_sets(candidate.grams, [groups], 0.0), groups, fold)
        for x, groups in ((own, candidate.groups[:-1]), (torch.cat([own, columns]), candidate.groups))
    )
    return more < less
