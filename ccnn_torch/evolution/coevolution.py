"""Cooperative coevolution of the layers of a network (Zhang and Gao 2012, section III-A and F), all repeats at once.

An individual is evaluated in `k` complete networks: set k of representatives with the individual in its own layer. What
joined networks share is computed once: layers before the individual once a set, and layers after it as one wide matrix
product a set over all individuals. Activations lie as ``[r, k, out, p, s]``, samples last: products write them in
place over the bias, and the sigmoid (most of the time) runs over contiguous memory.

The subpopulations take turns within a generation: each is renewed and judged beside the newest members of the others
(Potter and De Jong 2000, whom the paper follows), and what one gains the next can build on at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from ccnn_torch.evolution.genome import (
    BreedingDraws,
    Genome,
    breed_networks,
    breeding_shapes,
    initial_population,
    select,
    with_elites,
)
from ccnn_torch.evolution.random import uniform_parts
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.numerics.blocks import block_size, in_blocks
from ccnn_torch.numerics.trees import chosen, joined, mapped, picked

# Input of an unfed node: sigmoid(-1e4) is exactly 0, and unlike -inf it never makes a NaN.
_FORCED_OFF = -1e4
# Doubles in one block of activations. On a CPU small blocks lose more to thin matrix products than they win in the
# cache (measured: flat from 2^18 to 2^20, a third slower at 2^22); an accelerator wants to be filled.
_BLOCK = {"cpu": 1 << 19}
_BLOCK_ELSEWHERE = 1 << 26
# Copies of a block that are held at a time.
_COPIES = 3


class Task(NamedTuple):
    """Training rows, laid out for evaluation.

    Attributes:
        inputs: `r x i x s`.
        targets: `r x o x s`.
        shares: row weights that sum to 1, `r x s`; padded rows have 0.
    """

    inputs: Tensor
    targets: Tensor
    shares: Tensor


def make_task(inputs: Tensor, targets: Tensor, weights: Tensor) -> Task:
    """Rows as a learner gets them (`r x s x i`, `r x s x o`, `r x s`) to a `Task`."""
    there = (weights > 0).unsqueeze(-1)
    # A padded row may hold anything, NaN included: 0 times NaN would still spoil the mean.
    clean = [torch.where(there, rows, torch.zeros_like(rows)) for rows in (inputs, targets)]
    return Task(
        clean[0].transpose(-2, -1).contiguous(),
        clean[1].transpose(-2, -1).contiguous(),
        weights / weights.sum(-1, keepdim=True),
    )


EPSILON = 1e-6
"""Added to the error in eq. 11, on standardised outputs."""


def fitness(errors: Tensor) -> Tensor:
    """Eq. 11: 1 / (mean Euclidean output error + epsilon)."""
    return 1 / (errors + EPSILON)


class _Signal(NamedTuple):
    """Activations `b x out x (p s)` with b = r k (or r, while all sets share them), and fed nodes `b x out x p`."""

    values: Tensor
    fed: Tensor
    shared: bool


class _Step(NamedTuple):
    """One layer for one batch of matrices: `b x (out p) x in`, the same for the mask, and biases `b x out x p`."""

    weight: Tensor
    connected: Tensor
    offset: Tensor


def joined_errors(layer: int, population: Genome, representatives: Sequence[Genome], task: Task) -> Tensor:
    """Mean Euclidean output error of every joined network.

    Args:
        layer: the layer that the individuals belong to.
        population: `r x p x ...`.
        representatives: one a layer, `r x k x ...`; that of `layer` itself is not read.

    Returns:
        `r x p x k` [1].
    """
    sets = representatives[0].mask.shape[1]

    def judged(here: slice, some: slice) -> Tensor:
        own = mapped(lambda value: value[here, some], population)
        return _errors(layer, own, picked(list(representatives), here), picked(task, here))

    return _in_blocks(judged, population, sets * _widest(representatives), task)


def network_errors(networks: Sequence[Genome], task: Task) -> Tensor:
    """Mean Euclidean output error of whole networks: sets of representatives without an individual among them.

    Args:
        networks: one layer of all networks each, `r x p x ...`.

    Returns:
        `r x p` [1].
    """

    def judged(here: slice, some: slice) -> Tensor:
        own = mapped(lambda value: value[here, some], list(networks))
        return _errors(None, None, own, picked(task, here))[:, 0]

    return _in_blocks(judged, networks[0], _widest(networks), task)


def _widest(layers: Sequence[Genome]) -> int:
    return max(genome.mask.shape[-2] for genome in layers)


def _in_blocks(judged: Callable[[slice, slice], Tensor], population: Genome, width: int, task: Task) -> Tensor:
    """`judged` of some repeats and individuals at a time, `r x p x ...`; width: activations each and row."""
    # What suits the device, and the budget of memory holds (in, out, and the masks').
    suits = _BLOCK.get(task.inputs.device.type, _BLOCK_ELSEWHERE)
    size = block_size(_COPIES * 8, _COPIES * 8 * suits)
    return in_blocks(judged, population.mask.shape[:2], max(1, width * task.inputs.shape[-1]), size)


def _errors(layer: int | None, population: Genome | None, representatives: Sequence[Genome], task: Task) -> Tensor:
    """Errors of the individuals of one layer with every set, or (no layer) of the sets themselves: `r x p x k`."""
    repeats = len(task.inputs)
    individuals = 1 if population is None else population.mask.shape[1]
    sets, samples = representatives[0].mask.shape[1], task.inputs.shape[-1]
    signal = _Signal(task.inputs, task.inputs.new_ones(repeats, task.inputs.shape[1], 1), True)
    last = len(representatives) - 1
    for number, genome in enumerate(representatives):
        if population is not None and number == layer:
            step = _individuals(population, 1 if signal.shared else sets)
        else:
            step = _sets(genome, signal.shared)
        signal = _advance(signal, step, samples, task.targets if number == last else None)
        if number != layer and signal.shared:
            # The wide product has the sets beside each other in its rows: `r x (k out) x (p s)`.
            signal = _Signal(
                signal.values.view(repeats * sets, -1, signal.values.shape[-1]),
                signal.fed.view(repeats * sets, -1, signal.fed.shape[-1]),
                False,
            )
    outputs = task.targets.shape[1]
    kept = 1 if signal.shared else sets
    distances = signal.values.view(repeats, kept, outputs, individuals, samples).square_().sum(2).sqrt_()
    means = torch.matmul(distances.flatten(1, 2), task.shares.unsqueeze(-1)).view(repeats, kept, individuals)
    return means.transpose(1, 2).expand(repeats, individuals, sets)


def _individuals(population: Genome, sets: int) -> _Step:
    """The individuals' layer as one tall matrix a repeat, rows ordered (out, p), repeated for each set."""
    mask, weight = population
    repeats, count, out, width = mask.shape

    def tall(values: Tensor) -> Tensor:
        rows = values.transpose(1, 2).reshape(repeats, 1, out * count, width)
        return rows.expand(-1, sets, -1, -1).reshape(repeats * sets, out * count, width)

    offset = _bias(population).transpose(1, 2).unsqueeze(1).expand(-1, sets, -1, -1)
    return _Step(tall(weight[..., :width]), tall(mask.to(weight.dtype)), offset.reshape(-1, out, count))


def _sets(genome: Genome, shared: bool) -> _Step:
    """A layer of representatives: one wide matrix over all sets for shared signals, else one matrix a set."""
    mask, weight = genome
    repeats, sets, out, width = mask.shape
    shape = (repeats, sets * out) if shared else (repeats * sets, out)
    return _Step(
        weight[..., :width].reshape(*shape, width),
        mask.to(weight.dtype).view(*shape, width),
        _bias(genome).reshape(*shape, 1),
    )


def _bias(genome: Genome) -> Tensor:
    width = genome.mask.shape[-1]
    if genome.weight.shape[-1] > width:
        return genome.weight[..., width]
    return genome.weight.new_zeros(genome.weight.shape[:-1])


def _advance(signal: _Signal, step: _Step, samples: int, targets: Tensor | None) -> _Signal:
    """One layer: hidden (targets None) with sigmoid and forced zeros, or output, from which the targets are taken."""
    batch = len(step.weight)
    fed = torch.bmm(step.connected, signal.fed).view(batch, step.offset.shape[1], -1) > 0
    if targets is None:
        start = torch.where(fed, step.offset, _FORCED_OFF).unsqueeze(-1)
        values = start.expand(*fed.shape, samples).contiguous()
    else:
        repeats, outputs, _ = targets.shape
        offset = step.offset.view(repeats, -1, outputs, step.offset.shape[-1], 1)
        offset = offset.expand(-1, -1, -1, fed.shape[-1], -1)
        values = targets.new_empty(repeats, offset.shape[1], outputs, fed.shape[-1], samples)
        torch.sub(offset, targets.view(repeats, 1, outputs, 1, samples), out=values)
    values = values.view(batch, step.weight.shape[1], -1)
    values.baddbmm_(step.weight, signal.values)
    if targets is None:
        values.sigmoid_()
    return _Signal(values.view(batch, step.offset.shape[1], -1), fed.to(values.dtype), signal.shared)


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
        (children,) = breed_networks([population], scores, settings, progress, [draws])
        renewed = with_elites(children, population, scores, state.best[layer])
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
    scores = winner_fitness.squeeze(-1)
    best, fittest = chosen(scores > state.best_fitness, (tuple(parts), scores), (state.best, state.best_fitness))
    return replace(renewed, best=best, best_fitness=fittest)


def _companions(state: Coevolution, company: Tensor) -> list[Genome]:
    """Representatives by "optimization + randomization": the best of each subpopulation, then random ones.

    The best of a subpopulation is its part of the best joined network, which no other member has beaten.
    """
    companions = []
    for number, (population, best) in enumerate(zip(state.populations, state.best, strict=True)):
        others = select(population, (company[:, number] * population.mask.shape[1]).long())
        companions.append(joined([best, others], 1))
    return companions


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
