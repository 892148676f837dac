"""From metres and radians to units of the noise: channels that carry something, their noise, and robust row weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ccnn_torch.diagnosis._alone import NOTHING, Own, fit_alone, own_products
from ccnn_torch.diagnosis._evidence import fit_sets, grams_of
from ccnn_torch.effects import Situation

__all__ = ["NO_NOISE", "Whitening", "fitted_whitening", "moving_channels", "reweighted"]

# Degrees of freedom of the row weights (Student t), and beyond how many times its noise a row is set aside.
_DEGREES = 4.0
# The richest fit: at most so many candidates, the log evidence from which one is taken in, the spread of its log size.
_RICH, _SLIGHT, _ANY_SIZE = 8, 3.0, 6.0
_GROSS = 6.0
NO_NOISE = 1e-10
"""Less noise than any device has [m], [rad], and more than solvers leave: what lies below it is rounding."""


@dataclass(frozen=True)
class Whitening:
    """How rows become whitened rows.

    Attributes:
        channels: which of the pose channels, `c`.
        sigma: standard deviation of each [m, rad], `c`.
        weight: of each row, `s`; 0 = set aside.
        known: weight of the prior knowledge of the noise, in values; 0 = estimated from these rows.
    """

    channels: Tensor
    sigma: Tensor
    weight: Tensor
    known: float

    def __call__(self, values: Tensor) -> Tensor:
        """`s x c0` or `s x c0 x m` raw to `s x c` or `s x c x m`, in units of the noise, rows weighted."""
        return self.scaled(values[:, self.channels] if len(self.channels) < values.shape[1] else values)

    def scaled(self, values: Tensor) -> Tensor:
        """As calling it, of the channels alone: `s x c` or `s x c x m`."""
        return values * (self.scale if values.dim() == 2 else self.scale[..., None])

    @cached_property
    def scale(self) -> Tensor:
        """What a value of the channels is multiplied by, `s x c` [1/m], [1/rad]."""
        return self.weight.sqrt()[:, None] / self.sigma

    def keep(self) -> Tensor:
        """Indices of the rows that count."""
        return torch.nonzero(self.weight > 0).squeeze(-1)


def moving_channels(situation: Situation) -> Tensor:
    """As many channels as pose coordinates were measured, those that show most of them, `c`.

    A machine that is measured in two angles turns a little about a third axis, too; what is seen there is no more
    measurement, and has no noise of its own.
    """
    slope = torch.nan_to_num(situation.frame_slope).square().mean((0, 2))
    units = [c.unit for c in situation.mechanism.pose]
    kinds = [(slope[:3], units.count("m"), 0), (slope[3:], units.count("rad"), 3)]
    chosen = [kind.argsort(descending=True, stable=True)[:count] + first for kind, count, first in kinds]
    return torch.cat(chosen).sort().values


def fitted_whitening(
    residual: Tensor, columns: Sequence[Tensor], channels: Tensor, noise: Tensor | None, usable: Tensor
) -> Whitening:
    """Noise and row weights from the richest fit: of everything that may be there, one by one what explains most of
    what is left, as long as the evidence for it is more than slight.

    Args:
        residual: `s x c0` [m, rad].
        columns: of everything that may be there, `s x c0 x P` each.
        channels: `c`.
        noise: known standard deviation of each of the c0 channels, or None.
        usable: `s`, False where a row is left out from the start.
    """
    rms = residual[usable][:, channels].abs().median(0).values * 1.4826
    rms = rms.clamp_min(NO_NOISE)
    sigma = rms if noise is None else noise[channels]
    white = Whitening(channels, sigma, usable.to(residual.dtype), 0.0)
    shown = [c if len(channels) == c.shape[1] else c[:, channels] for c in columns if c.shape[-1]]
    # Columns count by what they tell, whatever their size: all have the same mean square.
    size = [(c.square().sum(-1)[usable] / sigma.square()).mean() / c.shape[-1] for c in shown]
    size = [s.sqrt().clamp_min(1e-300) for s in size]
    y = residual[:, channels]
    if noise is None:
        white = replace(white, sigma=sigma * _noise_share(shown, size, y, white).sqrt())
    chosen: list[int] = []
    least = None if noise is not None else (1e-4 * rms).clamp_min(NO_NOISE)
    left, free = y, 1.0
    for _ in range(_RICH):
        if chosen:
            own = torch.cat([shown[k] / size[k] for k in chosen], -1)
            ends = torch.tensor([shown[k].shape[-1] for k in chosen]).cumsum(0).tolist()
            parts = [torch.arange(e - shown[k].shape[-1], e) for e, k in zip(ends, chosen, strict=True)]
            fit = fit_sets(grams_of(white.scaled(own), white.scaled(y)), [parts], 0.0, spread=_ANY_SIZE)
            left = y - own @ fit.mean[0]
            free = max(1 - float(fit.effective[0]) / max(float((white.weight > 0).sum()) * len(channels), 1.0), 0.1)
            white = _settled(white, left, usable, free, least)
        target = white.scaled(left)
        products = [
            NOTHING if k in chosen else own_products(white.scaled(c), target, s)
            for k, (c, s) in enumerate(zip(shown, size, strict=True))
        ]
        fits = fit_alone([NOTHING, *products], target.square().sum(), float(target.numel()), 0.0, _ANY_SIZE)
        best = int(fits.log_evidence[1:].argmax())
        if not shown or float(fits.log_evidence[best + 1] - fits.log_evidence[0]) < _SLIGHT:
            break
        chosen.append(best)
    white = _settled(white, left, usable, free, least)
    return replace(white, known=0.0 if noise is None else 50.0)


def _noise_share(shown: Sequence[Tensor], size: Sequence[Tensor], y: Tensor, white: Whitening) -> Tensor:
    """Of the squares of each channel what the candidate that explains it best by itself leaves, `c`.

    Channel by channel: one that is almost all gap would else be lost in the noise of the others.

    Args:
        shown: columns of each candidate, `s x c x m` [m, rad].
        size: what they are divided by.
        y: residual, `s x c` [m, rad].
        white: noise and weights so far.
    """
    target = white.scaled(y).mT
    groups = [NOTHING] * len(target)
    for c, s in zip(shown, size, strict=True):
        x = white.scaled(c).transpose(0, 1)
        square, along = x.mT @ x / s.square(), (x.mT @ target[..., None])[..., 0] / s
        groups += [Own(xx, xy) for xx, xy in zip(square, along, strict=True)]
    squares = target.square().sum(-1).repeat(1 + len(shown))
    fits = fit_alone(groups, squares, float(target.shape[-1]), 0.0, _ANY_SIZE)
    evidence, noise = fits.log_evidence.reshape(-1, len(target)), fits.noise.reshape(-1, len(target))
    best = evidence.max(0)
    left = noise.gather(0, best.indices[None])[0] / noise[0]
    return torch.where(best.values - evidence[0] > _SLIGHT, left, 1.0).clamp(1e-6, 1.0)


def _settled(white: Whitening, left: Tensor, usable: Tensor, free: float, least: Tensor | None) -> Whitening:
    """Noise (unless it is known: `least` None) and weights from what a fit leaves, `s x c`.

    No channel's noise is below `least`: a perfect fit knows nothing of the noise.
    """
    if least is not None:
        rows = white.weight > 0
        spread = left[rows].abs().median(0).values * 1.4826 / free**0.5
        white = replace(white, sigma=torch.maximum(spread, least))
    return reweighted(white, left, usable, free)


def reweighted(white: Whitening, left: Tensor, usable: Tensor, free: float) -> Whitening:
    """Weights of rows from what a fit leaves, `s x c`.

    Rows beyond six times the usual are set aside, no more than a fifth of them. The others count by Student's t only
    where the remainder has heavier tails than a normal one: with normal noise every weight would be thrown away for
    nothing.
    """
    c = len(white.channels)
    size = (left / white.sigma).square().sum(-1) / max(free, 0.1)
    # Brought to the median of chi-squared with c degrees (Wilson and Hilferty).
    size = size * (c * (1 - 2 / (9 * c)) ** 3) / size[usable].median().clamp_min(1e-12)
    gross = size > (_GROSS**2) * max(1.0, c / 2)
    limit = torch.quantile(size[usable], 0.8)
    aside = (gross & (size > limit)) | ~usable
    inside = size[~aside]
    heavy = float(inside.square().mean()) > (c * c + 2 * c) * 1.5
    weight = (_DEGREES + c) / (_DEGREES + size) if heavy else torch.ones_like(size)
    weight = torch.where(aside, torch.zeros_like(weight), weight)
    return replace(white, weight=weight)
