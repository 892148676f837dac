"""Tensors in tuples, lists, dicts and dataclasses, all at once: picked, put, chosen, joined by their leading dimension.

A counter, a tensor without dimensions, belongs to all: it is neither picked from nor put into.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

_Tree = TypeVar("_Tree")


def mapped(function: Callable[..., Tensor], tree: _Tree, *others: _Tree) -> _Tree:
    """The same structure with `function` of the tensors at each place; what is no tensor stays as in the first."""

    def made(*parts: Any) -> Any:
        first = parts[0]
        if isinstance(first, Tensor):
            return function(*parts)
        if isinstance(first, list | tuple):
            values = [made(*own) for own in zip(*parts, strict=True)]
            return type(first)(*values) if hasattr(first, "_fields") else type(first)(values)
        if isinstance(first, dict):
            return {name: made(*(part[name] for part in parts)) for name in first}
        if dataclasses.is_dataclass(first) and not isinstance(first, type):
            names = [f.name for f in dataclasses.fields(first)]
            return type(first)(**{name: made(*(getattr(part, name) for part in parts)) for name in names})
        return first

    found: _Tree = made(tree, *others)
    return found


def picked(tree: _Tree, index: Tensor | slice) -> _Tree:
    """The entries `index` of every tensor."""
    return mapped(lambda value: value[index] if value.dim() else value, tree)


def put(tree: _Tree, index: Tensor, part: _Tree) -> _Tree:
    """With the entries `index` (int64) renewed; a counter is that of the part."""
    return mapped(lambda old, new: old.index_copy(0, index, new) if old.dim() else new, tree, part)


def chosen(first: Tensor, one: _Tree, other: _Tree) -> _Tree:
    """Entry by entry `one` where `first` (bool, their leading dimensions) is set; a counter is that of `one`."""

    def choose(ours: Tensor, theirs: Tensor) -> Tensor:
        if not ours.dim():
            return ours
        return torch.where(first.view(*first.shape, *[1] * (ours.dim() - first.dim())), ours, theirs)

    return mapped(choose, one, other)


def joined(trees: Sequence[_Tree], dim: int = 0) -> _Tree:
    """All tensors concatenated."""
    return mapped(lambda *parts: torch.cat(parts, dim), *trees)


def below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Those whose name has the prefix, by the rest of it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
