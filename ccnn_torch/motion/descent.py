"""Gauss-Newton steps of many sets of effects side by side, on residuals that are simulated for all of them at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.priors import WIDE
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.spec import Spec
from ccnn_torch.motion.whiten import Whitening

STEP = 1e-3
"""Of a difference quotient, in plausible sizes."""
# How often numbers at an end of what they may be are looked for in a step.
_HELD = 3
# Shares of a Gauss-Newton step that are tried, the whole one first, and what a step is damped by.
_SHARES = (1.0, 0.25)
_DAMPING, _LESS, _MORE = 1e-3, 0.2, 10.0
# Trials for each time that columns are simulated, and share of a promised gain from which columns still hold.
_TRIALS, _AS_PROMISED = 3, 0.5
# Share of the steps of a set that leaves more than its goal.
_FAR = 0.5
# A set whose step fails at this damping has ended.
_STIFF = 10.0
# Plausible sizes that a number moves at most in a step.
_FARTHEST = 5.0
# Simulated values that are held in memory at a time.
_VALUES = 3e7
# Half deviance for each value that a step must gain for another one to be made.
_GAINED = 1e-4


def lots(problem: Problem, specs: Sequence[tuple[int, Spec]]) -> Iterator[Sequence[tuple[int, Spec]]]:
    """Sets, one lot after the other, that are simulated at a time."""
    first, simulated = 0, 0
    for k, (_, spec) in enumerate(specs):
        simulated += (len(spec.moved) + 2) * problem.data.judged.numel()
        if simulated > _VALUES or k == len(specs) - 1:
            yield specs[first : k + 1]
            first, simulated = k + 1, 0


def sensitivities(
    problem: Problem,
    whitening: Whitening,
    theta: Tensor,
    axis: Tensor,
    places: Sequence[Sequence[int]],
) -> tuple[Tensor, Tensor]:
    """Whitened residuals and what numbers change in the positions.

    Args:
        theta: `p x k`.
        axis: of each row, `p`.
        places: of the numbers of each row.

    Returns:
        `p x v` and `p x m x v`, `v` values; beyond a row's own numbers 0.
    """
    residual = white_residual(problem, whitening, theta, axis)
    return residual, _columns(problem, whitening, theta, axis, places, residual)


def white_residual(problem: Problem, whitening: Whitening, theta: Tensor, axis: Tensor) -> Tensor:
    """Whitened residuals of models `p x k` of the axes `p`, `p x v`."""
    return problem.whitened(problem.residual(theta, axis), axis, whitening)


def _columns(
    problem: Problem,
    whitening: Whitening,
    theta: Tensor,
    axis: Tensor,
    places: Sequence[Sequence[int]],
    residual: Tensor,
) -> Tensor:
    """As `sensitivities`; residual: whitened, `p x v`."""
    counts = torch.tensor([len(own) for own in places], dtype=torch.int64)
    which = torch.repeat_interleave(torch.arange(len(places)), counts)
    columns = residual.new_zeros(len(theta), int(counts.max()) if len(counts) else 0, residual.shape[1])
    if len(which):
        # One row for every number that is moved.
        moved = theta[which]
        moved[torch.arange(len(which)), torch.tensor([j for own in places for j in own])] += STEP
        column = torch.cat([torch.arange(int(c)) for c in counts])
        columns[which, column] = (residual[which] - white_residual(problem, whitening, moved, axis[which])) / STEP
    return columns


class Point(NamedTuple):
    """Numbers of sets, `p x k`, with residuals and columns there, as of `sensitivities`."""

    theta: Tensor
    residual: Tensor
    columns: Tensor


def renew(
    problem: Problem,
    whitening: Whitening,
    point: Point,
    axis: Tensor,
    places: Sequence[Sequence[int]],
    those: Tensor,
) -> None:
    """Simulate the columns of some rows where they are now."""
    if len(those):
        own = [places[k] for k in those.tolist()]
        new = _columns(problem, whitening, point.theta[those], axis[those], own, point.residual[those])
        point.columns[those, : new.shape[1]] = new


def descended(
    problem: Problem,
    whitening: Whitening,
    begin: Point,
    axis: Tensor,
    places: Sequence[Sequence[int]],
    steps: int,
    values: float,
    goal: Tensor,
) -> tuple[Point, Tensor, Tensor]:
    """Where Gauss-Newton steps end, whether columns are those of there, and whether no step leads further, `p` each.

    From step to step columns follow what the residuals do (Broyden 1965), and are simulated anew where that promised
    another gain than there was, or none.
    """
    point = Point(*(v.clone() for v in begin))
    theta, residual, columns = point
    active, real = padded(places)
    bounds = [bound[axis].gather(-1, active) for bound in problem.library.bounds]
    damping = torch.full((len(theta),), _DAMPING, dtype=theta.dtype)
    made, is_exact = torch.ones(len(theta)), torch.ones(len(theta), dtype=torch.bool)
    settled = torch.zeros_like(is_exact)
    run = torch.tensor([k for k, own in enumerate(places) if own and steps], dtype=torch.int64)

    def white(theta: Tensor, those: Tensor) -> Tensor:
        return white_residual(problem, whitening, theta, axis[those])

    for _ in range(_TRIALS * steps):
        if not len(run):
            break
        x, y, own, at = columns[run], residual[run], theta[run].gather(-1, active[run]), theta[run]
        low, high = ((bound[run] - own) * real[run] for bound in bounds)
        move = _step(x, y, own * real[run], (low, high), damping[run], values)
        cost = _cost(y, at, values)
        least = _cost(y - (move[:, None] @ x)[:, 0], at.scatter_add(-1, active[run], move), values)
        promised = cost - least
        share, gained = _tried(white, theta, residual, run, active[run], move, promised >= _GAINED * values, values)
        good = (gained > 0).nonzero()[:, 0]
        step = (share[:, None] * move)[good]
        surprise = y[good] - residual[run[good]] - (step[:, None] @ x[good])[:, 0]
        columns[run[good]] += (step / step.square().sum(-1, keepdim=True))[..., None] * surprise[:, None]
        is_exact[run[good]] = False
        damping[run] *= torch.where(share == 1, _LESS, 1.0)
        poor = gained < torch.maximum(_AS_PROMISED * promised, promised.new_tensor(_GAINED * values))
        stale = poor & ~is_exact[run]
        damping[run] *= torch.where((share < 1) & ~(stale & (share == 0)), _MORE, 1.0)
        ended = is_exact[run] & ((promised < _GAINED * values) | (damping[run] >= _STIFF))
        settled[run[ended]] = True
        most = torch.where(residual[run].square().sum(-1) <= goal[run], steps, math.ceil(_FAR * steps))
        ended |= stale & (made[run] >= most)
        anew = run[stale & ~ended]
        renew(problem, whitening, point, axis, places, anew)
        made[anew], is_exact[anew] = made[anew] + 1, True
        run = run[~ended]
    return point, is_exact, settled


def _tried(
    white: Callable[[Tensor, Tensor], Tensor],
    theta: Tensor,
    residual: Tensor,
    run: Tensor,
    active: Tensor,
    move: Tensor,
    promising: Tensor,
    values: float,
) -> tuple[Tensor, Tensor]:
    """Take the best share of each step that leaves less, in `theta` and `residual`, all shares simulated at once.

    Args:
        white: whitened residuals of numbers `p x k` of the rows `p`.
        theta, residual: of all rows.
        run, active: the rows that step, `r`, and places of their numbers, `r x m`.
        move: their steps, `r x m`.
        promising: which of these are tried, `r`.
        values: how many count.

    Returns:
        the shares, 0 where no one leaves less, and the half deviance that each gained, `r` each.
    """
    share, gained = torch.zeros_like(move[:, 0]), torch.zeros_like(move[:, 0])
    those = promising.nonzero()[:, 0]
    if not len(those):
        return share, gained
    here, shares = run[those], move.new_tensor(_SHARES)
    moved = theta[here].expand(len(shares), -1, -1)
    moved = moved.scatter_add(-1, active[those].expand(len(shares), -1, -1), shares[:, None, None] * move[those])
    left = white(moved.flatten(0, 1), here.repeat(len(shares))).reshape(len(shares), len(here), -1)
    gain, best = (_cost(residual[here], theta[here], values) - _cost(left, moved, values)).max(0)
    better = (gain > 0).nonzero()[:, 0]
    share[those[better]], gained[those[better]] = shares[best[better]], gain[better]
    theta[here[better]], residual[here[better]] = moved[best[better], better], left[best[better], better]
    return share, gained


def padded(places: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor]:
    """Places of the numbers of each row, `p x m`, padded with 0, and 1 where there is one, else 0."""
    wide = max(map(len, places))
    active = torch.tensor([[*own, *[0] * (wide - len(own))] for own in places])
    real = torch.tensor([[k < len(own) for k in range(wide)] for own in places])
    return active, real.double()


def _step(x: Tensor, y: Tensor, own: Tensor, ends: tuple[Tensor, Tensor], damping: Tensor, values: float) -> Tensor:
    """Damped Gauss-Newton steps, `p x m`.

    Args:
        x, y: columns `p x m x v` and residuals `p x v`.
        own: the numbers, `p x m`.
        ends: least and largest step of each number, `p x m`; both 0 where there is no number.
        damping: share of the diagonal, `p`.
        values: how many count.
    """
    noise = (y.square().sum(-1) / values).clamp_min(1e-300)[:, None]
    gram, push = (x @ x.mT) / noise[..., None], (x @ y[..., None])[..., 0] / noise - own / WIDE**2
    inner = gram + torch.diag_embed(damping[:, None] * gram.diagonal(dim1=-2, dim2=-1) + 1 / WIDE**2)
    low, high = (end.clamp(-_FARTHEST, _FARTHEST) for end in ends)
    move, held = torch.zeros_like(own), low == high
    for _ in range(_HELD):
        # Numbers that a step would take beyond an end stay there, and the others make the best of that.
        there = torch.where(held, move, 0.0)
        rest = (push - (inner @ there[..., None])[..., 0]) * ~held
        left = inner * (~held[:, :, None] & ~held[:, None, :]) + torch.diag_embed(held.to(inner.dtype))
        free: Tensor = torch.linalg.solve(left, rest[..., None])[..., 0]
        move = torch.maximum(torch.minimum(there + free, high), low)
        held = held | (move != there + free)
    return move


def _cost(residual: Tensor, theta: Tensor, values: float) -> Tensor:
    """Half the deviance, `...`; residual `... x v`, theta `... x k`."""
    rss = residual.square().sum(-1)
    return 0.5 * values * torch.log(rss.clamp_min(1e-300)) + 0.5 * theta.square().sum(-1) / WIDE**2


def refitted(
    problem: Problem, whitening: Whitening, specs: Sequence[tuple[int, Spec]], parts: Sequence[Tensor]
) -> list[Tensor]:
    """Numbers of sets as some stretches alone tell them, `p x k` for each part, from the numbers that all tell.

    Args:
        problem, whitening, specs: as of `fit_many`.
        parts: stretches of each.
    """
    found: list[list[Tensor]] = [[] for _ in parts]
    for lot in lots(problem, specs):
        axis, places = torch.tensor([i for i, _ in lot]), [s.moved for _, s in lot]
        theta = torch.stack([s.theta for _, s in lot])
        both = sensitivities(problem, whitening, theta, axis, places)
        for own, rows in zip(found, parts, strict=True):
            begin = Point(
                theta, *(v.reshape(*v.shape[:-1], len(problem.judged), -1)[..., rows, :].flatten(-2) for v in both)
            )
            some, goal = problem.of(rows), torch.full_like(theta[:, 0], math.inf)
            own.append(descended(some, whitening, begin, axis, places, 1, some.values, goal)[0].theta)
    return [torch.cat(own) for own in found]
