"""Errors of joined networks: every one of them against the same network evaluated alone, node by node."""

from __future__ import annotations

import math

import naive_network as naive
import pytest
import torch
from hypothesis import given, settings, strategies as st

from ccnn_torch.evolution.coevolution import fitness, joined_errors, make_task
from ccnn_torch.numerics.blocks import memory_budget

REPEATS, INDIVIDUALS, SETS, ROWS = 2, 3, 2, 4


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from([[3, 4, 3, 2], [2, 3, 1], [3, 2], [2, 3, 2, 2, 2]]),
    st.sampled_from([0.0, 0.3, 0.7, 1.0]),
    st.booleans(),
    st.sampled_from([None, 1, 1500]),
    st.integers(0, 2**31),
)
def test_every_joined_network_has_the_error_it_has_alone(
    sizes: list[int], density: float, bias: bool, most: int | None, seed: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    populations = naive.random_layers(sizes, (REPEATS, INDIVIDUALS), density, bias, generator)
    representatives = naive.random_layers(sizes, (REPEATS, SETS), density, bias, generator)
    inputs = torch.randn(REPEATS, ROWS, sizes[0], generator=generator, dtype=torch.float64)
    targets = torch.randn(REPEATS, ROWS, sizes[-1], generator=generator, dtype=torch.float64)
    weights = torch.rand(REPEATS, ROWS, generator=generator, dtype=torch.float64)
    weights[1, -1] = 0
    task = make_task(inputs, targets, weights)
    for layer, population in enumerate(populations):
        with memory_budget(most):
            errors = joined_errors(layer, population, representatives, task)
        assert errors.shape == (REPEATS, INDIVIDUALS, SETS)
        for r in range(REPEATS):
            for p in range(INDIVIDUALS):
                for k in range(SETS):
                    joined = [(g, k) for g in representatives]
                    joined[layer] = (population, p)
                    masks = [genome.mask[r, number] for genome, number in joined]
                    reals = [genome.weight[r, number] for genome, number in joined]
                    expected = 0.0
                    for row in range(ROWS):
                        out = naive.output(masks, reals, inputs[r, row].tolist())
                        expected += float(weights[r, row]) * math.dist(out, targets[r, row].tolist())
                    expected /= float(weights[r].sum())
                    assert float(errors[r, p, k]) == pytest.approx(expected, rel=1e-11)


def test_rows_of_weight_0_may_hold_anything() -> None:
    generator = torch.Generator().manual_seed(1)
    layers = naive.random_layers([3, 4, 2], (1, 5), 0.8, True, generator)
    inputs = torch.randn(1, 6, 3, generator=generator, dtype=torch.float64)
    targets = torch.randn(1, 6, 2, generator=generator, dtype=torch.float64)
    weights = torch.tensor([[1.0, 2, 1, 1, 0, 0]], dtype=torch.float64)
    clean = joined_errors(0, layers[0], layers, make_task(inputs[:, :4], targets[:, :4], weights[:, :4]))
    inputs[:, 4], targets[:, 5] = torch.nan, torch.inf
    padded = joined_errors(0, layers[0], layers, make_task(inputs, targets, weights))
    assert torch.allclose(padded, clean, rtol=1e-13, atol=0)


def test_fitness_is_equation_11() -> None:
    """One sample off by (3, 4), one exact: mean distance 2.5."""
    errors = torch.tensor([2.5, 0.0], dtype=torch.float64)
    assert fitness(errors).tolist() == pytest.approx([1 / (2.5 + 1e-6), 1e6])
