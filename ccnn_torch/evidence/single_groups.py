"""Evidence of many groups of columns, each alone: as `marginal_likelihood.fit_sets`, in each group's principal axes.

There a group's inner products are numbers, not a matrix: however many groups there are and however wide, one update of
all of them is a few operations on one table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.marginal_likelihood import FIRST_NOISE, LIMIT, SPREAD, Scales

_UPDATES = 8
# Principal axes with less than this share of the largest one's squares are rounding.
_DIGITS = 1e-14


class GroupProducts(NamedTuple):
    """Inner products of one group of columns: `xx` `m x m` with itself, `xy` `m` with what is to be explained."""

    xx: Tensor
    xy: Tensor


NO_COLUMNS = GroupProducts(torch.zeros(0, 0), torch.zeros(0))
"""A group of no columns."""


class SingleFits(NamedTuple):
    """One entry a group, `b` groups.

    Attributes:
        log_evidence: `b`.
        noise: σ² in the units of y, `b`.
        mean: posterior means of the coefficients along the principal axes, `b x M`.
        energy: Σ (X θ)², `b`.
        rss: remaining sum of squares, `b`.
        effective: number of coefficients that the data determine, `b`.
        log_scale: log α², `b`.
        axes: principal axes of each group, `m x m` each, where they are known.
    """

    log_evidence: Tensor
    noise: Tensor
    mean: Tensor
    energy: Tensor
    rss: Tensor
    effective: Tensor
    log_scale: Tensor
    axes: Sequence[Tensor] = ()

    def coefficients(self) -> list[Tensor]:
        """Posterior means of the coefficients themselves, `m` each."""
        return [v @ m[: v.shape[-1]] for v, m in zip(self.axes, self.mean, strict=True)]


def own_products(x: Tensor, y: Tensor, size: Tensor | float = 1.0) -> GroupProducts:
    """x: whitened columns, `... x m`, which count divided by `size`; y: what they explain, `...`."""
    flat = x.flatten(0, -2)
    return GroupProducts(flat.mT @ flat / size**2, flat.mT @ y.reshape(-1) / size)


def fit_single_groups(
    groups: Sequence[GroupProducts], yy: Tensor, values: float, noise_dof: float, spread: float = SPREAD
) -> SingleFits:
    """Fit every group separately; `NO_COLUMNS` is what there is without any.

    Args:
        groups: inner products of each.
        yy: sum of the squares to be explained, 0-dim, or of each group, `b`.
        values: how many they are.
        noise_dof: weight of the prior of σ² about 1, in values; 0 = the noise is not known.
        spread: standard deviation of log α².
    """
    axes = axes_of([g.xx for g in groups], yy)
    along = axes.turned([g.xy for g in groups])
    there = torch.tensor([g.xy.numel() > 0 for g in groups])
    fits = fit_in_axes(axes.square, along, there, yy, values, noise_dof, spread)
    return fits._replace(axes=axes.each())


def fit_in_axes(
    square: Tensor, along: Tensor, there: Tensor, yy: Tensor, values: float, noise_dof: float, spread: float = SPREAD
) -> SingleFits:
    """Fit every group separately.

    Args:
        square, along: inner products along each group's principal axes with themselves and with y, `b x M`, padded
            with 0.
        there: False for a group of no columns, `b`.
        yy, values, noise_dof, spread: as for `fit_single_groups`.
    """
    trace = square.sum(-1).clamp_min(1e-300)
    psi = torch.log((yy.clamp_min(1e-300) / trace).clamp(math.exp(-LIMIT), math.exp(LIMIT))) * there
    psi, scales = psi[:, None], Scales(values, noise_dof, there[:, None], spread)
    noise = torch.ones_like(trace) if noise_dof > 0 else (yy / values / FIRST_NOISE).clamp_min(1e-12).expand(len(trace))
    for k in range(_UPDATES + 1):
        scale = psi.exp()
        diagonal = 1 + scale * square / noise[:, None]
        mean = scale * along / noise[:, None] / diagonal
        gamma = (1 - 1 / diagonal).sum(-1)
        rss = (yy - 2 * (mean * along).sum(-1) + (square * mean.square()).sum(-1)).clamp_min(0)
        if k == _UPDATES:
            break
        size = (mean.square() / scale).sum(-1)
        psi, noise = scales.updated(psi, size[:, None], gamma[:, None], rss)
    explained = (mean * along).sum(-1) / noise
    squares, log_det = yy / noise - explained, diagonal.log().sum(-1)
    evidence = scales.log_evidence(psi, gamma[:, None], noise, squares, log_det)
    return SingleFits(evidence, noise, mean, (square * mean.square()).sum(-1), rss, gamma, psi[:, 0])


class Axes(NamedTuple):
    """Principal axes of `b` groups of columns.

    Attributes:
        square: squares of the columns along them, `b x M`, 0 where that is rounding or there are no more.
        alike: which groups are as wide as each other, and their axes, `k x m x m`.
    """

    square: Tensor
    alike: Sequence[tuple[list[int], Tensor]]

    def turned(self, products: Sequence[Tensor]) -> Tensor:
        """Products of the columns with something, `m` each, along the axes, `b x M`, padded with 0."""
        along = torch.zeros_like(self.square)
        for mine, vectors in self.alike:
            width = vectors.shape[-1]
            along[mine, :width] = (vectors.mT @ torch.stack([products[k] for k in mine])[..., None])[..., 0]
        return torch.where(self.square > 0, along, 0.0)

    def each(self) -> list[Tensor]:
        """The axes of every group, `m x m`."""
        found = [self.square.new_zeros(0, 0) for _ in self.square]
        for mine, vectors in self.alike:
            for k, v in zip(mine, vectors, strict=True):
                found[k] = v
        return found


def axes_of(products: Sequence[Tensor], like: Tensor) -> Axes:
    """products: of each group's columns with each other, `m x m`; like: numbers of the type that is wanted."""
    widths = [len(xx) for xx in products]
    square = like.new_zeros(len(products), max(widths, default=0))
    alike = []
    for width in sorted(set(widths) - {0}):
        mine = [k for k, w in enumerate(widths) if w == width]
        values, vectors = torch.linalg.eigh(torch.stack([products[k] for k in mine]))
        square[mine, :width] = torch.where(values > _DIGITS * values[:, -1:], values, 0.0)
        alike.append((mine, vectors))
    return Axes(square, alike)
