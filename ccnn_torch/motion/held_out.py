"""How far sets of effects take the gap on runs that no fit saw."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis.shrink.held_out import Draws, Gap, HeldOut, shrink_of
from ccnn_torch.motion.fit import Spec, fit_many
from ccnn_torch.motion.problem import Problem, Whitening

__all__ = ["gap_of", "held_out"]

_STEPS = 3


def held_out(problem: Problem, whitening: Whitening, sets: Sequence[Sequence[Spec]]) -> Tensor:
    """Residuals of every stretch by fits to the other folds, `h x n x b x s` [rad or m].

    Args:
        problem: the data.
        whitening: of the residual.
        sets: `h` sets of each of `n` axes; what they hold and its shapes are those of all runs, the numbers are not.
    """
    left = problem.residual(torch.stack([torch.stack([s.theta for s in row]) for row in sets]))
    folds = int(problem.fold.max()) + 1
    for k in range(folds if folds > 1 else 0):
        here, rest = (problem.fold == k).nonzero()[:, 0], (problem.fold != k).nonzero()[:, 0]
        fits = fit_many(problem, whitening, sets, _STEPS, rest)
        theta = torch.stack([torch.stack([f.spec.theta for f in row]) for row in fits])
        left[:, :, here] = problem.residual(theta, here)
    return left


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
