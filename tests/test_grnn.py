"""The general regression neural network against a plain twin of loops, in blocks, by the million, and far away."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import Tensor

from ccnn_torch.compensation.targets.lowering import recorded
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners import TrainingData, grnn_network as _kernel
from ccnn_torch.learners.grnn import GRNN, GRNNSettings


def rows_of(repeats: int = 2, rows: int = 100, noise: float = 0.3, padded: int = 7, seed: int = 1) -> TrainingData:
    """Two outputs of three inputs, of which the third says nothing; the last rows of repeat 1 are padding."""
    generator = torch.Generator().manual_seed(seed)
    inputs = 2 * torch.rand(repeats, rows, 3, generator=generator, dtype=torch.float64) - 1
    clean = torch.stack([torch.sin(3 * inputs[..., 0]), inputs[..., 1] ** 2], -1)
    targets = clean + noise * torch.randn(repeats, rows, 2, generator=generator, dtype=torch.float64)
    weights = torch.ones(repeats, rows, dtype=torch.float64)
    weights[1:, rows - padded :] = 0
    return TrainingData(inputs, targets - targets.mean(1, keepdim=True), weights, torch.arange(repeats))


def trained(data: TrainingData, settings: GRNNSettings | None = None) -> tuple[GRNN, list[dict[str, Tensor]]]:
    learner, history = GRNN(settings), []
    learner.start(data)
    while not learner.finished:
        history.append(learner.step())
    return learner, history


Array = npt.NDArray[np.float64]


def bandwidths_of(learner: GRNN) -> Tensor:
    """Of the model, `r x i` [1]; infinite for an input that is switched off."""
    return 1 / torch.stack([learner.network(k).inverse_bandwidths for k in range(len(learner.converged))])


def naive(query: Array, inputs: Array, targets: Array, bandwidths: Array, skip: int) -> Array:
    """Eq. 5 of Specht, one row at a time."""
    above, below = np.zeros(targets.shape[1]), 0.0
    for row in range(len(inputs)):
        if row != skip:
            kernel = math.exp(
                -sum((q - x) ** 2 / (2 * h**2) for q, x, h in zip(query, inputs[row], bandwidths, strict=True))
            )
            above, below = above + kernel * targets[row], below + kernel
    return above / below


def test_predictions_and_leave_one_out_equal_the_plain_twin() -> None:
    data = rows_of()
    learner, history = trained(data)
    bandwidths = bandwidths_of(learner).numpy()
    assert (bandwidths[:, 2] > 1.5).all() and np.isinf(bandwidths[0, 2]) and (bandwidths[:, :2] < 0.5).all(), bandwidths
    for repeat, count in ((0, 100), (1, 93)):
        x, y = data.inputs[repeat, :count].numpy(), data.targets[repeat, :count].numpy()
        found = learner.predict(data.inputs)[repeat, :count].numpy()
        expected = np.stack([naive(q, x, y, bandwidths[repeat], -1) for q in x])
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
        left = np.stack([naive(q, x, y, bandwidths[repeat], k) for k, q in enumerate(x)])
        error = ((left - y) ** 2).mean()
        np.testing.assert_allclose(float(history[-1]["error_leave_one_out"][repeat]), error, rtol=1e-10)
        # What was chosen is the lowest of its neighbours, and lower than what the mean leaves.
        assert error < 0.6 * ((y - (y.sum(0) - y) / (count - 1)) ** 2).mean()
        for factor in (1.3, 1 / 1.3):
            moved = np.stack([naive(q, x, y, factor * bandwidths[repeat], k) for k, q in enumerate(x)])
            assert ((moved - y) ** 2).mean() > error


def test_blocks_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    data = rows_of(repeats=3, rows=40)
    whole, _ = trained(data)
    variance = whole.variance(data.inputs)
    monkeypatch.setitem(_kernel._BLOCK, "cpu", 700)
    pieces, _ = trained(data)
    torch.testing.assert_close(bandwidths_of(pieces), bandwidths_of(whole), rtol=1e-9, atol=0)
    torch.testing.assert_close(pieces.predict(data.inputs), whole.predict(data.inputs), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(pieces.variance(data.inputs), variance, rtol=1e-9, atol=1e-12)


def test_where_nothing_can_be_learned_it_stays_at_the_mean() -> None:
    generator = torch.Generator().manual_seed(2)
    data = rows_of(repeats=8, padded=0)
    targets = torch.randn(8, 100, 2, generator=generator, dtype=torch.float64)
    targets = targets - targets.mean(1, keepdim=True)
    learner, _ = trained(replace(data, targets=targets))
    # Fresh targets have mean 0 beside the rows, so the square of the output is what it adds to their variance of 1.
    added = learner.predict(data.inputs.flip(0)).square().mean((1, 2))
    assert float(added.mean()) <= 0.02, added
    still = bandwidths_of(learner).isinf().all(-1)
    assert bool(still.any())
    torch.testing.assert_close(
        learner.variance(data.inputs)[still].mean(), torch.tensor(1.0, dtype=torch.float64), rtol=0.1, atol=0
    )


def test_many_rows_are_judged_by_some_and_cost_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    data = rows_of(repeats=1, rows=100_000)
    settings = GRNNSettings(iterations=6, queries=100, references=400)
    largest = 0
    plain = _kernel.kernel_means

    def watched(queries: Tensor, rows: Tensor, *others: Tensor) -> _kernel.KernelMeans:
        nonlocal largest
        largest = max(largest, queries.shape[-2] * rows.shape[-2] * (rows.shape[-1] + 3) * len(queries))
        return plain(queries, rows, *others)

    monkeypatch.setattr(_kernel, "kernel_means", watched)
    learner, _ = trained(data, settings)
    truth = rows_of(repeats=1, rows=40, noise=0.0, seed=5)
    error = learner.predict(truth.inputs) - truth.targets
    assert float((error - error.mean(1, keepdim=True)).square().mean()) < 0.01
    assert largest * 8 <= 16e6
    # Bandwidths for all rows are narrower than those found best for a few, by the rate at which they shrink.
    judged = 1 / learner.state_dict()["inverse_bandwidths"]
    on = judged.isfinite()
    torch.testing.assert_close(
        bandwidths_of(learner)[on], judged[on] * (400 / 100_000) ** (1 / (4 + int(on.sum()))), rtol=1e-12, atol=0
    )


def test_a_file_of_many_poses_is_predicted() -> None:
    data = rows_of(repeats=1, rows=150)
    learner, _ = trained(data, GRNNSettings(iterations=3))
    poses = rows_of(repeats=1, rows=100_000, seed=3).inputs
    found = learner.network(0)(poses[0])
    torch.testing.assert_close(found[:50], learner.predict(poses[:, :50])[0], rtol=1e-10, atol=1e-12)
    assert bool(found.isfinite().all()) and float(found.abs().max()) <= float(data.targets.abs().max())


def test_far_away_it_gives_finite_numbers_and_admits_that_it_knows_nothing() -> None:
    data = rows_of()
    learner, _ = trained(data)
    far = data.inputs[:, :3] * torch.tensor([1e2, 1e6, 1e300], dtype=torch.float64).unsqueeze(-1)
    output, variance = learner.predict(far), learner.variance(far)
    assert bool(output.isfinite().all()) and bool((output.abs() <= data.targets.abs().amax((0, 1))).all())
    whole = data.targets.var(1, keepdim=True)
    assert bool((variance > 0.8 * whole).all()) and bool((variance < 2 * whole).all())


def test_intervals_cover_what_is_measured_next() -> None:
    covered = []
    for noise in (0.1, 0.5):
        learner, _ = trained(rows_of(repeats=10, noise=noise, padded=0))
        fresh = rows_of(repeats=10, rows=200, noise=noise, padded=0, seed=9)
        shift = rows_of(repeats=10, noise=noise, padded=0).targets.mean(1, keepdim=True)
        error = learner.predict(fresh.inputs) - fresh.targets - shift
        covered.append((error.abs() < 1.96 * learner.variance(fresh.inputs).sqrt()).double().mean())
    assert all(0.92 <= float(share) <= 0.98 for share in covered), covered


def test_the_metric_says_which_errors_count() -> None:
    """Only the second output is felt: the input that explains the first is switched off."""
    data = rows_of(repeats=1, padded=0)
    metric = torch.tensor([[0.0, 1.0]], dtype=torch.float64).expand(1, 100, 1, 2)
    learner, _ = trained(replace(data, metric=metric))
    assert bandwidths_of(learner)[0, 0] > 2 * bandwidths_of(trained(data)[0])[0, 0]
    assert bandwidths_of(learner)[0, 1] < 1


def test_rows_that_are_not_finite_are_refused() -> None:
    data = rows_of()
    spoilt = data.targets.clone()
    spoilt[0, 3, 0] = torch.nan
    with pytest.raises(MethodFailedError, match="outputs are not all finite"):
        GRNN().start(replace(data, targets=spoilt))


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"candidates": 1}, "candidates"),
    ],
)
def test_settings_out_of_range_are_named(keys: dict[str, float], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        GRNNSettings(**keys)  # type: ignore[arg-type]


def test_a_file_is_written_from_one_block_however_many_rows_are_stored() -> None:
    rows = torch.randn(9000, 8, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    targets, weights = rows[:, :2], torch.zeros(9000, dtype=torch.float64)
    residuals = _kernel.KernelVariance(rows, weights, targets.square(), targets.var(0))
    network = _kernel.GRNNNetwork(rows, targets, weights, rows.new_ones(8), residuals)
    for of in (network.forward, network.variance):
        operations = [str(node.target) for node in recorded(of, [rows[:67]]).graph.nodes]
        assert operations and not any("split" in name or "cat" in name for name in operations)
