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

from ccnn_torch.diagnosis.verdict.judgement import BESIDE_UNKNOWN, is_same
from ccnn_torch.evidence.form_error import LEVELS, OF_SMOOTH
from ccnn_torch.evidence.marginal_likelihood import fit_sets
from ccnn_torch.motion.drivers import Driver, driver_columns
from ccnn_torch.motion.form import weighed
from ccnn_torch.motion.outside import Candidate, Members, essential, holds, prior_of, with_drivers
from ccnn_torch.motion.search import Search
from ccnn_torch.motion.spec import Fit

# Odds up to which the logs do not distinguish one name from another.
_LIKE = 20.0
# Probability from which a member of the most probable set is named, where the set without it is probable, too.
_NAMED = 0.9
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
    classes: dict[int, tuple[int, ...]]
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
    share: dict[tuple[Members, str | None], float] = {}
    usual: list[float] = []
    for level in LEVELS:
        weights = _weights(sets, fits[0].noise, level * found.form[axis], level * OF_SMOOTH)
        usual = usual or weights
        top = max(weights)
        total = math.fsum(math.exp(w - top) for w in weights)
        for one, w in zip(sets, weights, strict=True):
            share[one.key] = share.get(one.key, 0.0) + math.exp(w - top) / total / len(LEVELS)
    ranked = sorted(share.items(), key=lambda item: -item[1])
    marginal = {e: sum(p for (members, _), p in ranked if e in members) for e in {e for f in fits for e in f.members}}
    outside = sum(p for (_, driver), p in ranked if driver is not None)
    if outside > 0.5:
        members, driver = key = next(key for key, _ in ranked if key[1] is not None)
        likeliest = max((k for k, one in enumerate(sets) if one.key == key), key=usual.__getitem__)
        outside = outside if holds(problem, sets[likeliest]) else min(outside, _UNCONFIRMED)
        outside = min(outside, BESIDE_UNKNOWN) if members else outside
        return AxisVerdict(by_members[members], outside, marginal, dict.fromkeys(members, ()), driver)
    inside = {members: p for (members, driver), p in ranked if driver is None}
    members = next(iter(inside))
    classes = _classes(members, inside)
    like = {m: {m, *classes[m]} for m in members}
    sure = tuple(m for m in members if sum(p for (own, _), p in ranked if like[m] & {*own}) >= _NAMED)
    likely = {*members}
    if sure and inside.get(sure, 0.0) * _LIKE > inside[members]:
        members, classes = sure, _classes(sure, inside)
    same = sum(p for own, p in inside.items() if is_same(frozenset(own), frozenset(members), classes))
    if {*members} < likely:
        # What was left out for want of a sure name mends the form of what is named, as a rule, and is no cause.
        same = min(same + sum(p for own, p in inside.items() if {*members} < {*own}), _NAMED)
    if not members and _after_loose(by_members[()], fits[0].noise) > _CLEARLY**2 * fits[0].rss:
        alone = min((f for f in fits if len(f.members) == 1), key=lambda f: f.left)
        return AxisVerdict(by_members[()], same, marginal, classes, None, alone.members[0])
    return AxisVerdict(by_members[members], same, marginal, classes, None)


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


def _classes(members: Members, inside: Mapping[Members, float]) -> dict[int, tuple[int, ...]]:
    """Of each member the effects that can stand in its place, the most probable first."""
    found = {}
    for m in members:
        rest = {*members} - {m}
        others = [(own, {*own} - rest) for own, p in inside.items() if rest <= {*own} and p * _LIKE > inside[members]]
        found[m] = tuple(new.pop() for own, new in others if len(new) == 1 and m not in own)
    return found
