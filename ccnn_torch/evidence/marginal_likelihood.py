"""Evidence of sets of groups of columns, from Gram matrices that are computed once.

Of a set of groups: y ~ N(X θ, σ² I), θ of group g ~ N(0, α_g² I), log α_g² ~ N(0, s²), and log σ² flat, or about 0
where the noise was given. α and σ are brought to their most probable values by MacKay's updates (1992) and integrated
there.

There is one such fit. Where the groups are in their principal axes, a group's inner products with itself are a
diagonal: it is eliminated by dividing, and only a matrix of the other columns is factorised (Schur's complement). So
groups that are alone need no matrix at all, and of a set its widest group is left out of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]

NARROW = 128
"""Columns up to which XᵀX is made as a whole."""
# MacKay updates.
_UPDATES = 8
JITTER = 1e-13
"""Added to the diagonal of a Gram matrix with 1 on it, as a share of the largest element: columns that are nearly the
same, far above the noise, would leave no digit of the 1."""
# Principal axes with less than this share of the largest one's squares are rounding.
_DIGITS = 1e-14
SPREAD = 4.0
"""Of log α² about a coefficient's plausible size: a factor of 7 in α, either way."""
_LIMIT = 25.0
# Updates begin with the mean square over this as variance of the noise.
_FIRST_NOISE = 10.0
# No update changes log α² by more.
_LARGEST_STEP = 3.0
_TINY = 1e-12
# Share of the values that a set leaves free, at least, in an update of the noise.
_FREE = 0.02


class Grams(NamedTuple):
    """Inner products over all rows and channels: `xx` `P x P`, `xy` `P`, `yy`, and the number of values.

    Of `b` models with columns of their own, `b x P x P`, `b x P` and `b`.
    """

    xx: Tensor
    xy: Tensor
    yy: Tensor
    values: float


class Fits(NamedTuple):
    """One entry a set, `b` sets: columns padded to `M`, groups to `g`.

    Attributes:
        log_evidence: `b`.
        noise: σ² in the units of y, `b`.
        first: posterior means of the coefficients of a first group in its principal axes, `b x m`.
        mean: of all others, `b x M`.
        energy: Σ (X_g θ_g)² of each group alone, `b x g`.
        rss: remaining sum of squares, `b`.
        effective: number of coefficients that the data determine, `b`.
        log_scale: log α², `b x g`.
        scale, inverse: α of each of the others, `b x M`, and the inverse of their products in units of α and σ.
    """

    log_evidence: Tensor
    noise: Tensor
    first: Tensor
    mean: Tensor
    energy: Tensor
    rss: Tensor
    effective: Tensor
    log_scale: Tensor
    scale: Tensor
    inverse: Tensor

    @property
    def covariance(self) -> Tensor:
        """Posterior covariance of the coefficients, `b x M x M`; of sets without a first group."""
        return self.scale[:, :, None] * self.inverse * self.scale[:, None, :]


def grams_of(x: Tensor, y: Tensor) -> Grams:
    """x: `s x c x P` whitened columns; y: `s x c`."""
    flat, value = x.flatten(0, 1), y.reshape(-1)
    return Grams(_squares(flat), flat.mT @ value, value @ value, float(len(value)))


def groups_of(columns: Iterable[Tensor]) -> list[Tensor]:
    """Groups of columns `... x m` that stand side by side, as indices of the columns."""
    widths = [c.shape[-1] for c in columns]
    return [*torch.split(torch.arange(sum(widths)), widths)] if widths else []


def scaled(grams: Grams, variance: float) -> Grams:
    """In units of a variance."""
    return Grams(grams.xx / variance, grams.xy / variance, grams.yy / variance, grams.values)


def _squares(flat: Tensor) -> Tensor:
    """XᵀX, `P x P`; of many columns the half above the diagonal, mirrored."""
    width = flat.shape[-1]
    if width <= NARROW:
        return flat.mT @ flat
    first, second = flat[:, : width // 2], flat[:, width // 2 :]
    across = first.mT @ second
    rows = [torch.cat([_squares(first), across], -1), torch.cat([across.mT, _squares(second)], -1)]
    return torch.cat(rows)


def without(grams: Grams, x: Tensor, y: Tensor, columns: Tensor) -> Grams:
    """Less what some of the rows bring, NaN but for these columns; x: `t x c x P`, y: `t x c`, of those rows."""
    away = grams_of(x[..., columns], y)
    xx, xy = torch.full_like(grams.xx, torch.nan), torch.full_like(grams.xy, torch.nan)
    xx[columns[:, None], columns] = grams.xx[columns[:, None], columns] - away.xx
    xy[columns] = grams.xy[columns] - away.xy
    return Grams(xx, xy, grams.yy - away.yy, grams.values - away.values)


class Prior(NamedTuple):
    """What is known beforehand of scales and noise.

    Attributes:
        values: how many values are explained.
        noise_dof: weight of the prior of σ² about 1, in values; 0 = the noise is not known.
        spread: standard deviation of log α², of all groups or of each, `b x g`.
    """

    values: float
    noise_dof: float
    spread: float | Array = SPREAD


def fit_sets(
    grams: Grams,
    sets: Sequence[Sequence[Tensor]],
    noise_dof: float,
    iterations: int = _UPDATES,
    spread: float | Tensor = SPREAD,
    start: tuple[Tensor, Tensor] | None = None,
) -> Fits:
    """Fit every set of groups.

    Args:
        grams: of all columns, or of those of each set.
        sets: each a sequence of groups, a group being the indices of its columns, int64.
        noise_dof: weight of the prior of σ² about 1, in values; 0 = the noise is not known.
        iterations: MacKay updates.
        spread: standard deviation of log α², of all groups or of each, `b x g`.
        start: log α² of each group, `b x g`, and σ², `b`, to begin with.
    """
    groups = max(max(map(len, sets), default=0), 1)
    width = torch.tensor([[*map(len, s), *[0] * (groups - len(s))] for s in sets], dtype=torch.int64)
    width = width.reshape(len(sets), groups)
    # Where each group stands among all of them, one after the other.
    index, slot = column_indices(width.flatten().cumsum(0).reshape(width.shape) - width, width)
    safe, real = torch.cat([index.new_zeros(1), *(g for s in sets for g in s)])[index + 1], index >= 0
    # Products with columns that are not there are NaN, and no factor 0 makes a number of that.
    each = [torch.arange(len(sets))[:, None]] if grams.xy.dim() > 1 else []
    square = grams.xx[(*(k[:, None] for k in each), safe[:, :, None], safe[:, None, :])]
    own = torch.where(real[:, :, None] & real[:, None, :], square, 0.0)
    along = torch.where(real, grams.xy[(*each, safe)], 0.0)
    none = along[:, :0]
    parts = _Parts.of(none, none, own[:, :0], own, along, _members(slot, groups))
    there = torch.nn.functional.pad(width > 0, (1, 0))
    if start is not None:
        start = torch.nn.functional.pad(start[0], (1, 0)), start[1]
    each_spread = torch.nn.functional.pad(spread, (1, 0), value=1.0).numpy() if isinstance(spread, Tensor) else spread
    prior = Prior(grams.values, noise_dof, each_spread)
    fits = _most_probable(parts, there, grams.yy, prior, iterations, start)
    return fits._replace(energy=fits.energy[:, 1:], log_scale=fits.log_scale[:, 1:])


def fit_batched_sets(
    turned: Grams, begin: Tensor, width: Tensor, noise_dof: float, start: tuple[Tensor, Tensor], updates: int
) -> Fits:
    """As `fit_sets`, of groups in their principal axes.

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
    own = turned.xx[others[:, :, None], others[:, None, :]]
    parts = _Parts.of(
        turned.xx.diagonal()[index],
        turned.xy[index],
        turned.xx[index[:, :, None], others[:, None, :]],
        own,
        turned.xy[others],
        _members(slot, width.shape[1] - 1),
    )
    return _most_probable(parts, width > 0, turned.yy, Prior(turned.values, noise_dof), updates, start)


def fit_in_axes(square: Tensor, along: Tensor, there: Tensor, yy: Tensor, prior: Prior) -> Fits:
    """As `fit_sets`, of groups that are alone in their principal axes.

    Args:
        square, along: inner products along each group's principal axes with themselves and with y, `b x m`, padded
            with 0.
        there: False for a group of no columns, `b`.
        yy: sum of the squares to be explained, 0-dim, or of each group, `b`.
        prior: of all.
    """
    none = square[..., None][..., :0]
    parts = _Parts.of(square, along, none, none[:, :0], square[:, :0], none[:, :0])
    return _most_probable(parts, there[:, None], yy, prior, _UPDATES)


def column_indices(begin: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Columns of `b` sets of `g` runs, which begin at some column and are so wide, `b x g` each.

    Returns:
        the columns of each set, `b x M`, and which of its runs they belong to; -1 where there are no more.
    """
    ends = width.cumsum(-1)
    place = torch.arange(int(ends[:, -1].max()) if len(ends) else 0)
    slot = (place[:, None] >= ends[:, None, :]).sum(-1)
    there = slot < width.shape[1]
    own = slot.clamp_max(width.shape[1] - 1)
    columns = place + (begin - ends + width).gather(1, own)
    return torch.where(there, columns, -1), torch.where(there, slot, -1)


def _members(slot: Tensor, groups: int) -> Tensor:
    """1 where a column is of a group, else 0, `b x M x groups`."""
    return (slot[..., None] == torch.arange(groups)).to(torch.float64)


class _Parts(NamedTuple):
    """Inner products of `b` sets: a first group in its principal axes, `m` columns, and other columns, `M`.

    Attributes:
        square, along: of the first group's columns with themselves and with y, `b x m`.
        across: of these with the others, `b x m x M`.
        own, along_rest: of the others with each other, `b x M x M`, and with y, `b x M`.
        member: 1 where a column of the others is of one of their groups, else 0, `b x M x (g - 1)`.
    """

    square: Array
    along: Array
    across: Array
    own: Array
    along_rest: Array
    member: Array

    @classmethod
    def of(cls, *products: Tensor) -> _Parts:
        return cls(*(v.numpy() for v in products))

    def by_group(self, first: Array, rest: Array) -> Array:
        """Sums over each group's columns, `b x g`; first: that of the first group, `b`; rest: `b x M`."""
        return np.concatenate([first[:, None], (rest[:, None] @ self.member)[:, 0]], -1)


def _to_begin_with(parts: _Parts, there: Array, yy: Array, prior: Prior) -> tuple[Array, Array]:
    """log α² of each group where its prior could make the whole gap, `b x g`, and σ², a tenth of it, `b`."""
    trace = parts.by_group(_total(parts.square), np.diagonal(parts.own, axis1=-2, axis2=-1)).clip(1e-300)
    psi = (np.log(yy.clip(1e-300))[:, None] - np.log(trace)).clip(-_LIMIT, _LIMIT) * there
    noise = np.ones_like(yy) if prior.noise_dof > 0 else (yy / prior.values / _FIRST_NOISE).clip(1e-12)
    return psi, noise


def _total(values: Array) -> Array:
    """Sum over the last dimension; a product with ones is the fastest sum of short rows."""
    total: Array = values @ _ones(values.shape[-1])
    return total


_ones: Callable[[int], Array] = cache(np.ones)


@np.errstate(all="ignore")  # what is 0 or beyond all numbers is clipped
def _most_probable(
    parts: _Parts, there: Tensor, yy: Tensor, prior: Prior, updates: int, start: tuple[Tensor, Tensor] | None = None
) -> Fits:
    """Sets at their most probable scales; in NumPy but for the factors, since an operation on so few numbers takes
    torch four times as long to begin as to do.

    Args:
        parts: inner products.
        there: which groups there are, `b x g`, bool.
        yy: sum of the squares to be explained, 0-dim or `b`.
        prior: of scales and noise.
        updates: MacKay's.
        start: log α² of each group, `b x g`, and σ², `b`, to begin with. None = where the prior of each group could
            make the whole gap, and the noise is a tenth of it.
    """
    square, along_first, across, own, along_rest, member = parts
    edge, across_t = np.diagonal(own, axis1=-2, axis2=-1), across.swapaxes(-2, -1)
    groups, total = there.numpy(), np.broadcast_to(yy.numpy(), len(square))
    psi, noise = _to_begin_with(parts, groups, total, prior) if start is None else (v.numpy() for v in start)
    # What stays so where there are no other columns.
    scale_rest, u_rest, mean, factor, inverse, reached, spread = along_rest, along_rest, along_rest, own, own, 0.0, 0.0
    for k in range(updates + 1):
        half, sigma = np.exp(psi / 2), np.sqrt(noise)[:, None]
        scale_first = half[:, :1]
        first_in = scale_first / sigma
        diagonal = 1 + square * first_in**2
        c_first = scale_first * along_first / noise[:, None]
        if along_rest.size:
            scale_rest = (member @ half[:, 1:, None])[..., 0]
            rest_in = scale_rest / sigma
            # The first group's columns, weighted as they take part in what is left of the others.
            weighted = across * (first_in**2 / diagonal)[..., None]
            both = rest_in[:, :, None] * rest_in[:, None, :]
            factor, inverse = _factor_and_inverse((own - across_t @ weighted) * both, edge * rest_in**2)
            taken = (across_t @ (first_in / diagonal * c_first)[..., None])[..., 0]
            u_rest = (inverse @ (scale_rest * along_rest / noise[:, None] - rest_in * taken)[..., None])[..., 0]
            mean = scale_rest * u_rest
            reached = (across @ mean[..., None])[..., 0]
            spread = ((across_t @ (weighted / diagonal[..., None])) * both * inverse).sum((-2, -1))
        u_first = (c_first - first_in / sigma * reached) / diagonal
        first = scale_first * u_first
        gamma = parts.by_group(_total(1 - 1 / diagonal) - spread, 1 - np.diagonal(inverse, axis1=-2, axis2=-1))
        explained = _total(first * along_first) + _total(mean * along_rest)
        made = _total(first * (square * first + 2 * reached)) + _total((own @ mean[..., None])[..., 0] * mean)
        rss = (total - 2 * explained + made).clip(0)
        if k == updates:
            break
        size = parts.by_group(_total(u_first**2), u_rest**2)
        psi, noise = _updated(psi, size, gamma, rss, groups, prior)
    log_det = _total(np.log(diagonal)) + 2 * _total(np.log(np.diagonal(factor, axis1=-2, axis2=-1)))
    plain = -0.5 * (prior.values * np.log(noise) + (total - explained) / noise + log_det)
    plain = plain - 0.5 * prior.noise_dof * (np.log(noise) + 1 / noise - 1)
    hyper = -0.5 * psi**2 / prior.spread**2 - 0.5 * np.log1p(0.5 * gamma * prior.spread**2)
    evidence = plain + _total(hyper * groups)
    pieces = mean[..., None] * member
    energy = np.concatenate([_total(square * first**2)[:, None], (pieces * (own @ pieces)).sum(1)], -1)
    fitted = (evidence, noise, first, mean, energy, rss, _total(gamma), psi, scale_rest, inverse)
    return Fits(*(torch.from_numpy(v) for v in fitted))


def _factor_and_inverse(inner: Array, edge: Array) -> tuple[Array, Array]:
    """Cholesky factor and inverse of 1 + `inner`, `b x M x M`; edge: largest it could have on its diagonal, `b x M`."""
    if not inner.shape[-1]:
        return inner, inner
    square = torch.from_numpy(inner)
    square.diagonal(dim1=-2, dim2=-1).add_(torch.from_numpy(1 + JITTER * edge.max(-1, keepdims=True)))
    factor = torch.linalg.cholesky_ex(square).L
    return factor.numpy(), torch.cholesky_inverse(factor).numpy()


def _updated(psi: Array, size: Array, gamma: Array, rss: Array, there: Array, prior: Prior) -> tuple[Array, Array]:
    """The next log α² `b x g` and σ² `b`.

    MacKay's update, which takes coefficients and γ for fixed, and one of Newton's steps from there for the prior.

    Args:
        psi: log α², `b x g`.
        size: sum of the squares of each group's coefficients in units of α, `b x g`.
        gamma: number of coefficients of each group that the data determine, `b x g`.
        rss: remaining sum of squares, `b`.
        there: which groups there are, `b x g`, bool.
        prior: of scales and noise.
    """
    precision = 1 / prior.spread**2
    step = np.log(size.clip(_TINY) / gamma.clip(_TINY)).clip(-_LARGEST_STEP, _LARGEST_STEP)
    half = 0.5 * size * np.exp(-step)
    step = step + (half - 0.5 * gamma - (psi + step) * precision) / (half + precision)
    psi = (psi + step.clip(-_LARGEST_STEP, _LARGEST_STEP) * there).clip(-_LIMIT, _LIMIT)
    left = (prior.values - _total(gamma)).clip(_FREE * prior.values + 1)
    return psi, ((rss + prior.noise_dof) / (left + prior.noise_dof)).clip(1e-12)


class GroupProducts(NamedTuple):
    """Inner products of one group of columns: `xx` `m x m` with itself, `xy` `m` with what is to be explained."""

    xx: Tensor
    xy: Tensor


NO_COLUMNS = GroupProducts(torch.zeros(0, 0), torch.zeros(0))
"""A group of no columns."""


def own_products(x: Tensor, y: Tensor, size: Tensor | float = 1.0) -> GroupProducts:
    """x: whitened columns, `... x m`, which count divided by `size`; y: what they explain, `...`."""
    flat = x.flatten(0, -2)
    return GroupProducts(flat.mT @ flat / size**2, flat.mT @ y.reshape(-1) / size)


def fit_single_groups(groups: Sequence[GroupProducts], yy: Tensor, prior: Prior) -> tuple[Fits, list[Tensor]]:
    """Fit every group separately; `NO_COLUMNS` is what there is without any.

    Args:
        groups: inner products of each.
        yy, prior: as for `fit_in_axes`.

    Returns:
        the fits, and the principal axes of each, `m x m`.
    """
    axes = axes_of([g.xx for g in groups], yy)
    along = axes.turned([g.xy for g in groups])
    there = torch.tensor([g.xy.numel() > 0 for g in groups])
    return fit_in_axes(axes.square, along, there, yy, prior), axes.each()


def real_squares(square: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Squares and products along principal axes, `b x M`, 0 where that is rounding."""
    real = square > _DIGITS * square.amax(-1, keepdim=True)
    return torch.where(real, square, 0.0), torch.where(real, along, 0.0)


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
        axes = [self.square.new_zeros(0, 0) for _ in self.square]
        for mine, vectors in self.alike:
            for k, v in zip(mine, vectors, strict=True):
                axes[k] = v
        return axes


def axes_of(products: Sequence[Tensor], like: Tensor) -> Axes:
    """products: of each group's columns with each other, `m x m`; like: numbers of the type that is wanted."""
    widths = [len(xx) for xx in products]
    square = like.new_zeros(len(products), max(widths, default=0))
    alike = []
    for width in sorted(set(widths) - {0}):
        mine = [k for k, w in enumerate(widths) if w == width]
        values, vectors = torch.linalg.eigh(torch.stack([products[k] for k in mine]))
        square[mine, :width] = real_squares(values, values)[0]
        alike.append((mine, vectors))
    return Axes(square, alike)
