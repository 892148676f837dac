"""The noise of every channel, and bad rows, before anything is named."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.noise_estimate import fitted_whitening

ROWS, NOISE = 300, torch.tensor([1e-5, 2e-5, 5e-5], dtype=torch.float64)


def drawn(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("gap", [3.0, 10.0])
@pytest.mark.parametrize("tails", [False, True])
def test_the_noise_of_every_channel_is_what_the_causes_leave_among_many_that_could_be(gap: float, tails: bool) -> None:
    # Three of twenty groups of columns make the gap, which two channels see and the third hardly does.
    columns = [drawn(k, ROWS, 3, 4) * torch.tensor([1.0, 0.7, 0.05])[:, None] for k in range(20)]
    made = sum((columns[k] @ drawn(100 + k, 4) for k in (2, 7, 13)), torch.zeros(ROWS, 3, dtype=torch.float64))
    noise = NOISE * drawn(50, ROWS, 3)
    if tails:
        noise = noise * (3 / (0.25 * drawn(51, ROWS, 12).square().sum(-1, keepdim=True))).sqrt()
    residual = gap * 2e-5 * made / made.square().mean().sqrt() + noise
    bad = [5, 60, 200]
    residual[bad] += 40 * NOISE
    usable = torch.ones(ROWS, dtype=torch.bool)
    white = fitted_whitening(residual, columns, torch.arange(3), None, usable)
    spread = noise.abs().median(0).values * 1.4826
    assert (white.sigma / spread).numpy() == pytest.approx(1.0, rel=0.15)
    aside = set(torch.nonzero(~white.counted)[:, 0].tolist())
    assert set(bad) <= aside and len(aside) < ROWS * 0.05
    told = fitted_whitening(residual, columns, torch.arange(3), NOISE, usable)
    assert told.sigma.tolist() == NOISE.tolist() and set(bad) <= set(torch.nonzero(~told.counted)[:, 0].tolist())


def test_a_column_of_zeros_is_no_measurement_without_noise() -> None:
    columns, usable = [drawn(k, ROWS, 3, 4) for k in range(5)], torch.ones(ROWS, dtype=torch.bool)
    residual = 1e-4 * columns[2] @ drawn(100, 4) + NOISE * drawn(50, ROWS, 3)
    residual[:, 0] = 0
    sigma = fitted_whitening(residual, columns, torch.arange(3), None, usable).sigma
    assert float(sigma[0] / sigma.max()) == pytest.approx(1e-2)
