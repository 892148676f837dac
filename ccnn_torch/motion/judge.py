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

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from ccnn_torch.evidence.form_error import DIRECTIONS, LEVELS, LOG_EXACT, OF_SMOOTH, share_of_exact
from ccnn_torch.evidence.judge import Explanation, judge, marginal, posterior
from ccnn_torch.evidence.marginal_likelihood import Grams
from ccnn_torch.motion.descent import sensitivities
from ccnn_torch.motion.fit import products, side_by_side, squares_unseen, weighed
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, prior_of
from ccnn_torch.motion.spec import Fit, Spec
from ccnn_torch.motion.stretches import direction
from ccnn_torch.motion.whiten import white_noise

# Probability of something outside that takes nothing away on runs that no fit saw, and of nothing where a set leaves
# clearly less, in RMS.
_UNCONFIRMED, _CLEARLY = 0.5, 3.0
# Sets beside which drivers are tried, besides those that lead from the best one to none.
_BASES = 6
# Share of what is left of runs that were not fitted up to which a set without a member is as good.
_NEARLY = 1.02
# Knots of a cubic spline: at quantiles of a driver, and evenly spaced ones of a position and of the time.
_KNOTS, _EVENLY = 7, 9
# Time constants of what fades after a reversal [s].
_FADING = (0.03, 0.1, 0.3)
# Changes of the temperature below this show nothing [K].
_WARMER = 5.0
# Share of the motion from which the lead of the command over the position is a torque.
_LOADED = 1e-4
# Quantiles between which the knots lie.
_ENDS = (0.02, 0.98)
# Share of the motion by which a torque moves the axis for its columns, and how far the columns reach.
_STEP, _SIZE = 1e-3, 0.05

Members = tuple[int, ...]
# Names, drivers, log posterior and set.
Named = tuple[frozenset[int], tuple[str, ...], float, "Candidate"]


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
    best = [fits[0].spec for fits in found.found]
    drivers, above = driver_columns(found.problem, best), _above_white(found.problem, best)
    verdicts = [_judged(found, i, drivers, above[i]) for i in range(len(found.found))]
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


def _judged(search: Search, axis: int, drivers: Sequence[Driver], above: float) -> AxisVerdict:
    problem, fits = search.problem, search.found[axis]
    by_members = {f.members: f for f in fits}
    left = {f.members: f.left for f in fits}
    unseen = {f.members: f.unseen for f in fits}
    sets = [Candidate(essential(f.members, left, unseen), (), f.grams, f.spec.groups, prior_of(f)) for f in fits]
    sets += with_drivers(search, axis, drivers, by_members)
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

    def left_by(grams: Grams, groups: list[Tensor]) -> float:
        """Squares that a set leaves, nominal values and time stamps being off as is likely."""
        return noise * float(weighed(grams, beside, [groups], noise).rss)

    def rest_of(one: Explanation[Candidate]) -> tuple[str, ...] | None:
        """What the remainder of an explanation follows, where that is more than the noise and form errors."""
        more = left_by(one.best.grams, one.best.groups) - noise * problem.values
        if more <= max(noise * _CLEARLY**2 * math.sqrt(2 * problem.values), DIRECTIONS * search.form[axis]):
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
        doubted = left_by(best.grams, []) > most
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
    best, told, most = fits[members], dict[int, tuple[int, ...]](), _NEARLY**2
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


class Candidate(NamedTuple):
    """A set of effects, with a driver or without, as it is weighed.

    Attributes:
        members: those that do something.
        drivers: what a term beside them follows; () = there is none, or it does next to nothing.
        grams, groups, log_prior: of its model linearised.
        rows: with a driver, whitened columns of members and driver, `m x v` each, and what they explain, `v`.
    """

    members: Members
    drivers: tuple[str, ...]
    grams: Grams
    groups: list[Tensor]
    log_prior: float
    rows: tuple[Tensor, Tensor, Tensor] | None = None


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
    mine, values = torch.tensor([axis]), problem.values
    white, plain = (
        [problem.whitened(d.columns[axis], mine.expand(len(d.columns[axis])), whitening) for d in drivers]
        for whitening in (found.whitening, plainly)
    )
    chain = [found.found[axis][0]]
    while chain[-1].members:
        less = [tuple(m for m in chain[-1].members if m != e) for e in chain[-1].members]
        chain.append(min((fits[r] for r in less if r in fits), key=lambda f: f.left, default=fits[()]))
    taken: list[dict[Members, float]] = [{} for _ in drivers]
    left = {members: fit.left for members, fit in fits.items()}
    # What a driver has to take away: a smooth function can follow what is wrong with the form of a model.
    slight = float((problem.stamped[axis][problem.data.judged] / problem.unit[axis]).square().mean()) * values
    bases = [*{f.members: f for f in [*found.found[axis][:_BASES], *chain]}.values()]
    theta, at, places = (
        torch.stack([f.spec.theta for f in bases]),
        mine.expand(len(bases)),
        [f.spec.flat for f in bases],
    )
    residual, columns = sensitivities(problem, found.whitening, theta, at, places)
    # Of the position itself, not of its whitened form.
    low, high = (ends[axis] for ends in problem.library.bounds)
    # A number at an end of what it may be stays there.
    free = ((theta > low) & (theta < high)).to(theta.dtype)
    left_plain, columns_plain = sensitivities(problem, plainly, theta, at, places)
    sets: list[tuple[int, Candidate]] = []
    for b, base in enumerate(bases):
        own = columns[b, : len(places[b])] * free[b, list(places[b])][:, None]
        y = residual[b] + theta[b, list(places[b])] @ own
        prior = prior_of(base, drivers=1)
        for k, (driver, beside) in enumerate(zip(drivers, white, strict=True)):
            x = torch.cat([own, beside])
            grams = products(found.nuisance[axis], x, y, values)
            groups = [*base.spec.groups, torch.arange(len(own), len(x))]
            sets.append((k, Candidate(base.members, (driver.name,), grams, groups, prior, (own, beside, y))))
    grams = side_by_side([one.grams for _, one in sets])
    means = weighed(grams, found.nuisance.shape[1], [one.groups for _, one in sets], None).mean
    for n, (k, one) in enumerate(sets):
        b = n // len(drivers)
        m = len(places[b])
        moved = (means[n, :m] - theta[b, list(places[b])]) * free[b, list(places[b])]
        rest = left_plain[b] - moved @ columns_plain[b, :m] - means[n, m : m + len(plain[k])] @ plain[k]
        taken[k][one.members] = float(rest.square().sum())
        gained = float(left_plain[b].square().sum()) - taken[k][one.members]
        sets[n] = k, one if gained >= slight else one._replace(drivers=())
    # Beside a driver a name has to do what the driver does not do as well.
    return [one._replace(members=essential(one.members, taken[k] if one.drivers else left, {})) for k, one in sets]


def holds(problem: Problem, candidate: Candidate, nuisance: int) -> bool:
    """Whether a driver takes something away on runs that no fit saw; the scales are those of all runs.

    nuisance: how many columns it has.
    """
    assert candidate.rows is not None
    own, columns, y = candidate.rows
    fold = problem.fold[:, None].expand(problem.judged.shape).flatten()
    less, more = (
        float(squares_unseen(x[None], y[None], weighed(candidate.grams, nuisance, [groups], None), fold))
        for x, groups in ((own, candidate.groups[:-1]), (torch.cat([own, columns]), candidate.groups))
    )
    return more < less


class Driver(NamedTuple):
    """A driver and its columns in plausible sizes [rad or m], `n x m x b x s`."""

    name: str
    columns: Tensor


def driver_columns(problem: Problem, specs: list[Spec]) -> list[Driver]:
    """Columns of each driver, and those of a torque that follows it; drivers that do not vary are left out.

    Args:
        problem: the data.
        specs: of each axis the set whose motion tells speed, acceleration and torque.
    """
    data = problem.data
    theta = torch.stack([spec.theta for spec in specs])
    moved = problem.positions(theta, problem.axes)
    step = data.time.diff(dim=-1).clamp_min(1e-9)
    speed = _slope(moved, step)
    acceleration = _slope(speed, step)
    error = problem.driven.followed - moved
    # An axis that follows exactly has no torque, and what rounding leaves of it has the sign of the speed.
    span = (data.position.amax((-1, -2)) - data.position.amin((-1, -2)))[:, None, None, None]
    loaded = error.abs().amax((-1, -2))[:, None, None, None] > _LOADED * span
    place, over = _smooth(moved, data.judged, True), _over_time(problem)
    sign = direction(speed, speed.abs().mean((-1, -2), keepdim=True))[:, None]
    fast = _smooth(speed, data.judged)
    direct = {
        "speed": fast,
        "acceleration": _smooth(acceleration, data.judged),
        "reversal": _fading(speed, data.time),
        "position": place,
        "torque": _smooth(error, data.judged) * loaded,
        # A constant of its own: what drifts begins somewhere.
        "time": torch.cat([torch.ones_like(over[:, :1]), over], 1),
    }
    # Friction comes and goes with the place, the time and the temperature as well.
    pushed = [("speed", fast), ("position", place), ("position", place * sign), ("time", over * sign)]
    warmest = problem.driven.warm.abs().max()
    if float(warmest) >= _WARMER:
        warm = (problem.driven.warm / warmest).expand(len(moved), -1, -1)[:, None]
        pushed.append(("temperature", warm * sign))
        direct["temperature"] = warm
    found = [Driver(name, _SIZE * span * columns) for name, columns in direct.items()]
    under = problem.pushed(theta, torch.cat([_STEP * span * columns for _, columns in pushed], 1))
    columns = (under - moved[:, None]) * (_SIZE / _STEP)
    widths = [c.shape[1] for _, c in pushed]
    return found + [Driver(n, c) for (n, _), c in zip(pushed, torch.split(columns, widths, 1), strict=True)]


def _slope(values: Tensor, step: Tensor) -> Tensor:
    slope = values.diff(dim=-1) / step
    return torch.cat([slope[..., :1], slope], -1)


def _smooth(driver: Tensor, judged: Tensor, is_even: bool = False) -> Tensor:
    """Cubic B-splines, `n x m x b x s`, with their knots at quantiles, or evenly spaced."""
    share = torch.linspace(*((0, 1, _EVENLY) if is_even else (*_ENDS, _KNOTS)), dtype=driver.dtype)
    found = driver.new_zeros(len(driver), len(share) + 2, *driver.shape[1:])
    for splines, one in zip(found, driver, strict=True):
        some = one[judged]
        even = some.min() + share * (some.max() - some.min())
        knots = torch.unique(even if is_even else torch.quantile(some, share)).numpy()
        if len(knots) > 2:
            ends = np.concatenate([knots[:1].repeat(3), knots, knots[-1:].repeat(3)])
            at = one.flatten().numpy().clip(knots[0], knots[-1])
            values = BSpline.design_matrix(at, ends, 3).toarray()
            splines[: values.shape[1]] = torch.from_numpy(values.T).reshape(-1, *one.shape)
    return found


def _fading(speed: Tensor, time: Tensor) -> Tensor:
    """What jumps with the sign of the speed at a reversal and fades, `n x m x b x s`."""
    sign = torch.sign(speed)
    turned = torch.zeros_like(sign)
    turned[..., 1:] = 0.5 * (sign[..., 1:] - sign[..., :-1])
    fall = torch.exp(-time.diff(dim=-1) / torch.tensor(_FADING, dtype=time.dtype)[:, None, None])
    columns = turned[:, None].repeat(1, len(_FADING), 1, 1)
    for k in range(1, sign.shape[-1]):
        columns[..., k] += columns[..., k - 1] * fall[..., k - 1]
    return columns


def _over_time(problem: Problem) -> Tensor:
    """Smooth functions of the time in each run, `n x m x b x s`."""
    data = problem.data
    share = torch.zeros_like(data.time)
    for run in sorted(set(data.run.tolist())):
        mine = data.run == run
        ends = data.time[mine][data.judged[mine]]
        share[mine] = ((data.time[mine] - ends.min()) / (ends.max() - ends.min()).clamp_min(1e-9)).clamp(0, 1)
    return _smooth(share[None], data.judged, True).expand(len(problem.axes), -1, -1, -1)
