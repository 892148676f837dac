"""The paper's operators one individual at a time, on the strings of section III-C: the oracle of the batched ones.

Strings carry a bias as one more bit at the end of each row that is always 1.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.evolution import Genome
from ccnn_torch.evolution.genome import active

Strings = tuple[str, list[float]]


def encode(mask: Tensor, weight: Tensor) -> Strings:
    """Rows of bits separated by blanks (eqs. 8-10: ``"11 10 11"``), and the weights of the ones."""
    bits = " ".join("".join("1" if bit else "0" for bit in row) for row in mask.tolist())
    return bits, weight[active(Genome(mask, weight))].tolist()


def decode(bits: str, weights: Sequence[float], bias: bool = False) -> Genome:
    """Inverse of `encode`."""
    mask = torch.tensor([[bit == "1" for bit in row] for row in bits.split()])
    weight = torch.zeros(len(mask), mask.shape[1] + bias, dtype=torch.float64)
    weight[active(Genome(mask, weight))] = torch.tensor(list(weights), dtype=torch.float64)
    return Genome(mask, weight)


def crossover(first: Strings, second: Strings, cuts: list[int]) -> tuple[Strings, Strings]:
    """Exchange alternate segments of the bit strings, and the segments of the weight strings that belong to them."""
    children: list[tuple[str, list[float]]] = [("", []), ("", [])]
    places = [0, *sorted(cuts), len(first[0])]
    for segment, (start, end) in enumerate(itertools.pairwise(places)):
        pair = (first, second) if segment % 2 == 0 else (second, first)
        for child, (bits, weights) in enumerate(pair):
            # Equivalent crossover: as many weights stand before the cut as ones.
            ones_before, ones_until = bits[:start].count("1"), bits[:end].count("1")
            children[child] = (
                children[child][0] + bits[start:end],
                children[child][1] + weights[ones_before:ones_until],
            )
    return children[0], children[1]


def flip(strings: Strings, flips: list[bool], fresh: list[float]) -> Strings:
    """Bit-flip mutation: insert a weight for a bit that becomes 1, delete that of one that becomes 0."""
    bits, weights = "", []
    queue = list(strings[1])
    for bit, flipped, new in zip(strings[0], flips, fresh, strict=True):
        own = queue.pop(0) if bit == "1" else None
        if flipped:
            bit, own = ("0", None) if bit == "1" else ("1", new)
        bits += bit
        if own is not None:
            weights.append(own)
    return bits, weights


def nonuniform(
    strings: Strings,
    chosen: list[bool],
    draws: list[float],
    generation: int,
    last: int,
    low: float,
    high: float,
    b: float,
) -> Strings:
    """Eqs. 12-13. chosen, draws: one for every place of the bit string; those of absent bits are not read."""
    weights = []
    queue = list(strings[1])
    for place, bit in enumerate(strings[0]):
        if bit == "0":
            continue
        weight = queue.pop(0)
        if chosen[place]:
            draw = draws[place]

            def step(y: float, r: float) -> float:
                return float(y * (1 - r ** ((1 - generation / last) ** b)))

            weight += step(high - weight, 2 * draw) if draw < 0.5 else -step(weight - low, 2 * draw - 1)
        weights.append(weight)
    return strings[0], weights


def tournament(fitness: list[float], draws: list[float]) -> int:
    """The fittest of those drawn, the first drawn of equals."""
    winner = None
    for draw in draws:
        candidate = int(draw * len(fitness))
        if winner is None or fitness[candidate] > fitness[winner]:
            winner = candidate
    assert winner is not None
    return winner
