"""Gross outliers among rows, by the spread of the other residuals."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

FAR = 10.0
"""Standard deviations beyond which a residual is a gross outlier. The errors of real arms are no normal noise (a
cable-driven one reaches six), so that a closer bound would drop rows that are right."""

# Of a residual [m]: exact rows leave rounding, in which no row is an outlier.
_LEAST = 1e-9

# A standard normal vector is never as long, and so many halvings of its half square reach the last digit.
_LONGEST, _HALVINGS = 40.0, 100


@cache
def chi_quantile(probability: float, channels: int) -> float:
    """Quantile of the length of `channels` standard normals, by bisection; scipy has it, but takes long to load."""
    order, low, high = torch.tensor([channels / 2, 0.0, _LONGEST**2 / 2], dtype=torch.float64)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        below = torch.special.gammainc(order, middle) < probability
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return float((low + high).sqrt())


def residual_scale(length: Tensor, used: Tensor, channels: int, parameters: int) -> Tensor:
    """Standard deviation of one channel from the median length of the residuals (the MAD about zero).

    Consistent with normal noise, and raised by sqrt(N / (N - k)) for the parameters fitted.

    Args:
        length: of each row's residual, `… x s`.
        used: rows that count, `… x s` bool.
        channels: of a row's residual.
        parameters: `k`.

    Returns:
        `… x 1`.
    """
    middle = torch.where(used, length, torch.nan).nanmedian(-1, keepdim=True).values
    equations = used.sum(-1, keepdim=True) * channels
    spared = (equations / (equations - parameters).clamp_min(1)).sqrt()
    return middle / chi_quantile(0.5, channels) * spared


def inlying(length: Tensor, used: Tensor, channels: int, parameters: int) -> Tensor:
    """Rows that are no gross outliers, `… x s` bool; all of them where there are too few rows to decide.

    Args:
        length, used, channels, parameters: as for `residual_scale`.
    """
    scale = residual_scale(length, used, channels, parameters).clamp_min(_LEAST)
    enough = used.sum(-1, keepdim=True) * channels >= 2 * parameters
    return (length <= FAR * scale) | ~enough
