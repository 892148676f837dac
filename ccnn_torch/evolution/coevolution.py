"""Cooperative coevolution of the layers of a network (paper 000, section III-A and F), all repeats at once.

The subpopulations take turns within a generation: each is renewed and judged beside the newest members of the others
(Potter and De Jong 2000, whom the paper follows), and what one gains the next can build on at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from ccnn_torch.evolution.breeding import BreedingDraws, breed, breeding_shapes, initial_population, with_elites
from ccnn_torch.evolution.evaluation import Task, fitness, joined_errors
from ccnn_torch.evolution.genome import Genome, kept, select
from ccnn_torch.evolution.random import uniform_parts
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.numerics.trees import chosen, joined

_T = TypeVar("_T")

# Streams of random numbers: one for the generations, one for each layer's first individuals.
_GENERATIONS, _FIRST = 0, 1

REPRESENTATIVES = 3
"""Random representatives of every other subpopulation beside its best."""


@dataclass(frozen=True)
class Coevolution:
    """State between generations.

    Attributes:
        populations: one a layer, `r x p x ...`.
        fitness: one a layer, `r x p`: the best of the joined networks of each individual.
        best: the best joined network of each repeat so far, one part a layer, `r x 1 x ...`.
        best_fitness: its fitness, `r`.
        generation: generations done.
    """

    populations: tuple[Genome, ...]
    fitness: tuple[Tensor, ...]
    best: tuple[Genome, ...]
    best_fitness: Tensor
    generation: int


def start(sizes: Sequence[int], task: Task, settings: CCNNSettings, seeds: Tensor) -> Coevolution:
    """Random subpopulations and their fitness (steps 1 and 2 of section III-F).

    Args:
        sizes: nodes of every layer, inputs and outputs included.
        seeds: `r`, int64.
    """
    populations = tuple(
        initial_population(after, before, settings, seeds, _FIRST + layer)
        for layer, (before, after) in enumerate(itertools.pairwise(sizes))
    )
    state = Coevolution(
        populations=populations,
        fitness=tuple(genome.weight.new_zeros(genome.weight.shape[:2]) for genome in populations),
        best=tuple(Genome(genome.mask[:, :1].clone(), genome.weight[:, :1].clone()) for genome in populations),
        best_fitness=task.inputs.new_zeros(len(seeds)),
        generation=0,
    )
    company = uniform_parts(seeds, _GENERATIONS, 0, [_company_shape(state)])[0]
    for layer, population in enumerate(populations):
        state = _judge(state, layer, population, company[:, layer], task)
    return state


def advance(state: Coevolution, task: Task, settings: CCNNSettings, seeds: Tensor) -> Coevolution:
    """One generation (steps 3 and 4 of section III-F)."""
    state = replace(state, generation=state.generation + 1)
    progress = state.generation / settings.generations
    shapes = [breeding_shapes(population, settings) for population in state.populations]
    all_shapes = [_company_shape(state), *itertools.chain(*shapes)]
    company, *numbers = uniform_parts(seeds, _GENERATIONS, state.generation, all_shapes)
    for layer, (population, scores) in enumerate(zip(state.populations, state.fitness, strict=True)):
        taken = sum(len(before) for before in shapes[:layer])
        draws = BreedingDraws(*numbers[taken : taken + len(shapes[layer])])
        children = breed(population, scores, settings, progress, draws)
        renewed = with_elites(children, population, scores, state.best[layer], settings)
        state = _judge(state, layer, renewed, company[:, layer], task)
    return state


def _company_shape(state: Coevolution) -> tuple[int, ...]:
    layers = len(state.populations)
    return layers, layers, REPRESENTATIVES


def _judge(state: Coevolution, layer: int, population: Genome, company: Tensor, task: Task) -> Coevolution:
    """Fitness of a renewed subpopulation, and the best joined network if one of its networks beats it.

    Args:
        company: numbers that choose the random representatives, `r x layers x representatives`.
    """
    companions = _companions(state, company)
    scores = fitness(joined_errors(layer, population, companions, task))
    best_company, which = scores.max(-1)
    winner_fitness, winner = best_company.max(-1, keepdim=True)
    beside = which.gather(-1, winner)
    parts = [
        select(population, winner) if number == layer else select(companion, beside)
        for number, companion in enumerate(companions)
    ]
    renewed = replace(
        state,
        populations=_put(state.populations, layer, population),
        fitness=_put(state.fitness, layer, best_company),
    )
    return _keep_best(renewed, parts, winner_fitness.squeeze(-1))


def _companions(state: Coevolution, company: Tensor) -> list[Genome]:
    """Representatives by "optimization + randomization": the best of each subpopulation, then random ones.

    The best of a subpopulation is its part of the best joined network, which no other member has beaten.
    """
    companions = []
    for number, (population, best) in enumerate(zip(state.populations, state.best, strict=True)):
        others = select(population, (company[:, number] * population.mask.shape[1]).long())
        companions.append(joined([best, others], 1))
    return companions


def keep_refined(state: Coevolution, refined: Sequence[Genome], scores: Tensor) -> Coevolution:
    """Write refined networks into the elite where they are fitter than the best joined network.

    Args:
        refined: parts of complete networks, `r x 1 x ...`; weights without a connection are dropped.
        scores: their fitness, `r`.
    """
    return _keep_best(state, [Genome(g.mask, kept(*g)) for g in refined], scores)


def _keep_best(state: Coevolution, networks: Sequence[Genome], scores: Tensor) -> Coevolution:
    better = scores > state.best_fitness
    best, fittest = chosen(better, (tuple(networks), scores), (state.best, state.best_fitness))
    return replace(state, best=best, best_fitness=fittest)


def density(populations: Sequence[Genome]) -> Tensor:
    """Share of the possible connections that exist, mean over the individuals of each layer, `r x layers`."""
    return torch.stack([genome.mask.to(genome.weight.dtype).mean((1, 2, 3)) for genome in populations], dim=-1)


def diversity(populations: Sequence[Genome], weight_range: float) -> Tensor:
    """Spread of the individuals of each layer, `r x layers` [1].

    Standard deviation of a gene over the individuals, mean over genes, in units of the weight range; a missing
    connection counts as weight 0. Uniform random weights have about 0.58, a subpopulation of copies 0.
    """
    return torch.stack([genome.weight.std(1).mean((1, 2)) for genome in populations], dim=-1) / weight_range


def _put(values: tuple[_T, ...], index: int, value: _T) -> tuple[_T, ...]:
    return (*values[:index], value, *values[index + 1 :])
