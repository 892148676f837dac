"""The evolutionary neural network (ENN) of the paper, one population of whole networks, as a learner."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from ccnn_torch.evolution.coevolution import density, diversity, fitness, make_task, network_errors
from ccnn_torch.evolution.genome import (
    BreedingDraws,
    breed_networks,
    breeding_shapes,
    genomes_of,
    initial_population,
    named_genomes,
    select,
    with_elites,
)
from ccnn_torch.evolution.random import uniform_parts
from ccnn_torch.evolution.settings import ENNSettings
from ccnn_torch.learners.protocol import TrainingData, weighted_mse
from ccnn_torch.learners.rows import OneNetwork, usable_rows
from ccnn_torch.numerics.trees import below, chosen, mapped

# Streams of random numbers: one for the generations, one for each layer's first individuals.
_GENERATIONS, _FIRST = 0, 1


class ENN(OneNetwork):
    """The CCNN's genomes, operators and fitness (eq. 11) without its cooperation; a step is one generation.

    An individual is a whole network: its layers have the same parents, and one number is its fitness. The model is the
    fittest network so far. Nothing is refined and nothing regularised, so that every difference in fitness counts,
    noise included.

    Metrics of a step: `fitness_best`, `fitness_mean`, `error_train`, `evaluations` (networks so far), each `r`;
    `density` and `diversity`, `r x layers`.
    """

    name = "enn"

    def __init__(self, settings: ENNSettings | None = None) -> None:
        self.settings = settings or ENNSettings()

    def start(self, data: TrainingData) -> None:
        """Take the data and judge the random first generation.

        Raises:
            MethodFailedError: training rows are not finite.
        """
        self._data = data = usable_rows(data)
        self._task = make_task(data.inputs, data.targets, data.weights)
        sizes = (data.inputs.shape[-1], *self.settings.hidden, data.targets.shape[-1])
        self._layers = [
            initial_population(after, before, self.settings, data.seeds, _FIRST + layer)
            for layer, (before, after) in enumerate(itertools.pairwise(sizes))
        ]
        self._generation = 0
        self._best = mapped(lambda value: value[:, :1].clone(), self._layers)
        self._best_fitness = torch.zeros_like(data.weights[:, 0])
        self._judge()

    def step(self) -> dict[str, Tensor]:
        """One generation."""
        settings, data = self.settings, self._data
        self._generation += 1
        shapes = [breeding_shapes(layer, settings) for layer in self._layers]
        numbers = iter(uniform_parts(data.seeds, _GENERATIONS, self._generation, list(itertools.chain(*shapes))))
        draws = [BreedingDraws(*itertools.islice(numbers, len(own))) for own in shapes]
        progress = self._generation / settings.generations
        children = breed_networks(self._layers, self._fitness, settings, progress, draws)
        self._layers = [
            with_elites(new, old, self._fitness, best)
            for new, old, best in zip(children, self._layers, self._best, strict=True)
        ]
        self._judge()
        judged = (self._generation + 1) * settings.population
        return {
            "fitness_best": self._best_fitness,
            "fitness_mean": self._fitness.mean(-1),
            "error_train": weighted_mse(self.predict(data.inputs), data.targets, data.weights),
            "density": density(self._layers),
            "diversity": diversity(self._layers, settings.weight_range),
            "evaluations": torch.full_like(self._best_fitness, judged),
        }

    @property
    def finished(self) -> bool:
        """True after the last generation."""
        return self._generation >= self.settings.generations

    @property
    def steps(self) -> int:
        """Generations."""
        return self.settings.generations

    def state_dict(self) -> dict[str, Tensor]:
        """The population with its fitness, and the fittest network so far."""
        tensors = {"fitness": self._fitness, "best_fitness": self._best_fitness}
        tensors |= named_genomes("population_", self._layers) | named_genomes("best_", self._best)
        return tensors | {"generation": torch.tensor(self._generation, dtype=torch.int64)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back a state; call `start` with the same data first."""
        self._layers, self._best = (genomes_of(below(state, prefix)) for prefix in ("population_", "best_"))
        self._fitness, self._best_fitness = state["fitness"], state["best_fitness"]
        self._generation = int(state["generation"])

    def _judge(self) -> None:
        """Fitness of the population, and the best network where one beats it."""
        self._fitness = fitness(network_errors(self._layers, self._task))
        highest, which = self._fitness.max(-1, keepdim=True)
        found = [select(layer, which) for layer in self._layers], highest.squeeze(-1)
        better = found[1] > self._best_fitness
        self._best, self._best_fitness = chosen(better, found, (self._best, self._best_fitness))

    def _model(self) -> tuple[list[Tensor], list[Tensor]]:
        """Masks and weights of the model, one a layer, `r x 1 x ...`."""
        return [layer.mask for layer in self._best], [layer.weight for layer in self._best]
