"""Heavy tails of the noise: a scale mixture of whole rows, or of each value by itself."""

from __future__ import annotations

import math

import torch
from torch import Tensor

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
