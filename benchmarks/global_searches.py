"""`ccnn identify` with three global searches besides its own methods: the comparison of Sun et al. (2018).

    pip install 'ccnn-torch[benchmarks]'
    python -m benchmarks.global_searches experiments/overconstrained_2dof.yaml methods=[lm,hga,tikhonov,ga,sa,pso]

Arguments are a config and overrides, as of `ccnn identify`; the paper's printed figures are shown beside
(`papers.py`). `ga` and `pso` are pymoo's genetic algorithm and particle swarm with its defaults (Blank and Deb 2020),
asked for their populations, which are evaluated together for all machines. `sa` is SciPy's generalised simulated
annealing (Xiang et al. 1997) without its local search. All stay in the box of `WIDTH` and spend the same number of
evaluations by default.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pymoo.algorithms.soo.nonconvex.ga import GA
from pymoo.algorithms.soo.nonconvex.pso import PSO
from pymoo.core.algorithm import Algorithm
from pymoo.core.evaluator import Evaluator
from pymoo.core.problem import Problem as Box
from pymoo.problems.static import StaticProblem
from scipy.optimize import dual_annealing

from benchmarks.papers import main
from ccnn_torch.identification.problems.problem import Fit, Problem, Progress
from ccnn_torch.identification.solvers import SOLVERS
from ccnn_torch.identification.solvers.hga import FORBIDDEN, WIDTH, Objective


def solve_ga(
    problem: Problem,
    seed: int,
    progress: Progress | None = None,
    *,
    evaluations: int = 30_000,
    population: int = 100,
) -> Fit:
    """Genetic algorithm of pymoo with its defaults: binary tournament, SBX crossover, polynomial mutation.

    Machine i draws its numbers from seed + i alone, here and in the others.

    Args:
        evaluations: bound for each machine.
        population: individuals.
    """
    # Looking for equal individuals takes more time than all the rest and finds none: the coding is real.
    make = partial(GA, pop_size=population, eliminate_duplicates=False)
    return _ask_and_tell(make, problem, population, evaluations, seed, progress)


def solve_pso(
    problem: Problem, seed: int, progress: Progress | None = None, *, evaluations: int = 30_000, particles: int = 50
) -> Fit:
    """Particle swarm of pymoo with its defaults (Zhan et al. 2009: inertia and pulls adapt to the swarm's state)."""
    return _ask_and_tell(partial(PSO, pop_size=particles), problem, particles, evaluations, seed, progress)


def solve_sa(problem: Problem, seed: int, progress: Progress | None = None, *, evaluations: int = 30_000) -> Fit:
    """Generalised simulated annealing of SciPy (Xiang et al. 1997) without its local search."""
    objective = Objective(problem)
    start = np.zeros(len(problem.scale))
    best, done = [], 0
    for machine in range(objective.machines):
        alone = objective.of(machine)
        found = dual_annealing(
            lambda point, alone=alone: float(alone.cost(torch.from_numpy(point)[None, None])),
            [(-WIDTH, WIDTH)] * len(start),
            maxiter=evaluations,  # never reached: an iteration takes 2 k evaluations
            maxfun=evaluations,
            rng=np.random.default_rng(seed + machine),
            no_local_search=True,
            x0=start,
        )
        best.append(torch.from_numpy(np.asarray(found.x)))
        done = max(done, int(found.nfev))
        if progress is not None:
            progress((machine + 1) / objective.machines)
    return _fit(objective, torch.stack(best), done)


SEARCHES = {"ga": solve_ga, "sa": solve_sa, "pso": solve_pso}


def _ask_and_tell(
    make: Callable[..., Algorithm],
    problem: Problem,
    population: int,
    evaluations: int,
    seed: int,
    progress: Progress | None,
) -> Fit:
    """Run one pymoo algorithm each machine, all populations evaluated in one call a generation."""
    objective = Objective(problem)
    r, k = objective.machines, len(problem.scale)
    generations = max(1, evaluations // population)
    searches = []
    for machine in range(r):
        draw = np.random.default_rng(seed + machine).uniform(-WIDTH, WIDTH, (population, k))
        draw[0] = 0.0  # the start is a guess worth having
        search = make(sampling=draw)
        search.setup(_box(objective), termination=("n_gen", generations), seed=seed + machine, verbose=False)
        searches.append(search)
    for generation in range(generations):
        asked = [search.ask() for search in searches]
        points = torch.from_numpy(np.stack([people.get("X") for people in asked]).astype(np.float64))
        costs = objective.cost(points).numpy()
        for search, people, cost in zip(searches, asked, costs, strict=True):
            Evaluator().eval(StaticProblem(search.problem, F=cost[:, None]), people)
            search.tell(infills=people)
        if progress is not None:
            progress((generation + 1) / generations)
    best = torch.from_numpy(np.stack([search.result().X for search in searches]).astype(np.float64))
    return _fit(objective, best, generations * population)


def _box(objective: Objective) -> Any:
    k = len(objective.problem.scale)
    return Box(n_var=k, n_obj=1, xl=np.full(k, -WIDTH), xu=np.full(k, WIDTH))


def _fit(objective: Objective, points: torch.Tensor, evaluations: int) -> Fit:
    """These searches end with their budget; the best point they saw is their answer."""
    cost = objective.cost(points[:, None])[:, 0]
    there = cost < FORBIDDEN
    message = "" if bool(there.all()) else "a machine has no parameters in the box with which all rows can be reached"
    return Fit(objective.values(points), cost, there, evaluations, message)


if __name__ == "__main__":
    SOLVERS.update(SEARCHES)
    main(Path(sys.argv[1]), *sys.argv[2:])
