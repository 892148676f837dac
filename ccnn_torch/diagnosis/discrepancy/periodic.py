"""A discrepancy term that is found rather than given: the platform sways with a period of its own, faster than the
waves that approximate any course of time can follow."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.candidates.nuisance import NuisanceFit, SharedColumns, TrialColumns, search_charge
from ccnn_torch.evidence.priors import OUTSIDE

# Periods in the time of the rows: from where the waves of any course end, to so many rows a period, or so many in all.
_SLOWEST, _ROWS_A_PERIOD, _MOST = 8.0, 3.0, 130.0
_STEP = 1 / 3
# Values between the neighbours of the best, so often.
_FINE, _ROUNDS = 9, 3


def periodic_discrepancy(time: Tensor, raw: Tensor, lead: Tensor, few: Tensor, left: NuisanceFit) -> list[Atom]:
    """The sine of time that explains most, its search charged, with its period in its `note`; none where there are too
    few rows for any.

    Args:
        time: of each row, `s` [s].
        raw: shifts and turns of the platform, `s x c0 x k` [m, rad].
        lead: the same whitened, `s x c x k`.
        few: rows evaluated, `t`.
        left: what is to be explained there.
    """
    span = float(time.max() - time.min())
    fastest = min(len(time) / _ROWS_A_PERIOD, _MOST)
    if span <= 0 or fastest < _SLOWEST + 1:
        return []
    share = (time - time.min()) / span
    looked_at = SharedColumns(lead[few])

    def gain(periods: Tensor) -> Tensor:
        return left.gain(TrialColumns(_waves(share[few], periods)[:, :, None], looked_at))

    grid = torch.arange(_SLOWEST, fastest, _STEP, dtype=time.dtype)
    score = gain(grid)
    best, reached, step = grid[score.argmax()], float(score.max()), _STEP
    for _ in range(_ROUNDS):
        close = best + step * torch.linspace(-1, 1, _FINE, dtype=time.dtype)
        finer = gain(close)
        if float(finer.max()) > reached:
            best, reached = close[finer.argmax()], float(finer.max())
        step *= 2 / (_FINE - 1)
    charge = search_charge(len(lead) / len(few) * score)
    columns = (raw[..., None] * _waves(share, best[None])[0][:, None, None]).flatten(-2)
    note = f"what follows the time is a sway with a period of {span / float(best):.3g} s"
    return [Atom("time", None, columns.new_zeros(0), columns, OUTSIDE - charge, note=note)]


def _waves(share: Tensor, periods: Tensor) -> Tensor:
    """Sine and cosine, `g x s x 2`; share: of the time, `s`; periods in all of it, `g`."""
    angle = 2 * math.pi * share * periods[:, None]
    return torch.stack([torch.sin(angle), torch.cos(angle)], -1)
