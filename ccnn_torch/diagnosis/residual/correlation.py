"""Noise that rows share: with the row before (autocorrelated), or with the other readings of the same target.

Rows that share their noise are fewer than they look. What they share is taken out of residual and columns by a linear
operator on the rows of each channel, so that the rest of the method sees rows of independent noise again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from ccnn_torch.effects import Situation
from ccnn_torch.records.splits import number_targets

# Targets from which it can be seen what their readings share.
FEWEST_TARGETS = 8
# Correlations from row to row, and shares of the variance that readings of a target have in common.
_FROM_ROW, _IN_TARGET = (0.3, 0.6, 0.8, 0.9, 0.95, 0.98), (0.2, 0.5, 0.8, 0.9, 0.95, 0.99)
# The same of a device that drifts and scatters, with the share of the variance that is of each row alone; and the rows
# up to which that is tried, as its cost grows with their square.
_DRIFTS, _SCATTERS, _MOST_ROWS = (0.9, 0.97, 0.99), (0.3, 0.6, 0.85), 1000
LOG_PRIOR = math.log(0.1)
"""Log prior odds of noise that rows share."""


@dataclass(frozen=True)
class Correlation:
    """Correlation of the noise between rows; channels are independent.

    Attributes:
        value: ρ of `autoregressive` noise, e_t = ρ e_(t-1) + u_t with the variance of e kept; or the share of the
            variance that readings of one target have in common. 0 = independent rows.
        target: number of each row's target, `s`; None = the row before.
        alone: share of the variance of autoregressive noise that is of each row alone, as a device has that drifts and
            scatters.
    """

    value: float = 0.0
    target: Tensor | None = None
    alone: float = 0.0

    def __call__(self, values: Tensor) -> Tensor:
        """Rows of unit noise with this correlation to rows of independent unit noise, `s x c` or `s x c x m`."""
        if self.value == 0:
            return values
        if self.target is None and self.alone:
            factor = _factor(len(values), self.value, self.alone)
            whole: Tensor = torch.linalg.solve_triangular(factor, values.flatten(1), upper=False)
            return whole.reshape(values.shape)
        if self.target is None:
            out = values.clone()
            out[1:] -= self.value * values[:-1]
            out[1:] /= math.sqrt(1 - self.value**2)
            return out
        count = torch.bincount(self.target).to(values.dtype)
        flat = values.flatten(1)
        mean = torch.zeros(len(count), flat.shape[1], dtype=values.dtype).index_add_(0, self.target, flat)
        mean = mean / count[:, None]
        own, shared = self._deviations(count)
        return ((flat - mean[self.target]) / own + (mean / shared[:, None])[self.target]).reshape(values.shape)

    def log_determinant(self, rows: int, channels: int) -> float:
        """Logarithm of the operator's determinant, by which densities before and after it differ."""
        if self.value == 0:
            return 0.0
        if self.target is None and self.alone:
            return -channels * float(_factor(rows, self.value, self.alone).diagonal().log().sum())
        if self.target is None:
            return -0.5 * channels * (rows - 1) * math.log(1 - self.value**2)
        count = torch.bincount(self.target).to(torch.float64)
        own, shared = self._deviations(count)
        return -channels * float(((count - 1) * math.log(own) + shared.log()).sum())

    def _deviations(self, count: Tensor) -> tuple[float, Tensor]:
        """Standard deviation of a reading about its target's mean, and of √m times the mean of m readings."""
        return math.sqrt(1 - self.value), (1 - self.value + count * self.value).sqrt()


INDEPENDENT = Correlation()


@lru_cache(maxsize=2)
def _factor(rows: int, value: float, alone: float) -> Tensor:
    """Cholesky factor of the correlation of noise that drifts and scatters, `rows x rows`."""
    number = torch.arange(rows, dtype=torch.float64)
    drifts = (1 - alone) * value ** (number[:, None] - number).abs()
    factor: Tensor = torch.linalg.cholesky(drifts + alone * torch.eye(rows, dtype=torch.float64))
    return factor


def possible_correlations(situation: Situation, keep: Tensor) -> list[Correlation]:
    """What may be: independent rows first.

    Args:
        situation: all rows.
        keep: those that count, in the order measured.
    """
    target = number_targets(situation.joints[keep], FEWEST_TARGETS)
    found = [INDEPENDENT, *(Correlation(value) for value in _FROM_ROW)]
    if len(keep) <= _MOST_ROWS:
        found += [Correlation(value, alone=alone) for value in _DRIFTS for alone in _SCATTERS]
    if target is not None:
        found += [Correlation(value, target) for value in _IN_TARGET]
    return found
