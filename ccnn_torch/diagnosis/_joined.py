"""Evidence of many sets of groups of columns side by side: as `_evidence.fit_sets`, with less to do.

With every group in its principal axes, the inner products of a set's widest group with itself are a diagonal. It is
eliminated by dividing, and what is left to be factorised is a matrix of the other columns only (Schur's complement).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis._evidence import Grams, padded
from ccnn_torch.diagnosis._scales import Scales

__all__ = ["Joined", "fit_joined"]

_DIGITS = 1e-13


class Joined(NamedTuple):
    """One entry a set, `b` sets of up to `g` groups, the first group being the widest.

    Attributes:
        log_evidence: `b`.
        noise: σ² in the units of y, `b`.
        first, rest: posterior means of the first group's coefficients and of the others' side by side, `b x m` each.
        energy: Σ (X_g θ_g)² of each group by itself, `b x g`.
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


def fit_joined(
    turned: Grams,
    sets: Sequence[Sequence[Tensor]],
    noise_dof: float,
    start: tuple[Tensor, Tensor],
    updates: int,
) -> Joined:
    """Fit every set of groups.

    Args:
        turned: inner products of all columns, each group in its principal axes.
        sets: each a sequence of groups, the widest first, a group being the indices of its columns, int64.
        noise_dof: as for `fit_sets`.
        start: log α² of each group, `b x g`, and σ², `b`.
        updates: MacKay's.
    """
    index, _ = padded([s[:1] for s in sets])
    others, slot = padded([s[1:] for s in sets])
    real, there = index >= 0, others >= 0
    square = torch.where(real, turned.xx.diagonal()[index.clamp_min(0)], 0.0)
    along_first = torch.where(real, turned.xy[index.clamp_min(0)], 0.0)
    along_rest = torch.where(there, turned.xy[others.clamp_min(0)], 0.0)
    # Products with columns that are not there are NaN, and no factor 0 makes a number of that.
    safe = others.clamp_min(0)[:, None, :]
    across = torch.where(real[:, :, None] & there[:, None, :], turned.xx[index.clamp_min(0)[:, :, None], safe], 0.0)
    own = torch.where(there[:, :, None] & there[:, None, :], turned.xx[others.clamp_min(0)[:, :, None], safe], 0.0)
    psi, noise = start
    member = torch.nn.functional.one_hot(slot.clamp_min(0), max(psi.shape[1] - 1, 1)).to(own.dtype) * there[..., None]
    member = member[..., : psi.shape[1] - 1]
    used = torch.cat([real.any(1, keepdim=True), (member > 0).any(1)], 1)
    scales = Scales(turned.values, noise_dof, used)

    def by_group(first: Tensor, rest: Tensor) -> Tensor:
        """Sums over each group's columns, `b x g`."""
        return torch.cat([first.sum(-1, keepdim=True), (rest[..., None] * member).sum(1)], -1)

    for k in range(updates + 1):
        half = (psi / 2).exp()
        scale_first, scale_rest = half[:, :1], (member @ half[:, 1:, None])[..., 0]
        sigma = noise.sqrt()[:, None]
        diagonal = 1 + square * (scale_first / sigma).square()
        rest = scale_rest / sigma
        coupled = across * (scale_first / sigma * rest)[:, None, :]
        inner = (own * rest[:, :, None]).mul_(rest[:, None, :])
        if inner.shape[-1]:
            # Columns that are nearly the same, under next to no noise, would leave no digit of the 1 on the diagonal.
            edge = inner.diagonal(dim1=-2, dim2=-1)
            edge += (1 + _DIGITS * edge.amax(-1))[:, None]
        shared = coupled / diagonal[..., None]
        factor = torch.linalg.cholesky_ex(inner - coupled.mT @ shared).L
        inverse = torch.cholesky_inverse(factor) if inner.shape[-1] else inner
        c_first, c_rest = scale_first * along_first / noise[:, None], scale_rest * along_rest / noise[:, None]
        u_rest = (inverse @ (c_rest[..., None] - shared.mT @ c_first[..., None]))[..., 0]
        u_first = (c_first - (coupled @ u_rest[..., None])[..., 0]) / diagonal
        spread = 1 / diagonal + ((coupled @ inverse) * coupled).sum(-1) / diagonal.square()
        gamma = by_group(1 - spread, 1 - inverse.diagonal(dim1=-2, dim2=-1))
        first, mean = scale_first * u_first, scale_rest * u_rest
        explained = (first * along_first).sum(-1) + (mean * along_rest).sum(-1)
        made = (square * first.square()).sum(-1) + ((own @ mean[..., None])[..., 0] * mean).sum(-1)
        made = made + 2 * ((across @ mean[..., None])[..., 0] * first).sum(-1)
        rss = (turned.yy - 2 * explained + made).clamp_min(0)
        if k == updates:
            break
        size = by_group(u_first.square(), u_rest.square())
        psi, noise = scales.updated(psi, size, gamma, rss)
    log_det = diagonal.log().sum(-1) + 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    evidence = scales.log_evidence(psi, gamma, noise, (turned.yy - explained) / noise, log_det)
    parts = mean[..., None] * member
    energy = torch.cat([(square * first.square()).sum(-1, keepdim=True), (parts * (own @ parts)).sum(1)], -1)
    return Joined(evidence, noise, first, mean, energy, rss, gamma.sum(-1), psi)
