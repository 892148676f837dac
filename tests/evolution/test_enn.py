"""The evolutionary network of one population: a naive evaluation, invariants of its generations, and what it learns."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from naive_network import output, random_layers
from torch import Tensor

from ccnn_torch.evolution.coevolution import EPSILON, make_task, network_errors
from ccnn_torch.evolution.genome import (
    ELITES,
    BreedingDraws,
    Genome,
    active,
    breed_networks,
    breeding_shapes,
    initial_population,
)
from ccnn_torch.evolution.random import uniform_parts
from ccnn_torch.evolution.settings import ENNSettings
from ccnn_torch.learners import TrainingData
from ccnn_torch.learners.enn import ENN
from ccnn_torch.numerics.blocks import memory_budget

SMALL = ENNSettings(hidden=(4, 3), population=24, generations=15, density=0.6)


def toy_data(seeds: list[int], rows: int = 40) -> TrainingData:
    generator = torch.Generator().manual_seed(3)
    inputs = 2 * torch.rand(len(seeds), rows, 2, generator=generator, dtype=torch.float64) - 1
    targets = torch.stack([inputs[..., 0] - inputs[..., 1] ** 2, torch.sin(2 * inputs[..., 1])], dim=-1)
    targets = (targets - targets.mean(1, keepdim=True)) / targets.std(1, keepdim=True, correction=0)
    return TrainingData(inputs, targets, torch.ones(len(seeds), rows, dtype=torch.float64), torch.tensor(seeds))


def history_of(learner: ENN, data: TrainingData) -> list[dict[str, Tensor]]:
    learner.start(data)
    history = []
    while not learner.finished:
        history.append(learner.step())
    return history


@pytest.mark.parametrize("most", [None, 10_000])
@pytest.mark.parametrize(("hidden", "bias"), [([4, 3], True), ([5], False), ([], True)])
def test_every_network_has_the_error_it_has_alone(hidden: list[int], bias: bool, most: int | None) -> None:
    data = toy_data([1, 2], rows=9)
    weights = data.weights.clone()
    weights[1, 7:] = 0
    generator = torch.Generator().manual_seed(5)
    layers = random_layers([2, *hidden, 2], (2, 6), 0.5, bias, generator)
    task = make_task(data.inputs, torch.where(weights.unsqueeze(-1) > 0, data.targets, torch.nan), weights)
    with memory_budget(most):
        found = network_errors(layers, task)
    for repeat in range(2):
        rows = int(weights[repeat].sum())
        for one in range(6):
            masks, reals = [g.mask[repeat, one] for g in layers], [g.weight[repeat, one] for g in layers]
            guess = torch.tensor([output(masks, reals, row.tolist()) for row in data.inputs[repeat, :rows]])
            error = (guess - data.targets[repeat, :rows]).norm(dim=-1).mean()
            torch.testing.assert_close(found[repeat, one], error, rtol=1e-6, atol=1e-7)


def test_layers_of_a_child_come_from_the_same_two_parents() -> None:
    """Every parent carries its number as its weights; nothing is cut inside a layer and nothing mutates by a step."""
    settings = ENNSettings(population=12, density=1.0, structural_mutation=0.0)
    layers = [
        initial_population(3, 2, settings, torch.arange(2), 1),
        initial_population(1, 3, settings, torch.arange(2), 2),
    ]
    numbers = torch.arange(12, dtype=torch.float64).view(1, 12, 1, 1)
    layers = [Genome(g.mask, torch.zeros_like(g.weight) + numbers) for g in layers]
    shapes = [breeding_shapes(g, settings) for g in layers]
    parts = uniform_parts(torch.arange(2), 0, 1, [*shapes[0], *shapes[1]])
    draws = [BreedingDraws(*parts[:7]), BreedingDraws(*parts[7:])]
    scores = torch.rand(2, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    children = breed_networks(layers, scores, settings, 1.0, draws)
    mixed = 0
    for repeat in range(2):
        for one in range(settings.population - ELITES):
            ancestors = [set(g.weight[repeat, one].unique().tolist()) for g in children]
            assert len(ancestors[0] | ancestors[1]) <= 2
            mixed += len(ancestors[0] | ancestors[1]) == 2
    assert mixed > 5


def test_fitness_never_falls_and_is_that_of_the_model() -> None:
    data = toy_data([1, 2, 3])
    learner = ENN(SMALL)
    history = history_of(learner, data)
    best = torch.stack([metrics["fitness_best"] for metrics in history])
    assert bool((best[1:] >= best[:-1]).all()) and bool((best[-1] > best[0]).all())
    error = (learner.predict(data.inputs) - data.targets).norm(dim=-1).mean(1)
    torch.testing.assert_close(best[-1], 1 / (error + EPSILON), rtol=1e-12, atol=0)
    assert torch.equal(history[-1]["evaluations"], torch.full((3,), 16 * 24, dtype=torch.float64))
    state = learner.state_dict()
    # The best network stands in the population; a place without a connection holds 0.
    for layer in range(3):
        genome = Genome(state[f"population_mask_{layer}"], state[f"population_weight_{layer}"])
        assert bool((genome.weight == state[f"best_weight_{layer}"]).all((2, 3)).any(1).all())
        assert bool((genome.weight[~active(genome)] == 0).all())
        assert bool((genome.weight.abs() <= SMALL.weight_range).all())


def test_repeats_do_not_depend_on_each_other() -> None:
    together = ENN(SMALL)
    history_of(together, toy_data([7, 7, 7]))
    alone = ENN(SMALL)
    data = toy_data([7, 7, 7])
    history_of(alone, TrainingData(data.inputs[1:2], data.targets[1:2], data.weights[1:2], data.seeds[1:2]))
    torch.testing.assert_close(alone.predict(data.inputs[1:2]), together.predict(data.inputs)[1:2], rtol=0, atol=1e-12)


def test_it_learns_a_smooth_function() -> None:
    data = toy_data([1, 2])
    learner = ENN(replace(SMALL, hidden=(6,), population=200, generations=120, density=0.8))
    history = history_of(learner, data)
    assert bool((history[-1]["error_train"] < 0.15).all()), history[-1]["error_train"]
    residual = (learner.predict(data.inputs) - data.targets).square().mean(1)
    variance = learner.variance(data.inputs).mean(1)
    assert bool(((variance > residual) & (variance < 3 * residual)).all())


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"population": 3}, "population"),
        ({"crossover": 1.5}, "crossover"),
        ({"hidden": [0]}, "hidden"),
        ({"generations": 0}, "generations"),
    ],
)
def test_settings_out_of_range_are_named(keys: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        ENNSettings(**keys)  # type: ignore[arg-type]
