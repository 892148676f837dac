"""Fitness of masked networks 3-12-12-3 on 125 rows beside `torch.func.vmap`, EvoTorch, EvoX and a numpy loop."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from benchmarks.generation import toy_rows
from benchmarks.measure import Call, Row, compare
from benchmarks.peers import fitness_peers
from ccnn_torch.evolution.coevolution import make_task, network_errors
from ccnn_torch.evolution.genome import Genome

SIZES, ROWS = [3, 12, 12, 3], 125
# Networks that the numpy loop and the others are timed on at most: more take as long each, or longer, out of the cache.
LOOP, MOST = 240, 2400


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """Populations of 240 and more networks."""
    inputs, targets = toy_rows(SIZES, ROWS)
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets)
    task = make_task(x[None], y[None], torch.ones(1, ROWS, dtype=torch.float64))
    for count in (240, 800, 2400) if quick else (240, 2400, 24_000, 240_000):
        layers = networks(count)
        plain = [(layer.mask[0].numpy(), layer.weight[0].numpy()) for layer in layers]

        def loop(plain: list[tuple[np.ndarray, np.ndarray]] = plain) -> list[float]:
            return [one_by_one([(mask[k], weight[k]) for mask, weight in plain], inputs, targets) for k in range(LOOP)]

        few = [Genome(layer.mask[:, :MOST], layer.weight[:, :MOST]) for layer in layers]
        many = [part for layer in few for part in (layer.mask[0].double(), layer.weight[0])]
        flat = torch.cat([layer.weight[0].flatten(1) for layer in few], 1)
        vmapped: Call = torch.func.vmap(lambda *parts: row_errors(parts, x, y).mean())
        peers: dict[str, Call] = {"torch.func.vmap": partial(vmapped, *many)}
        peers |= fitness_peers(SIZES, row_errors, torch.cat([x, y], 1), flat)
        ours = network_errors(layers, task)[0].numpy()
        np.testing.assert_allclose(ours[:LOOP], loop(), rtol=1e-9)
        for call in peers.values():
            np.testing.assert_allclose(call(), ours[:MOST], rtol=1e-9)
        yield from compare(
            "fitness of networks 3-12-12-3, 125 rows",
            count,
            "networks",
            partial(network_errors, layers, task),
            {name: (call, min(1.0, MOST / count)) for name, call in peers.items()}
            | {"numpy loop": (loop, LOOP / count)},
            rounds=3 if quick or count > 24_000 else 5,
            flops=2.0 * ROWS * count * sum(a * b for a, b in pairwise(SIZES)),
        )


def networks(count: int) -> list[Genome]:
    """Random layers of so many networks, `1 x count x …`."""
    draw, layers = torch.Generator().manual_seed(0), []
    for into, out in pairwise(SIZES):
        mask = torch.rand(1, count, out, into, generator=draw) < 0.5
        weight = 2 * torch.rand(1, count, out, into + 1, generator=draw, dtype=torch.float64) - 1
        weight[..., :into] *= mask
        layers.append(Genome(mask, weight))
    return layers


def row_errors(parts: tuple[torch.Tensor, ...], x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """The error of one network in each row, whose mean eq. 11 takes."""
    signal, fed = x, torch.ones(x.shape[1], dtype=torch.float64)
    for layer in range(len(parts) // 2):
        mask, weight = parts[2 * layer], parts[2 * layer + 1]
        signal = signal @ weight[:, :-1].mT + weight[:, -1]
        if layer < len(parts) // 2 - 1:
            fed = ((mask @ fed) > 0).double()
            signal = torch.sigmoid(signal) * fed
    return (signal - y).square().sum(-1).sqrt()


def one_by_one(network: list[tuple[np.ndarray, np.ndarray]], x: np.ndarray, y: np.ndarray) -> float:
    """The same in numpy."""
    signal = x
    fed: np.ndarray = np.ones(x.shape[1], dtype=bool)
    for layer, (mask, weight) in enumerate(network):
        signal = signal @ weight[:, :-1].T + weight[:, -1]
        if layer + 1 < len(network):
            fed = np.any(mask & fed, axis=1)
            signal = fed / (1 + np.exp(-signal))
    return float(np.sqrt(((signal - y) ** 2).sum(1)).mean())
