"""Evidence of many sets of groups of columns side by side: as `marginal_likelihood.fit_sets`, with less to do.

With every group in its principal axes, the inner products of a set's widest group with itself are a diagonal. It is
eliminated by dividing, and what is left to be factorised is a matrix of the other columns only (Schur's complement).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.marginal_likelihood import Grams, Scales

_DIGITS = 1e-13


class BatchedFits(NamedTuple):
    """One entry a set, `b` sets of `g` groups, the first group being the widest.

    Attributes:
        log_evidence: `b`.
        noise: σ² in the units of y, `b`.
        first, rest: posterior means of the first group's coefficients and of the others' side by side, `b x m` each.
        energy: Σ (X_g θ_g)² of each group alone, `b x g`.
        rss: remaining sum of squares, `b`.
        effective: number of coefficients that the data determine, `b`.
        log_scale: log α², `b x g`.
    """

    log_evidence: Tensor
    noise: Tensor
    first: Tensor
    rest: Tensor
    energy: Tensor
    rss: Tensor
    effective: Tensor
    log_scale: Tensor


def column_indices(begin: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Columns of `b` sets of `g` runs, which begin at some column and are so wide, `b x g` each.

    Returns:
        the columns of each set, `b x M`, M > 0, and which of its runs they belong to; -1 where there are no more.
    """
    ends = width.cumsum(-1)
    place = torch.arange(max(int(ends[:, -1].max()), 1))
    slot = (place[:, None] >= ends[:, None, :]).sum(-1)
    there = slot < width.shape[1]
    own = slot.clamp_max(width.shape[1] - 1)
    columns = place + (begin - ends + width).gather(1, own)
    return torch.where(there, columns, -1), torch.where(there, slot, -1)


def fit_batched_sets(
    turned: Grams, begin: Tensor, width: Tensor, noise_dof: float, start: tuple[Tensor, Tensor], updates: int
) -> BatchedFits:
    """Fit every set of groups.

    Args:
        turned: inner products of all columns, each group in its principal axes, and of a last column of zeros.
        begin, width: first column of each group of a set and how many it has, the widest group first, `b x g`, g > 1.
        noise_dof: as for `fit_sets`.
        start: log α² of each group, `b x g`, and σ², `b`.
        updates: MacKay's.
    """
    index, _ = column_indices(begin[:, :1], width[:, :1])
    others, slot = column_indices(begin[:, 1:], width[:, 1:])
    # -1, no column, is the last one.
    square, along_first, along_rest = turned.xx.diagonal()[index], turned.xy[index], turned.xy[others]
    across = turned.xx[index[:, :, None], others[:, None, :]]
    own = turned.xx[others[:, :, None], others[:, None, :]]
    member = (slot[..., None] == torch.arange(width.shape[1] - 1)).to(own.dtype)
    scales = Scales(turned.values, noise_dof, width > 0)
    psi, noise = start

    def by_group(first: Tensor, rest: Tensor) -> Tensor:
        """Sums over each group's columns, `b x g`; first: that of the first group, `b`."""
        return torch.cat([first[:, None], (rest[:, None] @ member)[:, 0]], -1)

    for k in range(updates + 1):
        half, sigma = (psi / 2).exp(), noise.sqrt()[:, None]
        scale_first, scale_rest = half[:, :1], (member @ half[:, 1:, None])[..., 0]
        first_in, rest_in = scale_first / sigma, scale_rest / sigma
        diagonal = 1 + square * first_in.square()
        # The first group's columns, weighted as they take part in what is left of the others.
        weighted = across * (first_in.square() / diagonal)[..., None]
        both = rest_in[:, :, None] * rest_in[:, None, :]
        inner = (own - across.mT @ weighted).mul_(both)
        # Columns that are nearly the same, under next to no noise, would leave no digit of the 1 on the diagonal.
        largest = (own.diagonal(dim1=-2, dim2=-1) * rest_in.square()).amax(-1, keepdim=True)
        inner.diagonal(dim1=-2, dim2=-1).add_(1 + _DIGITS * largest)
        factor = torch.linalg.cholesky_ex(inner).L
        inverse = torch.cholesky_inverse(factor)
        c_first, c_rest = scale_first * along_first / noise[:, None], scale_rest * along_rest / noise[:, None]
        taken = (across.mT @ (first_in / diagonal * c_first)[..., None])[..., 0]
        u_rest = (inverse @ (c_rest - rest_in * taken)[..., None])[..., 0]
        mean = scale_rest * u_rest
        reached = (across @ mean[..., None])[..., 0]
        u_first = (c_first - first_in / sigma * reached) / diagonal
        first = scale_first * u_first
        spread = (across.mT @ weighted.div_(diagonal[..., None])).mul_(both).mul_(inverse).sum((-2, -1))
        gamma = by_group((1 - 1 / diagonal).sum(-1) - spread, 1 - inverse.diagonal(dim1=-2, dim2=-1))
        explained = (first * along_first).sum(-1) + (mean * along_rest).sum(-1)
        made = (first * (square * first + 2 * reached)).sum(-1) + ((own @ mean[..., None])[..., 0] * mean).sum(-1)
        rss = (turned.yy - 2 * explained + made).clamp_min(0)
        if k == updates:
            break
        psi, noise = scales.updated(psi, by_group(u_first.square().sum(-1), u_rest.square()), gamma, rss)
    log_det = diagonal.log().sum(-1) + 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    evidence = scales.log_evidence(psi, gamma, noise, (turned.yy - explained) / noise, log_det)
    parts = mean[..., None] * member
    energy = torch.cat([(square * first.square()).sum(-1, keepdim=True), (parts * (own @ parts)).sum(1)], -1)
    return BatchedFits(evidence, noise, first, mean, energy, rss, gamma.sum(-1), psi)
