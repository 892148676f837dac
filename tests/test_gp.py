"""The Gaussian process against a naive one, against scikit-learn's, and in the trainer's hands."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from torch import Tensor

from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners import TrainingData, gp
from ccnn_torch.learners.gaussian_process import GPNetwork, log_evidence
from ccnn_torch.learners.gp import GaussianProcess, GPSettings
from ccnn_torch.testing import check_learner
from ccnn_torch.training import train

FLOOR = 1e-6


def wavy(repeats: int = 2, rows: int = 40, noise: float = 0.1, seed: int = 0) -> TrainingData:
    """Two smooth functions of two inputs with noise; repeats differ in all of it."""
    generator = torch.Generator().manual_seed(seed)
    inputs = 2 * torch.rand(repeats, rows, 2, generator=generator, dtype=torch.float64) - 1
    clean = torch.stack([torch.sin(3 * inputs[..., 0]) + inputs[..., 1], torch.cos(2 * inputs.sum(-1))], -1)
    targets = clean + noise * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
    targets = (targets - targets.mean(1, keepdim=True)) / targets.std(1, keepdim=True)
    return TrainingData(inputs, targets, torch.ones(repeats, rows, dtype=torch.float64), torch.arange(5, 5 + repeats))


def trained(data: TrainingData, **keys: object) -> GaussianProcess:
    learner = GaussianProcess(GPSettings(**keys))  # type: ignore[arg-type]
    learner.start(data)
    while not learner.finished:
        learner.step()
    return learner


def naive_kernel(one: np.ndarray, other: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Pair by pair, as the textbook has it. theta: hyperparameters as the learner holds them."""
    found = np.empty((len(one), len(other)))
    for a, x in enumerate(one):
        for b, z in enumerate(other):
            d = math.sqrt(sum(((x[k] - z[k]) / math.exp(theta[k])) ** 2 for k in range(len(x))))
            found[a, b] = math.exp(theta[-3]) * (1 + math.sqrt(3) * d) * math.exp(-math.sqrt(3) * d)
    return found


def test_it_is_the_textbooks_process() -> None:
    data = wavy()
    learner = trained(data, steps=12)
    points = torch.rand(7, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 3 - 1.5
    mean, variance = learner.predict(points.expand(2, -1, -1)), learner.variance(points.expand(2, -1, -1))
    state, likelihood = learner.state_dict(), learner.step()["log_likelihood"]
    for repeat in range(2):
        total = 0.0
        for output in range(2):
            theta = state["best_theta"][repeat, output].numpy()
            x, y = data.inputs[repeat].numpy(), data.targets[repeat, :, output].numpy()
            noise = math.exp(theta[-2]) + FLOOR
            covariance = naive_kernel(x, x, theta) + noise * np.eye(len(x))
            across = naive_kernel(points.numpy(), x, theta)
            expected = theta[-1] + across @ np.linalg.solve(covariance, y - theta[-1])
            np.testing.assert_allclose(mean[repeat, :, output], expected, atol=1e-10)
            left = math.exp(theta[-3]) - np.sum(across * np.linalg.solve(covariance, across.T).T, -1) + noise
            np.testing.assert_allclose(variance[repeat, :, output], left, rtol=1e-9)
            total += stats.multivariate_normal(np.full(len(x), theta[-1]), covariance).logpdf(y)
            total += stats.norm(math.log(4) + math.log(2) / 2, 1.0).logpdf(theta[:-3]).sum()
            total += stats.norm(-1.0, 1.5).logpdf(theta[-3]) + stats.norm(-2.0, 2.0).logpdf(math.log(noise))
        # The step above may have found better ones still.
        assert float(likelihood[repeat]) >= total - 1e-8
        assert float(state["best"][repeat].sum()) == pytest.approx(total, abs=1e-8)


def test_it_agrees_with_scikit_learn() -> None:
    data = wavy(1, 60)
    learner = trained(data, steps=15)
    theta = learner.state_dict()["best_theta"][0, 1].numpy()
    scales, noise = np.exp(theta[:-3]), math.exp(theta[-2]) + FLOOR
    shape = Matern(scales, nu=1.5)
    peer = GaussianProcessRegressor(ConstantKernel(math.exp(theta[-3])) * shape + WhiteKernel(noise), optimizer=None)
    peer.set_params(alpha=1e-300)
    peer.fit(data.inputs[0].numpy(), data.targets[0, :, 1].numpy() - theta[-1])
    points = np.random.default_rng(0).uniform(-2, 2, (20, 2))
    mean, deviation = peer.predict(points, return_std=True)
    given = torch.from_numpy(points)
    np.testing.assert_allclose(learner.predict(given[None])[0, :, 1], mean + theta[-1], atol=1e-9)
    # scikit-learn counts the white noise of a new point in.
    np.testing.assert_allclose(learner.variance(given[None])[0, :, 1], deviation**2, rtol=1e-9)
    # Search: our maximum has no lower likelihood than where it began, by the peer's measure.
    start = np.log([1.0, *np.full(2, math.exp(0.7)), math.exp(-3.0) + FLOOR])
    assert peer.log_marginal_likelihood(peer.kernel_.theta) > peer.log_marginal_likelihood(start) + 5


def test_slopes_are_those_of_finite_differences() -> None:
    data = wavy(2, 15)
    theta = torch.tensor([[0.3, -0.5, 0.4, -1.5, 0.2], [1.0, 0.1, -0.7, -3.0, -0.4]], dtype=torch.float64)
    weights = torch.ones(2, 15, dtype=torch.float64)
    weights[0, 3], weights[1, 5:] = 0, 0.5

    def value(at: Tensor) -> Tensor:
        return log_evidence(at, data.inputs, data.targets[..., 0], weights).value

    slope = log_evidence(theta, data.inputs, data.targets[..., 0], weights).slope
    for k in range(5):
        by = torch.zeros(5, dtype=torch.float64)
        by[k] = 1e-5
        difference = (value(theta + by) - value(theta - by)) / 2e-5
        torch.testing.assert_close(slope[:, k], difference, rtol=1e-6, atol=1e-7)


def test_steps_are_those_of_bfgs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each output against BFGS as the textbook has it, trial by trial."""
    monkeypatch.setattr(gp, "_FIRST_STEP", 1.0)
    data, learner = wavy(1, 8, seed=1), GaussianProcess(GPSettings(tolerance=0.0))
    learner.start(data)
    start, shortened = learner.state_dict()["theta"][0].numpy(), 0
    taken = [(row, -math.inf, np.zeros(5), np.eye(5), 1.0) for row in start]
    trials = list(start)
    for number in range(15):
        for o, (at, value, slope, inverse, length) in enumerate(taken):
            given = torch.from_numpy(trials[o])[None], data.inputs, data.targets[..., o], data.weights
            found = log_evidence(*given)
            new, rise, step = float(found.value), found.slope[0].numpy(), trials[o] - at
            if new < value + 1e-4 * slope @ step:
                length *= 0.3
                shortened += 1
            else:
                change = slope - rise
                if number == 0:
                    inverse = np.eye(5) / abs(rise).max()
                elif step @ change > 1e-10 * change @ change:
                    curvature = step @ change
                    if np.array_equal(inverse, inverse[0, 0] * np.eye(5)):
                        inverse = np.eye(5) * curvature / (change @ change)
                    project = np.eye(5) - np.outer(step, change) / curvature
                    inverse = project @ inverse @ project.T + np.outer(step, step) / curvature
                at, value, slope, length = trials[o], new, rise, 1.0
            taken[o] = at, value, slope, inverse, length
            way = inverse @ slope
            trials[o] = at + length * way / max(1.0, abs(way).max())
        learner.step()
        np.testing.assert_allclose(learner.state_dict()["theta"][0], trials, rtol=0, atol=1e-7)
    assert shortened > 0


def test_a_row_of_weight_two_is_that_row_twice() -> None:
    once = wavy(1, 30)
    once.weights[:, :10] = 2
    twice = TrainingData(
        torch.cat([once.inputs, once.inputs[:, :10]], 1),
        torch.cat([once.targets, once.targets[:, :10]], 1),
        torch.ones(1, 40, dtype=torch.float64),
        once.seeds,
    )
    learners = [GaussianProcess(GPSettings()) for _ in range(2)]
    state = trained(once, steps=5).state_dict()
    for learner, data in zip(learners, (once, twice), strict=True):
        learner.start(data)
        learner.load_state_dict(learner.state_dict() | {k: state[k] for k in ("best_theta", "best")})
    points = wavy(1, 9, seed=4).inputs
    assert [learner.network(0).describe()["rows"] for learner in learners] == [30, 40]
    torch.testing.assert_close(learners[0].variance(points), learners[1].variance(points), rtol=1e-9, atol=0)


@pytest.mark.parametrize("keys", [{}, {"hyperparameter_rows": 29, "variance_rows": 28}])
def test_padded_rows_do_not_exist(keys: dict[str, int]) -> None:
    whole = wavy(2, 30)
    whole.weights[1, [3, 7, 20, 29]] = 0
    left = whole.weights[1] > 0
    alone = TrainingData(
        whole.inputs[1:, left], whole.targets[1:, left], torch.ones(1, 26, dtype=torch.float64), whole.seeds[1:]
    )
    points = wavy(2, 9, seed=4).inputs
    padded, single = (GaussianProcess(GPSettings(steps=8, **keys)) for _ in range(2))
    for learner, data in ((padded, whole), (single, alone)):
        learner.start(data)
        while not learner.finished:
            learner.step()
    # With the second settings the rows stand in another order, those that do not exist at its end.
    torch.testing.assert_close(padded.predict(points)[1:], single.predict(points[1:]), rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(padded.variance(points)[1:], single.variance(points[1:]), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("settings", [GPSettings(steps=25), GPSettings(steps=5, variance_rows=16)])
def test_it_is_a_learner(settings: GPSettings) -> None:
    check_learner(lambda: GaussianProcess(settings))


def test_it_learns_and_tells_what_it_does_not_know() -> None:
    whole = wavy(3, 480)
    data, fresh = (
        TrainingData(whole.inputs[:, rows], whole.targets[:, rows], whole.weights[:, rows], whole.seeds)
        for rows in (slice(0, 80), slice(80, None))
    )
    learner = trained(data)
    error = learner.predict(fresh.inputs) - fresh.targets
    # The noise is about 0.016 of the outputs' variance.
    assert float(error.square().mean()) < 0.03
    covered = (error.abs() <= 1.96 * learner.variance(fresh.inputs).sqrt()).double().mean()
    assert 0.92 < float(covered) < 0.98
    assert bool(learner.converged.all())
    far = learner.variance(torch.full((3, 1, 2), 30.0, dtype=torch.float64))
    assert bool((far > 5 * learner.variance(data.inputs).amax(1, keepdim=True)).all())
    assert not bool(trained(data, steps=3).converged.any())


def test_noise_alone_is_left_alone() -> None:
    """Sixty rows without anything to learn, and three inputs: no worse than the mean by more than 2 %."""
    generator = torch.Generator().manual_seed(2)
    inputs = [2 * torch.rand(10, 60, 3, generator=generator, dtype=torch.float64) - 1 for _ in range(2)]
    targets = torch.randn(10, 60, 2, generator=generator, dtype=torch.float64)
    targets = (targets - targets.mean(1, keepdim=True)) / targets.std(1, keepdim=True)
    data = TrainingData(inputs[0], targets, torch.ones(10, 60, dtype=torch.float64), torch.arange(10))
    # The mean is 0, and fresh noise has the variance 1: what a prediction is beyond 0 adds to that.
    assert float(trained(data).predict(inputs[1]).square().mean()) < 0.02


def test_final_predictions_condition_on_more_rows_than_the_search() -> None:
    data, fresh = wavy(2, 150), wavy(2, 300, seed=1)
    few = GaussianProcess(GPSettings(steps=20, hyperparameter_rows=25, variance_rows=20, tolerance=0))
    few.start(data)
    while not few.finished:
        metrics = few.step()
        if not few.finished:
            during = (few.predict(fresh.inputs) - fresh.targets).square().mean((1, 2))
    after = (few.predict(fresh.inputs) - fresh.targets).square().mean((1, 2))
    assert bool((after < during).all())
    described = few.network(0).describe()
    assert (described["rows"], described["variance_rows"]) == (150, 20)
    assert metrics["evaluations"].tolist() == [20, 20]
    # A variance that knows of fewer rows is no smaller.
    state = few.state_dict()
    more = GaussianProcess(GPSettings(steps=20, hyperparameter_rows=25, variance_rows=150, tolerance=0))
    more.start(data)
    more.load_state_dict(state)
    assert bool((few.variance(fresh.inputs) >= more.variance(fresh.inputs) - 1e-12).all())
    torch.testing.assert_close(few.predict(fresh.inputs), more.predict(fresh.inputs), rtol=0, atol=0)


def test_a_training_that_was_stopped_goes_on_to_the_same_numbers(tmp_path: Path) -> None:
    settings = GPSettings(steps=14, hyperparameter_rows=30, variance_rows=20, tolerance=0)
    data = replace(wavy(2, 70), validation=wavy(2, 20, seed=9))

    def stopping(step: int) -> type[GaussianProcess]:
        class Stopped(GaussianProcess):
            def step(self) -> dict[str, Tensor]:
                if int(self.state_dict()["step"]) == step:
                    raise KeyboardInterrupt
                return super().step()

        return Stopped

    whole = GaussianProcess(settings)
    expected = train(whole, data)
    with pytest.raises(KeyboardInterrupt):
        train(stopping(8)(settings), data, checkpoint=tmp_path / "state", every=3)
    resumed = GaussianProcess(settings)
    found = train(resumed, data, checkpoint=tmp_path / "state", every=3)
    assert torch.equal(found.best_validation, expected.best_validation)
    assert torch.equal(found.history["error_validation"], expected.history["error_validation"])
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    assert torch.equal(whole.predict(data.inputs), resumed.predict(data.inputs))


def test_a_repeat_without_a_cholesky_factor_is_a_constant_and_the_others_are_not_touched() -> None:
    data = wavy(3, 30)
    learner, alone = (GaussianProcess(GPSettings(steps=12, tolerance=0)) for _ in range(2))
    for one in (learner, alone):
        one.start(data)
    spoilt = learner.state_dict()
    # Rows that are all alike, of a variance that drowns the noise: the matrix is singular in double precision.
    spoilt["theta"][1, :, :3] = 40.0
    learner.load_state_dict(spoilt)
    for one in (learner, alone):
        while not one.finished:
            metrics = one.step()
            assert all(bool(value.isfinite().all()) for value in metrics.values())
    points = wavy(3, 50, seed=1).inputs
    predicted, variance = learner.predict(points), learner.variance(points)
    torch.testing.assert_close(predicted[1], data.targets[1].mean(0).expand(50, 2), rtol=0, atol=1e-12)
    torch.testing.assert_close(variance[1], data.targets[1].var(0, correction=0).expand(50, 2), rtol=0, atol=1e-5)
    assert torch.equal(predicted[::2], alone.predict(points)[::2])
    assert torch.equal(variance[::2], alone.variance(points)[::2])
    assert learner.converged.tolist() == [False, False, False]
    torch.testing.assert_close(learner.network(1)(points[1]), predicted[1])


def test_rows_that_are_no_numbers_are_refused() -> None:
    data = wavy(2, 30)
    data.inputs[1, 4, 0] = torch.nan
    with pytest.raises(MethodFailedError, match="not all finite"):
        GaussianProcess().start(data)


def test_a_repeat_does_not_depend_on_those_beside_it() -> None:
    data = wavy(3, 60)
    alone = TrainingData(*(part[2:] for part in (data.inputs, data.targets, data.weights, data.seeds)))
    keys = {"steps": 30, "hyperparameter_rows": 40, "variance_rows": 30}
    points = wavy(3, 9, seed=1).inputs
    together, single = trained(data, **keys), trained(alone, **keys)
    torch.testing.assert_close(together.predict(points)[2:], single.predict(points[2:]), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(together.variance(points)[2:], single.variance(points[2:]), rtol=1e-9, atol=1e-9)


def test_the_network_has_the_learners_numbers() -> None:
    data = wavy(2, 50)
    learner = trained(data, steps=20, hyperparameter_rows=30, variance_rows=25)
    points = 4 * wavy(2, 40, seed=1).inputs
    for repeat in range(2):
        network = learner.network(repeat)
        torch.testing.assert_close(network(points[repeat]), learner.predict(points)[repeat], rtol=0, atol=1e-10)
        variance = learner.variance(points)[repeat]
        torch.testing.assert_close(network.variance(points[repeat]), variance, rtol=1e-10, atol=0)
        torch.testing.assert_close(network.variance(points[repeat, 3]), variance[3], rtol=1e-10, atol=0)
        again = GPNetwork.from_description(network.describe())
        again.load_state_dict(network.state_dict())
        assert torch.equal(again(points), network(points))


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": 0},
        {"max_rows": 1},
        {"variance_rows": 513},
        {"tolerance": -1.0},
    ],
)
def test_settings_out_of_range(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        GPSettings(**wrong)  # type: ignore[arg-type]


def test_a_model_is_conditioned_on_more_rows_without_another_search() -> None:
    generator = torch.Generator().manual_seed(0)
    inputs = 2 * torch.rand(1, 60, 3, generator=generator, dtype=torch.float64) - 1
    targets = torch.sin(3 * inputs[..., :2]) + 0.02 * torch.randn(1, 60, 2, generator=generator, dtype=torch.float64)
    few, all_rows = (GaussianProcess(GPSettings(steps=40)) for _ in range(2))
    for learner, count in ((few, 30), (all_rows, 60)):
        ones, seeds = torch.ones(1, count, dtype=torch.float64), torch.zeros(1, dtype=torch.int64)
        learner.start(TrainingData(inputs[:, :count], targets[:, :count], ones, seeds))
    while not few.finished:
        few.step()
    all_rows.condition(few.state_dict())
    at = 2 * torch.rand(1, 400, 3, generator=generator, dtype=torch.float64) - 1
    errors = [(m.predict(at) - torch.sin(3 * at[..., :2])).square().mean().sqrt() for m in (few, all_rows)]
    assert float(errors[1]) < 0.8 * float(errors[0])
    torch.testing.assert_close(all_rows.network(0)(at[0]), all_rows.predict(at)[0], rtol=0, atol=1e-12)
