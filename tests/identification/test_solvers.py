"""Every solver on a small real problem, against SciPy and against plain one-machine twins."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from five_bar_leg import leg_problem
from numpy.typing import NDArray
from scipy.optimize import dual_annealing, least_squares

from ccnn_torch.errors import InputError
from ccnn_torch.identification import Problem
from ccnn_torch.identification.solvers.lockstep import run_side_by_side
from ccnn_torch.identification.solvers.objective import FORBIDDEN, make_objective
from ccnn_torch.identification.solvers.registry import SOLVERS, get_solver

SHORT: dict[str, dict[str, Any]] = {
    "hga": {"generations": 40},
    "ga": {"evaluations": 1000},
    "sa": {"evaluations": 300},
    "pso": {"evaluations": 500},
}


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
    start = make_objective(problem).cost(torch.zeros(2, 1, 6, dtype=torch.float64))[:, 0]
    assert bool((plain.cost < 0.05 * start).all())
    assert bool((whole.cost < plain.cost).all())
    assert plain.evaluations < whole.evaluations


@pytest.mark.parametrize("name", SHORT)
def test_a_solver_lowers_the_cost_and_gives_the_same_numbers_again(name: str) -> None:
    problem, _ = leg_problem(machines=2)
    told: list[float] = []
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002 - to see that nobody touched it
    fit = get_solver(name, **SHORT[name])(problem, 5, told.append)
    again = get_solver(name, **SHORT[name])(problem, 5)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert (np.random.get_state()[1] == before[1]).all()  # noqa: NPY002
    assert torch.equal(fit.values, again.values) and torch.equal(fit.cost, again.cost)
    objective = make_objective(problem)
    assert bool((fit.cost < 0.8 * objective.cost(torch.zeros(2, 1, 6, dtype=torch.float64))[:, 0]).all())
    assert torch.allclose(
        objective.cost(((fit.values - problem.start) / problem.scale)[:, None])[:, 0], fit.cost, rtol=1e-9
    )
    assert told == sorted(told) and told[-1] == pytest.approx(1.0, abs=0.5) and max(told) <= 1.0


@pytest.mark.parametrize("name", SHORT)
def test_a_machine_has_the_same_result_alone_and_beside_others(name: str) -> None:
    problem, _ = leg_problem(machines=3)
    solver = get_solver(name, **SHORT[name])
    together, alone = solver(problem, 3), solver(one(problem, 2), 5)
    assert torch.allclose(together.values[2:], alone.values, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["ga", "sa", "pso"])
def test_the_global_searches_stay_in_their_box_and_keep_to_their_budget(name: str) -> None:
    problem, _ = leg_problem(machines=1)
    far = dataclasses.replace(problem, start=problem.start + 8 * problem.scale)  # the truth is outside the box
    fit = get_solver(name, **SHORT[name])(far, 0)
    assert bool((((fit.values - far.start) / far.scale).abs() <= 3 + 1e-9).all())
    assert fit.evaluations <= SHORT[name]["evaluations"] + 12


def test_annealing_in_lockstep_is_scipys_annealing() -> None:
    problem, _ = leg_problem(machines=2)
    fit = get_solver("sa", evaluations=300)(problem, 7)
    for machine in range(2):
        residual = residual_of(problem, machine)
        found = dual_annealing(
            lambda x, residual=residual: float((residual(x) ** 2).sum() / 2),
            [(-3.0, 3.0)] * 6,
            maxiter=10_000,
            maxfun=300,
            rng=np.random.default_rng(7 + machine),
            no_local_search=True,
            x0=np.zeros(6),
        )
        assert float(fit.cost[machine]) == pytest.approx(found.fun, rel=1e-9)


@pytest.mark.parametrize("name", ["hga", "pso"])
def test_a_row_of_weight_zero_counts_for_nothing_even_where_it_cannot_be_reached(name: str) -> None:
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
    solver = get_solver(name, **SHORT[name])
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
    assert torch.allclose(make_objective(heavy).cost(points), make_objective(twice).cost(points), rtol=1e-12)


def test_the_gradient_is_that_of_finite_differences_and_zero_outside_the_reach() -> None:
    problem, _ = leg_problem()
    objective = make_objective(problem)
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
        get_solver("pso")(dataclasses.replace(problem, weights=torch.zeros_like(problem.weights)), 0)


def test_an_error_in_a_search_or_in_the_evaluation_ends_all_of_them() -> None:
    def endless(machine: int, ask: Any) -> NDArray[np.float64]:
        while True:
            if ask(np.zeros(1)) > 5 and machine == 1:
                raise ValueError("enough")

    count = 0

    def evaluate(points: NDArray[np.float64]) -> list[int]:
        nonlocal count
        count += 1
        if count > 50:
            raise RuntimeError("broken")
        return [count] * len(points)

    with pytest.raises(ValueError, match="enough"):
        run_side_by_side(endless, evaluate, np.zeros((3, 1)))
    count = 10
    with pytest.raises(RuntimeError, match="broken"):
        run_side_by_side(lambda m, ask: endless(0, ask), evaluate, np.zeros((3, 1)))


def test_the_registry_knows_its_names_and_says_the_nearest() -> None:
    assert list(SOLVERS) == ["lm", "hga", "tikhonov", "ga", "sa", "pso"]
    with pytest.raises(InputError, match=r"there is no solver 'hgaa'; did you mean 'hga'\?"):
        get_solver("hgaa")
    with pytest.raises(InputError, match=r"no setting 'generation'; did you mean 'generations'\?"):
        get_solver("hga", generation=3)
    with pytest.raises(InputError, match="known: lm, hga, tikhonov, ga, sa, pso, each also as NAME_per_leg"):
        get_solver("xyzzy")
