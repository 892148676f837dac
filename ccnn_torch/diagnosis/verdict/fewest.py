"""The same correction of a model by as few of its numbers as will do."""

from __future__ import annotations

import torch
from torch import Tensor

# Squares that are not seen in all rows together, in noise variances.
_UNSEEN = 0.1
# Times what a verdict leaves that a part of its numbers may leave.
_KEPT = 1.2
# Share by which the gains of numbers that do the same may differ.
_TIE = 1e-6


def fewest(gram: Tensor, mean: Tensor, spread: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Numbers of a model that do to the rows what all of them do, as few as can be found one by one.

    Some numbers do the very same to all poses, as shifts along parallel axes do, and a fit spreads an error over them.

    Args:
        gram: inner products of what the numbers do, each by its plausible size, `m x m`.
        mean, spread: the numbers as fitted, in plausible sizes, `m`, and their covariance, `m x m`.
        noise: variance of one value.

    Returns:
        The numbers, `m`, 0 for those that are not needed; standard deviations, `m`, those of the fit for these.
    """
    deviation = spread.diagonal().clamp_min(0).sqrt()
    target, chosen, found = gram @ mean, torch.zeros(len(mean), dtype=torch.bool), torch.zeros_like(mean)

    def unseen(these: Tensor, values: Tensor) -> bool:
        return float((values - these) @ gram @ (values - these)) <= _UNSEEN * noise

    def solved(these: Tensor) -> Tensor:
        values = torch.zeros_like(mean)
        values[these] = torch.linalg.solve(gram[these][:, these], target[these])
        return values

    while not unseen(found, mean):
        cross = gram[chosen]
        free = gram.diagonal() - (cross * torch.linalg.solve(gram[chosen][:, chosen], cross)).sum(0)
        gain = (target - gram @ found).square() / free
        gain[chosen | (free <= _UNSEEN * noise)] = 0.0
        if not bool((gain > 0).any()):
            return mean, deviation
        # Of numbers that do the same the first, whatever the rounding.
        chosen[torch.nonzero(gain >= (1 - _TIE) * gain.max())[0]] = True
        found = solved(chosen)
    for i in torch.nonzero(chosen).squeeze(-1).tolist():
        chosen[i] = False
        if unseen(fewer := solved(chosen), mean):
            found = fewer
        else:
            chosen[i] = True
    # As well as they are known where the others are what the model has.
    inner, cross = spread[~chosen][:, ~chosen], spread[~chosen]
    known = spread.diagonal() - (cross * torch.linalg.solve(inner, cross)).sum(0)
    return found, torch.where(chosen, known.clamp_min(0).sqrt(), deviation)


def together(gram: Tensor, mean: Tensor, deviation: Tensor, left: float) -> int:
    """How many of the clearest numbers have to be entered together to leave no more than 1.2 times what all leave.

    Args:
        gram, mean: as for `fewest`.
        deviation: standard deviations, `m`, which say which numbers are the clearest.
        left: squares that all of them leave.
    """
    gone = mean.clone()
    for count, i in enumerate((mean.abs() / deviation).argsort(descending=True).tolist()):
        if float(gone @ gram @ gone) <= (_KEPT**2 - 1) * left:
            return count
        gone[i] = 0.0
    return len(mean)
