"""The next generation of a population: elites, selection, crossover, hybrid mutation (paper 000, III-D and F).

Individuals are single layers (a subpopulation of the coevolution) or, in several layers with shared parents, whole
networks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evolution.genome import Genome, kept, select
from ccnn_torch.evolution.operators import (
    crossover,
    flip_connections,
    nonuniform_mutation,
    swap_genes,
    tournament,
    weakest_draw,
)
from ccnn_torch.evolution.random import uniform
from ccnn_torch.evolution.settings import EvolutionSettings
from ccnn_torch.numerics.trees import joined, mapped

# What paper 000 leaves open and what made no difference on its cases: contestants of one tournament, cut points of a
# crossover. b of eq. 13 is the paper's.
CONTESTANTS, CUTS, EXPONENT = 3, 2, 2.0


class BreedingDraws(NamedTuple):
    """Uniform numbers that one generation of one subpopulation takes; h = half the number of children.

    Attributes:
        contestants: `r x 2h x t`.
        pairs: whether a pair is crossed, `r x h`.
        places: cut places, `r x h x cuts`.
        flips, fresh: bits that flip, and the weights of those that appear, `r x h x out x in`.
        genes, steps: which weights mutate, and how far, `r x h x out x (in or in + 1)`.
    """

    contestants: Tensor
    pairs: Tensor
    places: Tensor
    flips: Tensor
    fresh: Tensor
    genes: Tensor
    steps: Tensor


def breeding_shapes(population: Genome, settings: EvolutionSettings) -> list[tuple[int, ...]]:
    """Shapes of `BreedingDraws` for one repeat."""
    half = (settings.population - settings.elites + 1) // 2
    bits, reals = tuple(population.mask.shape[2:]), tuple(population.weight.shape[2:])
    return [
        (2 * half, CONTESTANTS),
        (half,),
        (half, CUTS),
        (half, *bits),
        (half, *bits),
        (half, *reals),
        (half, *reals),
    ]


def initial_population(outputs: int, inputs: int, settings: EvolutionSettings, seeds: Tensor, stream: int) -> Genome:
    """Random structures of the stated density, weights uniform in the range; `r x population x out x in (+ 1)`."""
    size = settings.population
    draws = uniform(seeds, stream, 0, (size, outputs, 2 * inputs + settings.bias))
    mask = draws[..., :inputs] < settings.density
    weight = (draws[..., inputs:] * 2 - 1) * settings.weight_range
    return Genome(mask, kept(mask, weight))


def breed(
    population: Genome, fitness: Tensor, settings: EvolutionSettings, progress: float, draws: BreedingDraws
) -> Genome:
    """Children of one subpopulation, `r x (population - elites) x ...`.

    Args:
        population: `r x p x ...`.
        fitness: `r x p`.
        progress: t / T of eq. 13.
    """
    return breed_networks([population], fitness, settings, progress, [draws])[0]


def breed_networks(
    layers: Sequence[Genome],
    fitness: Tensor,
    settings: EvolutionSettings,
    progress: float,
    draws: Sequence[BreedingDraws],
) -> list[Genome]:
    """Children whose layers come from the same two parents: a whole network is crossed or not, and cut in every layer.

    Args:
        layers: `r x p x ...` each.
        fitness: `r x p`.
        progress: t / T of eq. 13.
        draws: one a layer; contestants and pairs are those of the first.
    """
    chosen, crossed = tournament(fitness, draws[0].contestants), draws[0].pairs < settings.crossover
    return [
        _children(select(layer, chosen), crossed, settings, progress, numbers)
        for layer, numbers in zip(layers, draws, strict=True)
    ]


def _children(
    parents: Genome, crossed: Tensor, settings: EvolutionSettings, progress: float, draws: BreedingDraws
) -> Genome:
    """Two parents give two children. The first of each pair goes to structural mutation, the second to non-uniform
    mutation of its weights: the paper's hybrid search, half and half.

    Args:
        parents: mothers, then as many fathers, `r x 2h x ...`.
        crossed: which pairs are crossed, `r x h`.
    """
    half = crossed.shape[1]
    mothers, fathers = mapped(lambda value: value[:, :half], parents), mapped(lambda value: value[:, half:], parents)
    shape = parents.weight.shape[2:]
    swap = swap_genes(draws.places, math.prod(shape)).reshape(-1, half, *shape)
    first, second = crossover(mothers, fathers, swap & crossed[..., None, None])
    limit = settings.weight_range
    first = flip_connections(first, draws.flips < settings.structural_mutation, (draws.fresh * 2 - 1) * limit)
    chosen = (draws.genes < settings.weight_mutation) | weakest_draw(second, draws.genes)
    second = nonuniform_mutation(second, chosen, draws.steps, progress, -limit, limit, EXPONENT)
    count = settings.population - settings.elites
    return mapped(lambda one, other: torch.cat([one, other], 1)[:, :count], first, second)


def with_elites(
    children: Genome, population: Genome, fitness: Tensor, best: Genome, settings: EvolutionSettings
) -> Genome:
    """Elites before the children: the part of the best joined network, then the best of the population.

    Individuals as fit as the best of their subpopulation are copies of that part and not taken twice.

    Args:
        best: that part, `r x 1 x ...`.
    """
    parts = [best]
    if settings.elites > 1:
        others = fitness.masked_fill(fitness == fitness.amax(-1, keepdim=True), -torch.inf)
        parts.append(select(population, others.topk(settings.elites - 1, dim=-1).indices))
    parts.append(children)
    return joined(parts, 1)
