"""A subpopulation as two tensors: which connections exist, and their weights (paper 000, section III-B and C)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Genome(NamedTuple):
    """Individuals of one layer of connections.

    The paper's weight string has one real for every 1 of the mask. Here the weights keep their place in the matrix, and
    a place without a connection holds exactly 0, so that a forward pass needs no masking.

    Attributes:
        mask: which connections exist, `... x out x in`, bool.
        weight: `... x out x in`, or `... x out x (in + 1)` with the bias in the last column, which is always on.
    """

    mask: Tensor
    weight: Tensor


def active(genome: Genome) -> Tensor:
    """Genes that carry a weight: the connections and, where there is one, the bias column; shape of the weights."""
    mask, weight = genome
    if mask.shape[-1] == weight.shape[-1]:
        return mask
    return torch.cat([mask, mask.new_ones((*mask.shape[:-1], 1))], dim=-1)


def kept(mask: Tensor, weight: Tensor) -> Tensor:
    """Weights, 0 where there is no connection; arguments and result as those of a `Genome`."""
    return torch.where(active(Genome(mask, weight)), weight, 0.0)


def select(genome: Genome, index: Tensor) -> Genome:
    """Individuals by number. genome: `r x p x ...`; index: `r x c`, int64; returns `r x c x ...`."""
    repeats, individuals = genome.mask.shape[:2]
    start = torch.arange(0, repeats * individuals, individuals, device=index.device)
    flat = (index + start.unsqueeze(-1)).flatten()

    def pick(values: Tensor) -> Tensor:
        return values.flatten(0, 1).index_select(0, flat).view(repeats, index.shape[1], *values.shape[2:])

    return Genome(pick(genome.mask), pick(genome.weight))
