"""Harmonics of turning joints: found where they are, switched off where they are not, carried into the model."""

from __future__ import annotations

from dataclasses import replace

import torch
from evolution.test_waves import QUICK, noise_like, uniform_rows

from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.evolution.waves import fit_harmonics, harmonic_count
from ccnn_torch.learners import TrainingData
from ccnn_torch.learners.ccnn import CCNN

ROWS = 400


def gears(angles: torch.Tensor) -> torch.Tensor:
    """Two joints, of which the first has a gear that errs: `... x s x 2` [rad] to the same [1]."""
    first, second = angles.unbind(-1)
    return torch.stack([torch.sin(31 * first) + 0.5 * torch.cos(2 * first), 0 * second], -1)


def rows(low: float = -1.0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features, their size [rad] and noisy outputs; two repeats, the first one's last row is padding."""
    inputs = uniform_rows(2, ROWS, 2)
    inputs[..., 0] = low + (1 - low) * (inputs[..., 0] + 1) / 2
    step = torch.tensor([[3.0, 2.0], [3.0, 2.0]], dtype=torch.float64)
    return inputs, step, gears(inputs * step.unsqueeze(-2)) + 0.1 * noise_like(inputs, 3)


def weights() -> torch.Tensor:
    """One for every row but the padding."""
    found = torch.ones(2, ROWS, dtype=torch.float64)
    found[0, -1] = 0
    return found


def test_finds_the_harmonics_that_are_there_and_no_others() -> None:
    inputs, step, targets = rows()
    targets[0, -1] = torch.nan
    found = fit_harmonics(inputs, step, targets, weights(), (0, 1), None, 40)
    sine, cosine = found.amplitude[:, 0, :40], found.amplitude[:, 0, 40:]
    assert torch.allclose(sine[:, 30], torch.ones(2, dtype=torch.float64), atol=0.05)
    assert torch.allclose(cosine[:, 1], torch.full((2,), 0.5, dtype=torch.float64), atol=0.05)
    others = found.amplitude[:, 0].clone()
    others[:, 30] = others[:, 41] = 0
    assert float(others.abs().max()) < 0.05
    assert float(found.amplitude[:, 1].abs().max()) < 0.02
    fresh = uniform_rows(2, ROWS, 5)[..., :2]
    truth = gears(fresh * step.unsqueeze(-2))
    error = found(fresh) - truth
    assert float(error.square().mean().sqrt()) < 0.05
    # What is claimed to be known of the amplitudes is what is known.
    assert 0.5 < float((error[..., 0].square() / found.variance(fresh)[..., 0]).mean()) < 2


def test_lines_seen_in_part_of_a_turn_hold_in_the_rest() -> None:
    """A third of the first joint's turn was measured; two lines explain it, and go on where nothing was measured."""
    inputs, step, targets = rows(low=0.3)
    found = fit_harmonics(inputs, step, targets, weights(), (0, 1), None, 40)
    far = torch.zeros(2, 50, 2, dtype=torch.float64)
    far[..., 0] = torch.linspace(-0.6, -0.3, 50, dtype=torch.float64)
    error = (found(far) - gears(far * step.unsqueeze(-2)))[..., 0]
    assert float(error.square().mean().sqrt()) < 0.1


def test_noise_alone_gives_next_to_nothing() -> None:
    inputs, step, _ = rows()
    found = fit_harmonics(inputs, step, noise_like(inputs, 3), weights(), (0, 1), None, 40)
    assert float(found(inputs).square().mean()) < 0.05


def test_errors_are_judged_in_the_channels_of_the_metric() -> None:
    """One channel sees the sum of both joints: what fits there is found without the joints being told apart."""
    inputs, step, targets = rows()
    metric = torch.ones(2, ROWS, 1, 2, dtype=torch.float64) + 0.5 * noise_like(inputs, 9).unsqueeze(-2)
    found = fit_harmonics(inputs, step, targets, weights(), (0, 1), metric, 40)
    assert torch.allclose(found.amplitude[:, 0, 30], torch.ones(2, dtype=torch.float64), atol=0.1)


def test_few_rows_get_few_harmonics() -> None:
    assert harmonic_count(96, 2000, 6) == 96 and harmonic_count(96, 400, 6) == 50
    assert harmonic_count(96, 299, 6) == 0 and harmonic_count(96, 299, 2) == 37


def test_the_network_learns_what_they_leave_and_takes_them_along() -> None:
    angles = uniform_rows(2, ROWS, 2)
    step = torch.tensor([[3.0, 2.0], [3.0, 2.0]], dtype=torch.float64)
    turned = angles * step.unsqueeze(-2)
    coupling = 0.7 * torch.sin(turned[..., :1]) * torch.tensor([0.0, 1.0], dtype=torch.float64)
    targets = gears(turned) + coupling + 0.05 * noise_like(angles, 4)
    inputs = torch.cat([torch.sin(turned), torch.cos(turned), angles], -1)
    data = TrainingData(
        inputs,
        targets,
        torch.ones(2, ROWS, dtype=torch.float64),
        torch.tensor([0, 1]),
        angles=2,
        angle_step=step,
        angle_outputs=(0, 1),
    )
    errors = {}
    for harmonics in (0, 40):
        learner = CCNN(replace(QUICK, waves=0, harmonics=harmonics))
        learner.start(data)
        while not learner.finished:
            learner.step()
        errors[harmonics] = float((learner.predict(inputs) - targets).square().mean())
    assert errors[0] > 0.2 and errors[40] < 0.01
    module = learner.network(1)
    assert torch.allclose(module(inputs[1]), learner.predict(inputs)[1], rtol=0, atol=1e-12)
    assert torch.allclose(module.variance(inputs[1]), learner.variance(inputs)[1], rtol=1e-9)
    again = type(module).from_description(module.describe())
    again.load_state_dict(module.state_dict())
    assert torch.equal(again(inputs[1]), module(inputs[1]))


def test_the_papers_settings_have_none() -> None:
    """Without refinement nothing but evolution shapes the network."""
    inputs, step, targets = rows()
    data = TrainingData(inputs, targets, weights(), torch.tensor([0, 1]), angles=2, angle_step=step)
    settings = CCNNSettings(hidden=(3,), population=10, generations=1, members=1, refinement_iterations=0)
    learner = CCNN(settings)
    learner.start(replace(data, angle_outputs=(0, 1), inputs=inputs.repeat(1, 1, 3)))
    learner.step()
    assert "harmonics" not in learner.network(0).describe()
