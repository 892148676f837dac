"""EvoTorch, EvoX, pyrenn and mujoco.sysid, where they are installed; else they are left out.

`pip install 'ccnn-torch[benchmarks]'` installs them.

Both libraries of evolution get the networks' errors of `fitness.row_errors` as a PyTorch module, judged as their
documentation says for populations of networks: EvoTorch by a functional module under `vmap`, EvoX by its
`SupervisedLearningProblem`. A connection whose weight is 0 is none.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from benchmarks.measure import Call

PEERS = {"evotorch": "EvoTorch", "evox": "EvoX", "pyrenn": "pyrenn"}
Score = Callable[..., Tensor]
# A genetic algorithm's settings, of both.
_TOURNAMENT, _STEP = 3, 0.1
# Networks at a time under `vmap`: more leave the cache and take up to three times as long each.
_CHUNK = 2400


def missing() -> list[str]:
    """Peers that are not installed."""
    absent = [name for module, name in PEERS.items() if find_spec(module) is None]
    return absent if sysid() else [*absent, "mujoco.sysid"]


def sysid() -> Any:
    """mujoco.sysid; None where MuJoCo, or one of the packages that sysid itself needs, is not installed."""
    try:
        tool: Any = importlib.import_module("mujoco.sysid")
    except ImportError:
        return None
    # Without those packages it can be imported, and is empty.
    return tool if hasattr(tool, "optimize") else None


class Network(nn.Module):
    """Layers as `out x (into + 1)` matrices, the last column being the biases."""

    def __init__(self, sizes: Sequence[int], error: Score) -> None:
        super().__init__()
        shapes = [(out, into + 1) for into, out in pairwise(sizes)]
        self.layers = nn.ParameterList([nn.Parameter(torch.zeros(s, dtype=torch.float64)) for s in shapes])
        self.error = error

    def forward(self, x: Tensor) -> Tensor:
        """The error in each row of inputs and targets side by side."""
        parts = [part for layer in self.layers for part in ((layer[:, :-1] != 0).double(), layer)]
        n = self.layers[0].shape[1] - 1
        return self.error(tuple(parts), x[:, :n], x[:, n:])


def fitness_peers(sizes: Sequence[int], error: Score, rows: Tensor, flat: Tensor) -> Mapping[str, Call]:
    """Eq. 11's error of every network, `flat` `p x k`, on `rows` `s x (n + m)`."""
    found: dict[str, Call] = {}
    if find_spec("evotorch"):
        problem = _evotorch_problem(sizes, error, rows)
        batch = importlib.import_module("evotorch").SolutionBatch(problem, len(flat), empty=True)
        batch.set_values(flat)

        def evotorch() -> Tensor:
            problem.evaluate(batch)
            values: Tensor = batch.evals[:, 0]
            return values

        found["EvoTorch"] = evotorch
    if find_spec("evox"):
        judge, to_layers = _evox_problem(sizes, error, rows, len(flat))
        found["EvoX"] = lambda: judge.evaluate(to_layers(flat))
    return found


def generation_peers(sizes: Sequence[int], error: Score, rows: Tensor, population: int) -> Mapping[str, Call]:
    """One generation of a genetic algorithm: tournaments, crossover, mutation, evaluation of so many whole networks."""
    found: dict[str, Call] = {}
    if find_spec("evotorch"):
        problem = _evotorch_problem(sizes, error, rows)
        operators = importlib.import_module("evotorch.operators")
        steps = [
            operators.OnePointCrossOver(problem, tournament_size=_TOURNAMENT),
            operators.GaussianMutation(problem, stdev=_STEP),
        ]
        algorithms = importlib.import_module("evotorch.algorithms")
        search = algorithms.GeneticAlgorithm(problem, operators=steps, popsize=population, re_evaluate=False)
        found["EvoTorch GeneticAlgorithm"] = search.step
    if find_spec("evox"):
        judge, to_layers = _evox_problem(sizes, error, rows, population)
        found["EvoX, its operators"] = _evox_generation(judge.evaluate, to_layers, population, Network(sizes, error))
    return found


def _evotorch_problem(sizes: Sequence[int], error: Score, rows: Tensor) -> Any:
    evotorch: Any = importlib.import_module("evotorch")
    logging.getLogger("evotorch").setLevel(logging.WARNING)
    functional: Any = importlib.import_module("evotorch.neuroevolution.net")
    network = functional.ModuleExpectingFlatParameters(Network(sizes, error), disable_autograd_tracking=True)
    judge = torch.func.vmap(lambda weights: network(weights, rows).mean(), chunk_size=_CHUNK)
    keys = {"solution_length": network.parameter_length, "initial_bounds": (-1, 1), "dtype": torch.float64}
    return evotorch.Problem("min", judge, vectorized=True, **keys)


def _evox_problem(sizes: Sequence[int], error: Score, rows: Tensor, population: int) -> tuple[Any, Any]:
    neuro: Any = importlib.import_module("evox.problems.neuroevolution.supervised_learning")
    network = Network(sizes, error)
    to_layers = importlib.import_module("evox.utils").ParamsAndVector(network).batched_to_params
    loader = DataLoader(TensorDataset(rows, rows), batch_size=None, sampler=[slice(None)])
    judge = neuro.SupervisedLearningProblem(network, loader, lambda found, _: found, -1, population)
    return judge, to_layers


def _evox_generation(judge: Any, to_layers: Any, population: int, network: nn.Module) -> Call:
    """EvoX has no genetic algorithm for one objective; these are the operators of its others."""
    select: Any = importlib.import_module("evox.operators.selection").tournament_selection
    cross: Any = importlib.import_module("evox.operators.crossover").simulated_binary
    mutate: Any = importlib.import_module("evox.operators.mutation").polynomial_mutation
    count = sum(part.numel() for part in network.parameters())
    bound = torch.ones(count, dtype=torch.float64)
    people = 2 * torch.rand(population, count, dtype=torch.float64) - 1
    errors = judge(to_layers(people))

    def step() -> None:
        nonlocal people, errors
        people = mutate(cross(people[select(population, errors, _TOURNAMENT)]), -bound, bound)
        errors = judge(to_layers(people))

    return step


def pyrenn_fit(sizes: Sequence[int], x: Tensor, y: Tensor, iterations: int) -> Call | None:
    """Its Levenberg-Marquardt from random weights; None where it is not installed."""
    if find_spec("pyrenn") is None:
        return None
    pyrenn: Any = importlib.import_module("pyrenn")

    def fit() -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            pyrenn.train_LM(x.numpy().T, y.numpy().T, pyrenn.CreateNN(list(sizes)), k_max=iterations)

    return fit
