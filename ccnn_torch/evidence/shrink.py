"""Share of the gap that a fit takes away on rows that it did not see, with a bootstrap interval."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

_REPEATS = 400
# What a 95 % interval leaves out.
_TAIL = 0.05
INTERVAL = (_TAIL / 2, 1 - _TAIL / 2)
"""Quantiles of a 95 % interval."""
RUNS = 50
"""Rows are dealt and drawn in runs: so many in all, as neighbouring rows may share their errors."""
FOLDS = 5
"""Parts of the rows that are held out in turn."""
# Reducible residual of a bootstrap sample, at least, as a share of that of all rows.
_LEAST_GAP = 1e-3


@dataclass(frozen=True)
class HeldOut:
    """Held-out rows under one set of candidates.

    Attributes:
        left: what is left of every row by a fit to other rows, unwhitened, `s x c` [m, rad].
        uncertain: mean square that the fit's own uncertainty adds to each row, `s x c`.
    """

    left: Tensor
    uncertain: Tensor


class Draws(NamedTuple):
    """Rows drawn in runs with replacement, `repeats`: how often each row, `repeats x s`, and a standard normal number
    for the noise within what is known of it, `repeats`."""

    counts: Tensor
    normal: Tensor


@dataclass(frozen=True)
class Gap:
    """Root mean squares over held-out rows, and the share of the reducible gap that goes away with its 95 % interval.

    All in one unit, m or rad; `shrink` and `interval` are None where there is no gap above the noise.
    """

    before: float
    after: float
    floor: float
    shrink: float | None
    interval: tuple[float, float] | None


def shrink_of(before: Tensor, held: HeldOut, floor: Tensor, channels: Tensor, floor_dof: float, draws: Draws) -> Gap:
    """Before and after on the channels of one unit.

    What is left above the noise is corrected for what the noise of four fifths of the rows does to the fit: it
    estimates how far this cause, with its true numbers, leaves the gap. Blocks of rows are drawn with replacement, and
    the noise is drawn within what is known of it.

    Args:
        before: residual of the nominal machine, `s x c` [m, rad].
        held: with the set.
        floor: variance of the noise, `c`.
        channels: `c`, bool.
        floor_dof: on how many values an estimate of the noise's variance rests, whose interval then reaches from "the
            rest is another cause" to "the rest is noise"; 0 = known.
        draws: of the rows.
    """
    old = before[:, channels].square().sum(-1)
    new = held.left[:, channels].square().sum(-1)
    unsure = held.uncertain[:, channels].sum(-1)
    noise = float(floor[channels].sum())
    b2, a2 = float(old.mean()), float(new.mean())
    if b2 <= noise:
        return Gap(math.sqrt(b2), math.sqrt(a2), math.sqrt(noise), None, None)
    plain = min(max(1 - (a2 - noise) / (b2 - noise), 0.0), 1.0)
    drawn = noise * (1 + (math.sqrt(2 / floor_dof) if floor_dof > 0 else 0.0) * draws.normal)
    rest, gap = (draws.counts @ torch.stack([new - unsure, old], -1) / len(old) - drawn[:, None]).unbind(-1)
    share = 1 - rest / gap.clamp_min(_LEAST_GAP * (b2 - noise))
    # Less than the noise that was given is left: no cause takes away more than all, and the spread of the draws stays.
    share = (share - (share.mean() - 1).clamp_min(0.0)).clamp(0.0, 1.0)
    # Noise that was estimated may be another cause: then all that is left belongs to the gap.
    if floor_dof > 0:
        left, whole = (draws.counts @ torch.stack([new - unsure, old], -1) / len(old)).unbind(-1)
        least = float(torch.quantile((1 - left / whole).clamp(0.0, 1.0), _TAIL / 2))
    else:
        least = 1.0
    # Where draws reach 1, all of the gap, the interval ends there and leaves out draws on the lower side alone.
    above = 0.0 if float((share >= 1).to(share.dtype).mean()) > _TAIL / 2 else _TAIL / 2
    low, high = torch.quantile(share, torch.tensor([_TAIL - above, 1 - above], dtype=share.dtype)).tolist()
    return Gap(math.sqrt(b2), math.sqrt(a2), math.sqrt(noise), plain, (min(low, plain, least), max(high, plain)))


def draws(rows: int, seed: int) -> Draws:
    """Of so many rows."""
    generator = torch.Generator().manual_seed(seed)
    chosen = resampled(rows, generator)
    counts = torch.zeros(chosen.shape, dtype=torch.float64).scatter_add_(
        1, chosen, torch.ones(chosen.shape, dtype=torch.float64)
    )
    return Draws(counts, torch.randn(_REPEATS, generator=generator, dtype=torch.float64))


def resampled(rows: int, generator: torch.Generator) -> Tensor:
    """Rows drawn in runs with replacement, `repeats x rows`."""
    run = max(1, rows // RUNS)
    starts = torch.randint(rows, (_REPEATS, -(-rows // run)), generator=generator)
    return ((starts[..., None] + torch.arange(run)) % rows).flatten(1)[:, :rows]
