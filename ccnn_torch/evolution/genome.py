"""Genomes of a subpopulation: encoding, selection, crossover, mutation, breeding (the paper, sections III-B to F).

Bits are in row order (row = node of the later layer). The weight string holds the weight of every 1, in the same
order; where the network has biases, a node's bias follows the weights of its row.

Every random number is an argument, so that an operator can be held against a plain one-individual-at-a-time version
that is given the same numbers. The length of the paper's weight string is the number of ones by construction: each
operator leaves 0 where there is no connection, and a weight travels with its bit.

Individuals are single layers (a subpopulation of the coevolution) or, in several layers with shared parents, whole
networks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evolution.random import uniform
from ccnn_torch.evolution.settings import EvolutionSettings
from ccnn_torch.numerics.trees import joined, mapped


class Genome(NamedTuple):
    """Individuals of one layer of connections.

    The paper's weight string has one real for every 1 of the mask. Here the weights keep their place in the matrix, and
    a place without a connection holds exactly 0, so that a forward pass needs no masking.

    Attributes:
        mask: which connections exist, `... x out x in`, bool.
        weight: `... x out x in`, or `... x out x (in + 1)` with the bias in the last column, which is always on.
    """

    mask: Tensor
    weight: Tensor


def named_genomes(prefix: str, layers: Iterable[Genome]) -> dict[str, Tensor]:
    """All tensors by name, as `PREFIXmask_0`."""
    return {f"{prefix}{name}_{n}": value for n, layer in enumerate(layers) for name, value in layer._asdict().items()}


def genomes_of(named: dict[str, Tensor]) -> list[Genome]:
    """Inverse of `named_genomes` without a prefix; what else is there is left aside."""
    layers = range(sum(name.startswith("mask_") for name in named))
    return [Genome(named[f"mask_{layer}"], named[f"weight_{layer}"]) for layer in layers]


def active(genome: Genome) -> Tensor:
    """Genes that carry a weight: the connections and, where there is one, the bias column; shape of the weights."""
    mask, weight = genome
    if mask.shape[-1] == weight.shape[-1]:
        return mask
    return torch.cat([mask, mask.new_ones((*mask.shape[:-1], 1))], dim=-1)


def kept(mask: Tensor, weight: Tensor) -> Tensor:
    """Weights, 0 where there is no connection; arguments and result as those of a `Genome`."""
    return torch.where(active(Genome(mask, weight)), weight, 0.0)


def select(genome: Genome, index: Tensor) -> Genome:
    """Individuals by number. genome: `r x p x ...`; index: `r x c`, int64; returns `r x c x ...`."""
    repeats, individuals = genome.mask.shape[:2]
    start = torch.arange(0, repeats * individuals, individuals, device=index.device)
    flat = (index + start.unsqueeze(-1)).flatten()

    def pick(values: Tensor) -> Tensor:
        return values.flatten(0, 1).index_select(0, flat).view(repeats, index.shape[1], *values.shape[2:])

    return Genome(pick(genome.mask), pick(genome.weight))


def tournament(fitness: Tensor, draws: Tensor) -> Tensor:
    """Tournament selection with replacement.

    Args:
        fitness: `r x p`.
        draws: uniform numbers, `r x c x t`, t = contestants of one tournament.

    Returns:
        Number of each winner, `r x c`, int64; of equal contestants the first drawn.
    """
    contestants = (draws * fitness.shape[-1]).long()
    scores = fitness.gather(-1, contestants.flatten(1)).view_as(contestants)
    return contestants.gather(-1, scores.argmax(-1, keepdim=True)).squeeze(-1)


def swap_genes(draws: Tensor, genes: int) -> Tensor:
    """Which genes two parents exchange: the row-order string is cut, and its segments are exchanged alternately.

    Args:
        draws: uniform numbers, `... x cuts` (one: single-point), each a cut at one of the places 1 .. genes - 1; two at
            one place cancel.
        genes: length of the string.

    Returns:
        `... x genes`, bool.
    """
    cuts = 1 + (draws * (genes - 1)).long()
    places = torch.arange(genes, device=draws.device)
    return (places >= cuts.unsqueeze(-1)).sum(-2) % 2 == 1


def crossover(first: Genome, second: Genome, swap: Tensor) -> tuple[Genome, Genome]:
    """Equivalent crossover (III-D): the cut in the weight string follows the ones before the cut in the bit string.

    With weights kept at the place of their bits that is one exchange of the same genes in both tensors.

    Args:
        first, second: parents, `... x out x in`.
        swap: genes to exchange, `... x out x in`, or `... x out x (in + 1)` where there are biases.
    """
    bits = swap[..., : first.mask.shape[-1]]
    return (
        Genome(torch.where(bits, second.mask, first.mask), torch.where(swap, second.weight, first.weight)),
        Genome(torch.where(bits, first.mask, second.mask), torch.where(swap, first.weight, second.weight)),
    )


def flip_connections(genome: Genome, flip: Tensor, fresh: Tensor) -> Genome:
    """Bit-flip mutation: a connection that appears gets a fresh weight, one that vanishes loses its own.

    Args:
        flip: bits to change, `... x out x in`, bool.
        fresh: weights for those that appear, `... x out x in`.
    """
    mask = genome.mask ^ flip
    kept = genome.weight[..., : mask.shape[-1]]
    weight = torch.where(flip, torch.where(mask, fresh, torch.zeros_like(fresh)), kept)
    return Genome(mask, torch.cat([weight, genome.weight[..., mask.shape[-1] :]], dim=-1))


def weakest_draw(genome: Genome, draws: Tensor) -> Tensor:
    """The one active gene of each individual with the smallest draw: an unbiased choice of a gene to mutate.

    Args:
        draws: uniform numbers, shape of the weights.

    Returns:
        bool, shape of the weights; all False for an individual without any weight.
    """
    places = active(genome)
    lowest = draws.masked_fill(~places, 1.0)
    return (lowest == lowest.amin((-2, -1), keepdim=True)) & places


def nonuniform_mutation(
    genome: Genome, chosen: Tensor, draws: Tensor, progress: float, low: float, high: float, exponent: float
) -> Genome:
    """Non-uniform mutation, eqs. 12-13: steps that shrink with the generations.

    Args:
        chosen: weights to change, shape of the weights, bool; places without a connection are left at 0.
        draws: uniform numbers, shape of the weights. One number serves both: below 1/2 the weight goes up (rand = 0 in
            eq. 12), above it down, and its fraction of that half is r of eq. 13.
        progress: t / T in [0, 1].
        low, high: LD and UD. A weight outside (a refined one may be) is drawn back towards the range.
        exponent: b.
    """
    doubled = draws * 2
    up = doubled < 1
    share = 1 - torch.where(up, doubled, doubled - 1) ** ((1 - progress) ** exponent)
    stepped = genome.weight + torch.where(up, high - genome.weight, low - genome.weight) * share
    return Genome(genome.mask, torch.where(chosen & active(genome), stepped, genome.weight))


ELITES = 2
"""Individuals that survive unchanged: the part of the best joined network, and the next best."""
# What the paper leaves open and what made no difference on its cases: contestants of one tournament, cut points of a
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
    half = (settings.population - ELITES + 1) // 2
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
    count = settings.population - ELITES
    return mapped(lambda one, other: torch.cat([one, other], 1)[:, :count], first, second)


def with_elites(children: Genome, population: Genome, fitness: Tensor, best: Genome) -> Genome:
    """Elites before the children: the part of the best joined network, then the best of the population.

    Individuals as fit as the best of their subpopulation are copies of that part and not taken twice.

    Args:
        best: that part, `r x 1 x ...`.
    """
    others = fitness.masked_fill(fitness == fitness.amax(-1, keepdim=True), -torch.inf)
    return joined([best, select(population, others.topk(ELITES - 1, dim=-1).indices), children], 1)
