"""Batched Levenberg-Marquardt against SciPy on the same residual, and where it has to be robust."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from linkages import NOISE, measured
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification import (
    Channel,
    ParameterChoice,
    Problem,
    inverse_problem,
    reweighted,
    solve_lm,
    what_is_known,
)


def scipy_values(problem: Problem, machine: int, **keys: object) -> NDArray[np.float64]:
    """Minimum by SciPy with its own finite differences, in plausible errors from the start."""
    data = tuple(d[machine if len(d) > 1 else 0] for d in problem.data)
    start, rows = problem.start[machine], problem.weights.shape[1]
    pull = problem.scale / problem.prior_sd

    def residual(u: NDArray[np.float64]) -> NDArray[np.float64]:
        shift = torch.from_numpy(u)
        value = problem.residual((start + problem.scale * shift).expand(rows, -1), *data)
        value = value * problem.weights[machine, :, None].sqrt()
        return torch.cat([value.flatten(), pull * shift]).numpy()

    found = least_squares(residual, np.zeros(len(start)), jac="3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14, **keys)
    return (start + problem.scale * torch.from_numpy(found.x)).numpy()


@pytest.mark.parametrize("prior", [{}, {"L*": 2e-3, "gamma?": 1e-3}])
def test_it_finds_what_scipy_finds(prior: dict[str, float]) -> None:
    rows = measured(3, 24, 1)
    weights = torch.rand(3, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    problem = inverse_problem(
        rows.mechanism, rows.joints, rows.pose, weights, ParameterChoice(prior=prior), pose_noise=NOISE
    )
    fit = solve_lm(problem)
    sd = what_is_known(problem, fit.values).sd
    assert bool(fit.converged.all()) and fit.message == ""
    for machine in range(3):
        off = (fit.values[machine] - torch.from_numpy(scipy_values(problem, machine))) / sd[machine]
        assert float(off.abs().max()) < 1e-3
    residual = problem.residual(fit.values[:, None].expand(3, 24, -1), *problem.data)
    cost = (residual.square().sum(-1) * weights).sum(-1) / 2
    cost = cost + ((fit.values - problem.start) / problem.prior_sd).square().sum(-1) / 2
    torch.testing.assert_close(fit.cost, cost, rtol=1e-9, atol=0)


def test_every_machine_is_as_if_alone() -> None:
    rows = measured(5, 24, 2)
    together = solve_lm(inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE), starts=3)
    for machine in range(5):
        alone = inverse_problem(rows.mechanism, rows.joints[machine], rows.pose[machine], pose_noise=NOISE)
        torch.testing.assert_close(solve_lm(alone).values[0], together.values[machine], rtol=0, atol=1e-6)


def waves(count: int) -> Problem:
    """A sine of unknown frequency, with a poor start: many minima."""
    t = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None]
    truth = torch.linspace(20, 24, count, dtype=torch.float64)
    y = torch.sin(truth[:, None, None] * t)

    def residual(values: torch.Tensor, t: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (torch.sin(values * t) - y) / 1e-3

    return Problem(
        parameters=(Parameter("frequency", "1", 10.0),),
        start=torch.full((count, 1), 10.0, dtype=torch.float64),
        scale=torch.tensor([5.0], dtype=torch.float64),
        prior_sd=torch.tensor([torch.inf], dtype=torch.float64),
        residual=residual,
        data=(t[None], y),
        weights=torch.ones(count, 40, dtype=torch.float64),
        channels=(Channel("y"),),
    )


def test_several_starts_find_the_deepest_minimum() -> None:
    problem = waves(4)
    truth = torch.linspace(20, 24, 4, dtype=torch.float64)
    assert float((solve_lm(problem).values[:, 0] - truth).abs().min()) > 1
    shares: list[float] = []
    fit = solve_lm(problem, seed=1, progress=shares.append, starts=40)
    torch.testing.assert_close(fit.values[:, 0], truth, rtol=0, atol=1e-6)
    assert shares[-1] == 1.0
    assert torch.equal(fit.values, solve_lm(problem, seed=1, starts=40).values)


def test_starts_stay_within_reach() -> None:
    """Where a start is out of reach it is drawn in, and a step that leads out is not taken."""
    rows = measured(2, 24, 3)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    wide = dataclasses.replace(problem, scale=problem.scale * 60)
    fit = solve_lm(wide, starts=16)
    assert bool(torch.isfinite(fit.values).all()) and bool(fit.converged.all())
    assert bool((fit.cost <= solve_lm(problem).cost * (1 + 1e-9)).all())


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_outliers_do_little_under_a_robust_loss(loss: str) -> None:
    rows = measured(8, 60, 4)
    clean = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    sd = what_is_known(clean, rows.truth).sd
    spoilt = rows.pose.clone()
    spoilt[:, ::10] += 5e-3
    problem = inverse_problem(rows.mechanism, rows.joints, spoilt, pose_noise=NOISE)
    plain, robust = solve_lm(problem), solve_lm(problem, loss=loss)
    assert bool(robust.converged.all())
    off = ((robust.values - rows.truth) / sd).square().mean().sqrt()
    assert float(off) < 2.5 < 10 < float(((plain.values - rows.truth) / sd).square().mean().sqrt())
    weights = reweighted(problem, robust.values, loss).weights
    assert float(weights[:, ::10].max()) < 0.2 < 0.7 < float(weights.median())


def test_without_outliers_a_robust_loss_costs_little() -> None:
    rows = measured(200, 36, 5)
    problem = inverse_problem(rows.mechanism, rows.joints, rows.pose, pose_noise=NOISE)
    plain, robust = solve_lm(problem), solve_lm(problem, loss="huber")
    spread = [(fit.values - rows.truth).square().mean(0) for fit in (plain, robust)]
    # 95 % efficiency is a ratio of 1.05; of 200 machines its own standard error is about 0.03.
    assert 0.97 < float((spread[1] / spread[0]).mean()) < 1.15
    assert not torch.equal(plain.values, robust.values)


def test_the_first_machine_that_fails_is_named() -> None:
    problem = waves(3)
    short = solve_lm(problem, max_iterations=1)
    assert not bool(short.converged.any())
    assert short.message == "3 of 3 machines failed; the first, number 1, did not settle in 1 steps"
    start = problem.start.clone()
    start[1] = torch.nan
    lost = solve_lm(dataclasses.replace(problem, start=start))
    assert "the first, number 2, has a residual that is not finite at its start" in lost.message
    assert bool(lost.converged[0]) and not bool(lost.converged[1])


def test_what_it_cannot_do_is_refused() -> None:
    for keys in ({"loss": "hubert"}, {"starts": 0}):
        with pytest.raises(InputError, match=r"loss is one of squared, huber, cauchy and starts at least 1"):
            solve_lm(waves(1), **keys)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="loss is one of"):
        reweighted(waves(1), waves(1).start, "none")
