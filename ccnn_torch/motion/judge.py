"""From fitted sets to a verdict on each axis: tempered posterior, classes, and what is outside the library.

Evidence counts every sample as new information about one right model. The model is never right, so that log odds are
tempered by the stretches of the logs. Of a difference of log likelihoods, D over all stretches, those that speak
against it, d < 0, show how far chance reaches: a normal variable with the mean D and twice their sum of squares as its
variance has log odds D^2 / sum(d^2). And no stretch alone bears a verdict: odds are at most twice those without the
stretch that speaks most for it. The smallest of the three counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.evidence.marginal_likelihood import fit_sets, grams_of
from ccnn_torch.motion.drivers import driver_columns
from ccnn_torch.motion.fit import Fit, sensitivities
from ccnn_torch.motion.problem import Whitening
from ccnn_torch.motion.search import CROWD, Search, log_posterior

__all__ = ["AxisVerdict", "judge_axes"]

# Log prior odds of a driver.
_OUTSIDE = math.log(0.001)
# Log odds below which one effect can stand in the place of another.
_LIKE = math.log(20.0)
# A driver is part of the cause where it takes away this share of the mean square that the best set leaves, unwhitened.
_SHARE = 0.1
# And this share of that of the gap: less is the form of an effect that is named.
_OF_GAP = 0.03
# An effect without which the mean square grows by less than this share of the gap's only corrects the form of others.
# Or, since the nominal model has a form that is not right either, by the square of this share of what the position
# differs from the command.
_FORM, _FORM_NOMINAL = 0.01, 0.01
# Claims are never surer: of those of 0.95 and more on simulated motions, before this limit, 19 of 28 were right.
_MOST = 0.9


class AxisVerdict(NamedTuple):
    """The verdict on one axis.

    Attributes:
        best: the most probable set, without members that do nothing.
        probability: of the set, its members standing for their classes.
        marginal: probability of each effect that was fitted, by its number.
        classes: of each member the effects that can stand in its place.
        driver: what the residual follows outside the library; None where nothing is needed.
    """

    best: Fit
    probability: float
    marginal: dict[int, float]
    classes: dict[int, tuple[int, ...]]
    driver: str | None


def judge_axes(found: Search) -> list[AxisVerdict]:
    """The verdict on each axis."""
    verdicts = []
    drivers = driver_columns(found.problem, [fits[0].spec for fits in found.found])
    for i, fits in enumerate(found.found):
        best = fits[0]
        odds = {f.members: _odds(best, f) for f in fits}
        by_members = {f.members: f for f in fits}
        slight = _slight(found, i, by_members[()])
        named = _essential(best, by_members, slight)
        weight = {m: math.exp(-value) for m, value in odds.items()}
        outside = _outside(found, i, drivers)
        extra = math.exp(min(outside.odds, 50.0))
        total = sum(weight.values()) + extra
        classes = {m: _class(best, m, odds) for m in best.members}
        same = sum(
            w
            for members, w in weight.items()
            if _holds(members, named.members, classes)
            and (len(members) == len(named.members) or named.left - by_members[members].left < slight)
        )
        marginal = {
            e: sum(w for members, w in weight.items() if e in members) / sum(weight.values())
            for e in {e for f in fits for e in f.members}
        }
        wild = extra / total > 0.5
        probability = extra / total if wild else same / total
        if wild:
            named = _essential(outside.beside, by_members, slight)
        like = {m: classes.get(m, ()) for m in named.members}
        verdicts.append(AxisVerdict(named, min(probability, _MOST), marginal, like, outside.driver if wild else None))
    return verdicts


def _odds(best: Fit, other: Fit) -> float:
    """Tempered log odds of the best set against another, at least 0."""
    evidence = best.log_evidence - other.log_evidence
    prior = log_posterior(best) - log_posterior(other) - evidence
    gained = 0.5 * (other.squares - best.squares) / best.noise
    return max(_tempered(evidence, gained) + prior, 0.0)


def _tempered(evidence: float, gained: Tensor) -> float:
    """The log odds that count; gained: difference of log likelihoods by stretch."""
    whole = float(gained.sum())
    if evidence <= 0 or whole <= 0 or len(gained) < 3:
        return evidence
    against = float(gained.clamp_max(0).square().sum())
    rest = whole - float(gained.max())
    return max(min(evidence, whole**2 / max(against, 1e-300), 2 * rest), 0.0)


def _class(best: Fit, member: int, odds: dict[tuple[int, ...], float]) -> tuple[int, ...]:
    """Effects that can stand in the place of a member."""
    rest = set(best.members) - {member}
    like = []
    for members, value in odds.items():
        new = set(members) - rest
        if rest <= set(members) and len(new) == 1 and member not in new and value < _LIKE:
            like.append((value, new.pop()))
    return tuple(e for _, e in sorted(like))


def _slight(found: Search, axis: int, nothing: Fit) -> float:
    """Mean square [rad^2 or m^2] below which nothing is named."""
    data = found.problem.data
    error = (data.command[axis] - data.position[axis])[data.judged].square().mean()
    return max(_FORM * nothing.left, _FORM_NOMINAL**2 * float(error))


def _essential(best: Fit, fits: dict[tuple[int, ...], Fit], slight: float) -> Fit:
    """The set without members that only correct the form of others, the least first."""
    while best.members:
        rest = [tuple(m for m in best.members if m != e) for e in best.members]
        least = min((fits[r] for r in rest if r in fits), key=lambda f: f.left)
        if least.left - best.left > slight:
            break
        best = least
    return best


def _holds(members: tuple[int, ...], named: tuple[int, ...], classes: dict[int, tuple[int, ...]]) -> bool:
    """Whether a set has every named effect, or one of its class in its place."""
    left = set(members)
    for m in named:
        one = next((e for e in (m, *classes[m]) if e in left), None)
        if one is None:
            return False
        left.remove(one)
    return True


class _Wild(NamedTuple):
    """The most probable set with a driver beside it, and its tempered log odds against the best set of the library."""

    driver: str | None
    beside: Fit
    odds: float


def _outside(found: Search, axis: int, drivers: dict[str, Tensor]) -> _Wild:
    """Drivers beside the sets that lead from none to the best one: with one, the best set may be smaller."""
    problem, fits = found.problem, found.found[axis]
    best, by_members = fits[0], {f.members: f for f in fits}
    slight = _slight(found, axis, by_members[()])
    values, blocks, judged = float(problem.judged.sum()), problem.judged.shape, problem.data.judged
    top = _Wild(None, best, -math.inf)
    for base in _chain(best, by_members):
        specs = [base.spec if i == axis else own[0].spec for i, own in enumerate(found.found)]
        theta = torch.stack([s.theta for s in specs])[None]
        flat = base.spec.flat
        m = len(flat)
        active = torch.full((1, len(specs), m), -1)
        active[0, axis] = torch.tensor(flat, dtype=torch.int64)
        residual, own = sensitivities(problem, found.whitening, theta, active)
        plain = problem.residual(theta)[0, axis]
        x0, y = own[axis, 0], residual[axis, 0] + base.spec.theta[list(flat)] @ own[axis, 0]
        starts, begin = [], 0
        for group in base.spec.active:
            starts.append(torch.arange(begin, begin + len(group)))
            begin += len(group)
        prior = log_posterior(base) - base.log_evidence + _OUTSIDE + (CROWD if len(base.members) >= 2 else 0.0)
        for name, columns in drivers.items():
            white = problem.whitened(columns[axis][:, None], _one(found, axis))[0]
            x = torch.cat([x0, white])
            grams = grams_of(x.mT[:, None, :], y[:, None])._replace(values=values)
            fit = fit_sets(grams, [[*starts, torch.arange(m, len(x))]], 0.0)
            mean = fit.mean[0]
            after = (y - mean @ x).square().reshape(blocks).sum(-1)
            gained = 0.5 * (best.squares - after) / best.noise
            evidence = float(fit.log_evidence[0]) - best.log_evidence
            odds = _tempered(evidence, gained) + prior - (log_posterior(best) - best.log_evidence)
            # What it takes away of the position itself, not of its whitened form.
            taken = plain - (mean[m:, None, None] * columns[axis]).sum(0)
            before2, after2 = (float(v[judged].square().mean()) for v in (plain, taken))
            if before2 - after2 < max(_SHARE * before2, _OF_GAP * by_members[()].left, slight):
                odds = min(odds, _OUTSIDE)
            if odds > top.odds:
                top = _Wild(name, base, odds)
    return top


def _chain(best: Fit, fits: dict[tuple[int, ...], Fit]) -> list[Fit]:
    """The best set, it without its least member, and so on to none."""
    found = [best]
    while found[-1].members:
        now = found[-1].members
        rest = [tuple(m for m in now if m != e) for e in now]
        found.append(min((fits[r] for r in rest if r in fits), key=lambda f: f.left))
    return found


def _one(found: Search, axis: int) -> Whitening:
    """The whitening of one axis."""
    return Whitening(found.whitening.coefficients[axis : axis + 1])
