"""Evidence of sets of groups of columns, from Gram matrices that are computed once.

Of a set of groups: y ~ N(X θ, σ² I), θ of group g ~ N(0, α_g² I), log α_g² ~ N(0, s²), and log σ² flat, or about 0
where the noise was given. α and σ are brought to their most probable values by MacKay's updates (1992) and integrated
there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

# Columns up to which XᵀX is made as a whole.
_NARROW = 128
# MacKay updates.
_UPDATES = 8
_DIGITS = 1e-13
# Spread of log α² about a coefficient's plausible size: a factor of 7 in α, either way.
SPREAD = 4.0
LIMIT = 25.0
FIRST_NOISE = 10.0
"""Updates begin with the mean square over this as variance of the noise."""
# No update changes log α² by more.
_LARGEST_STEP = 3.0
_TINY = 1e-12
# Share of the values that a set leaves free, at least, in an update of the noise.
_FREE = 0.02


class Grams(NamedTuple):
    """Inner products over all rows and channels: `xx` `P x P`, `xy` `P`, `yy`, and the number of values."""

    xx: Tensor
    xy: Tensor
    yy: Tensor
    values: float


class Fits(NamedTuple):
    """One entry a set, `b` sets: columns padded to `M`, groups to `g`.

    Attributes:
        log_evidence: `b`.
        noise: σ² in the units of y, `b`.
        columns: index of each column, `b x M`; -1 = padding.
        slot: which group of its set a column belongs to, `b x M`.
        mean: posterior mean of the coefficients, `b x M`.
        covariance: posterior covariance of the coefficients, `b x M x M`.
        energy: Σ (X_g θ_g)² of each group alone, `b x g`.
        rss: remaining sum of squares, `b`.
        effective: number of coefficients that the data determine, `b`.
        log_scale: log α², `b x g`.
    """

    log_evidence: Tensor
    noise: Tensor
    columns: Tensor
    slot: Tensor
    mean: Tensor
    covariance: Tensor
    energy: Tensor
    rss: Tensor
    effective: Tensor
    log_scale: Tensor


def grams_of(x: Tensor, y: Tensor) -> Grams:
    """x: `s x c x P` whitened columns; y: `s x c`."""
    flat, value = x.flatten(0, 1), y.reshape(-1)
    return Grams(_squares(flat), flat.mT @ value, value @ value, float(len(value)))


def scaled(grams: Grams, variance: float) -> Grams:
    """In units of a variance."""
    return Grams(grams.xx / variance, grams.xy / variance, grams.yy / variance, grams.values)


def _squares(flat: Tensor) -> Tensor:
    """XᵀX, `P x P`; of many columns the half above the diagonal, mirrored."""
    width = flat.shape[-1]
    if width <= _NARROW:
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


def fit_sets(
    grams: Grams,
    sets: Sequence[Sequence[Tensor]],
    noise_dof: float,
    iterations: int = _UPDATES,
    spread: float = SPREAD,
    start: tuple[Tensor, Tensor] | None = None,
) -> Fits:
    """Fit every set of groups.

    Args:
        grams: of all columns.
        sets: each a sequence of groups, a group being the indices of its columns, int64.
        noise_dof: weight of the prior of σ² about 1, in values; 0 = the noise is not known.
        iterations: MacKay updates.
        spread: standard deviation of log α².
        start: log α² of each group, `b x g`, and σ², `b`, to begin with.
    """
    columns, slot = padded(sets)
    columns, slot = columns.to(grams.xy.device), slot.to(grams.xy.device)
    groups = max(max(map(len, sets), default=0), 1)
    safe = columns.clamp_min(0)
    # Products with columns that are not there are NaN, and no factor 0 makes a number of that.
    real = columns >= 0
    g = torch.where(real[:, :, None] & real[:, None, :], grams.xx[safe[:, :, None], safe[:, None, :]], 0.0)
    b = torch.where(real, grams.xy[safe], 0.0)
    member = torch.nn.functional.one_hot(slot.clamp_min(0), groups).to(g.dtype) * real[..., None]  # b x M x groups
    there = member.sum(1) > 0
    scales = Scales(grams.values, noise_dof, there, spread)
    # Start where the prior of each group could make the whole gap, and the noise is a tenth of it.
    trace = (member * g.diagonal(dim1=-2, dim2=-1)[..., None]).sum(1).clamp_min(1e-300)
    psi = torch.log((grams.yy.clamp_min(1e-300) / trace).clamp(math.exp(-LIMIT), math.exp(LIMIT))) * there
    noise = (grams.yy / grams.values / FIRST_NOISE).clamp_min(1e-12).expand(len(columns)).clone()
    noise = torch.where(torch.tensor(noise_dof > 0), torch.ones_like(noise), noise)
    if start is not None:
        psi, noise = start
    width = columns.shape[1]
    for k in range(iterations + 1):
        scale = (member @ (psi / 2).exp()[..., None])[..., 0]
        whole = scale / noise.sqrt()[:, None]
        a = (g * whole[:, :, None]).mul_(whole[:, None, :])
        if width:
            # Columns that are nearly the same, under next to no noise, would leave no digit of the 1 on the diagonal.
            diagonal = a.diagonal(dim1=-2, dim2=-1)
            diagonal += (1 + _DIGITS * diagonal.amax(-1))[:, None]
        factor = torch.linalg.cholesky_ex(a).L
        c = scale * b / noise[:, None]
        u = torch.cholesky_solve(c[..., None], factor)[..., 0]
        inverse = torch.cholesky_inverse(factor) if width else a
        gamma = ((1 - inverse.diagonal(dim1=-2, dim2=-1))[..., None] * member).sum(1)
        size = (u.square()[..., None] * member).sum(1)
        mean = scale * u
        rss = (grams.yy - 2 * (mean * b).sum(-1) + ((g @ mean[..., None])[..., 0] * mean).sum(-1)).clamp_min(0)
        if k == iterations:
            break
        psi, noise = scales.updated(psi, size, gamma, rss)
    log_det = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    squares = grams.yy / noise - (c * u).sum(-1)
    log_evidence = scales.log_evidence(psi, gamma, noise, squares, log_det)
    part = mean[..., None] * member
    energy = (part * (g @ part)).sum(1)
    covariance = scale[:, :, None] * inverse * scale[:, None, :]
    return Fits(log_evidence, noise, columns, slot, mean, covariance, energy, rss, gamma.sum(-1), psi)


def padded(sets: Sequence[Sequence[Tensor]]) -> tuple[Tensor, Tensor]:
    """Columns and slots of every set, `b x M`, padded with -1."""
    widths = [[g.numel() for g in s] for s in sets]
    totals = torch.tensor([sum(w) for w in widths], dtype=torch.int64)
    shape = (len(sets), int(totals.max()) if len(sets) else 0)
    columns, slot = torch.full(shape, -1), torch.full(shape, -1)
    flat = [g for s in sets for g in s]
    if flat:
        row = torch.repeat_interleave(torch.arange(len(sets)), totals)
        place = torch.arange(len(row)) - (totals.cumsum(0) - totals)[row]
        number = torch.tensor([k for w in widths for k in range(len(w))])
        columns[row, place] = torch.cat(flat)
        slot[row, place] = torch.repeat_interleave(number, torch.tensor([n for w in widths for n in w]))
    return columns, slot


class Scales(NamedTuple):
    """What is known beforehand of the scales of `b` sets of `g` groups.

    Attributes:
        values: how many values are explained.
        noise_dof: weight of the prior of σ² about 1, in values; 0 = the noise is not known.
        there: which groups there are, `b x g`, bool.
        spread: standard deviation of log α².
    """

    values: float
    noise_dof: float
    there: Tensor
    spread: float = SPREAD

    def updated(self, psi: Tensor, size: Tensor, gamma: Tensor, rss: Tensor) -> tuple[Tensor, Tensor]:
        """The next log α² `b x g` and σ² `b`.

        MacKay's update, which takes coefficients and γ for fixed, and one of Newton's steps from there for the prior.

        Args:
            psi: log α², `b x g`.
            size: sum of the squares of each group's coefficients in units of α, `b x g`.
            gamma: number of coefficients of each group that the data determine, `b x g`.
            rss: remaining sum of squares, `b`.
        """
        prior = 1 / self.spread**2
        step = torch.log(size.clamp_min(_TINY) / gamma.clamp_min(_TINY)).clamp(-_LARGEST_STEP, _LARGEST_STEP)
        half = 0.5 * size * torch.exp(-step)
        step = step + (half - 0.5 * gamma - (psi + step) * prior) / (half + prior)
        psi = (psi + step.clamp_(-_LARGEST_STEP, _LARGEST_STEP).mul_(self.there)).clamp_(-LIMIT, LIMIT)
        left = (self.values - gamma.sum(-1)).clamp_min(_FREE * self.values + 1)
        return psi, ((rss + self.noise_dof) / (left + self.noise_dof)).clamp_min(1e-12)

    def log_evidence(self, psi: Tensor, gamma: Tensor, noise: Tensor, squares: Tensor, log_det: Tensor) -> Tensor:
        """At log α² `b x g` and σ² `b`, `b`.

        Args:
            psi, gamma: as for `updated`.
            noise: σ², `b`.
            squares: of y in units of its covariance, `b`.
            log_det: of that covariance in units of σ², `b`.
        """
        plain = -0.5 * (self.values * noise.log() + squares + log_det)
        plain = plain - 0.5 * self.noise_dof * (noise.log() + 1 / noise - 1)
        hyper = -0.5 * psi.square() / self.spread**2 - 0.5 * torch.log1p(0.5 * gamma * self.spread**2)
        return plain + (hyper * self.there).sum(-1)
