"""From fitted sets to a verdict on each axis: tempered posterior, classes, and what is outside the library.

Evidence counts every sample as new information about one right model. The model is never right, so that log odds are
tempered by the stretches of the logs. Of a difference of log likelihoods, D over all stretches, those stretches that speak
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
# An effect without which the mean square grows by less than this share of the gap's only corrects the form of others.
_FORM = 0.01
# Claims are never surer.
_MOST = 0.995


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
    outside = _outside(found)
    for i, fits in enumerate(found.found):
        best = fits[0]
        odds = {f.members: _odds(best, f) for f in fits}
        by_members = {f.members: f for f in fits}
        named = _essential(best, by_members)
        weight = {m: math.exp(-value) for m, value in odds.items()}
        driver, against = outside[i]
        extra = math.exp(min(against, 50.0))
        total = sum(weight.values()) + extra
        classes = {m: _class(best, m, odds) for m in best.members}
        gap = by_members[()].left
        same = sum(
            w
            for members, w in weight.items()
            if _holds(members, named.members, classes)
            and (len(members) == len(named.members) or named.left - by_members[members].left < _FORM * gap)
        )
        marginal = {
            e: sum(w for members, w in weight.items() if e in members) / sum(weight.values())
            for e in {e for f in fits for e in f.members}
        }
        wild = extra / total > 0.5
        probability = extra / total if wild else same / total
        verdicts.append(AxisVerdict(named, min(probability, _MOST), marginal, {m: classes[m] for m in named.members}, driver if wild else None))
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


def _essential(best: Fit, fits: dict[tuple[int, ...], Fit]) -> Fit:
    """The set without members that only correct the form of others, the least first."""
    gap = fits[()].left
    while best.members:
        rest = [tuple(m for m in best.members if m != e) for e in best.members]
        least = min((fits[r] for r in rest if r in fits), key=lambda f: f.left)
        if least.left - best.left > _FORM * gap:
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


def _outside(found: Search) -> list[tuple[str | None, float]]:
    """Of each axis the driver that explains most beside the best set, and its tempered log odds."""
    problem = found.problem
    best = [fits[0] for fits in found.found]
    specs = [f.spec for f in best]
    groups = driver_columns(problem, specs)
    wide = max(len(s.flat) for s in specs)
    active = torch.full((1, len(specs), wide), -1)
    for i, s in enumerate(specs):
        active[0, i, : len(s.flat)] = torch.tensor(s.flat, dtype=torch.int64)
    theta = torch.stack([s.theta for s in specs])[None]
    residual, own = sensitivities(problem, found.whitening, theta, active)
    plain = problem.residual(theta)[0]
    values = float(problem.judged.sum())
    blocks = problem.judged.shape
    answers: list[tuple[str | None, float]] = []
    for i, s in enumerate(specs):
        m = len(s.flat)
        base, y = own[i, 0, :m], residual[i, 0] + s.theta[list(s.flat)] @ own[i, 0, :m]
        starts, begin = [], 0
        for group in s.active:
            starts.append(torch.arange(begin, begin + len(group)))
            begin += len(group)
        top: tuple[str | None, float] = (None, -math.inf)
        for name, columns in groups.items():
            white = problem.whitened(columns[i][:, None], _one(found, i))[0]
            x = torch.cat([base, white])
            grams = grams_of(x.mT[:, None, :], y[:, None])._replace(values=values)
            wild = torch.arange(m, len(x))
            fit = fit_sets(grams, [starts, [*starts, wild]], 0.0)
            mean = fit.mean[1]
            left = y - mean @ x
            after = left.square().unflatten(-1, blocks).sum(-1)
            before = best[i].squares
            count = len(s.members)
            prior = _OUTSIDE + (CROWD if count >= 2 else 0.0)
            odds = float(fit.log_evidence[1] - fit.log_evidence[0])
            odds = _tempered(odds, 0.5 * (before - after) / best[i].noise) + prior
            # What it takes away of the position itself, not of its whitened form.
            taken = plain[i] - (mean[m:, None, None] * columns[i]).sum(0)
            judged = problem.data.judged
            share = 1 - float(taken[judged].square().sum() / plain[i][judged].square().sum().clamp_min(1e-300))
            if share < _SHARE:
                odds = min(odds, _OUTSIDE)
            if odds > top[1]:
                top = (name, odds)
        answers.append(top)
    return answers


def _one(found: Search, axis: int) -> Whitening:
    """The whitening of one axis."""
    return Whitening(found.whitening.coefficients[axis : axis + 1])
