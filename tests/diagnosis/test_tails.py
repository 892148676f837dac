"""Weights of values where the noise has heavy tails."""

import numpy as np
import pytest
import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.whitening import weights_of

SIZES = torch.tensor([1.0, 0.5, 2.0, 1.5], dtype=torch.float64)


def drawn(kind: str, seed: int, rows: int = 300) -> Tensor:
    """Noise of variance `SIZES` squared: normal, or Student's t of three degrees by value or by row."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(rows, 4))
    if kind == "values":
        noise = rng.standard_t(3, (rows, 4)) / np.sqrt(3)
    if kind == "rows":
        noise = noise * np.sqrt(1 / rng.chisquare(3, (rows, 1)))
    return torch.from_numpy(noise) * SIZES


def weights(noise: Tensor, is_known: bool) -> Tensor:
    return weights_of(noise / SIZES, torch.ones_like(noise, dtype=torch.bool), is_known)


def test_normal_noise_keeps_all_its_weight() -> None:
    kept = [bool((weights(drawn("normal", seed), False) == 1).all()) for seed in range(50)]
    assert sum(kept) >= 48


@pytest.mark.parametrize("kind", ["values", "rows"])
def test_a_mean_is_nearer_under_heavy_tails_and_weighted_squares_are_1(kind: str) -> None:
    plain, weighed = [], []
    for seed in range(60):
        noise = drawn(kind, seed)
        weight = weights(noise, False)
        plain.append((noise.mean(0) / SIZES).square().mean())
        weighed.append(((weight * noise).sum(0) / weight.sum(0) / SIZES).square().mean())
        assert float((weight * (noise / SIZES).square()).mean()) == pytest.approx(1, abs=3e-3)
        ratio = weight / weight[:1]
        shared = bool(torch.allclose(ratio, ratio[:, :1]))
        assert shared == (kind == "rows")
    assert np.sum(weighed) < 0.65 * np.sum(plain)


def test_a_remainder_above_a_known_noise_stays_above_it() -> None:
    noise = 3 * drawn("values", 1, 2000)
    left = float((weights(noise, True) * (noise / SIZES).square()).mean())
    assert left == pytest.approx(9, rel=0.15)


def test_values_that_were_not_measured_say_nothing() -> None:
    noise = drawn("values", 2)
    seen = torch.rand(noise.shape, generator=torch.Generator().manual_seed(0)) > 0.3
    far = torch.where(seen, noise, 1e6)
    assert torch.equal(weights_of(far, seen, False), weights_of(torch.where(seen, noise, 0.0), seen, False))
