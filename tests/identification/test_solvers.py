"""Every solver on a small real problem, against SciPy and against plain one-machine twins."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from five_bar_leg import leg_problem
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ccnn_torch.errors import InputError
from ccnn_torch.identification import Problem
from ccnn_torch.identification.solvers import SOLVERS, get_solver
from ccnn_torch.identification.solvers.hga import FORBIDDEN, Objective

SHORT = {"generations": 40}


def one(problem: Problem, machine: int) -> Problem:
    """The problem of one machine alone."""
    part = slice(machine, machine + 1)
    return dataclasses.replace(
        problem,
        start=problem.start[part],
        data=tuple(d[part] for d in problem.data),
        weights=problem.weights[part],
    )


def residual_of(problem: Problem, machine: int = 0) -> Any:
    """Residual of one machine as numpy knows it, in units of the scale."""

    def residual(points: NDArray[np.float64]) -> NDArray[np.float64]:
        values = problem.start[machine] + torch.from_numpy(points) * problem.scale
        return problem.residual(values, *(d[machine] for d in problem.data)).flatten().numpy()

    return residual


def test_the_hybrid_algorithm_ends_in_the_minimum_that_scipy_finds() -> None:
    problem, _ = leg_problem(machines=3)
    fit = get_solver("hga", generations=150)(problem, 0)
    assert bool(fit.converged.all()) and fit.message == ""
    for machine in range(3):
        found = least_squares(residual_of(problem, machine), np.zeros(6), jac="3-point", xtol=1e-15, ftol=1e-15)
        assert float(fit.cost[machine]) == pytest.approx(found.cost, rel=1e-8)
        apart = (fit.values[machine] - problem.start[machine]) / problem.scale - torch.from_numpy(found.x)
        assert float(apart.abs().max()) < 1e-4


def test_the_genetic_algorithm_comes_near_and_quadratic_programming_goes_the_rest() -> None:
    problem, _ = leg_problem(machines=2)
    plain = get_solver("hga", generations=150, sqp=False)(problem, 0)
    whole = get_solver("hga", generations=150)(problem, 0)
    start = Objective(problem).cost(torch.zeros(2, 1, 6, dtype=torch.float64))[:, 0]
    assert bool((plain.cost < 0.05 * start).all())
    assert bool((whole.cost < plain.cost).all())
    assert plain.evaluations < whole.evaluations


def test_a_solver_lowers_the_cost_and_gives_the_same_numbers_again() -> None:
    problem, _ = leg_problem(machines=2)
    told: list[float] = []
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002 - to see that nobody touched it
    fit = get_solver("hga", **SHORT)(problem, 5, told.append)
    again = get_solver("hga", **SHORT)(problem, 5)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()  # noqa: NPY002
    assert torch.equal(fit.values, again.values) and torch.equal(fit.cost, again.cost)
    objective = Objective(problem)
    assert bool((fit.cost < 0.8 * objective.cost(torch.zeros(2, 1, 6, dtype=torch.float64))[:, 0]).all())
    assert torch.allclose(
        objective.cost(((fit.values - problem.start) / problem.scale)[:, None])[:, 0], fit.cost, rtol=1e-9
    )
    assert told == sorted(told) and told[-1] == pytest.approx(1.0, abs=0.5) and max(told) <= 1.0


def test_a_machine_has_the_same_result_alone_and_beside_others() -> None:
    problem, _ = leg_problem(machines=3)
    solver = get_solver("hga", **SHORT)
    together, alone = solver(problem, 3), solver(one(problem, 2), 5)
    assert torch.allclose(together.values[2:], alone.values, rtol=0, atol=1e-12)


def test_a_row_of_weight_zero_counts_for_nothing_even_where_it_cannot_be_reached() -> None:
    problem, _ = leg_problem(machines=2, rows=20)
    pose, joints = (d.clone() for d in problem.data)
    pose[:, 3] = 100.0
    weights = problem.weights.clone()
    weights[:, 3] = 0
    spoiled = dataclasses.replace(problem, data=(pose, joints), weights=weights)
    left = [row for row in range(20) if row != 3]
    without = dataclasses.replace(
        problem, data=tuple(d[:, left] for d in problem.data), weights=problem.weights[:, left]
    )
    solver = get_solver("hga", **SHORT)
    assert torch.allclose(solver(spoiled, 0).cost, solver(without, 0).cost, rtol=1e-6)


def test_a_prior_draws_to_the_start() -> None:
    problem, _ = leg_problem()
    tight = dataclasses.replace(problem, prior_sd=problem.prior_sd.clone().index_fill_(0, torch.tensor([4]), 1e-9))
    fit = get_solver("hga", generations=40)(tight, 0)
    assert float((fit.values - problem.start)[0, 4].abs()) < 1e-8
    assert float((fit.values - problem.start)[0, 0].abs()) > 1e-5


def test_a_weight_of_two_is_a_row_that_stands_twice() -> None:
    problem, _ = leg_problem(rows=12)
    weights = problem.weights.clone()
    weights[:, :3] = 2
    twice = dataclasses.replace(
        problem,
        data=tuple(torch.cat([d, d[:, :3]], dim=1) for d in problem.data),
        weights=torch.ones(1, 15, dtype=torch.float64),
    )
    points = torch.rand(1, 7, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    heavy = dataclasses.replace(problem, weights=weights)
    assert torch.allclose(Objective(heavy).cost(points), Objective(twice).cost(points), rtol=1e-12)


def test_the_gradient_is_that_of_finite_differences_and_zero_outside_the_reach() -> None:
    problem, _ = leg_problem()
    objective = Objective(problem)
    point = torch.full((1, 6), 0.3, dtype=torch.float64)
    cost, gradient = objective.cost_and_gradient(point)
    steps = 1e-5 * torch.eye(6, dtype=torch.float64)
    ahead, behind = (objective.cost((point + sign * steps)[None])[0] for sign in (1, -1))
    assert torch.allclose((ahead - behind) / 2e-5, gradient[0], rtol=1e-5)
    assert float(cost) == pytest.approx(float(objective.cost(point[:, None])), rel=1e-12)
    lost, slope = objective.cost_and_gradient(torch.full((1, 6), 1e3, dtype=torch.float64) * torch.eye(6)[2])
    assert float(lost) == FORBIDDEN and not bool(slope.any())


def test_what_cannot_be_reached_from_the_start_is_said() -> None:
    problem, _ = leg_problem(machines=2)
    pose = problem.data[0].clone()
    pose[1, 0] = 100.0
    with pytest.raises(InputError, match="machine 1: a measured row cannot be reached"):
        get_solver("hga")(dataclasses.replace(problem, data=(pose, problem.data[1])), 0)
    with pytest.raises(InputError, match="machine 0 has no row"):
        get_solver("hga")(dataclasses.replace(problem, weights=torch.zeros_like(problem.weights)), 0)


def test_the_registry_knows_its_names_and_says_the_nearest() -> None:
    assert list(SOLVERS) == ["lm", "hga", "tikhonov"]
    with pytest.raises(InputError, match=r"there is no method 'hgaa'; did you mean 'hga'\?"):
        get_solver("hgaa")
    with pytest.raises(InputError, match=r"no setting 'generation'; did you mean 'generations'\?"):
        get_solver("hga", generation=3)
    with pytest.raises(InputError, match=r"known are lm, hga, tikhonov$"):
        get_solver("xyzzy")
