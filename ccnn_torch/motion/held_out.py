"""How far sets of effects take the gap on runs that no fit saw."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis.shrink.held_out import INTERVAL
from ccnn_torch.motion.fit import Spec, fit_many
from ccnn_torch.motion.problem import Problem, Whitening

__all__ = ["Spread", "held_out", "resampled", "shrink_of"]

_REPEATS, _STEPS = 400, 3
# Reducible residual of a bootstrap sample, at least, as a share of that of all stretches.
_LEAST_GAP = 1e-3


def held_out(problem: Problem, whitening: Whitening, sets: Sequence[Sequence[Spec]]) -> Tensor:
    """Residuals of every stretch by fits to the other folds, `h x n x b x s` [rad or m].

    Args:
        problem: the data.
        whitening: of the residual.
        sets: `h` sets of each of `n` axes; what they hold and its shapes are those of all runs, the numbers are not.
    """
    fold = problem.fold
    nominal = problem.residual(torch.stack([torch.stack([s.theta for s in row]) for row in sets]))
    left = nominal.clone()
    if int(fold.max()) == 0:
        return left
    for k in range(int(fold.max()) + 1):
        here, rest = (fold == k).nonzero()[:, 0], (fold != k).nonzero()[:, 0]
        fits = fit_many(problem, whitening, sets, _STEPS, rest)
        theta = torch.stack([torch.stack([f.spec.theta for f in row]) for row in fits])
        left[:, :, here] = problem.residual(theta, here)
    return left


class Spread:
    """Stretches drawn with replacement, and squares of residuals of them."""

    def __init__(self, problem: Problem, seed: int) -> None:
        self.judged = problem.data.judged
        count = len(self.judged)
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randint(count, (_REPEATS, count), generator=generator)
        self.counts = torch.zeros(_REPEATS, count, dtype=torch.float64).scatter_add_(
            1, drawn, torch.ones(drawn.shape, dtype=torch.float64)
        )
        self.samples = self.judged.sum(-1).double()

    def squares(self, residual: Tensor) -> Tensor:
        """Of all axes together by stretch, `b`; residual: `n x b x s`."""
        return (residual.square() * self.judged).sum((0, -1))


def resampled(spread: Spread, squares: Tensor) -> Tensor:
    """Mean squares of the drawn stretches, `400`."""
    return (spread.counts @ squares) / (spread.counts @ spread.samples).clamp_min(1.0)


def shrink_of(
    spread: Spread, before: Tensor, after: Tensor, floor: float
) -> tuple[float, float, float | None, list[float] | None]:
    """RMS before and after, the shrink above the noise, and its 95 % interval.

    Args:
        spread: the draws.
        before, after: squares by stretch, `b`.
        floor: variance of the noise of all axes together.
    """
    total = float(spread.samples.sum())
    b2, a2 = float(before.sum()) / total, float(after.sum()) / total
    if b2 <= floor:
        return math.sqrt(b2), math.sqrt(a2), None, None
    share = min(max(1 - (a2 - floor) / (b2 - floor), 0.0), 1.0)
    gap = (resampled(spread, before) - floor).clamp_min(_LEAST_GAP * (b2 - floor))
    drawn = (1 - (resampled(spread, after) - floor) / gap).clamp(0, 1)
    low, high = torch.quantile(drawn, torch.tensor(INTERVAL, dtype=drawn.dtype)).tolist()
    # What is taken for noise may be another cause: then all that is left belongs to the gap.
    least = 1 - a2 / b2
    return math.sqrt(b2), math.sqrt(a2), share, [max(min(low, share, least), 0.0), max(high, share)]
