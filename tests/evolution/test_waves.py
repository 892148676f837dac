"""Periodic nodes: found where they are and only there, refined, and carried into the exported network."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from ccnn_torch.evolution.gauss_newton import linearise, network_of, residual
from ccnn_torch.evolution.refinement import Refined, refine
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.evolution.waves import Waves, find_waves, no_waves, wave_signal
from ccnn_torch.learners import TrainingData, structure
from ccnn_torch.learners.ccnn import CCNN

QUICK = CCNNSettings(
    hidden=(6,), rival_hidden=(), generations=1, population=10, members=2, kept=2, waves=4, refinement_iterations=40
)


def uniform_rows(repeats: int, rows: int, inputs: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(repeats, rows, inputs, generator=generator, dtype=torch.float64) - 1


def noise_like(values: Tensor, seed: int) -> Tensor:
    return torch.randn(values.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_two_waves_are_found_and_named() -> None:
    inputs = uniform_rows(2, 150, 3)
    residual = torch.stack([torch.sin(17 * inputs[..., 1] + 0.4), 0.7 * torch.cos(41.3 * inputs[..., 2])], -1)
    residual = residual + 0.2 * noise_like(residual, 1)
    free = no_waves((2,), 5, inputs)
    found = find_waves(free, residual, inputs, torch.ones(2, 150, dtype=torch.float64), torch.ones(3) > 0, passes=3)
    for k in range(2):
        used = found.frequency[k] != 0
        assert found.source[k][used].tolist() == [1, 2]
        # Within a quarter of the width of a spectral line, pi over the span.
        assert found.frequency[k][used].tolist() == pytest.approx([17.0, 41.3], abs=0.4)


def test_noise_has_none_and_padded_rows_do_not_matter() -> None:
    inputs = uniform_rows(40, 100, 3)
    rows = torch.ones(40, 100, dtype=torch.float64)
    rows[:, 90:] = 0
    noise = noise_like(inputs, 2)
    readable = torch.ones(3) > 0
    found = find_waves(no_waves((40,), 4, inputs), noise, inputs, rows, readable, passes=1)
    # Chance lets about one set in eight have one.
    assert float((found.frequency != 0).any(-1).double().mean()) < 0.3
    spoilt = noise.masked_fill(rows.unsqueeze(-1) == 0, torch.nan)
    again = find_waves(no_waves((40,), 4, inputs), spoilt, inputs, rows, readable, passes=1)
    assert torch.equal(found.frequency, again.frequency) and torch.equal(found.source, again.source)


def test_a_state_of_two_values_is_no_motion() -> None:
    inputs = uniform_rows(1, 200, 1).sign()
    found = find_waves(
        no_waves((1,), 2, inputs), inputs * 3.0, inputs, torch.ones(1, 200, dtype=torch.float64), torch.ones(1) > 0, 1
    )
    assert not bool(found.frequency.any())


def test_the_jacobian_has_frequencies_and_amplitudes() -> None:
    """Closed form against automatic differentiation, a free slot and an unread input included."""
    generator = torch.Generator().manual_seed(5)
    masks = [torch.rand(2, 4, 3, generator=generator) < 0.8, torch.rand(2, 2, 4 + 6, generator=generator) < 0.8]
    masks[1][:, :, [6, 9]] = False
    waves = Waves(torch.tensor([[0, 3, 0], [2, 1, 0]]), torch.tensor([[5.0, 9.0, 0.0], [7.0, 11.0, 0.0]]).double())
    network = network_of(masks, True, waves)
    weights = torch.randn(2, 4 * 4 + 2 * 11, generator=generator, dtype=torch.float64)
    flat = torch.cat([weights, waves.frequency], -1)
    inputs, targets = uniform_rows(2, 12, 4), uniform_rows(2, 12, 2, seed=1)
    expected = torch.autograd.functional.jacobian(lambda w: residual(network, w, inputs, targets, None), flat)
    expected = torch.stack([expected[k, :, :, k] for k in range(2)]) * network.active[:, None, None]
    local = linearise(network, flat, inputs, targets, None, torch.ones(2, 12, 2, dtype=torch.float64))
    found = expected.gather(-1, network.kept_flat[:, None, None].expand(-1, 12, 2, -1))
    assert torch.allclose(local.matrix, torch.einsum("bsck,bscl->bkl", found, found), rtol=1e-9, atol=1e-12)


def gear_data(repeats: int = 2, rows: int = 120) -> tuple[TrainingData, Tensor]:
    inputs = uniform_rows(repeats, rows, 2)
    clean = torch.stack([inputs[..., 0] ** 2 - 0.3, torch.sin(23.7 * inputs[..., 0])], -1)
    clean = torch.cat([clean[..., :1] + clean[..., 1:], inputs[..., 1:] + 0.0 * clean[..., 1:]], -1)
    targets = clean + 0.05 * noise_like(clean, 4)
    seeds = torch.arange(repeats)
    return TrainingData(inputs, targets, torch.ones(repeats, rows, dtype=torch.float64), seeds), clean


def test_ccnn_learns_a_gear_that_sigmoids_cannot() -> None:
    data, _ = gear_data()
    fresh, truth = gear_data(rows=400)
    errors = {}
    for waves in (0, 4):
        learner = CCNN(replace(QUICK, waves=waves))
        learner.start(data)
        while not learner.finished:
            learner.step()
        errors[waves] = float((learner.predict(fresh.inputs) - truth).square().mean())
    assert errors[0] > 0.1 and errors[4] < 0.005
    assert float(learner.network(0).frequencies[0, 0]) == pytest.approx(23.7, abs=0.1)
    # The exported network has the nodes too, and the variance of its output layer.
    module = learner.network(1)
    assert len(module.frequencies) > 0
    assert torch.allclose(module(fresh.inputs[1]), learner.predict(fresh.inputs)[1], rtol=0, atol=1e-12)
    assert torch.allclose(module.variance(fresh.inputs[1]), learner.variance(fresh.inputs)[1], rtol=1e-9)
    within = (learner.predict(fresh.inputs) - fresh.targets).abs() < 1.96 * learner.variance(fresh.inputs).sqrt()
    assert 0.85 < float(within.double().mean()) < 0.99


def test_a_member_whose_descent_fails_costs_the_others_no_wave(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a normal matrix has no Cholesky factor."""

    def failing(*arguments: Any) -> Refined:
        found = refine(*arguments)
        if arguments[-2] is None or not bool(arguments[-2].frequency.any()):
            return found
        found.log_evidence[1] = -torch.inf
        return replace(found, weights=[weight.index_fill(0, torch.tensor(1), torch.nan) for weight in found.weights])

    monkeypatch.setattr(structure, "refine", failing)
    data, _ = gear_data()
    fresh, truth = gear_data(rows=400)
    learner = CCNN(QUICK)
    learner.start(data)
    while not learner.finished:
        learner.step()
    assert float((learner.predict(fresh.inputs) - truth).square().mean()) < 0.005


def test_angles_are_read_by_waves_alone() -> None:
    """A turning joint comes as sine, cosine and angle; sigmoids read the first two, periodic nodes the last."""
    angle = 3 * uniform_rows(1, 200, 1)
    inputs = torch.cat([torch.sin(angle), torch.cos(angle), angle / 3], -1)
    targets = torch.sin(12 * angle) + 0.3 * torch.cos(angle) + 0.02 * noise_like(angle, 6)
    data = TrainingData(inputs, targets, torch.ones(1, 200, dtype=torch.float64), torch.tensor([0]), angles=1)
    learner = CCNN(replace(QUICK, waves=2))
    learner.start(data)
    while not learner.finished:
        learner.step()
    assert learner.network(0).frequencies.round().tolist()[0] == [0, 0, 36]
    assert learner._structures[0].refined.masks[0].shape[-1] == 2
    assert torch.allclose(learner.network(0)(inputs[0]), learner.predict(inputs)[0], rtol=0, atol=1e-12)
    assert float((learner.predict(inputs) - targets).square().mean()) < 0.01


def test_signal_of_a_free_slot_is_a_constant() -> None:
    inputs = uniform_rows(1, 5, 2)
    signal = wave_signal(no_waves((1,), 1, inputs), inputs)
    assert signal[..., 0].eq(0).all() and signal[..., 1].eq(1).all()
