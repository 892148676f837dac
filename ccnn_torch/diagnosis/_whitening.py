"""From metres and radians to units of the noise: channels that carry something, their noise, and robust row weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis._evidence import fit_sets, grams_of

__all__ = ["Whitening", "fitted_whitening", "moving_channels", "reweighted"]

# Degrees of freedom of the row weights (Student t), and beyond how many times its noise a row is set aside.
_DEGREES = 4.0
_GROSS = 6.0


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
        flat = values.dim() == 2
        three = values.unsqueeze(-1) if flat else values
        three = three[:, self.channels] / self.sigma[:, None] * self.weight.sqrt()[:, None, None]
        return three.squeeze(-1) if flat else three

    def keep(self) -> Tensor:
        """Indices of the rows that count."""
        return torch.nonzero(self.weight > 0).squeeze(-1)


def moving_channels(residual: Tensor, jacobian: Tensor) -> Tensor:
    """Channels in which the joints move the platform or something was measured, `c`."""
    moved = jacobian.abs().amax((0, 2))
    scale = moved.clone()
    scale[:3] /= moved[:3].max().clamp_min(1e-300)
    scale[3:] /= moved[3:].max().clamp_min(1e-300) if len(moved) > 3 else 1.0
    return torch.nonzero((scale > 1e-6) | (residual.abs().amax(0) > 1e-12)).squeeze(-1)


def fitted_whitening(
    residual: Tensor, columns: Tensor, channels: Tensor, noise: Tensor | None, usable: Tensor
) -> Whitening:
    """Noise and row weights from the richest fit: all columns with one common prior scale, reweighted four times.

    Args:
        residual: `s x c0` [m, rad].
        columns: of everything that may be there, `s x c0 x P`.
        channels: `c`.
        noise: known standard deviation of each of the c0 channels, or None.
        usable: `s`, False where a row is left out from the start.
    """
    rms = residual[usable][:, channels].abs().median(0).values.clamp_min(1e-15) * 1.4826
    sigma = rms if noise is None else noise[channels]
    white = Whitening(channels, sigma, usable.to(residual.dtype), 0.0)
    unit = columns / (columns[usable][:, channels] / sigma[:, None]).square().mean((0, 1)).sqrt().clamp_min(1e-300)
    everything = [[torch.arange(unit.shape[-1])]]
    for _ in range(4):
        x, y = white(unit), white(residual)
        fit = fit_sets(grams_of(x, y), everything, 0.0, spread=6.0)
        left = residual - (unit @ fit.mean[0])
        weight = white.weight > 0
        free = 1 - float(fit.effective[0]) / max(float(weight.sum()) * len(channels), 1.0)
        if noise is None:
            spread = left[weight][:, channels].abs().median(0).values * 1.4826 / max(free, 0.1) ** 0.5
            # No channel's noise is below a thousandth of what it shows: a perfect fit knows nothing of the noise.
            white = replace(white, sigma=torch.maximum(spread, 1e-4 * rms))
        white = reweighted(white, left, usable, free)
    return replace(white, known=0.0 if noise is None else 50.0)


def reweighted(white: Whitening, left: Tensor, usable: Tensor, free: float) -> Whitening:
    """Weights of rows from what a fit leaves, `s x c0`.

    Rows beyond six times the usual are set aside, no more than a fifth of them. The others count by Student's t only
    where the remainder has heavier tails than a normal one: with normal noise every weight would be thrown away for
    nothing.
    """
    c = len(white.channels)
    size = (left[:, white.channels] / white.sigma).square().sum(-1) / max(free, 0.1)
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
