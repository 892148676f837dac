"""Periodic nodes: a sine and a cosine of one input, which feed the outputs directly.

A gear or a screw repeats its error many times over a joint's range. Sigmoids cannot follow that, and no descent finds
the frequency, since the error has a minimum at each of them. So frequencies are found by search: matching pursuit
(Mallat and Zhang, IEEE Trans. Signal Process. 41(12), 1993) in what the network leaves, one input and one frequency at
a time, each with the amplitudes of all found so far fitted anew (Pati, Rezaiifar and Krishnaprasad 1993). Refinement
then moves frequencies and amplitudes together with all other weights, and its prior switches off what is not needed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# Inputs span 2, so that a wave of frequency pi has one period. Slower ones are left to the sigmoids.
_SLOWEST, _FASTEST = 4.0, 130.0
# Width of a spectral line is pi over the span; a quarter of its half finds every line near its top.
_SPACING = math.pi / 8
# An input with fewer values than this is a state (a direction, a load case), not a motion.
_FEWEST_VALUES = 8
# Keeps the normal equations regular where sine and cosine are nearly the same on the rows.
_RIDGE = 1e-9


class Waves(NamedTuple):
    """`k` slots for periodic nodes; a slot that is not in use has the frequency 0 and no connection.

    Attributes:
        source: which input a node reads, `... x k` int64.
        frequency: in rad per unit of the scaled input, `... x k`.
    """

    source: Tensor
    frequency: Tensor


def no_waves(leading: tuple[int, ...], slots: int, like: Tensor) -> Waves:
    """Slots that are all free."""
    frequency = torch.zeros(*leading, slots, dtype=like.dtype, device=like.device)
    return Waves(torch.zeros_like(frequency, dtype=torch.int64), frequency)


def wave_signal(waves: Waves, inputs: Tensor) -> Tensor:
    """Sines, then cosines, `... x s x 2k`. inputs: `... x s x i`, the leading dimensions broadcast."""
    phase = wave_inputs(waves.source, inputs) * waves.frequency.unsqueeze(-2)
    return torch.cat([torch.sin(phase), torch.cos(phase)], -1)


def wave_inputs(source: Tensor, inputs: Tensor) -> Tensor:
    """The input that each node reads, `... x s x k`."""
    leading = np.broadcast_shapes(source.shape[:-1], inputs.shape[:-2])
    rows = inputs.shape[-2]
    index = source.unsqueeze(-2).expand(*leading, rows, source.shape[-1])
    return inputs.expand(*leading, *inputs.shape[-2:]).gather(-1, index)


def find_waves(waves: Waves, residual: Tensor, inputs: Tensor, rows: Tensor, readable: Tensor, passes: int) -> Waves:
    """Fill free slots with the periodic nodes that explain most of a residual.

    Each pass takes, for every output, the input and frequency of the largest share of squares explained, where that
    share is more than the best of so many candidates has by chance: of noise, -s/2 log(1 - share) is distributed
    exponentially, so that its largest of n has passed log n + 2 one time in eight.

    Args:
        waves: slots so far, `b x k`.
        residual: `b x s x o`.
        inputs: `b x s x i`, about in [-1, 1].
        rows: row weights, `b x s`.
        readable: which inputs may be read, `i` bool.
        passes: how often to look, each time at what the nodes found before leave.
    """
    there = (rows > 0).unsqueeze(-1)
    root = rows.sqrt().unsqueeze(-1)
    inputs, residual = inputs.masked_fill(~there, 0), residual.masked_fill(~there, 0) * root
    frequencies = torch.arange(_SLOWEST, _FASTEST, _SPACING, dtype=inputs.dtype, device=inputs.device)
    moving = _values(inputs, there)
    candidates = torch.nonzero(readable & moving.any(0)).flatten().tolist()
    left = residual
    count = rows.sum(-1, keepdim=True)
    enough = math.log(max(1, int(readable.sum())) * residual.shape[-1] * len(frequencies)) + 2
    found = Waves(waves.source.clone(), waves.frequency.clone())
    for _ in range(passes):
        gain, source, frequency = _best(left, inputs, root, frequencies, candidates, moving)
        good = -count / 2 * torch.log1p(-gain.clamp(0, 1 - 1e-12)) > enough
        if not bool(good.any()):
            break
        found = _filled(found, source, frequency, good)
        left = _left(found, residual, inputs, root)
    return found


def _best(
    left: Tensor, inputs: Tensor, root: Tensor, frequencies: Tensor, candidates: list[int], moving: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Largest share of the squares of each output that one node explains, its input and frequency: `b x o` each."""
    total = left.square().sum(-2).clamp_min(1e-300)
    shape = total.shape
    best = (torch.zeros_like(total), torch.zeros(shape, dtype=torch.int64, device=left.device), torch.zeros_like(total))
    for source in candidates:
        phase = inputs[..., source, None] * frequencies
        sine, cosine = torch.sin(phase) * root, torch.cos(phase) * root
        ss, cc, sc = ((a * b).sum(-2).unsqueeze(-1) for a, b in ((sine, sine), (cosine, cosine), (sine, cosine)))
        determinant = ss * cc - sc * sc
        along, across = sine.mT @ left, cosine.mT @ left
        explained = (cc * along.square() - 2 * sc * along * across + ss * across.square()) / determinant.clamp_min(
            _RIDGE
        )
        distinct = (determinant > 1e-3 * ss * cc) & moving[:, source, None, None]
        share = torch.where(distinct, explained / total.unsqueeze(-2), 0.0)
        top = share.max(-2)
        better = top.values > best[0]
        best = (
            torch.where(better, top.values, best[0]),
            torch.where(better, source, best[1]),
            torch.where(better, frequencies[top.indices], best[2]),
        )
    return best


def _filled(waves: Waves, source: Tensor, frequency: Tensor, good: Tensor) -> Waves:
    """Nodes put into the first free slots, output by output, unless they are there already."""
    for output in range(source.shape[-1]):
        own, line = source[:, output, None], frequency[:, output, None]
        same = (waves.source == own) & ((waves.frequency - line).abs() < _SPACING)
        free = waves.frequency == 0
        wanted = good[:, output, None] & ~same.any(-1, keepdim=True) & free.any(-1, keepdim=True)
        first = torch.zeros_like(free).scatter(-1, free.to(torch.int8).argmax(-1, keepdim=True), True) & wanted
        waves = Waves(torch.where(first, own, waves.source), torch.where(first, line, waves.frequency))
    return waves


def _left(waves: Waves, residual: Tensor, inputs: Tensor, root: Tensor) -> Tensor:
    """What the nodes leave of a residual with their amplitudes fitted by least squares; `root` has the row weights."""
    basis = wave_signal(waves, inputs) * (waves.frequency != 0).repeat(1, 2).unsqueeze(-2) * root
    eye = torch.eye(basis.shape[-1], dtype=basis.dtype, device=basis.device)
    # A little more than nothing: two nodes of nearly the same frequency must not cancel each other.
    normal = basis.mT @ basis + (1e-6 * basis.shape[-2] + _RIDGE) * eye
    amplitudes: Tensor = torch.linalg.solve(normal, basis.mT @ residual)
    return residual - basis @ amplitudes


def _values(inputs: Tensor, there: Tensor) -> Tensor:
    """Whether an input takes more than a few values, `b x i` bool."""
    ordered = inputs.masked_fill(~there, torch.inf).sort(-2).values
    steps = (ordered[:, 1:] > ordered[:, :-1] + 1e-9) & ordered[:, 1:].isfinite()
    return steps.sum(-2) + 1 >= _FEWEST_VALUES
