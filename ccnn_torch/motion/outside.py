"""Sets of effects beside what a driver of something outside the library does."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.marginal_likelihood import Grams
from ccnn_torch.motion.descent import STEP
from ccnn_torch.motion.drivers import done, drivers_of
from ccnn_torch.motion.fit import products, side_by_side, squares_unseen, weighed
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, prior_of, promises
from ccnn_torch.motion.spec import Fit, Spec, nothing, started
from ccnn_torch.motion.whiten import white_noise

# Sets beside which drivers are tried, besides those that lead from the best one to none.
_BASES = 6
NEARLY = 1.02
"""Ratio of RMS, of what is left of runs that were not fitted, up to which a set without a member is as good."""
# Names that are looked for beside a torque, and fits of both together; and what such a torque follows.
_BESIDE, _FITS = 2, 6
# Share of a torque that changes from fit to fit where it has come to rest.
_SETTLED = 0.02
_FOLLOWED = ("speed", "position")

Members = tuple[int, ...]


class Candidate(NamedTuple):
    """A set of effects, with a driver or without, as it is weighed.

    Attributes:
        members: those that do something.
        drivers: what a term beside them follows; () = there is none.
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
    most = NEARLY**2 * unseen.get(members, 0.0)
    while members:
        rest = [r for e in members if (r := tuple(m for m in members if m != e)) in left]
        rest = [r for r in rest if left[r] <= left[members] or unseen.get(r, math.inf) <= most]
        if not rest:
            break
        members = min(rest, key=lambda r: left[r])
    return members


class _Beside(NamedTuple):
    """A driver beside a set.

    Attributes:
        set: as it is weighed.
        left: squares that are left of the position itself, in `unit`.
        spec, does: numbers of the set, and what the driver adds, `b x s` [rad or m], most probable together.
    """

    set: Candidate
    left: float
    spec: Spec
    does: Tensor


def with_drivers(found: Search, axis: int, fits: Mapping[Members, Fit], is_noise: bool) -> list[Candidate]:
    """Drivers beside the most probable sets and those that lead from the best one to none; torques that follow one also
    beside the names that promise most with them in place, unless the best set leaves noise (`is_noise`)."""
    problem = found.problem
    chain = [found.found[axis][0]]
    while chain[-1].members:
        less = [tuple(m for m in chain[-1].members if m != e) for e in chain[-1].members]
        chain.append(min((fits[r] for r in less if r in fits), key=lambda f: f.left, default=fits[()]))
    bases = {f.members: f.spec for f in [*found.found[axis][:_BASES], *chain]}
    sets = [one for spec in bases.values() for one in _beside(found, axis, spec)]
    every = list(enumerate(drivers_of(problem, axis, problem.data.position[axis])))
    for name in () if is_noise else _FOLLOWED:
        tried = [k for k, driver in every if driver.name == name and driver.is_torque]
        sets += [one for several in _beside_torque(found, axis, tried, fits) for one in several]
    taken: dict[int, dict[Members, float]] = {}
    for k, one in sets:
        own = taken.setdefault(k, {})
        own[one.set.members] = min(one.left, own.get(one.set.members, math.inf))
    # What a driver has to take away: a smooth function can follow what is wrong with the form of a model.
    squares = problem.unit[axis].square()
    slight = float((problem.stamped[axis][problem.data.judged].square() / squares).mean()) * problem.values
    told = []
    for k, (candidate, rest, *_) in sets:
        if fits[candidate.members].left * problem.values / float(squares) - rest >= slight:
            # Beside a driver a name has to do what the driver does not do as well.
            told.append(candidate._replace(members=essential(candidate.members, taken[k], {})))
    return told


def _beside_torque(
    found: Search, axis: int, tried: Sequence[int], fits: Container[Members]
) -> Iterator[list[tuple[int, _Beside]]]:
    """Torques that follow one driver, by their numbers, alone and beside the names that promise most with the last of
    them in place: a fit of these names without it may be far from what they do then."""
    problem, spec = found.problem, nothing(found.problem.library)
    variance = found.found[axis][0].noise + found.form[axis]
    # Beside names, which act on the simulated motion, one that follows the measured motion would draw it there.
    push = _beside(found, axis, spec, tried[-1:], None, problem.data.position[axis])[0][1].does
    for _ in range(_BESIDE + 1):
        last = None
        for _ in range(_FITS):
            _, _, spec, does = _beside(found, axis, spec, tried[-1:], push)[0][1]
            if last is not None and float((does - last).square().sum()) <= _SETTLED**2 * float(does.square().sum()):
                push = does
                break
            # Half of the way: a torque that brakes is smaller on the motion that it makes.
            last, push = does, (push + does) / 2
        several = _beside(found, axis, spec, tried, push)
        yield several
        best, _, spec, push = several[-1][1]
        assert best.rows is not None
        wide = torch.cat([found.nuisance, best.rows[1].expand(len(found.nuisance), -1, -1)], 1)
        promised = promises(problem.under(axis, push), found.whitening, [(axis, spec)], wide, [variance])[0]
        more = (started(spec, variant, axis) for _, variant in sorted(promised, key=lambda one: -one[0]))
        # Numbers of names are told as they are without the torque.
        fitted = next((one for one in more if one.members in fits), None)
        if fitted is None:
            return
        spec = fitted


def _beside(
    found: Search,
    axis: int,
    spec: Spec,
    tried: Sequence[int] | None = None,
    push: Tensor | None = None,
    moved: Tensor | None = None,
) -> list[tuple[int, _Beside]]:
    """Each driver, by its number, beside a set, linearised at its numbers.

    Args:
        tried: numbers of drivers; None = all.
        push: torque that is in place, `b x s`, in the place of which that of a driver is looked for; None = none.
        moved: motion that drivers follow, `b x s`; None = the simulated one.
    """
    problem = found.problem if push is None else found.problem.under(axis, push)
    theta, flat = spec.theta, list(spec.flat)
    low, high = (ends[axis, flat] for ends in problem.library.bounds)
    # A number at an end of what it may be stays there.
    free = (theta[flat] > low) & (theta[flat] < high)
    drivers, changes = _changes(problem, axis, spec, tried, push, moved)
    parts, views = [1, len(flat), *(len(columns) for _, columns in drivers.values())], []
    parts.append(len(changes) - sum(parts))
    # Whitened, and the position itself.
    for whitening in (found.whitening, white_noise(len(problem.axes))):
        white = problem.whitened(changes, torch.tensor([axis]).expand(len(changes)), whitening)
        residual, own, *each, in_place = torch.split(white, parts)
        own = own * free[:, None]
        views.append((residual[0] + theta[flat] @ own + in_place.sum(0), own, each))
    (y, own, each), (plain, own_plain, each_plain) = views
    sets = []
    for (name, _), beside in zip(drivers.values(), each, strict=True):
        x = torch.cat([own, beside])
        grams, groups = products(found.nuisance[axis], x, y, problem.values), torch.arange(len(own), len(x))
        rows, prior = (own, beside, y), prior_of(spec, drivers=1)
        sets.append(Candidate(spec.members, (name,), grams, [*spec.groups, groups], prior, rows))
    grams = side_by_side([one.grams for one in sets])
    means = weighed(grams, found.nuisance.shape[1], [one.groups for one in sets], None).mean
    result = []
    for (k, (_, columns)), one, mean, beside in zip(drivers.items(), sets, means, each_plain, strict=True):
        now, amount = theta.clone(), mean[len(flat) : len(flat) + len(beside)]
        now[flat] = torch.where(free, torch.maximum(torch.minimum(mean[: len(flat)], high), low), theta[flat])
        rest = plain - now[flat] @ own_plain - amount @ beside
        does_now = torch.tensordot(amount, columns, 1)
        result.append((k, _Beside(one, float(rest.square().sum()), spec._replace(theta=now), does_now)))
    return result


def _changes(
    problem: Problem, axis: int, spec: Spec, tried: Sequence[int] | None, push: Tensor | None, moved: Tensor | None
) -> tuple[dict[int, tuple[str, Tensor]], Tensor]:
    """As of `_beside`: names and columns of drivers, and rows `… x b x s`: the residual, and what numbers of the set,
    drivers, and the torque that is in place change in the positions."""
    flat = list(spec.flat)
    theta = spec.theta.repeat(len(flat) + 1, 1)
    theta[torch.arange(1, len(theta)), flat] += STEP
    mine = torch.tensor([axis]).expand(len(theta))
    places = problem.positions(theta, mine)
    left = problem.left_by(places, mine)
    every = drivers_of(problem, axis, places[0] if moved is None else moved)
    drivers = {k: (d.name, d.columns()) for k, d in enumerate(every) if tried is None or k in tried}
    torques = [columns for k, (_, columns) in drivers.items() if every[k].is_torque]
    torques += [] if push is None else [push[None]]
    does = done(problem, spec.theta, axis, places[0], torch.cat(torques))
    direct = [columns for k, (_, columns) in drivers.items() if not every[k].is_torque]
    return drivers, torch.cat([left[:1], (left[:1] - left[1:]) / STEP, *direct, does])


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
