"""From fitted sets to a verdict on each axis.

The forms of effects, and that of the nominal model, are those of the machine only nearly: sets are weighed again under
a noise with their form errors in it (`evidence.form_error`). Members that take nothing away on runs that were
not fitted are left out of a set before it counts.

Beside sets stand what no effect describes: groups of columns that follow a driver (speed, acceleration, reversal,
position, torque, time, temperature), added to the simulated position or to the torque that the axis moves under.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.form_error import DIRECTIONS, LEVELS, LOG_EXACT, OF_SMOOTH, share_of_exact
from ccnn_torch.evidence.judge import Explanation, judge, marginal, posterior
from ccnn_torch.evidence.marginal_likelihood import Grams
from ccnn_torch.motion.fit import side_by_side, weighed
from ccnn_torch.motion.outside import NEARLY, Candidate, Members, essential, holds, with_drivers
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, prior_of
from ccnn_torch.motion.spec import Fit, Spec

# Probability of something outside that takes nothing away on runs that no fit saw, and of nothing where a set leaves
# clearly less, in RMS.
_UNCONFIRMED, _CLEARLY = 0.5, 3.0
# Names, drivers, log posterior and set.
Named = tuple[frozenset[int], tuple[str, ...], float, Candidate]


class AxisVerdict(NamedTuple):
    """The verdict on one axis.

    Attributes:
        best: the most probable set, without members that do nothing.
        probability: of the set, its members standing for their classes.
        marginal: probability of each effect that was fitted, by its number.
        classes: of each member the effects that can stand in its place.
        driver: what the residual follows outside the library; None where nothing is needed.
        hidden: where nothing is named since models and time stamps are known no better, the effect that explains most;
            None where nothing leaves no more than what the best set leaves.
        doubted: whether some of that is more than what values and time stamps may be off by.
    """

    best: Fit
    probability: float
    marginal: dict[int, float]
    classes: Mapping[int, tuple[int, ...]]
    driver: str | None
    hidden: int | None = None
    doubted: bool = False


def judge_axes(found: Search) -> list[AxisVerdict]:
    """The verdict on each axis."""
    above = _above_white(found.problem, [fits[0].spec for fits in found.found])
    verdicts = [_judged(found, i, above[i]) for i in range(len(found.found))]
    named = {m for v in verdicts for m in v.best.members}
    # What another joint shows clearly is not hidden.
    verdicts = [v._replace(hidden=None, doubted=False) if v.hidden in named else v for v in verdicts]
    return [v._replace(probability=min(v.probability, _UNCONFIRMED)) if v.doubted else v for v in verdicts]


def no_worse(
    found: Search, verdicts: Sequence[AxisVerdict], order: Members, residuals: Tensor
) -> tuple[list[AxisVerdict], dict[int, int]]:
    """The verdicts without names that leave more on runs that they were not fitted to than those before them.

    Args:
        found: the search.
        verdicts: of each axis.
        order: all their names, the one that explains most first.
        residuals: held out, with none of the names, and with each one more in that order, `(k + 1) x n x b x s`.

    Returns:
        the verdicts, and of axes of which they are other ones how many of the names in that order were kept.
    """
    left = (residuals.square() * found.problem.data.judged).sum((-1, -2))
    kept: dict[int, int] = {}
    verdicts = list(verdicts)
    for i, (verdict, more) in enumerate(zip(verdicts, left.T.tolist(), strict=True)):
        fits, k = {fit.members: fit for fit in found.found[i]}, len(order)
        members = verdict.best.members

        def first(k: int, own: Members = members) -> Members:
            return tuple(sorted({*order[:k]} & {*own}))

        # Beside a set that was not fitted a smaller one stands.
        while k and (first(k) == first(k - 1) or more[k] > more[k - 1] or first(k) not in fits):
            k -= 1
        k = k if more[k] <= more[0] else 0
        if first(k) != members:
            kept[i], classes = k, {m: like for m, like in verdict.classes.items() if m in first(k)}
            probability = min(verdict.probability, _UNCONFIRMED)
            verdicts[i] = verdict._replace(
                best=fits[first(k)], probability=probability, classes=classes, hidden=None, doubted=False
            )
    return verdicts, kept


def _above_white(problem: Problem, specs: Sequence[Spec]) -> list[float]:
    """Mean squares of what is left of each axis over those of white noise with the same differences from sample to
    sample (von Neumann 1941): 1 where nothing but noise is left."""
    left = problem.pooled(problem.residual(torch.stack([spec.theta for spec in specs]), problem.axes))
    pairs = problem.judged[:, 1:] & problem.judged[:, :-1]
    white = left.diff(dim=-1)[:, pairs].square().mean(-1) / 2
    ratio: list[float] = (left[:, problem.judged].square().mean(-1) / white.clamp_min(1e-300)).tolist()
    return ratio


def _judged(search: Search, axis: int, above: float) -> AxisVerdict:
    problem, fits = search.problem, search.found[axis]
    by_members = {f.members: f for f in fits}
    left = {f.members: f.left for f in fits}
    unseen = {f.members: f.unseen for f in fits}
    sets = [Candidate(essential(f.members, left, unseen), (), f.grams, f.spec.groups, prior_of(f.spec)) for f in fits]
    # What one name leaves as white noise no torque beside it says better.
    is_noise = len(fits[0].members) < 2 and above < 1 + _CLEARLY * math.sqrt(2 / problem.values)
    sets += with_drivers(search, axis, by_members, is_noise)
    twins, beside, noise = problem.library.twins, search.nuisance.shape[1], fits[0].noise

    def named(level: float) -> list[Named]:
        weights = _weights(sets, beside, noise, level * search.form[axis], level * OF_SMOOTH)
        return [
            (names, one.drivers, w, one)
            for w, one in zip(weights, sets, strict=True)
            for names in names_of(one.members, twins)
        ]

    # What an effect makes of the logs has no form error where white noise is all that is left.
    every = named(0.0)
    # Each further name has to have its exact form as well.
    exact: list[Named] = [
        (names, (), w + LOG_EXACT / 2 * max(len(names) - 2, 0), one) for names, drivers, w, one in every if not drivers
    ]
    beaten = max(w for *_, w, _ in every) - max(w for *_, w, _ in exact)
    share = share_of_exact(above, above, 1 + search.form[axis] / noise, problem.values, beaten)
    explanations = posterior([(share, exact), *(((1 - share) / len(LEVELS), named(level)) for level in LEVELS)])

    # Of the squares that are noise.
    scatter = noise * _CLEARLY**2 * math.sqrt(2 * problem.values)

    def left_by(grams: Grams, groups: list[Tensor]) -> float:
        """Squares that a set leaves, nominal values and time stamps being off as is likely."""
        return noise * float(weighed(grams, beside, [groups], noise).rss)

    def rest_of(one: Explanation[Candidate]) -> tuple[str, ...] | None:
        """What the remainder of an explanation follows, where that is more than the noise and form errors."""
        more = left_by(one.best.grams, one.best.groups) - noise * problem.values
        if more <= max(scatter, DIRECTIONS * search.form[axis]):
            return None
        return next((e.drivers for e in explanations if e.drivers and e.names == one.names), ())

    verdict = judge(explanations, explanations, rest_of, of_classes=True)
    best, classes = least_unseen(by_members, verdict.chosen.best.members, verdict.classes)
    hidden, doubted = None, False
    probability = verdict.probability
    if verdict.outside and verdict.chosen.drivers and not holds(problem, verdict.chosen.best, beside):
        probability = min(probability, _UNCONFIRMED)
    most = _CLEARLY**2 * fits[0].rss
    if not best.members and not verdict.outside and best.rss > most:
        # Not what a value that is known no better explains as well.
        alone = (f for f in fits if len(f.members) == 1)
        hidden = min(alone, key=lambda f: left_by(f.grams, f.spec.groups)).members[0]
        doubted = left_by(best.grams, []) > noise * problem.values + scatter
    marginals = {e: marginal(explanations, e) for e in {*(e for f in fits for e in f.members), *twins}}
    driver = next(iter(verdict.drivers), None) if verdict.outside else None
    return AxisVerdict(best, probability, marginals, classes, driver, hidden, doubted)


def least_unseen(
    fits: Mapping[Members, Fit], members: Members, classes: Mapping[int, tuple[int, ...]]
) -> tuple[Fit, Mapping[int, tuple[int, ...]]]:
    """The fit of a verdict, each of its names being the one of its class that leaves clearly least of runs that it was
    not fitted to, and their classes: what priors and form errors do not tell apart other runs may.

    Of a class is also what leaves as little in the place of a name that is needed, whatever the prior is.
    """
    best, told, most = fits[members], dict[int, tuple[int, ...]](), NEARLY**2
    for name, like in classes.items():
        rest = {*best.members} - {name}
        others = {min({*m} - rest): f for m, f in fits.items() if rest < {*m} and len(m) == len(members)}
        needed = (less := fits.get(tuple(sorted(rest)))) is None or less.left > most * best.left
        near = (o for o, f in others.items() if f.left <= most * best.left and f.rss <= most * best.rss)
        as_little = (o for o in near if needed and o != name)
        own = [*dict.fromkeys((*like, *as_little))]
        least = min((o for o in own if o in others), key=lambda o: others[o].unseen, default=name)
        if least != name and most * others[least].unseen < best.unseen:
            best, name, own = others[least], least, [name, *(o for o in own if o != least)]
        told[name] = tuple(own)
    return best, told


def _weights(sets: Sequence[Candidate], nuisance: int, noise: float, form: float, smooth: float) -> list[float]:
    """Log posterior of each set under noise and form errors, not normalised; nuisance: how many columns it has.

    What follows a driver is smooth where its cause need not be: beside one, where that is the best, a name has to do
    more than that share of what the driver does.
    """

    grams = side_by_side([one.grams for one in sets])

    def under(variance: float) -> list[float]:
        found = weighed(grams, nuisance, [one.groups for one in sets], variance).log_evidence.tolist()
        return [evidence + one.log_prior for evidence, one in zip(found, sets, strict=True)]

    weights = under(noise + form)
    best = sets[weights.index(max(weights))]
    if best.rows is None:
        return weights
    does = float(weighed(best.grams, nuisance, [best.groups], None).energy[0, len(best.groups) - 1])
    smeared = under(noise + form + smooth * does)
    least = torch.tensor([0.0 if one.rows is not None else -math.inf for one in sets], dtype=torch.float64)
    whole, beside = (torch.logsumexp(torch.tensor(w, dtype=torch.float64) + least, 0) for w in (weights, smeared))
    pairs = zip(sets, weights, smeared, strict=True)
    return [w if one.rows is None else v + float(whole - beside) for one, w, v in pairs]


def names_of(members: Members, twins: Mapping[int, int]) -> Iterator[frozenset[int]]:
    """The names of a set, and those with effects that do the same in the place of its members."""
    like = [[m, *(twin for twin, effect in twins.items() if effect == m)] for m in members]
    return map(frozenset, product(*like))
