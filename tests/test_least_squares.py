"""Batched Levenberg-Marquardt against scipy, one problem at a time."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.optimize import least_squares
from scipy.stats import chi

from ccnn_torch.numerics.least_squares import jacobian_of, levenberg_marquardt
from ccnn_torch.numerics.outliers import chi_quantile


def _rosenbrock(x):
    return torch.stack([10 * (x[..., 1] - x[..., 0] ** 2), 1 - x[..., 0]], dim=-1)


def test_rosenbrock_from_many_starts():
    start = 4 * torch.rand(5, 7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 2
    found = levenberg_marquardt(_rosenbrock, start, max_iterations=200)
    assert found.converged.all() and found.message == "" and found.value.shape == (5, 7, 2)
    torch.testing.assert_close(found.value, torch.ones(5, 7, 2, dtype=torch.float64), rtol=0, atol=1e-9)


def test_curve_fits_agree_with_scipy():
    """y = a exp(-b t) + noise, 6 data sets at once, with and without handing the rows over as data."""
    generator = torch.Generator().manual_seed(1)
    t = torch.linspace(0, 3, 25, dtype=torch.float64)
    truth = 1 + torch.rand(6, 2, generator=generator, dtype=torch.float64)
    y = truth[:, :1] * torch.exp(-truth[:, 1:] * t)
    y = y + 0.05 * torch.randn(y.shape, generator=generator, dtype=torch.float64)

    def residual(x, rows=y):
        return x[..., :1] * torch.exp(-x[..., 1:] * t) - rows

    start = torch.ones(6, 2, dtype=torch.float64)
    whole = levenberg_marquardt(residual, start)
    rows = levenberg_marquardt(residual, start, data=(y,))
    torch.testing.assert_close(whole.value, rows.value, rtol=0, atol=1e-12)

    def both(x, rows):
        wave = torch.exp(-x[..., 1:] * t)
        return residual(x, rows), torch.stack([wave, -x[..., :1] * t * wave], dim=-1)

    at_once = levenberg_marquardt(residual, start, data=(y,), both=both)
    assert at_once.iterations == rows.iterations and at_once.converged.all()
    torch.testing.assert_close(at_once.value, rows.value, rtol=0, atol=1e-12)
    for i in range(6):
        theirs = least_squares(
            lambda x, i=i: residual(torch.from_numpy(x), y[i]).numpy(), [1.0, 1.0], xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        np.testing.assert_allclose(whole.value[i].numpy(), theirs.x, rtol=1e-7)
        np.testing.assert_allclose(float(whole.cost[i]), theirs.cost, rtol=1e-10)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 4), st.integers(1, 6), st.integers(0, 10_000))
def test_linear_problems_give_the_minimum_norm_step(c, k, seed):
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(3, c, k, generator=generator, dtype=torch.float64)
    b = torch.randn(3, c, generator=generator, dtype=torch.float64)
    if float(torch.linalg.cond(a).max()) > 1e3:
        return
    start = torch.zeros(3, k, dtype=torch.float64)
    found = levenberg_marquardt(lambda x: (a @ x[..., None])[..., 0] - b, start, lambda x: a, max_iterations=200)
    expected = (torch.linalg.pinv(a) @ b[..., None])[..., 0]
    torch.testing.assert_close(found.value, expected, rtol=1e-6, atol=1e-7)


def test_stays_in_the_domain():
    """A full Newton step would leave the domain of the logarithm; the residual there is NaN."""
    start = torch.tensor([[5.0], [0.01]], dtype=torch.float64)
    found = levenberg_marquardt(lambda x: torch.log(x) + 3, start)
    torch.testing.assert_close(found.value, torch.full((2, 1), -3.0, dtype=torch.float64).exp(), rtol=1e-10, atol=0)


def test_failure_is_a_value_with_a_sentence():
    start = torch.tensor([[1.0], [-1.0], [2.0]], dtype=torch.float64)
    found = levenberg_marquardt(torch.log, start)
    assert found.converged.tolist() == [True, False, True]
    why = "has a residual that is not finite at its start"
    assert found.message == f"1 of 3 problems failed; the first, number 2, {why}"
    assert found.value[1] == -1.0
    hurried = levenberg_marquardt(_rosenbrock, torch.tensor([-1.2, 1.0], dtype=torch.float64), max_iterations=2)
    assert not hurried.converged and "did not settle in 2 steps" in hurried.message


def test_a_point_without_slope_is_left_alone():
    found = levenberg_marquardt(lambda x: torch.ones_like(x) + 0 * x, torch.zeros(2, 1, dtype=torch.float64))
    assert found.converged.all() and (found.value == 0).all()


def test_no_problem_at_all():
    found = levenberg_marquardt(_rosenbrock, torch.zeros(0, 2, dtype=torch.float64))
    assert found.value.shape == (0, 2) and found.iterations == 0 and found.message == ""


def test_jacobian_of_broadcasts_captured_data():
    scale = torch.tensor([1.0, 2.0], dtype=torch.float64)
    point = torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    value, slope = jacobian_of(lambda x: scale[:, None] * torch.stack([x.prod(-1), x.sum(-1)], dim=-1), point)
    expected = torch.autograd.functional.jacobian(lambda x: 2.0 * torch.stack([x.prod(), x.sum()]), point[1, 1])
    torch.testing.assert_close(slope[1, 1], expected)
    assert value.shape == (4, 2, 2) and slope.shape == (4, 2, 2, 3)


@pytest.mark.parametrize("inputs", [1, 3])
def test_jacobian_of_combinations_is_that_of_all_outputs_combined(inputs):
    point = torch.randn(5, inputs, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def outputs(x):
        return torch.cat([x.sin(), x.prod(-1, keepdim=True), x.square()], dim=-1)

    def combined(value):
        return torch.stack([value, 1 + value.square(), value.cos()], dim=-2)

    value, whole = jacobian_of(outputs, point)
    torch.testing.assert_close(jacobian_of(outputs, point, combined)[1], combined(value) @ whole)


def test_a_function_that_ignores_its_point_has_the_jacobian_zero() -> None:
    point = torch.ones(4, 1, dtype=torch.float64)
    for outputs in (1, 5):  # by rows, and by columns
        value, slope = jacobian_of(lambda x, n=outputs: torch.full((len(x), n), 2.0, dtype=torch.float64), point)
        assert torch.equal(slope, torch.zeros(4, outputs, 1, dtype=torch.float64)) and bool((value == 2).all())


def test_a_jacobian_inside_the_function_is_a_constant_to_it() -> None:
    point = torch.linspace(0.1, 1, 5, dtype=torch.float64)[:, None]
    slope = jacobian_of(lambda x: jacobian_of(torch.sin, x)[0] + x.square(), point)[1]
    torch.testing.assert_close(slope[..., 0], 2 * point)


def test_quantiles_of_a_length_are_those_of_scipy() -> None:
    for channels in (1, 2, 3, 6):
        for probability in (0.01, 0.5, 0.99):
            assert chi_quantile(probability, channels) == pytest.approx(chi.ppf(probability, channels), rel=1e-12)
