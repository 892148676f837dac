"""From fitted sets to a verdict on each axis.

The forms of effects, and that of the nominal model, are those of the machine only nearly: sets are weighed again under
a noise with their form errors in it (`diagnosis.search.form_error`). Members that move the axis by less than the time
stamps of the log can tell are left out of a set before it counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.evidence.marginal_likelihood import Grams, fit_sets, grams_of
from ccnn_torch.diagnosis.search.form_error import LEVELS
from ccnn_torch.motion.drivers import Driver, driver_columns
from ccnn_torch.motion.fit import Fit, sensitivities
from ccnn_torch.motion.form import weighed
from ccnn_torch.motion.problem import Problem, Whitening
from ccnn_torch.motion.search import CROWD, Search, log_posterior

__all__ = ["AxisVerdict", "judge_axes"]

# Log prior odds of a driver.
_OUTSIDE = math.log(0.001)
# Odds up to which the logs do not distinguish one name from another.
_LIKE = 20.0
# Share of a sampling step by which the time stamps of commands and positions may differ.
_STAMP = 0.1
# Sets beside which drivers are tried, besides those that lead from the best one to none.
_BASES = 6
# Probability from which a member of the most probable set is named, where the set without it is probable, too.
_NAMED = 0.9

Members = tuple[int, ...]


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


class _Set(NamedTuple):
    """A set of effects, with a driver or without, as it is weighed."""

    key: tuple[Members, str | None]
    grams: Grams
    groups: list[Tensor]
    log_prior: float


def judge_axes(found: Search) -> list[AxisVerdict]:
    """The verdict on each axis."""
    drivers = driver_columns(found.problem, [fits[0].spec for fits in found.found])
    return [_judged(found, i, drivers) for i in range(len(found.found))]


def _judged(found: Search, axis: int, drivers: Sequence[Driver]) -> AxisVerdict:
    problem, fits = found.problem, found.found[axis]
    by_members = {f.members: f for f in fits}
    slight = _slight(problem, axis)
    left = {f.members: f.left for f in fits}
    sets = [_Set((_essential(f.members, left, slight), None), f.grams, f.spec.groups, _prior(f)) for f in fits]
    sets += _with_drivers(found, axis, drivers, by_members, slight)
    share: dict[tuple[Members, str | None], float] = {}
    for variance in (fits[0].noise + level * found.form[axis] for level in LEVELS):
        weights = [float(weighed(one.grams, one.groups, variance).log_evidence[0]) + one.log_prior for one in sets]
        top = max(weights)
        total = math.fsum(math.exp(w - top) for w in weights)
        for one, w in zip(sets, weights, strict=True):
            share[one.key] = share.get(one.key, 0.0) + math.exp(w - top) / total / len(LEVELS)
    ranked = sorted(share.items(), key=lambda item: -item[1])
    marginal = {e: sum(p for (members, _), p in ranked if e in members) for e in {e for f in fits for e in f.members}}
    outside = sum(p for (_, driver), p in ranked if driver is not None)
    if outside > 0.5:
        members, driver = next(key for key, _ in ranked if key[1] is not None)
        return AxisVerdict(by_members[members], outside, marginal, dict.fromkeys(members, ()), driver)
    inside = {members: p for (members, driver), p in ranked if driver is None}
    members = next(iter(inside))
    classes = _classes(members, inside)
    like = {m: {m, *classes[m]} for m in members}
    sure = tuple(m for m in members if sum(p for (own, _), p in ranked if like[m] & {*own}) >= _NAMED)
    if sure in inside:
        members, classes = sure, _classes(sure, inside)
    same = sum(p for own, p in inside.items() if _equals(own, members, classes))
    return AxisVerdict(by_members[members], same, marginal, classes, None)


def _prior(fit: Fit) -> float:
    return log_posterior(fit) - fit.log_evidence


def _slight(problem: Problem, axis: int) -> float:
    """Mean square of what a shift of the time stamps moves the axis by [rad^2 or m^2]: less is no effect."""
    step = float(problem.data.time.diff(dim=-1).median())
    return (_STAMP * step) ** 2 * float(problem.data.speed[axis][problem.data.judged].square().mean())


def _essential(members: Members, left: Mapping[Members, float], slight: float) -> Members:
    """The set without members that do next to nothing, the least first; left: mean square that each set leaves."""
    while members:
        rest = [tuple(m for m in members if m != e) for e in members]
        least = min((r for r in rest if r in left), key=lambda r: left[r], default=None)
        if least is None or left[least] - left[members] >= slight:
            break
        members = least
    return members


def _classes(members: Members, inside: Mapping[Members, float]) -> dict[int, tuple[int, ...]]:
    """Of each member the effects that can stand in its place, the most probable first."""
    found = {}
    for m in members:
        rest = {*members} - {m}
        others = [(own, {*own} - rest) for own, p in inside.items() if rest <= {*own} and p * _LIKE > inside[members]]
        found[m] = tuple(new.pop() for own, new in others if len(new) == 1 and m not in own)
    return found


def _equals(own: Members, named: Members, classes: Mapping[int, tuple[int, ...]]) -> bool:
    """Whether a set has every named effect, or one of its class in its place, and nothing else."""
    left = {*own}
    for m in named:
        left.discard(next((e for e in (m, *classes[m]) if e in left), m))
    return not left and len(own) == len(named)


def _with_drivers(
    found: Search, axis: int, drivers: Sequence[Driver], fits: Mapping[Members, Fit], slight: float
) -> list[_Set]:
    """Drivers beside the most probable sets, and those that lead from the best one to none."""
    problem, judged, one = found.problem, found.problem.data.judged, _one(found, axis)
    values = float(problem.judged.sum())
    white = [problem.whitened(driver.columns[axis][:, None], one)[0] for driver in drivers]
    chain = [found.found[axis][0]]
    while chain[-1].members:
        less = [tuple(m for m in chain[-1].members if m != e) for e in chain[-1].members]
        chain.append(min((fits[r] for r in less if r in fits), key=lambda f: f.left))
    sets: list[tuple[int, _Set]] = []
    taken: list[dict[Members, float]] = [{} for _ in drivers]
    left = {members: fit.left for members, fit in fits.items()}
    for base in {f.members: f for f in [*found.found[axis][:_BASES], *chain]}.values():
        theta = torch.stack([base.spec.theta if i == axis else own[0].spec.theta for i, own in enumerate(found.found)])
        flat = list(base.spec.flat)
        active = torch.full((1, len(theta), len(flat)), -1)
        active[0, axis] = torch.tensor(flat, dtype=torch.int64)
        residual, own = sensitivities(problem, found.whitening, theta[None], active)
        plain = problem.residual(theta[None])[0, axis]
        y = residual[axis, 0] + base.spec.theta[flat] @ own[axis, 0]
        prior = _prior(base) + _OUTSIDE + (CROWD if len(base.members) >= 2 else 0.0)
        for k, (driver, columns) in enumerate(zip(drivers, white, strict=True)):
            x = torch.cat([own[axis, 0], columns])
            grams = grams_of(x.mT[:, None, :], y[:, None])._replace(values=values)
            groups = [*base.spec.groups, torch.arange(len(flat), len(x))]
            # What it takes away of the position itself, not of its whitened form.
            mean = fit_sets(grams, [groups], 0.0).mean[0, len(flat) :]
            rest = (plain - (mean[:, None, None] * driver.columns[axis]).sum(0))[judged].square().mean()
            taken[k][base.members] = float(rest)
            there = driver.name if float(plain[judged].square().mean() - rest) >= slight else None
            sets.append((k, _Set((base.members, there), grams, groups, prior)))
    # Beside a driver a name has to do what the driver does not do as well.
    return [
        one._replace(key=(_essential(one.key[0], taken[k] if one.key[1] else left, slight), one.key[1]))
        for k, one in sets
    ]


def _one(found: Search, axis: int) -> Whitening:
    """The whitening of one axis."""
    return Whitening(found.whitening.coefficients[axis : axis + 1])
