"""A budget of memory: steps stay within it, and give what they give without it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from ccnn_torch.evolution.coevolution import make_task, network_errors
from ccnn_torch.evolution.gauss_newton import linearise, network_of, residual
from ccnn_torch.evolution.genome import Genome
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.learners import TrainingData
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.learners.gp import GaussianProcess, GPSettings
from ccnn_torch.numerics.blocks import blocks, memory_budget
from ccnn_torch.training import train

_MB = 1 << 20


def peak(call: Callable[[], Tensor]) -> tuple[int, Tensor]:
    """Largest sum of what tensors held at a time, beside what was there before [bytes], and the result."""
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as seen:
        found = call()
    assert seen.profiler is not None and seen.profiler.kineto_results is not None
    events = seen.profiler.kineto_results.events()
    held = most = 0
    for _, change in sorted((e.start_ns(), e.nbytes()) for e in events if e.name() == "[memory]"):
        held += change
        most = max(most, held)
    return most, found


def normal_matrices() -> Callable[[], Tensor]:
    """Of four networks on 4,000 rows, and their residuals."""
    draw = torch.Generator().manual_seed(0)
    shapes = list(pairwise((3, 12, 12, 3)))
    network = network_of([torch.rand(4, out, into, generator=draw) < 0.6 for into, out in shapes], True)
    flat, x, y = (
        torch.randn(4, *size, generator=draw, dtype=torch.float64)
        for size in ((network.active.shape[-1],), (4000, 3), (4000, 3))
    )
    ones = torch.ones_like(y)
    return lambda: torch.cat(
        [linearise(network, flat, x, y, None, ones).matrix.flatten(), residual(network, flat, x, y, None).flatten()]
    )


def fitness() -> Callable[[], Tensor]:
    """Of 3,000 networks on 125 rows."""
    draw = torch.Generator().manual_seed(0)
    layers = [
        Genome(
            torch.ones(1, 3000, out, into, dtype=torch.bool),
            torch.rand(1, 3000, out, into + 1, generator=draw).double(),
        )
        for into, out in pairwise((3, 12, 3))
    ]
    x = torch.rand(1, 125, 3, generator=draw).double()
    task = make_task(x, x, torch.ones(1, 125, dtype=torch.float64))
    return lambda: network_errors(layers, task)


def gaussian_process() -> Callable[[], Tensor]:
    """Two steps for eight repeats of 200 rows, and predictions."""
    draw = torch.Generator().manual_seed(0)
    x = torch.rand(8, 200, 2, generator=draw).double()
    data = TrainingData(x, torch.sin(3 * x), torch.ones(8, 200, dtype=torch.float64), torch.arange(8))

    def call() -> Tensor:
        learner = GaussianProcess(GPSettings(steps=2))
        train(learner, data)
        return learner.predict(x)

    return call


@pytest.mark.parametrize(
    ("make", "budgets", "beside"),
    [
        # Beside the rows' share six matrices of all weights stay, and the residuals, which are asked for.
        (normal_matrices, (64 * _MB, 12 * _MB), 6 * _MB),
        # The weights of all networks laid out for products.
        (fitness, (4 * _MB, _MB), 3 * _MB),
        # States and predictions of all repeats.
        (gaussian_process, (16 * _MB, 4 * _MB), 6 * _MB),
    ],
)
def test_steps_stay_within_a_budget_and_give_the_same(
    make: Callable[[], Callable[[], Tensor]], budgets: tuple[int, ...], beside: int
) -> None:
    call = make()
    with memory_budget(1 << 40):
        free, wanted = peak(call)
    taken = []
    for budget in budgets:
        with memory_budget(budget):
            most, found = peak(call)
        assert most <= budget + beside
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)
        taken.append(most)
    assert sorted(taken, reverse=True) == taken and taken[-1] < 0.75 * free


def test_a_training_is_the_same_with_networks_one_by_one() -> None:
    draw = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(2, 60, 2, generator=draw).double() - 1
    data = TrainingData(x, torch.sin(3 * x), torch.ones(2, 60, dtype=torch.float64), torch.arange(2))
    settings = CCNNSettings(
        hidden=(6,), rival_hidden=(), population=8, generations=1, members=2, waves=2, wave_searches=1
    )
    found = []
    for budget in (1 << 40, 1 << 15):
        learner = CCNN(settings)
        with memory_budget(budget):
            train(learner, data)
        found.append(learner.predict(x))
    torch.testing.assert_close(*found, rtol=1e-6, atol=1e-6)


def test_blocks_cover_everything_once_and_evenly() -> None:
    with memory_budget(100):
        assert [(b.start, b.stop) for b in blocks(10, 30)] == [(0, 2), (2, 5), (5, 7), (7, 10)]
        assert [(b.start, b.stop) for b in blocks(3, 1000)] == [(0, 1), (1, 2), (2, 3)]
        assert [(b.start, b.stop) for b in blocks(0, 1)] == [(0, 0)]
