"""Random numbers of simulated machines: each a function of (seed, stream, …)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def generator_of(*seeds: int) -> torch.Generator:
    """A generator of its own for each tuple of seeds; numpy's hashing makes neighbouring seeds independent."""
    state = np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(state >> np.uint64(1)))


def normal_draws(shape: Sequence[int], seeds: Sequence[int], *stream: int) -> Tensor:
    """Standard normal numbers, `r x shape`; machine k's depend on its own seed alone."""
    draws = [torch.randn(tuple(shape), generator=generator_of(s, *stream), dtype=torch.float64) for s in seeds]
    return torch.stack(draws)
