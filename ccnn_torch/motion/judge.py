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

from ccnn_torch.evidence.form_error import LEVELS, OF_SMOOTH
from ccnn_torch.evidence.judge import judge, marginal, posterior
from ccnn_torch.evidence.marginal_likelihood import fit_sets
from ccnn_torch.motion.drivers import Driver, driver_columns
from ccnn_torch.motion.form import weighed
from ccnn_torch.motion.outside import Candidate, essential, holds, prior_of, with_drivers
from ccnn_torch.motion.search import Search
from ccnn_torch.motion.spec import Fit

# Probability of something outside that takes nothing away on runs that no fit saw, and of nothing where a set leaves
# clearly less, in RMS.
_UNCONFIRMED, _CLEARLY = 0.5, 3.0


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
    verdict = judge(explanations, explanations)
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
