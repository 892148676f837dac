"""Tensors in one structure, entry by entry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.numerics.trees import chosen, joined, picked, put


class Pair(NamedTuple):
    values: Tensor
    other: Tensor | None


@dataclass(frozen=True)
class State:
    pairs: list[Pair]
    count: Tensor
    name: str


def state(first: int, count: int) -> State:
    """Three entries, numbered from `first` on."""
    values = torch.arange(first, first + 3)
    return State([Pair(values, None), Pair(values[:, None].repeat(1, 2), values)], torch.tensor(count), f"from {first}")


def numbers(tree: State) -> list[int]:
    """The entries, the same everywhere."""
    values = tree.pairs[0].values
    assert tree.pairs[0].other is None and torch.equal(tree.pairs[1].values, values[:, None].repeat(1, 2))
    assert tree.pairs[1].other is not None and torch.equal(tree.pairs[1].other, values)
    return values.tolist()


def test_entries_are_picked_put_chosen_and_joined_in_every_tensor_at_once() -> None:
    one, other = state(0, 7), state(10, 8)
    assert numbers(picked(one, torch.tensor([2, 0]))) == [2, 0] and numbers(picked(one, slice(1))) == [0]
    assert numbers(put(one, torch.tensor([1]), picked(other, torch.tensor([2])))) == [0, 12, 2]
    assert numbers(chosen(torch.tensor([True, False, True]), one, other)) == [0, 11, 2]
    assert joined([one.pairs, other.pairs])[0].values.tolist() == [0, 1, 2, 10, 11, 12]


def test_a_counter_belongs_to_all_and_what_is_no_tensor_stays() -> None:
    one, other = state(0, 7), state(10, 8)
    assert int(picked(one, torch.tensor([1])).count) == 7
    assert int(put(one, torch.tensor([1]), picked(other, torch.tensor([1]))).count) == 8
    assert int(chosen(torch.tensor([False, False, False]), one, other).count) == 7
    assert put(one, torch.tensor([1]), picked(other, torch.tensor([1]))).name == "from 0"
