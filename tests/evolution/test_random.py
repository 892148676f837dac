"""The stateless generator: known answers, distribution, and independence of seeds, streams and counters."""

from __future__ import annotations

import torch
from scipy import stats

from ccnn_torch.evolution.random import _GOLDEN, _mix_, member_seeds, uniform


def test_the_mixer_is_splitmix64() -> None:
    """First outputs of the published generator for the seed 1234567."""
    states = 1234567 + torch.arange(1, 4, dtype=torch.int64) * _GOLDEN
    unsigned = [word % 2**64 for word in _mix_(states).tolist()]
    assert unsigned == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_numbers_are_uniform_in_the_open_interval() -> None:
    numbers = uniform(torch.arange(20), 3, 17, (50_001,))
    assert numbers.shape == (20, 50_001)
    assert numbers.dtype == torch.float64
    assert 0 < float(numbers.min()) < 1e-4 and 1 - 1e-4 < float(numbers.max()) < 1
    flat = numbers.flatten().numpy()
    # 1e6 numbers: five standard errors.
    assert abs(flat.mean() - 1 / 2) < 5 * (1 / 12) ** 0.5 / 1e3
    assert abs(flat.var() - 1 / 12) < 5 * (1 / 180) ** 0.5 / 1e3
    assert stats.kstest(flat, "uniform").pvalue > 1e-3
    assert min(stats.kstest(row, "uniform").pvalue for row in numbers.numpy()) > 1e-4


def test_neighbouring_numbers_seeds_streams_and_counters_are_independent() -> None:
    base = uniform(torch.tensor([5]), 2, 9, (100_000,))[0]
    others = {
        "next number": base.roll(1),
        "second next": base.roll(2),
        "seed": uniform(torch.tensor([6]), 2, 9, (100_000,))[0],
        "stream": uniform(torch.tensor([5]), 3, 9, (100_000,))[0],
        "counter": uniform(torch.tensor([5]), 2, 10, (100_000,))[0],
        "stream and counter exchanged": uniform(torch.tensor([5]), 9, 2, (100_000,))[0],
    }
    for name, other in others.items():
        assert not torch.equal(base, other), name
        assert stats.pearsonr(base.numpy(), other.numpy()).pvalue > 1e-4, name
        table = torch.histogramdd(torch.stack([base, other], -1), [8, 8], [0.0, 1.0, 0.0, 1.0]).hist
        assert stats.chisquare(table.flatten().numpy()).pvalue > 1e-4, name


def test_a_repeat_draws_the_same_whatever_stands_beside_it() -> None:
    together = uniform(torch.tensor([8, -3, 2**62]), 1, 4, (6, 7))
    for k, seed in enumerate((8, -3, 2**62)):
        assert torch.equal(uniform(torch.tensor([seed]), 1, 4, (6, 7))[0], together[k])
    assert torch.equal(uniform(torch.tensor([8]), 1, 4, (21,))[0], together[0].flatten()[:21])


def test_members_of_a_repeat_have_seeds_of_their_own() -> None:
    seeds = member_seeds(torch.arange(200), 5)
    assert torch.equal(seeds[:, 0], torch.arange(200))
    assert len(torch.unique(seeds)) == 1000
    assert torch.equal(member_seeds(torch.tensor([7]), 3)[0], seeds[7, :3])


def test_no_seeds_or_numbers_repeat() -> None:
    numbers = uniform(torch.arange(1000), 0, 0, (10,))
    assert len(torch.unique(numbers)) > 9_990
