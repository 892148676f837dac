"""Predictive intervals cover what they claim: on rows that were neither trained on nor calibrated by."""

from __future__ import annotations

import math

import pytest
import torch
from test_run import short
from torch import Tensor
from toy import Descent

from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.dataset import Dataset
from ccnn_torch.calibration.early_stop import Plan
from ccnn_torch.calibration.fitting import Fitted, fit_method
from ccnn_torch.calibration.statistics import coverage, inside_domain, sd_scale
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.records.splits import Split


def draw(kind: str, *shape: int, seed: int = 0) -> Tensor:
    """Residuals of one shape of tails, of any size."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(shape, generator=generator, dtype=torch.float64)
    uniform = torch.rand(shape, generator=generator, dtype=torch.float64)
    if kind == "normal":
        return 3e-5 * normal
    if kind == "joints of different size":
        return normal * torch.logspace(-5, -3, shape[-1], dtype=torch.float64)
    if kind == "laplace":
        return (uniform - 0.5).sign() * -torch.log1p(-2 * (uniform - 0.5).abs())
    if kind == "student":
        return normal / torch.randn((3, *shape), generator=generator, dtype=torch.float64).square().mean(0).sqrt()
    if kind == "outliers":
        return normal * torch.where(uniform < 0.05, 5.0, 1.0)
    return normal * torch.exp(0.5 * (2 * uniform - 1))


@pytest.mark.parametrize(
    "kind", ["normal", "joints of different size", "laplace", "student", "outliers", "varying spread"]
)
@pytest.mark.parametrize("rows", [12, 20, 60, 400])
def test_intervals_cover_new_rows_from_few_held_out_ones(kind: str, rows: int) -> None:
    held, new = draw(kind, 500, rows, 3), draw(kind, 500, 300, 3, seed=1)
    claimed = torch.full_like(held, 0.7e-5)
    scale = sd_scale(held, claimed, torch.ones(500, rows, dtype=torch.float64))
    covered = coverage(new, claimed[:, :1] * scale.unsqueeze(1).expand(-1, 300, -1), torch.ones(500, 300))
    assert 0.93 <= float(covered.mean()) <= 0.97
    assert float(covered.std()) < 0.04


def test_a_right_sd_is_left_alone_where_rows_are_many() -> None:
    sd = torch.logspace(-6, -4, 2000, dtype=torch.float64).view(1, -1, 1).expand(1, -1, 3)
    scale = sd_scale(draw("normal", 1, 2000, 3) / 3e-5 * sd, sd, torch.ones(1, 2000))
    assert torch.allclose(scale, torch.ones_like(scale), atol=0.06)


def test_padding_counts_for_nothing_and_perfect_rows_ask_for_no_correction() -> None:
    residuals, sd = draw("laplace", 2, 30, 3), torch.ones(2, 30, 3, dtype=torch.float64)
    weights = torch.ones(2, 30, dtype=torch.float64)
    weights[1, 17:] = 0
    spoiled = residuals.clone()
    spoiled[1, 17:] = torch.nan
    found = sd_scale(spoiled, sd, weights)
    assert torch.allclose(found[1:], sd_scale(residuals[1:, :17], sd[1:, :17], weights[1:, :17]))
    assert torch.allclose(found[:1], sd_scale(residuals[:1], sd[:1], weights[:1]))
    one = torch.ones(2, 3, dtype=torch.float64)
    assert torch.equal(sd_scale(residuals * 0, sd, weights), one)
    assert torch.equal(sd_scale(residuals[:, :0], sd[:, :0], weights[:, :0]), one)
    assert bool((sd_scale(residuals[:, :1], sd[:, :1], weights[:, :1]) > 0).all())


class Overconfident(Descent):
    """Knows how its noise varies, but thinks a tenth of it."""

    name = "overconfident"

    def variance(self, inputs: Tensor) -> Tensor:
        return (0.01 * self._noise(inputs)).expand(*inputs.shape[:-1], self._map.shape[-1])

    @staticmethod
    def _noise(inputs: Tensor) -> Tensor:
        return (0.2 + inputs[..., :1].abs()).square()


def linear_dataset(repeats: int = 30, train: int = 80, held: int = 20, test: int = 200) -> Dataset:
    """A linear map of three inputs with noise that grows away from the middle; the same inputs in every repeat."""
    generator = torch.Generator().manual_seed(3)
    rows = train + held + test
    inputs = 2 * torch.rand(rows, 3, generator=generator, dtype=torch.float64) - 1
    slope = torch.randn(3, 2, generator=generator, dtype=torch.float64)
    noise = torch.randn(repeats, rows, 2, generator=generator, dtype=torch.float64)
    order = torch.arange(rows)
    split = Split(order[:train], order[train : train + held], order[train + held :])
    return Dataset(
        inputs.expand(repeats, -1, -1),
        1e-4 * (inputs @ slope + noise * 0.3 * (0.2 + inputs[:, :1].abs())),
        torch.ones(repeats, rows, dtype=torch.bool),
        [split] * repeats,
        list(range(repeats)),
        torch.zeros(3, dtype=torch.bool),
    )


def covered(dataset: Dataset, fitted: Fitted) -> Tensor:
    rows = dataset.usable_rows("test")
    inputs = rows.take(dataset.inputs)
    return coverage(rows.take(dataset.deviation) - fitted.predict(inputs), fitted.sd(inputs), rows.weights)


@pytest.mark.parametrize("learner", [Descent, Overconfident])
@pytest.mark.parametrize("folds", [1, 5])
def test_a_fitted_method_covers_its_test_rows(learner: type[Descent], folds: int) -> None:
    dataset = linear_dataset()
    fitted = fit_method("toy", learner, dataset, Plan(True, None, 20, folds=folds), None, lambda *_: [])
    share = covered(dataset, fitted)
    assert 0.93 <= float(share.mean()) <= 0.97
    assert fitted.sd_scale.shape == (30, 2)


def test_nothing_held_out_leaves_the_sd_as_the_learner_says() -> None:
    dataset = linear_dataset(repeats=4)
    fitted = fit_method("toy", Overconfident, dataset, Plan(False, None, 20), None, lambda *_: [])
    assert torch.equal(fitted.sd_scale, torch.ones(4, 2, dtype=torch.float64))
    inputs = dataset.inputs
    features = fitted.scaling.features(inputs)
    own = fitted.learner.variance(features).sqrt() * fitted.scaling.deviation.unsqueeze(1)  # type: ignore[attr-defined]
    assert torch.allclose(fitted.sd(inputs), own, rtol=1e-12)
    assert float(covered(dataset, fitted).mean()) < 0.6


def test_a_run_tells_coverage_sd_and_that_nothing_was_held_out() -> None:
    calibration = calibrate(short(repeats=2, methods=["constant"]))
    block = calibration.results["methods"]["constant"]
    assert any("No rows were held out" in note for note in calibration.results["notes"])
    # Noise of 1e-5 m is most of what the constant leaves of q1 and q2.
    assert 0.9e-5 < block["sd"]["q1"]["median"] < 1.5e-5
    assert len(block["coverage"]["values"]) == 2 and 0.8 < block["coverage"]["median"] <= 1
    assert block["converged"] is None
    held = calibrate(short(repeats=2, methods=["constant"], training={"early_stop": False, "folds": 5}))
    assert held.results["rows"] == calibration.results["rows"]
    assert not any("No rows were held out" in note for note in held.results["notes"])
    assert torch.equal(held.outcomes["constant"].deviation, calibration.outcomes["constant"].deviation)
    assert not torch.equal(held.outcomes["constant"].fitted.sd_scale, torch.ones(2, 3, dtype=torch.float64))


def test_the_domain_is_that_of_the_compensator() -> None:
    calibration = calibrate(short(repeats=2, methods=["constant"], seed=4))
    dataset = calibration.prepared.dataset
    inside = inside_domain(dataset, calibration.config.compensation.margin)
    domain = calibration.compensator().domain
    expected = domain.excess(domain.cage(dataset.inputs[calibration.repeat()])).squeeze(-1) == 0
    assert torch.equal(inside[calibration.repeat()], expected)
    assert not bool(inside_domain(dataset, 0.0).all()) or math.isclose(float(expected.double().mean()), 1.0)


class Broken(Overconfident):
    """Its variance is not a variance."""

    def variance(self, inputs: Tensor) -> Tensor:
        return super().variance(inputs) - 1.0


def test_a_variance_that_is_none_fails_the_method() -> None:
    with pytest.raises(MethodFailedError, match="variance that is not finite, or not above 0"):
        fit_method("toy", Broken, linear_dataset(repeats=2), Plan(True, None, 20), None, lambda *_: [])
