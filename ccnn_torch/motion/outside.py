"""Sets with a cause outside the library beside them: what a driver does, and whether it does it on other runs, too."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.marginal_likelihood import Grams, fit_sets, grams_of
from ccnn_torch.motion.drivers import Driver
from ccnn_torch.motion.fit import sensitivities, squares_unseen
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import CROWD, Search, log_posterior
from ccnn_torch.motion.spec import Fit
from ccnn_torch.motion.whiten import white_noise

# Log prior odds of a driver.
_OUTSIDE = math.log(0.001)
# Sets beside which drivers are tried, besides those that lead from the best one to none.
_BASES = 6
# Share of what is left of runs that were not fitted up to which a set without a member is as good.
_NEARLY = 1.02

Members = tuple[int, ...]


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
        prior = prior_of(base) + _OUTSIDE + (CROWD if len(base.members) >= 2 else 0.0)
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
