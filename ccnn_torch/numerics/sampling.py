"""Random points."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.errors import InputError


def drawn_within(
    low: Tensor, high: Tensor, count: int, generator: torch.Generator, good: Callable[[Tensor], Tensor], wrong: str
) -> Tensor:
    """Points uniform in a box that are good (`s x d` to `s` bool), `count x d`; `wrong` where hardly any is."""
    found: list[Tensor] = []
    for _ in range(100):
        points = low + (high - low) * torch.rand(count, len(low), generator=generator, dtype=torch.float64)
        found.append(points[good(points)])
        if sum(map(len, found)) >= count:
            return torch.cat(found)[:count]
    raise InputError(wrong)
