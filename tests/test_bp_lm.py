"""BP-LM: its Jacobian against automatic differentiation, a known network found again, and the paper's first case."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.prepare import prepare
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.evolution.network import forward
from ccnn_torch.learners import TrainingData
from ccnn_torch.learners.bp_lm import BPLM, BPLMSettings
from ccnn_torch.training import train


def known_network(repeats: int, rows: int, noise: float, seed: int) -> TrainingData:
    """Rows of a sigmoid network of three hidden nodes with two outputs, weights drawn once."""
    generator = torch.Generator().manual_seed(7)
    shapes = ((3, 4), (2, 4))
    weights = [3 * torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]
    masks = [torch.ones(out, into - 1, dtype=torch.bool) for out, into in shapes]
    generator = torch.Generator().manual_seed(seed)
    inputs = 2 * torch.rand(repeats, rows, 3, generator=generator, dtype=torch.float64) - 1
    clean = forward(masks, weights, inputs)
    clean = (clean - clean.mean((0, 1))) / clean.std((0, 1))
    targets = clean + noise * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    return TrainingData(inputs, targets, torch.ones(repeats, rows, dtype=torch.float64), torch.arange(repeats))


def trained(data: TrainingData, settings: BPLMSettings) -> tuple[BPLM, list[dict[str, Tensor]]]:
    learner, history = BPLM(settings), []
    learner.start(data)
    while not learner.finished:
        history.append(learner.step())
    return learner, history


def test_a_small_known_network_is_recovered() -> None:
    data = known_network(2, 120, 0.02, seed=1)
    learner, history = trained(data, BPLMSettings(hidden=(6,), restarts=6, iterations=80))
    fresh = known_network(2, 200, 0.0, seed=2)
    shift = known_network(2, 120, 0.0, seed=1).targets
    errors = [learner.predict(part.inputs) - part.targets for part in (fresh, replace(data, targets=shift))]
    # The noise is 0.02; the two sets of rows are standardised apart by a few per cent.
    scale = [float((error - error.mean(1, keepdim=True)).std()) for error in errors]
    assert scale[1] < 0.01 and scale[0] < 0.1, scale
    # It knows how good it is.
    deviation = learner.variance(data.inputs).sqrt().mean((1, 2))
    assert bool(((deviation > 0.016) & (deviation < 0.026)).all()), deviation
    evidence = torch.stack([metrics["evidence_best"] for metrics in history])
    assert bool((evidence[-1] > evidence[4] + 1).all())


def test_many_restarts_find_what_one_misses() -> None:
    data = known_network(6, 60, 0.02, seed=3)
    errors = []
    for restarts in (1, 8):
        _, history = trained(data, BPLMSettings(hidden=(5,), restarts=restarts, iterations=30))
        errors.append(torch.stack([metrics["evidence_best"] for metrics in history]).amax(0))
    assert bool((errors[1] >= errors[0] - 0.01).all()) and float((errors[1] - errors[0]).mean()) > 0.02, errors


def test_it_stops_at_rest_and_says_where_it_did_not() -> None:
    noise = known_network(3, 80, 0.0, seed=4)
    generator = torch.Generator().manual_seed(5)
    targets = torch.randn(noise.targets.shape, generator=generator, dtype=torch.float64)
    settings = BPLMSettings(hidden=(4,), restarts=2, iterations=200)
    learner, history = trained(replace(noise, targets=targets - targets.mean(1, keepdim=True)), settings)
    assert len(history) < 60 and bool(learner.converged.all())
    # Nothing can be learned, and nothing is.
    assert float(learner.predict(noise.inputs).square().mean()) < 0.02
    short, _ = trained(noise, replace(settings, iterations=4))
    assert not bool(short.converged.any())


def test_a_repeat_that_fails_is_the_mean_and_does_not_spoil_the_others() -> None:
    data = known_network(3, 60, 0.1, seed=6)
    settings = BPLMSettings(hidden=(3,), restarts=2, iterations=40)
    whole, _ = trained(data, settings)
    # Finite rows, but their squares are not.
    broken, _ = trained(
        replace(data, targets=data.targets * torch.tensor([1, 1e200, 1], dtype=torch.float64).view(3, 1, 1)), settings
    )
    torch.testing.assert_close(broken.predict(data.inputs)[[0, 2]], whole.predict(data.inputs)[[0, 2]])
    assert bool((broken.predict(data.inputs)[1] == 0).all())
    assert broken.converged.tolist() == [bool(whole.converged[0]), False, bool(whole.converged[2])]


def test_on_case_one_it_is_far_below_the_constant_and_the_papers_own_figure() -> None:
    config = RunConfig.from_file("experiments/tripod.yaml", ["seed=1000", "repeats=4"])
    dataset = prepare(config).dataset
    learner = BPLM(BPLMSettings(restarts=3, iterations=25))
    data, scaling = dataset.scaled("fit", False, learner)
    rows = dataset.usable_rows("test")
    joints, deviation = rows.take(dataset.inputs.expand(4, -1, -1)), rows.take(dataset.deviation)
    train(learner, data)
    found = scaling.restore(learner.predict(scaling.features(joints)))
    errors = [(guess - deviation).square().mean((1, 2)) for guess in (found, scaling.mean.unsqueeze(1))]
    assert float((errors[0] / errors[1]).median()) < 0.8
    assert float(errors[0].median()) < 14.168e-10 / 8


def test_rows_that_are_not_finite_are_refused() -> None:
    data = known_network(1, 20, 0.1, seed=8)
    with pytest.raises(MethodFailedError, match="inputs are not all finite"):
        BPLM().start(replace(data, inputs=data.inputs * torch.inf))


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [({"hidden": []}, "hidden"), ({"restarts": 0}, "restarts"), ({"tolerance": 0.0}, "tolerance")],
)
def test_settings_out_of_range_are_named(keys: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        BPLMSettings(**keys)  # type: ignore[arg-type]
