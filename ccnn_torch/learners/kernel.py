"""Gaussian kernel regression of many bandwidth vectors at once, in blocks of bounded memory.

Nadaraya and Watson (1964), as the general regression neural network of Specht (IEEE Trans. Neural Networks 2, 1991):
the output is the mean of the stored outputs, weighted by exp(-sum_i (x_i - x'_i)^2 / (2 h_i^2)). A bandwidth of
infinity switches an input off; with all of them off the output is the plain mean.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# Features are about [-1, 1]; further out nothing changes any more, and squares stay finite.
FARTHEST = 1e6
# Doubles of one block. On a CPU 4 MB stay in the cache (measured: twice as fast as 64 MB); an accelerator wants more.
_BLOCK = {"cpu": 1 << 19}
_BLOCK_ELSEWHERE = 1 << 25


class KernelMeans(NamedTuple):
    """Kernel-weighted means at the queries, for every bandwidth vector.

    Attributes:
        mean: `... x c x q x v`.
        squares: sum of the squared shares of the rows, `... x c x q`; 1 / it is how many rows the mean is of.
    """

    mean: Tensor
    squares: Tensor


def block_size(like: Tensor) -> int:
    """Doubles of one block on this device."""
    return _BLOCK.get(like.device.type, _BLOCK_ELSEWHERE)


def kernel_means(
    queries: Tensor,
    rows: Tensor,
    log_weights: Tensor,
    values: Tensor,
    inverse_bandwidths: Tensor,
    own: Tensor | None = None,
) -> KernelMeans:
    """All queries in one piece.

    The largest exponent is taken out before the exponential, so that far from every row the nearest one is left
    instead of 0 / 0.

    Args:
        queries: `... x q x i` [1].
        rows: stored inputs, `... x n x i` [1].
        log_weights: logarithms of their weights, `... x n`; -inf leaves a row out.
        values: what to average, `... x n x v`.
        inverse_bandwidths: 1 / h, `... x c x i`; 0 switches an input off.
        own: number of the row that each query is itself, to be left out, `q` int64; None = no query is a row.
    """
    apart = queries.clamp(-FARTHEST, FARTHEST).transpose(-1, -2).unsqueeze(-1) - rows.transpose(-1, -2).unsqueeze(-2)
    apart = apart * apart
    count, stored = apart.shape[-2], apart.shape[-1]
    precisions = inverse_bandwidths * inverse_bandwidths * -0.5
    exponents = (precisions @ apart.flatten(-2)).reshape(*inverse_bandwidths.shape[:-1], count, stored)
    exponents = exponents + log_weights.unsqueeze(-2).unsqueeze(-3)
    if own is not None:
        itself = own.unsqueeze(-1) == torch.arange(stored, device=own.device)
        exponents = exponents.masked_fill(itself, -torch.inf)
    # The bound is for a query without any row: its kernels are then all 0, and so is its mean.
    nearest = exponents.amax(-1, keepdim=True).clamp_min(-1e300)
    kernels = torch.exp(exponents - nearest)
    shares = kernels / kernels.sum(-1, keepdim=True).clamp_min(1e-300)
    return KernelMeans(shares @ values.unsqueeze(-3), shares.square().sum(-1))


def blocked_means(
    queries: Tensor,
    rows: Tensor,
    log_weights: Tensor,
    values: Tensor,
    inverse_bandwidths: Tensor,
    own: Tensor | None = None,
) -> KernelMeans:
    """`kernel_means` of many repeats, a block of repeats and queries at a time; all leading dimensions are `r`."""
    repeats, count = queries.shape[:2]
    stored, width = rows.shape[1:]
    block = block_size(rows)
    each = max(1, stored * (width + 3 * inverse_bandwidths.shape[1]))
    columns = min(count, max(1, block // each))
    side_by_side = max(1, block // (each * columns))
    parts = []
    for first in range(0, repeats, side_by_side):
        here = slice(first, first + side_by_side)
        fixed = (rows[here], log_weights[here], values[here], inverse_bandwidths[here])
        pieces = [
            kernel_means(
                queries[here, start : start + columns], *fixed, None if own is None else own[start : start + columns]
            )
            for start in range(0, count, columns)
        ]
        parts.append(KernelMeans(*(torch.cat(kind, 2) for kind in zip(*pieces, strict=True))))
    return KernelMeans(*(torch.cat(kind) for kind in zip(*parts, strict=True)))
