"""Which places a simulated machine is measured at: drawn, even, or planned for what they tell."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.runs.identification._places import Places
from ccnn_torch.runs.identification._random import generator_of
from ccnn_torch.runs.identify_config import IdentifyConfig

__all__ = ["choose_places"]


def choose_places(config: IdentifyConfig, places: Places, count: int, seeds: Sequence[int], stream: int) -> Tensor:
    """Places that need no plan, `s x .` (even, shared by the machines) or `r x s x .` (random, each its own)."""
    assert config.simulate is not None
    if config.simulate.design == "random":
        return torch.stack([places.random(count, generator_of(seed, stream)) for seed in seeds])
    return places.even(count)
