"""Noise and robust row weights from the residual of the largest model."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.diagnosis.residual.whitening import (
    MAD,
    Whitening,
    renewed,
)
from ccnn_torch.evidence.marginal_likelihood import (
    NO_COLUMNS,
    Axes,
    GroupProducts,
    Prior,
    axes_of,
    fit_in_axes,
    fit_sets,
    fit_single_groups,
    grams_of,
    groups_of,
    own_products,
)
from ccnn_torch.mechanisms.pose import CHANNELS

# The largest model: how many candidates at most, the log evidence from which one is in it, the spread of its log size.
_LARGEST, _SLIGHT, _ANY_SIZE = 8, 3.0, 6.0
# Candidates that are evaluated with the rows' weights as they are, the most promising when all weigh alike.
_NEXT = 4
# The principal axes of all are taken anew where the channels' noise has changed by more among each other (logarithm).
_SAME_AXES = 0.2
# Updates of a fit that begins where the one before it ended.
_UPDATES = 4
# Weight of a noise that was given, in values, before the number of rows.
_KNOWN = 50.0


def fitted_whitening(
    residual: Tensor,
    columns: Sequence[Tensor],
    channels: Tensor,
    noise: Tensor | None,
    usable: Tensor,
    seen: Tensor | None = None,
    axes: Tensor | None = None,
    every: Sequence[Coordinate] | None = None,
) -> Whitening:
    """Noise and row weights from the largest model: of everything that may be there, one by one what explains most of
    what is left, as long as the evidence for it is more than slight.

    Args:
        residual: `s x c0` [m, rad].
        columns: of everything that may be there, `s x c0 x P` each.
        channels: `c`.
        noise: known standard deviation of each of the c0 channels, or None.
        usable: `s`, False where a row is left out from the start.
        seen: which values were measured, `s x c0` bool; None = all.
        axes, every: as in `Whitening`; every: those of position and rotation vector when None.
    """
    if axes is not None and seen is not None:
        # A direction that lacks a part is none.
        usable, seen = usable & seen.all(-1), None
    seen = None if seen is None else seen[:, channels]
    given, known = (residual.new_ones(residual.shape[-1]), 0.0) if noise is None else (noise, _KNOWN)
    weight = usable.to(residual.dtype)[:, None].expand(-1, len(channels))
    every = CHANNELS[: residual.shape[-1]] if every is None else every
    white = Whitening(channels, given[channels], weight, known, seen, axes, every)
    y = white.picked(residual)
    shown = [white.picked(c).to(residual.dtype) for c in columns if c.shape[-1]]
    shown = shown if seen is None else [c * seen[..., None] for c in shown]
    count = white.count(torch.nonzero(usable)[:, 0])
    if noise is None:
        white = white.believed(white.usual(y, usable) * MAD)
    candidates = _Everything(shown, white)
    if noise is None:
        white = white.believed(white.sigma * _noise_share(candidates, y, white).sqrt())
    chosen: list[int] = []
    log_scale = y.new_zeros(1, 0)
    left, free = y, 1.0
    for _ in range(_LARGEST):
        if chosen:
            own = torch.cat([shown[k] / candidates.size[k] for k in chosen], -1)
            grams = grams_of(white.scaled(own), white.scaled(y))._replace(values=count)
            groups = groups_of(shown[k] for k in chosen)
            fit = fit_sets(grams, [groups], 0.0, _UPDATES, _ANY_SIZE, (log_scale, y.new_ones(1)))
            left, log_scale = y - own @ fit.mean[0], fit.log_scale
            free = 1 - float(fit.effective[0]) / max(float(white.counted.sum()) * len(channels), 1.0)
            white = renewed(white, left, y, free, usable)
        rest = [k for k in range(len(shown)) if k not in chosen]
        if not rest:
            break
        squares = white.scaled(left).square().sum()
        rough = candidates.roughly_added(white, left)[rest]
        likely = [rest[k] for k in rough.argsort(descending=True)[:_NEXT].tolist()]
        products = [own_products(white.scaled(shown[k]), white.scaled(left), candidates.size[k]) for k in likely]
        fits, _ = fit_single_groups([NO_COLUMNS, *products], squares, Prior(count, 0.0, _ANY_SIZE))
        gain = fits.log_evidence[1:] - fits.log_evidence[0]
        best = int(gain.argmax())
        if float(gain[best]) < _SLIGHT:
            break
        chosen.append(likely[best])
        log_scale = torch.cat([log_scale, fits.log_scale[1 + best : 2 + best]], -1)
    return renewed(white, left, y, free, usable)


class _Everything:
    """All that may be there, and its inner products channel by channel: these stay when the noise changes.

    Columns count by their information, not their size: all have the same mean square.

    Attributes:
        columns: of each candidate, `s x c x m` [m, rad].
        size: what they are divided by.
    """

    def __init__(self, columns: Sequence[Tensor], white: Whitening) -> None:
        self.columns = columns
        self._weight = white.weight
        self._turned: tuple[Axes, Tensor] | None = None
        self._among = [self._by_channel(c, c) for c in columns]
        # Weights are 1 or 0 at first.
        count = white.weight.sum()
        per = white.sigma[:, None] ** -2
        squares = [(g.diagonal(dim1=-2, dim2=-1) * per).sum() / g.shape[-1] for g in self._among]
        self.size = [(s / count).sqrt().clamp_min(1e-300) for s in squares]

    def _by_channel(self, one: Tensor, other: Tensor) -> Tensor:
        """Inner products `c x m x k` of `s x c x m` and `s x c x k`."""
        plain = bool((self._weight == 1).all())
        weighted = one if plain else one * self._weight[..., None]
        return weighted.permute(1, 2, 0) @ other.transpose(0, 1)

    def by_channel(self, y: Tensor, white: Whitening) -> list[list[GroupProducts]]:
        """Of every candidate those of each channel, in units of the noise; y: residual, `s x c`."""
        per = white.sigma**-2
        found = []
        for columns, among, size in zip(self.columns, self._among, self.size, strict=True):
            square = among * per[:, None, None] / size**2
            along = self._by_channel(columns, y[..., None])[..., 0] * per[:, None] / size
            found.append([GroupProducts(xx, xy) for xx, xy in zip(square, along, strict=True)])
        return found

    def roughly_added(self, white: Whitening, left: Tensor) -> Tensor:
        """Log evidence that each candidate would gain beside a fit that leaves so much, `s x c`, as if all rows weighed
        alike and up to a number that all have in common: near enough to rank them."""
        per = white.sigma**-2
        share = per * white.weight.sum(0) / self._weight.sum(0)
        if self._turned is None or _spread(share / self._turned[1]) > _SAME_AXES:
            square = share[:, None, None]
            inner = [(a * square).sum(0) / size**2 for a, size in zip(self._among, self.size, strict=True)]
            self._turned = axes_of(inner, left), share
        axes, before = self._turned
        target = (left * white.weight * per).reshape(-1)
        along = axes.turned(
            [c.flatten(0, 1).mT @ target / size for c, size in zip(self.columns, self.size, strict=True)]
        )
        square = axes.square * (share / before).mean()
        squares, there = white.scaled(left).square().sum(), torch.ones(len(square), dtype=torch.bool)
        return fit_in_axes(square, along, there, squares, Prior(float(self._weight.sum()), 0.0, _ANY_SIZE)).log_evidence


def _spread(factors: Tensor) -> float:
    """Between the least and the largest, in logarithms."""
    least, largest = factors.log().aminmax()
    return float(largest - least)


def _noise_share(every: _Everything, y: Tensor, white: Whitening) -> Tensor:
    """Of the squares of each channel what the candidate that explains it best alone leaves, `c`.

    Channel by channel: one that is almost all gap would else be lost in the noise of the others.

    Args:
        every: candidates.
        y: residual, `s x c` [m, rad].
        white: noise and weights so far.
    """
    target = white.scaled(y).mT
    groups = [NO_COLUMNS] * len(target) + [own for each in every.by_channel(y, white) for own in each]
    squares = target.square().sum(-1).repeat(1 + len(every.columns))
    fits, _ = fit_single_groups(groups, squares, Prior(float(white.counted.sum()), 0.0, _ANY_SIZE))
    evidence, noise = fits.log_evidence.reshape(-1, len(target)), fits.noise.reshape(-1, len(target))
    best = evidence.max(0)
    left = noise.gather(0, best.indices[None])[0] / noise[0]
    return torch.where(best.values - evidence[0] > _SLIGHT, left, 1.0).clamp(1e-6, 1.0)
