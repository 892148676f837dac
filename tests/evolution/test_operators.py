"""The batched operators against the reference on encoded strings, given the same random numbers."""

from __future__ import annotations

import math

import pytest
import reference_operators as reference
import torch
from hypothesis import given, settings, strategies as st
from reference_operators import decode, encode
from torch import Tensor

from ccnn_torch.evolution import Genome
from ccnn_torch.evolution.genome import (
    active,
    crossover,
    flip_connections,
    nonuniform_mutation,
    select,
    swap_genes,
    tournament,
    weakest_draw,
)

Situation = tuple[Genome, Genome, bool, torch.Generator]

LEAD = (2, 3)


@st.composite
def situations(draw: st.DrawFn) -> Situation:
    """Two batches of parents of one shape, of any density from empty to full, and a generator for draws."""
    out, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    bias = draw(st.booleans())
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    density = draw(st.sampled_from([0.0, 0.2, 0.6, 1.0]))
    return make(out, width, bias, density, generator), make(out, width, bias, density, generator), bias, generator


def make(out: int, width: int, bias: bool, density: float, generator: torch.Generator) -> Genome:
    mask = rand((*LEAD, out, width), generator) < density
    weight = rand((*LEAD, out, width + bias), generator) * 4 - 2
    return Genome(mask, torch.where(active(Genome(mask, weight)), weight, torch.zeros_like(weight)))


def rand(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def individuals(genome: Genome) -> list[Genome]:
    masks, weights = genome.mask.flatten(0, 1), genome.weight.flatten(0, 1)
    return [Genome(mask, weight) for mask, weight in zip(masks, weights, strict=True)]


def strings(one: Genome, bias: bool) -> reference.Strings:
    """As the reference wants them: one string, an always-on bit for each bias."""
    bits, weights = encode(one.mask, one.weight)
    return "".join(row + "1" * bias for row in bits.split()), weights


def check(result: Genome, expected: list[reference.Strings], bias: bool) -> None:
    for one, (bits, weights) in zip(individuals(result), expected, strict=True):
        got_bits, got_weights = strings(one, bias)
        assert got_bits == bits
        # The paper's invariant: one weight for every 1.
        assert len(got_weights) == bits.count("1")
        assert got_weights == pytest.approx(weights, rel=1e-14, abs=1e-14)
        assert bool((one.weight[~active(one)] == 0).all())


@settings(max_examples=60, deadline=None)
@given(situations(), st.integers(1, 4))
def test_point_crossover_is_the_equivalent_crossover_of_the_strings(situation: Situation, count: int) -> None:
    first, second, bias, generator = situation
    shape = first.weight.shape[-2:]
    draws = rand((*LEAD, count), generator)
    swap = swap_genes(draws, math.prod(shape)).unflatten(-1, shape)
    one, two = crossover(first, second, swap)
    expected = []
    for a, b, draw in zip(individuals(first), individuals(second), draws.flatten(0, 1).tolist(), strict=True):
        cuts = [1 + int(value * (math.prod(shape) - 1)) for value in draw]
        expected.append(reference.crossover(strings(a, bias), strings(b, bias), cuts))
    check(one, [pair[0] for pair in expected], bias)
    check(two, [pair[1] for pair in expected], bias)


@settings(max_examples=60, deadline=None)
@given(situations(), st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_bit_flips_insert_and_delete_weights(situation: Situation, probability: float) -> None:
    genome, _, bias, generator = situation
    flips = rand(tuple(genome.mask.shape), generator) < probability
    fresh = rand(tuple(genome.mask.shape), generator) * 2 - 1
    never = flips.new_zeros((*flips.shape[:-1], int(bias)))
    with_bias = torch.cat([flips, never], -1).flatten(2).flatten(0, 1).tolist()
    news = torch.cat([fresh, torch.zeros_like(fresh[..., : int(bias)])], -1).flatten(2).flatten(0, 1).tolist()
    expected = [
        reference.flip(strings(one, bias), row, new)
        for one, row, new in zip(individuals(genome), with_bias, news, strict=True)
    ]
    check(flip_connections(genome, flips, fresh), expected, bias)


@settings(max_examples=60, deadline=None)
@given(situations(), st.integers(0, 120), st.floats(0.5, 3.0))
def test_nonuniform_mutation_follows_equations_12_and_13(situation: Situation, generation: int, b: float) -> None:
    genome, _, bias, generator = situation
    shape = tuple(genome.weight.shape)
    chosen, draws = rand(shape, generator) < 0.5, rand(shape, generator)
    result = nonuniform_mutation(genome, chosen, draws, generation / 120, -1.5, 2.5, b)
    expected = [
        reference.nonuniform(strings(one, bias), c, d, generation, 120, -1.5, 2.5, b)
        for one, c, d in zip(
            individuals(genome),
            chosen.flatten(2).flatten(0, 1).tolist(),
            draws.flatten(2).flatten(0, 1).tolist(),
            strict=True,
        )
    ]
    check(result, expected, bias)
    if generation == 120:
        assert torch.equal(result.weight, genome.weight)


@settings(max_examples=30, deadline=None)
@given(situations())
def test_the_weakest_draw_is_one_active_gene(situation: Situation) -> None:
    genome, _, _, generator = situation
    draws = rand(tuple(genome.weight.shape), generator)
    chosen = weakest_draw(genome, draws)
    places = active(genome)
    assert bool((chosen <= places).all())
    assert torch.equal(chosen.sum((-2, -1)), places.any(-1).any(-1).long())
    lowest = torch.where(places, draws, torch.inf).amin((-2, -1))
    found = chosen.any(-1).any(-1)
    assert torch.equal((draws * chosen).sum((-2, -1))[found], lowest[found])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 9), st.integers(1, 4))
def test_tournament_is_won_by_the_fittest_drawn(seed: int, size: int, contestants: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    fitness = (rand((2, size), generator) * 4).floor()
    draws = rand((2, 6, contestants), generator)
    winners = tournament(fitness, draws)
    expected = [[reference.tournament(fitness[r].tolist(), row) for row in draws[r].tolist()] for r in range(2)]
    assert winners.tolist() == expected


def test_individuals_are_selected_in_their_own_repeat() -> None:
    genome = make(2, 3, True, 0.5, torch.Generator().manual_seed(1))
    chosen = select(genome, torch.tensor([[2, 0, 2, 1], [1, 1, 0, 2]]))
    for repeat, row in enumerate([[2, 0, 2, 1], [1, 1, 0, 2]]):
        for place, number in enumerate(row):
            assert torch.equal(chosen.mask[repeat, place], genome.mask[repeat, number])
            assert torch.equal(chosen.weight[repeat, place], genome.weight[repeat, number])


def test_the_papers_example_of_the_encoding() -> None:
    """Section III-C, eqs. 8-10 and the weight strings below them."""
    layers = [
        ("11 10 11", [0.2, 0.4, -0.2, 0.1, 0.3], [[1, 1], [1, 0], [1, 1]]),
        ("011 001 100", [-0.3, 0.3, -0.1, 0.4], [[0, 1, 1], [0, 0, 1], [1, 0, 0]]),
        ("111", [0.1, -0.1, 0.2], [[1, 1, 1]]),
    ]
    for bits, weights, matrix in layers:
        genome = decode(bits, weights)
        assert genome.mask.int().tolist() == matrix
        assert genome.weight[genome.mask].tolist() == weights
        assert encode(genome.mask, genome.weight) == (bits, weights)
    middle = decode(*layers[1][:2]).weight
    assert middle.tolist() == [[0, -0.3, 0.3], [0, 0, -0.1], [0.4, 0, 0]]


def test_single_point_crossover_on_the_papers_strings() -> None:
    """Section III-D: cut 011 001 100 after its fourth bit; two ones stand before the cut, so two weights do."""
    first = decode("011 001 100", [-0.3, 0.3, -0.1, 0.4])
    second = decode("100 111 010", [1.0, 2.0, 3.0, 4.0, 5.0])
    swap = swap_genes(torch.tensor([[3.5 / 8]], dtype=torch.float64), 9).view(3, 3)
    one, two = crossover(first, second, swap)
    assert encode(*one) == ("011 011 010", [-0.3, 0.3, 3.0, 4.0, 5.0])
    assert encode(*two) == ("100 101 100", [1.0, 2.0, -0.1, 0.4])


@settings(max_examples=40, deadline=None)
@given(situations())
def test_encoding_and_back(situation: Situation) -> None:
    genome, _, bias, _ = situation
    for one in individuals(genome):
        again = decode(*encode(one.mask, one.weight), bias=bias)
        assert torch.equal(again.mask, one.mask)
        assert torch.equal(again.weight, one.weight)
