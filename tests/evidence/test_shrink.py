"""The share of a gap that goes away, and its interval, on residuals made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from ccnn_torch.evidence.shrink import Gap, HeldOut, draws, shrink_of

ROWS, NOISE = 400, 0.1
BOTH = torch.tensor([True, True, False])


def residuals(left: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Before, of size 1 in two channels, and after; the third channel is of another unit."""
    drawn = torch.randn(2, ROWS, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return drawn[0], torch.hypot(torch.tensor(left), torch.tensor(NOISE)) * drawn[1]


def gap(left: float, floor_dof: float = 0.0, uncertain: float = 0.0) -> Gap:
    before, after = residuals(left)
    held = HeldOut(after, torch.full_like(after, uncertain))
    floor = torch.full((3,), NOISE**2, dtype=torch.float64)
    return shrink_of(before, held, floor, BOTH, floor_dof, draws(ROWS, 1))


def test_the_interval_leaves_out_a_fortieth_of_the_resampled_shares_at_each_end() -> None:
    found = gap(0.5)
    before, after = (v[:, :2].square().sum(-1).numpy() for v in residuals(0.5))
    noise = 2 * NOISE**2
    assert (found.before, found.after) == pytest.approx((math.sqrt(before.mean()), math.sqrt(after.mean())))
    plain = 1 - (after.mean() - noise) / (before.mean() - noise)
    assert found.shrink == pytest.approx(plain)
    counts = draws(ROWS, 1).counts.numpy() / ROWS
    shares = 1 - (counts @ after - noise) / (counts @ before - noise)
    assert found.interval == pytest.approx(tuple(np.quantile(shares, [0.025, 0.975])))


def test_where_all_of_the_gap_goes_the_interval_leaves_out_one_end_alone() -> None:
    found, uncertain = gap(0.0), NOISE**2
    before, after = (v[:, :2].square().sum(-1).numpy() for v in residuals(0.0))
    assert found.interval is not None and found.interval[1] == 1.0
    # What the fit's own uncertainty adds is none of the gap.
    low = gap(0.0, uncertain=uncertain).interval
    assert low is not None and low[0] > found.interval[0]
    # Noise that was estimated may be another cause: then all that is left belongs to the gap.
    doubted = gap(0.0, floor_dof=ROWS).interval
    counts = draws(ROWS, 1).counts.numpy()
    whole = 1 - (counts @ after) / (counts @ before)
    assert doubted is not None and doubted[0] == pytest.approx(np.quantile(whole, 0.025))


def test_a_gap_within_the_noise_has_no_share() -> None:
    before, after = residuals(0.0)
    held = HeldOut(after, torch.zeros_like(after))
    found = shrink_of(0.1 * NOISE * before, held, torch.full((3,), NOISE**2), BOTH, 0.0, draws(ROWS, 1))
    assert found.shrink is None and found.interval is None
