"""Work in blocks that a budget of memory holds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from typing import TypeVar

from ccnn_torch.numerics.trees import joined

_Tree = TypeVar("_Tree")

# Of one step where nobody sets a budget. A constant, not a share of what is free: sums over other blocks differ in
# their last digit, and a seed gives the same digits on every machine. On one core normal matrices of 4,000 rows take a
# third less time in blocks of so much than all at once.
_DEFAULT = 1 << 27
_budget: ContextVar[int | None] = ContextVar("memory_budget", default=None)


@contextmanager
def memory_budget(max_bytes: int | None) -> Iterator[None]:
    """Bound what the steps within may allocate at a time, in bytes; None, or more than a step takes, = its default."""
    token = _budget.set(max_bytes)
    try:
        yield
    finally:
        _budget.reset(token)


def block_size(bytes_each: int, default: int = _DEFAULT) -> int:
    """How many rows, networks or numbers of `bytes_each` the budget holds, 1 at least; `default` bytes at most."""
    budget = _budget.get()
    return max(1, (default if budget is None else min(default, budget)) // max(1, bytes_each))


def blocks(count: int, bytes_each: int, default: int = _DEFAULT) -> Iterator[slice]:
    """Slices that cover `count` rows or networks, as few and as even as the budget allows; one where there are none."""
    number = max(1, -(-count // block_size(bytes_each, default)))
    ends = [count * k // number for k in range(number + 1)]
    return (slice(first, end) for first, end in pairwise(ends))


def in_blocks(of: Callable[[slice, slice], _Tree], count: Sequence[int], each: int, size: int, dim: int = 1) -> _Tree:
    """`of` of some rows and columns at a time, put together.

    Args:
        count: how many rows and columns; a block has few columns before it has few rows.
        each: numbers that one column of one row takes, at least 1.
        size: numbers of a block, about.
        dim: dimension of the columns in the tensors that `of` gives; that of the rows is 0.
    """
    rows, columns = count
    wide = min(columns, max(1, size // each))
    high = max(1, size // (each * wide))
    return joined(
        [
            joined([of(slice(r, r + high), slice(c, c + wide)) for c in range(0, columns, wide)], dim)
            for r in range(0, rows, high)
        ]
    )
