"""Hybrid genetic algorithm: a genetic algorithm finds the hill, sequential quadratic programming climbs it.

Paper 001, section IV. The genetic algorithm is real-coded and runs on the individuals of all machines at once; what the
paper leaves open is ours: tournament selection, extended line recombination (Mühlenbein and Schlierkamp-Voosen 1993),
and the mutation of the breeder genetic algorithm (there), whose steps have all sizes from a tenth of the box downwards,
so that it needs no schedule.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.evolution.genome import tournament
from ccnn_torch.evolution.random import uniform_parts
from ccnn_torch.identification.problems.problem import Fit, Problem, Progress, WeightedRows

FORBIDDEN = 1e100
"""Cost of parameters with which a measured row cannot be reached; finite, so that searches may compare with it."""

# Rows evaluated in one call: intermediate results of the kinematics then stay in the processor's cache.
_ROWS_AT_ONCE = 1 << 15

WIDTH = 3.0
"""Half the width of the box that global searches stay in, in units of `Problem.scale`."""


_HELD = 1e-9


class Objective:
    """Half the weighted sum of squares and prior terms of a problem, in the coordinates u = (values - start) / scale.

    Raises:
        InputError: a machine without a row that counts, or whose start does not reach one.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.rows = WeightedRows(problem)
        for empty in (~(problem.weights > 0).any(-1)).nonzero():
            raise InputError(f"machine {int(empty)} has no row to identify from: all its weights are 0")
        start = torch.zeros(self.machines, 1, len(problem.scale), dtype=torch.float64)
        for lost in (self.cost(start)[:, 0] >= FORBIDDEN).nonzero():
            raise InputError(
                f"machine {int(lost)}: a measured row cannot be reached with the parameters that the search starts "
                "from; leave the row out or correct it"
            )

    @property
    def machines(self) -> int:
        """Number of machines, `r`."""
        return self.problem.start.shape[0]

    def of(self, machine: int) -> Objective:
        """The objective of one machine alone."""
        problem, one = self.problem, slice(machine, machine + 1)
        data = tuple(d if len(d) == 1 else d[one] for d in problem.data)
        missing = problem.missing if problem.missing is None or len(problem.missing) == 1 else problem.missing[one]
        start, weights = problem.start[one], problem.weights[one]
        return Objective(dataclasses.replace(problem, start=start, data=data, weights=weights, missing=missing))

    def values(self, points: Tensor, machines: Tensor | None = None) -> Tensor:
        """From coordinates to parameters: `m x … x k` [1] of these machines to the same [SI]."""
        start = self.problem.start if machines is None else self.problem.start[machines]
        return start.reshape(len(start), *(1,) * (points.dim() - 2), -1) + points * self.problem.scale

    def cost(self, points: Tensor, machines: Tensor | None = None) -> Tensor:
        """Costs of a population.

        Args:
            points: `m x p x k` [1].
            machines: which machine each of the `m` is, `m`, int64; all in order when None.

        Returns:
            `m x p`; `FORBIDDEN` where a residual is not finite.
        """
        machines = torch.arange(self.machines) if machines is None else machines
        count = self.problem.weights.shape[-1] * max(len(machines), 1)
        parts = torch.split(self.values(points, machines), max(1, _ROWS_AT_ONCE // max(count, 1)), dim=1)
        return torch.cat([self.rows.cost(part, machines) for part in parts], dim=1).clamp_max(FORBIDDEN)

    def cost_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Cost `r` and its gradient `r x k` at `r x k` [1]; `FORBIDDEN` and 0 where a residual is not finite."""
        cost, gradient, _ = self._normal(points)
        good = (cost < FORBIDDEN) & torch.isfinite(gradient).all(-1)
        return torch.where(good, cost, FORBIDDEN), torch.where(good[:, None], gradient, 0.0)

    def even_coordinates(self, points: Tensor) -> Tensor:
        """T with T Tᵀ the inverse of the Gauss-Newton Hessian at `r x k`; `r x k x k`.

        Directions that the rows hardly see are held by a share of 1e-9 of the largest curvature.
        """
        hessian = torch.nan_to_num(self._normal(points)[2], posinf=0.0, neginf=0.0)
        held = _HELD * hessian.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-100)
        unit = torch.eye(len(self.problem.scale), dtype=hessian.dtype)
        factor = torch.linalg.cholesky(hessian + held[:, None, None] * unit)
        turn: Tensor = torch.linalg.solve_triangular(factor.mT, unit.expand_as(factor), upper=True)
        return turn

    def _normal(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost `r`, gradient `r x k` and Gauss-Newton matrix `r x k x k`."""
        found = self.rows.normal(self.values(points)[:, None], torch.arange(self.machines))
        cost, gradient, matrix = (part[:, 0] for part in found)
        return cost, gradient, matrix


Array = NDArray[np.float64]

# Streams of random numbers: the first population and the generations.
_FIRST, _BREED = 0, 1
# Line recombination reaches so far beyond either parent, as a share of their distance.
_BEYOND = 0.25
# The smallest mutation step is the largest times 2^-20.
_OCTAVES = 20.0
# Share of the work that the genetic algorithm is, for the progress.
_GENETIC_SHARE = 0.9
# Rounds of quadratic programming, and the share of the cost below which the gain of one ends them.
_ROUNDS, _GAIN = 20, 1e-9
# Steps by the gradient after them.
_LAST = 2


@dataclass(frozen=True)
class HybridGenetic:
    """Genetic algorithm, then SQP from its best individual (SciPy's SLSQP with the gradient by differentiation).

    Attributes:
        population: individuals of each machine.
        generations: bound on the generations.
        elites: best individuals that go on unchanged.
        crossover: share of the other individuals that have two parents.
        mutation: probability that a parameter of a new individual is changed.
        tournament: contestants of one selection.
        settled: the search of a machine ends when its cost fell by less than 1 % in so many generations.
        sqp: whether SQP follows; without it this is the plain genetic algorithm.
    """

    population: int = 100
    generations: int = 3000
    elites: int = 8
    crossover: float = 0.7
    mutation: float = 0.1
    tournament: int = 2
    settled: int = 200
    sqp: bool = True

    def __call__(self, problem: Problem, seed: int, progress: Progress | None = None) -> Fit:
        """Minimise; machine i draws its numbers from seed + i alone."""
        objective = Objective(problem)
        tell = progress or (lambda _: None)
        share = _GENETIC_SHARE if self.sqp else 1.0
        best, cost, generations, settled = self._evolve(objective, seed, lambda done: tell(share * done))
        evaluations = self.population * (generations + 1)
        if self.sqp:
            best, cost, settled, calls = polish(objective, best, lambda done: tell(share + (1 - share) * done))
            evaluations += calls
        tell(1.0)
        return Fit(objective.values(best), cost, settled, evaluations, _message(settled, self.sqp))

    def _evolve(self, objective: Objective, seed: int, tell: Progress) -> tuple[Tensor, Tensor, int, Tensor]:
        """Best points `r x k`, their costs `r`, generations of the slowest machine, and which settled, `r`."""
        r, k = objective.machines, len(objective.problem.scale)
        seeds = seed + torch.arange(r)
        (draws,) = uniform_parts(seeds, _FIRST, 0, [(self.population, k)])
        people = (2 * draws - 1) * WIDTH
        people[:, 0] = 0.0  # the start is a guess worth having
        costs = objective.cost(people)
        mark, since = costs.amin(-1), torch.zeros(r, dtype=torch.int64)
        active = torch.arange(r)
        generation = 0
        while len(active) and generation < self.generations:
            generation += 1
            children = self._breed(people[active], costs[active], seeds[active], generation)
            kept = costs[active].argsort(dim=-1, stable=True)[:, : self.elites]
            old = people[active].gather(1, kept[..., None].expand(-1, -1, k))
            people[active] = torch.cat([old, children], dim=1)
            costs[active] = torch.cat([costs[active].gather(1, kept), objective.cost(children, active)], dim=1)
            least = costs.amin(-1)
            better = least < 0.99 * mark
            mark = torch.where(better, least, mark)
            since[active] = torch.where(better[active], 0, since[active] + 1)
            active = active[since[active] < self.settled]
            tell(generation / self.generations)
        place = costs.argmin(-1)
        return people[torch.arange(r), place], costs.amin(-1), generation, since >= self.settled

    def _breed(self, people: Tensor, costs: Tensor, seeds: Tensor, generation: int) -> Tensor:
        """Children `m x (p - elites) x k` of people `m x p x k` with costs `m x p`."""
        k, count = people.shape[-1], self.population - self.elites
        shapes = [(2 * count, self.tournament), (count,), (count,), (count, k), (count, k), (count, k)]
        picks, mates, along, chosen, size, side = uniform_parts(seeds, _BREED, generation, shapes)
        parents = people.gather(1, tournament(-costs, picks)[..., None].expand(-1, -1, k))
        first, second = parents[:, :count], parents[:, count:]
        share = torch.where(mates < self.crossover, (1 + 2 * _BEYOND) * along - _BEYOND, 0.0)
        children = first + share[..., None] * (second - first)
        step = torch.where(side < 0.5, -0.2, 0.2) * WIDTH * 2 ** (-_OCTAVES * size)
        return (children + torch.where(chosen < self.mutation, step, 0.0)).clamp(-WIDTH, WIDTH)


def polish(objective: Objective, points: Tensor, tell: Progress) -> tuple[Tensor, Tensor, Tensor, int]:
    """Sequential quadratic programming from each machine's point, without bounds.

    SciPy's SLSQP begins with the identity for the Hessian and learns the rest by updates, of which parameters that are
    hardly distinguishable need thousands. So each round is in coordinates in which the Gauss-Newton Hessian at its
    start is the identity, and rounds follow until one gains nothing that counts.

    Args:
        points: `r x k` [1].
        tell: called with the share of the rounds that is done.

    Returns:
        points `r x k`, costs `r`, converged `r` (the last round gained nothing that counts), and the evaluations of the
        slowest machine (one gradient = one).
    """
    here, calls = points, 0
    cost = objective.cost_and_gradient(here)[0]
    ended = torch.zeros(len(here), dtype=torch.bool)
    for number in range(_ROUNDS):
        found, count = _one_round(objective, here, cost)
        reached = objective.cost_and_gradient(found)[0]
        ended = ~(reached < cost * (1 - _GAIN))
        here = torch.where((reached < cost)[:, None], found, here)
        cost, calls = torch.minimum(cost, reached), calls + count
        tell((number + 1) / _ROUNDS)
        if bool(ended.all()):
            break
    for _ in range(_LAST):
        here, cost = _one_step(objective, here, cost)
    return here, cost, ended, calls + 2 * _LAST


def _one_step(objective: Objective, points: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
    """A Gauss-Newton step of each machine, where it makes the gradient less.

    At its end the cost is flat, and differs by rounding alone between points that still differ in their gradient.
    """
    turn = objective.even_coordinates(points)
    gradient = (turn.mT @ objective.cost_and_gradient(points)[1][..., None])[..., 0]
    stepped = points - (turn @ gradient[..., None])[..., 0]
    reached, slope = objective.cost_and_gradient(stepped)
    left = (turn.mT @ slope[..., None])[..., 0]
    better = (left.norm(dim=-1) < gradient.norm(dim=-1)) & (reached <= cost * (1 + _GAIN))
    return torch.where(better[:, None], stepped, points), torch.where(better, reached, cost)


def _one_round(objective: Objective, points: Tensor, cost: Tensor) -> tuple[Tensor, int]:
    """SLSQP of every machine from its point: where it ended, `r x k`, and the evaluations of the slowest."""
    unit = cost.clamp_min(1e-300)
    # u = points + turn z, so that cost / unit is about 1 + gradient z + |z|² / 2.
    turn = objective.even_coordinates(points) * unit.sqrt()[:, None, None]
    ends, calls = zip(
        *(_search(objective.of(i), points[i], turn[i], float(unit[i])) for i in range(len(points))), strict=True
    )
    return torch.stack(ends), max(calls)


def _search(alone: Objective, point: Tensor, turn: Tensor, unit: float) -> tuple[Tensor, int]:
    """SLSQP of one machine in the coordinates z of `_one_round`: where it ended, `k`, and its evaluations."""

    def evaluate(z: Array) -> tuple[float, Array]:
        cost, gradient = alone.cost_and_gradient((point + turn @ torch.from_numpy(z))[None])
        return float(cost) / unit, (turn.mT @ gradient[0] / unit).numpy()

    options = {"maxiter": 500, "ftol": 1e-15}
    found = minimize(evaluate, np.zeros(len(point)), jac=True, method="SLSQP", options=options)
    return point + turn @ torch.from_numpy(found.x), int(found.nfev)


def _message(settled: Tensor, sqp: bool) -> str:
    failed = (~settled).nonzero()
    if len(failed) == 0:
        return ""
    what = "quadratic programming still gained" if sqp else "the genetic algorithm still gained when it had to stop"
    return f"{len(failed)} of {len(settled)} machines did not settle; for the first (index {int(failed[0])}) {what}"
