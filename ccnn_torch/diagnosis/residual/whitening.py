"""Whitening of the residual: channels, noise, robust row weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ccnn_torch.coordinates import Coordinate
from ccnn_torch.effects import Situation
from ccnn_torch.mechanisms import Instrument, sees_directions
from ccnn_torch.mechanisms.pose import CHANNELS

# Degrees of freedom of Student's t that are tried, and the log odds that speak against tails before the rows do.
_DEGREES, _UNUSUAL = (3.0, 5.0, 10.0), 3.0
# Steps of expectation and maximisation.
_STEPS = 20
# Squared scale of a channel, at least: where its noise is at the least that is believed, it may be far smaller.
_LEAST = 0.1


def weights_of(left: Tensor, seen: Tensor, is_known: bool) -> Tensor:
    """Weights of values under the most probable of: a normal distribution, Student's t of rows, Student's t of values.

    Each is fitted with a scale of its own in every channel, since what is left may be more than noise. Weights are the
    expected precisions of the mixture (Lange, Little and Taylor 1989) over that scale, so that weighted squares are 1
    in the mean; where the noise is known they are over the scale that a t of this variance has, and the mean shows what
    is left beside the noise.

    Args:
        left: what a fit leaves in units of the noise, `s x c`.
        seen: which of them were measured, `s x c` bool.
        is_known: whether the standard deviation of the noise is known.

    Returns:
        `s x c`, 1 for a normal distribution.
    """
    plain = torch.ones_like(left)
    degrees = left.new_tensor(_DEGREES).repeat(2)[:, None, None]
    square = torch.where(seen, left, 0.0).square()
    count = seen.sum(0).clamp_min(1)
    # A row is one draw of as many values as it has, a value one draw of one.
    of_rows = (torch.arange(len(degrees)) < len(_DEGREES))[:, None, None]
    size = torch.where(of_rows, seen.sum(-1, keepdim=True), 1).to(left.dtype)
    variance = (square.sum(0) / count).clamp_min(1e-300)
    scale = variance.expand(len(degrees), 1, -1)

    def distance(scale: Tensor) -> Tensor:
        own = square / scale
        return torch.where(of_rows, own.sum(-1, keepdim=True), own)

    for _ in range(_STEPS):
        weight = (degrees + size) / (degrees + distance(scale))
        scale = ((weight * square).sum(-2, keepdim=True) / count).clamp_min(1e-300)
    far = distance(scale)
    one = torch.lgamma((degrees + size) / 2) - torch.lgamma(degrees / 2) - size / 2 * (math.pi * degrees).log()
    one = one - (degrees + size) / 2 * (far / degrees).log1p()
    # Of rows the draw stands in each of its values.
    density = torch.where(seen, torch.where(of_rows, one / size.clamp_min(1), one) - scale.log() / 2, 0.0)
    normal = -0.5 * float((count * ((2 * math.pi * variance).log() + 1)).sum())
    gain = density.sum((-2, -1)) - normal
    best = int(gain.argmax())
    if float(gain[best]) < _UNUSUAL:
        return plain
    weight = ((degrees + size) / (degrees + far)).expand(-1, *left.shape)[best]
    nu = float(degrees[best])
    return torch.where(seen, weight / ((nu - 2) / nu if is_known else scale[best].clamp_min(_LEAST)), plain)


# Beyond how many times its noise a row is set aside, and the quantile of the rows that are never.
_GROSS, _KEPT = 6.0, 0.8
NO_NOISE = 1e-10
"""Smallest noise [m], [rad]: below that of any device, above the rounding of the solvers."""
MAD = 1.4826
"""Standard deviation of a normal variate over its median absolute deviation."""
LEAST_FREE = 0.1
"""Share of the values that a fit leaves free, at least: no noise is estimated from fewer."""
# Estimated noise, at least, as a share of the residual, and of the noise of the other channels of its unit: a column of
# zeros, as for the height of a machine that moves in a plane, is no measurement without noise.
_LEAST_NOISE, _AMONG_CHANNELS = 1e-4, 1e-2
ROUNDING = 1e-9
"""Directions of what was fitted before with less than this share of the largest one are rounding."""


@dataclass(frozen=True)
class Whitening:
    """How rows become whitened rows.

    Attributes:
        channels: which of the pose channels, `c`.
        sigma: standard deviation of each [m, rad], `c`.
        weight: of each value, `s x c`; 0 in a row that is set aside.
        known: weight of the prior knowledge of the noise, in values; 0 = estimated from these rows.
        seen: which values were measured, `s x c` bool; None = all.
        axes: of the measuring device, in which the channels are, `s x c x c0`; None = those of the base frame.
        every: names and units of all the c0 channels.
    """

    channels: Tensor
    sigma: Tensor
    weight: Tensor
    known: float
    seen: Tensor | None = None
    axes: Tensor | None = None
    every: Sequence[Coordinate] = CHANNELS

    @property
    def names(self) -> list[str]:
        """What the channels are called."""
        return ["across", "along"] if self.axes is not None else [self.every[int(c)].name for c in self.channels]

    @property
    def lengths(self) -> Tensor:
        """Which of the channels are lengths, `c` bool."""
        return torch.tensor([self.every[int(c)].unit == "m" for c in self.channels])

    def __call__(self, values: Tensor) -> Tensor:
        """`s x c0` or `s x c0 x m` raw to `s x c` or `s x c x m`, in units of the noise, rows weighted."""
        return self.scaled(self.picked(values))

    def picked(self, values: Tensor) -> Tensor:
        """The channels of `s x c0` or `s x c0 x m`, `s x c` or `s x c x m`."""
        if self.axes is None:
            return values[:, self.channels] if len(self.channels) < values.shape[1] else values
        return (self.axes @ values[..., None])[..., 0] if values.dim() == 2 else self.axes @ values

    def unpicked(self, values: Tensor, rows: Tensor | None = None) -> Tensor:
        """Inverse of `picked`, 0 in what is no channel: of `t x c` in some rows the `t x 3` or `t x 6`."""
        if self.axes is not None:
            axes = self.axes if rows is None else self.axes[rows]
            return (axes.mT @ values[..., None])[..., 0]
        out = values.new_zeros(len(values), len(self.every))
        out[:, self.channels] = values
        return out

    def scaled(self, values: Tensor) -> Tensor:
        """As calling it, of the channels alone: `s x c` or `s x c x m`."""
        return values * (self.scale if values.dim() == 2 else self.scale[..., None])

    @cached_property
    def scale(self) -> Tensor:
        """What a value of the channels is multiplied by, `s x c` [1/m], [1/rad]."""
        scale = self.weight.sqrt() / self.sigma
        return scale if self.seen is None else torch.where(self.seen, scale, 0.0)

    def usual(self, values: Tensor, rows: Tensor) -> Tensor:
        """Median size of each channel over the values measured in some rows, `c` [m, rad]; values: `s x c`."""
        if self.seen is None:
            return values[rows].abs().median(0).values
        found: Tensor = torch.where(self.seen, values.abs(), torch.nan)[rows].nanmedian(0).values
        return found.nan_to_num(nan=NO_NOISE)

    @property
    def times(self) -> Tensor | None:
        """Rows that count over those in which each channel was measured, `c` [1]; None where all was."""
        keep = self.keep()
        return None if self.seen is None else len(keep) / self.seen[keep].sum(0).clamp_min(1).to(self.sigma.dtype)

    def count(self, rows: Tensor | None = None) -> float:
        """How many values were measured in some rows, by default in those that count."""
        there = self.keep() if rows is None else rows
        return float(len(there) * len(self.channels) if self.seen is None else self.seen[there].sum())

    def believed(self, sigma: Tensor) -> Whitening:
        """The same with another noise, `c` [m, rad], of each channel at least what is believed."""
        alike = self.lengths[:, None] == self.lengths
        among = _AMONG_CHANNELS * torch.where(alike, sigma, 0.0).amax(-1)
        return replace(self, sigma=torch.maximum(sigma, among).clamp_min(NO_NOISE))

    @property
    def counted(self) -> Tensor:
        """Whether a row counts, `s` bool."""
        return (self.weight > 0).any(-1)

    def keep(self) -> Tensor:
        """Indices of the rows that count."""
        return torch.nonzero(self.counted).squeeze(-1)


def device_axes(situation: Situation) -> Tensor | None:
    """Axes in which a device's noise is the same in all rows, `s x c x c0`; None where these are the base frame's.

    Directions are seen across the motion of the last joint and along it: there is no error along the direction.
    """
    if not sees_directions(situation.mechanism):
        return None
    along = torch.nn.functional.normalize(situation.jacobian[..., -1], dim=-1)
    across = torch.linalg.cross(torch.nn.functional.normalize(situation.platform[0], dim=-1), along, dim=-1)
    return torch.stack([across, along], -2)


def moving_channels(situation: Situation) -> Tensor:
    """As many channels as pose coordinates were measured, those that show most of them, `c`.

    A machine that is measured in two angles turns a little about a third axis, too; what is seen there is no more
    measurement, and has no noise of its own.
    """
    if sees_directions(situation.mechanism):
        return torch.arange(2)
    mechanism = situation.mechanism
    if isinstance(mechanism, Instrument):
        return torch.tensor([k for k, c in enumerate(mechanism.channels) if c.name])
    slope = torch.nan_to_num(situation.frame_slope).square().mean((0, 2))
    units = [c.unit for c in mechanism.pose]
    kinds = [(slope[:3], units.count("m"), 0), (slope[3:], units.count("rad"), 3)]
    chosen = [kind.argsort(descending=True, stable=True)[:count] + first for kind, count, first in kinds]
    return torch.cat(chosen).sort().values


def reweighted(white: Whitening, left: Tensor, usable: Tensor, free: float) -> Whitening:
    """Weights of values from what a fit leaves, `s x c`.

    Rows beyond six times the usual are set aside, no more than a fifth of them. The others count by Student's t, of
    whole rows or of each value by itself, where that is clearly more probable than a normal distribution.
    """
    c = len(white.channels)
    size = (left / white.sigma).square().sum(-1) / max(free, LEAST_FREE)
    if white.seen is not None:
        # As of a row in which all was measured.
        size = torch.where(white.seen, left / white.sigma, 0.0).square().sum(-1) / max(free, LEAST_FREE)
        size = size * c / white.seen.sum(-1).clamp_min(1)
    # Brought to the median of chi-squared with c degrees (Wilson and Hilferty).
    size = size * (c * (1 - 2 / (9 * c)) ** 3) / size[usable].median().clamp_min(1e-12)
    gross = size > (_GROSS**2) * max(1.0, c / 2)
    limit = torch.quantile(size[usable], _KEPT)
    aside = (gross & (size > limit)) | ~usable
    inside = ~aside
    there = torch.ones_like(left, dtype=torch.bool) if white.seen is None else white.seen
    weight = torch.zeros_like(left)
    apart = left[inside] / white.sigma / max(free, LEAST_FREE) ** 0.5
    weight[inside] = weights_of(apart, there[inside], white.known > 0)
    return replace(white, weight=weight)


def without_frames(white: Whitening, left: Tensor, fitted: Tensor) -> Tensor:
    """What is left of the rows when frames are fitted to it, `s x c0` [m, rad].

    Args:
        white: noise and weights.
        left: `s x c0` [m, rad].
        fitted: what the frames can do, `s x c0 x r`.
    """
    if not fitted.shape[-1]:
        return left
    keep = white.keep()
    x, y = white(fitted)[keep].flatten(0, 1), white(torch.nan_to_num(left))[keep].flatten()
    found: Tensor = left - fitted @ torch.linalg.lstsq(x, y, driver="gelsd").solution
    return found


def without_fitted(fitted: Tensor, columns: Sequence[Tensor]) -> list[Tensor]:
    """What was fitted before, `s x c x r` whitened, takes its part out of everything, `s x c x m` each."""
    if not fitted.shape[-1]:
        return [*columns]
    u, s, _ = torch.linalg.svd(fitted.flatten(0, 1), full_matrices=False)
    q = u[:, s > ROUNDING * s[0]]
    return [(c.flatten(0, 1) - q @ (q.mT @ c.flatten(0, 1))).reshape(c.shape) for c in columns]


def size_of_fitted(fitted: Tensor) -> float:
    """Half the logarithm of the determinant of the products of what was fitted, `s x c x r` whitened."""
    if not fitted.shape[-1]:
        return 0.0
    values = torch.linalg.svdvals(fitted.flatten(0, 1))
    return float(values[values > ROUNDING * values[0]].log().sum())


def renewed(white: Whitening, left: Tensor, residual: Tensor, free: float, usable: Tensor) -> Whitening:
    """Noise, unless it was given, and weights from what a fit leaves: a perfect fit knows nothing of the noise.

    Args:
        white: before.
        left: of the fit, `s x c` [m, rad].
        residual: what was fitted, `s x c` [m, rad].
        free: share of the values that the fit leaves free.
        usable: rows that may count, `s`.
    """
    if white.known == 0:
        counted = white.counted & usable
        spread = white.usual(left, counted) * MAD / max(free, LEAST_FREE) ** 0.5
        rms = white.usual(residual, counted) * MAD
        white = white.believed(torch.maximum(spread, _LEAST_NOISE * rms))
    return reweighted(white, left, usable, free)
