"""One generation of the coevolution beside a numpy loop that does the same, and the paper's 120 generations as a whole.

The loop joins every individual with the best and three random representatives (eq. 11), one network after another.
EvoTorch and EvoX have no cooperating populations: their genetic algorithms breed and judge as many whole networks as
the coevolution joins and judges, four for each individual, and once as many as it has individuals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.measure import Call, Row, compare
from benchmarks.peers import generation_peers
from ccnn_torch.evolution import CCNNSettings
from ccnn_torch.evolution.coevolution import EPSILON, REPRESENTATIVES, advance, make_task, start
from ccnn_torch.evolution.genome import CONTESTANTS, CUTS, ELITES, EXPONENT

Array = NDArray[np.float64]
Individual = tuple[NDArray[np.bool_], Array]


SIZES, ROWS = [3, 12, 12, 3], 125


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """The paper's population, and larger ones; then the paper's evolutions from start to end."""
    from benchmarks.fitness import row_errors

    rows = torch.from_numpy(np.concatenate(toy_rows(SIZES, ROWS), 1))
    for population in (80,) if quick else (80, 800, 8000):
        settings = CCNNSettings(hidden=tuple(SIZES[1:-1]), population=population, generations=120)
        individuals = 3 * population
        peers: dict[str, Call] = {}
        for networks in (individuals * (1 + REPRESENTATIVES), individuals) if population <= 800 else ():
            found = generation_peers(SIZES, row_errors, rows, networks)
            peers |= {f"{name}, {networks:,} whole networks": call for name, call in found.items()}
        if population <= 800:
            peers["numpy loop"] = NumpyLoop(SIZES, ROWS, settings).generation
        task, ours = f"one generation, 3-12-12-3, {ROWS} rows", batched(SIZES, ROWS, 1, settings)
        yield from compare(task, individuals, "individuals", ours, peers, rounds=3)
    for sizes in ([3, 6, 6, 3], [3, 12, 12, 3]):
        settings = CCNNSettings(hidden=tuple(sizes[1:-1]), population=80, generations=120)
        name = "-".join(map(str, sizes))

        def evolution(sizes: list[int] = sizes, settings: CCNNSettings = settings) -> None:
            step = batched(sizes, ROWS, 1, settings)
            for _ in range(settings.generations):
                step()

        yield from compare(
            f"the paper's evolution of {name}, 3 x 80, {ROWS} rows", 120, "generations", evolution, rounds=3
        )


def toy_rows(sizes: list[int], rows: int) -> tuple[Array, Array]:
    """Inputs in [-1, 1] and smooth standardised outputs."""
    generator = np.random.default_rng(0)
    inputs = generator.uniform(-1, 1, (rows, sizes[0]))
    outputs = np.sin(inputs @ generator.standard_normal((sizes[0], sizes[-1])))
    return inputs, (outputs - outputs.mean(0)) / outputs.std(0)


def batched(sizes: list[int], rows: int, repeats: int, settings: CCNNSettings) -> Callable[[], None]:
    """One generation of this package, each call from the state that the last one left."""
    inputs, targets = (torch.from_numpy(part).expand(repeats, -1, -1) for part in toy_rows(sizes, rows))
    task = make_task(inputs, targets, torch.ones(repeats, rows, dtype=torch.float64))
    seeds = torch.arange(repeats)
    state = start(sizes, task, settings, seeds)

    def step() -> None:
        nonlocal state
        state = advance(state, task, settings, seeds)

    return step


class NumpyLoop:
    """The same algorithm as a loop over individuals."""

    def __init__(self, sizes: list[int], rows: int, settings: CCNNSettings) -> None:
        self.settings = settings
        self.random = np.random.default_rng(1)
        self.inputs, self.targets = toy_rows(sizes, rows)
        self.done = 0
        self.populations: list[list[Individual]] = []
        for before, after in itertools.pairwise(sizes):
            self.populations.append([self.individual(after, before) for _ in range(settings.population)])
        self.best = [population[0] for population in self.populations]
        self.best_fitness = 0.0
        self.fitness = [np.array([]) for _ in self.populations]
        for layer in range(len(self.populations)):
            self.judge(layer)

    def individual(self, after: int, before: int) -> Individual:
        mask = self.random.random((after, before)) < self.settings.density
        weight = self.random.uniform(-1, 1, (after, before + 1)) * self.settings.weight_range
        weight[:, :-1] *= mask
        return mask, weight

    def generation(self) -> None:
        """Elites, selection, crossover, mutation and evaluation of every layer in turn."""
        settings = self.settings
        self.done = min(self.done + 1, settings.generations - 1)
        for layer, population in enumerate(self.populations):
            order = np.argsort(-self.fitness[layer])
            renewed = [self.best[layer], *(population[i] for i in order[1:ELITES])]
            while len(renewed) < settings.population:
                renewed += self.children(population, self.fitness[layer])
            self.populations[layer] = renewed[: settings.population]
            self.judge(layer)

    def children(self, population: list[Individual], fitness: Array) -> list[Individual]:
        settings, random = self.settings, self.random
        parents = []
        for _ in range(2):
            drawn = random.integers(len(population), size=CONTESTANTS)
            mask, weight = population[drawn[np.argmax(fitness[drawn])]]
            parents.append((mask.copy(), weight.copy()))
        (mask, weight), (other_mask, other_weight) = parents
        if random.random() < settings.crossover:
            places = np.arange(weight.size)[:, None] >= random.integers(1, weight.size, CUTS)
            swap = (places.sum(1) % 2 == 1).reshape(weight.shape)
            bits = swap[:, :-1]
            mask[bits], other_mask[bits] = other_mask[bits], mask[bits].copy()
            weight[swap], other_weight[swap] = other_weight[swap], weight[swap].copy()
        flips = random.random(mask.shape) < settings.structural_mutation
        fresh = random.uniform(-1, 1, mask.shape) * settings.weight_range
        weight[:, :-1] = np.where(flips, np.where(mask, 0.0, fresh), weight[:, :-1])
        mask ^= flips
        active = np.concatenate([other_mask, np.ones((len(other_mask), 1), dtype=bool)], axis=1)
        draws = np.where(active, random.random(other_weight.shape), 1.0)
        chosen = ((draws < settings.weight_mutation) | (draws == draws.min())) & active
        progress = (1 - self.done / settings.generations) ** EXPONENT
        share = 1 - random.random(other_weight.shape) ** progress
        bound = np.where(random.random(other_weight.shape) < 0.5, settings.weight_range, -settings.weight_range)
        other_weight[chosen] += ((bound - other_weight) * share)[chosen]
        return [(mask, weight), (other_mask, other_weight)]

    def judge(self, layer: int) -> None:
        settings = self.settings
        size = settings.population
        sets = [self.best] + [
            [population[self.random.integers(size)] for population in self.populations] for _ in range(REPRESENTATIVES)
        ]
        scores = np.zeros(size)
        for number, individual in enumerate(self.populations[layer]):
            for companions in sets:
                network = [*companions[:layer], individual, *companions[layer + 1 :]]
                fitness = self.evaluate(network)
                scores[number] = max(scores[number], fitness)
                if fitness > self.best_fitness:
                    self.best_fitness, self.best = fitness, network
        self.fitness[layer] = scores

    def evaluate(self, network: list[Individual]) -> float:
        signal = self.inputs
        fed: np.ndarray = np.ones(self.inputs.shape[1], dtype=bool)
        for layer, (mask, weight) in enumerate(network):
            signal = signal @ weight[:, :-1].T + weight[:, -1]
            if layer + 1 < len(network):
                fed = np.any(mask & fed, axis=1)
                signal = fed / (1 + np.exp(-signal))
        error = np.sqrt(((signal - self.targets) ** 2).sum(1)).mean()
        return 1 / (float(error) + EPSILON)
