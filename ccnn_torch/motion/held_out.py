"""How far sets of effects take the gap on runs that no fit saw."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.evidence.shrink import Draws, Gap, HeldOut, shrink_of
from ccnn_torch.motion.descent import refitted
from ccnn_torch.motion.judge import AxisVerdict
from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.search import Search, log_posterior
from ccnn_torch.motion.spec import Spec, nothing, without
from ccnn_torch.motion.whiten import Whitening


def held_out(problem: Problem, whitening: Whitening, sets: Sequence[Sequence[Spec]]) -> Tensor:
    """Residuals of every stretch by fits to the other folds, `h x n x b x s` [rad or m].

    Args:
        problem: the data.
        whitening: of the residual.
        sets: `h` sets of each of `n` axes; what they hold and its shapes are those of all runs, the numbers are not.
    """
    pairs = [(i, spec) for row in sets for i, spec in enumerate(row)]
    axis = problem.axes.repeat(len(sets))
    left = problem.residual(torch.stack([spec.theta for _, spec in pairs]), axis)
    folds = range(int(problem.fold.max()) + 1) if int(problem.fold.max()) else ()
    parts = [(problem.fold != k).nonzero()[:, 0] for k in folds]
    for k, theta in enumerate(refitted(problem, whitening, pairs, parts)):
        here = (problem.fold == k).nonzero()[:, 0]
        left[:, here] = problem.of(here).residual(theta, axis)
    return left.reshape(len(sets), -1, *left.shape[1:])


def best_to_follow(
    problem: Problem, found: Search, verdicts: Sequence[AxisVerdict], left: Tensor
) -> tuple[list[Spec], Tensor]:
    """Of each axis the set that leaves least of runs that no fit saw, and what that is, `n x b x s` [rad or m].

    A verdict has the fewest names that are sure; a command is the better the more is in it that the runs bear out.
    Beside the verdict's set stand the likeliest one under the noise that it leaves itself, and the closest fit.

    Args:
        problem: as of `held_out`.
        found: all sets.
        verdicts: of each axis.
        left: what the verdicts' sets leave so, as of `held_out`.
    """
    likeliest = [max(fits, key=log_posterior).spec for fits in found.found]
    closest = [min(fits, key=lambda fit: fit.rss).spec for fits in found.found]
    sets = [[v.best.spec for v in verdicts]]
    for other in (likeliest, closest):
        if all([s.members for s in own] != [s.members for s in other] for own in sets):
            sets.append(other)
    residuals = left[None]
    if sets[1:]:
        residuals = torch.cat([residuals, held_out(problem, found.whitening, sets[1:])])
    least = residuals[..., problem.data.judged].square().mean(-1).argmin(0).tolist()
    chosen = torch.stack([residuals[k, i] for i, k in enumerate(least)])
    return [sets[k][i] for i, k in enumerate(least)], chosen


def gap_of(problem: Problem, before: Tensor, after: Tensor, floor: float, known: bool, draws: Draws) -> Gap:
    """RMS before and after, and the shrink above the noise; stretches are drawn.

    Args:
        problem: the data.
        before, after: residuals, `n x b x s`.
        floor: variance of the noise of all axes together.
        known: whether it was given.
        draws: of the stretches.
    """
    judged = problem.data.judged
    per = judged.sum() / len(judged)
    rows = [((v.square() * judged).sum((0, -1)) / per).sqrt()[:, None] for v in (before, after)]
    held = HeldOut(rows[1], torch.zeros_like(rows[1]))
    dof = 0.0 if known else float(judged.sum())
    return shrink_of(rows[0], held, torch.tensor([floor], dtype=per.dtype), torch.tensor([True]), dof, draws)


def only(spec: Spec, members: Sequence[int]) -> Spec:
    """The set with these members alone."""
    while extra := [k for k, m in enumerate(spec.members) if m not in members]:
        spec = without(spec, extra[0])
    return spec


def singles(found: Search) -> dict[str, list[Spec]]:
    """Of each effect alone its fit on every axis; an axis that cannot show it has none."""
    library = found.problem.library
    alone = [{f.members[0]: f.spec for f in fits if len(f.members) == 1} for fits in found.found]
    return {
        name: [own.get(e, nothing(library)) for own in alone]
        for name, e in ((name, library.twins.get(k, k)) for k, name in enumerate(library.names))
        if any(e in own for own in alone)
    }


def in_order(problem: Problem, verdicts: Sequence[AxisVerdict]) -> list[str]:
    """Names of the verdict, the one without which most is left first."""
    names = problem.library.names
    there = list(dict.fromkeys(m for v in verdicts for m in v.best.members))
    if not there:
        return []
    specs = [only(v.best.spec, [m for m in there if m != e]) for e in there for v in verdicts]
    left = problem.residual(torch.stack([s.theta for s in specs]), problem.axes.repeat(len(there)))
    size = (left.square() * problem.data.judged).sum((1, 2)).reshape(len(there), -1).sum(1)
    return [names[there[k]] for k in torch.argsort(size, descending=True).tolist()]
