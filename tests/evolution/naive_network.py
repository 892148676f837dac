"""A network evaluated node by node in plain Python, dead nodes deleted one by one: the oracle of the batched code."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from ccnn_torch.evolution import Genome
from ccnn_torch.evolution.genome import active


def random_layers(
    sizes: list[int], lead: tuple[int, ...], density: float, bias: bool, generator: torch.Generator
) -> list[Genome]:
    """One genome a layer, `lead x out x in`; 0 where there is no connection."""
    layers = []
    for before, after in itertools.pairwise(sizes):
        mask = torch.rand(*lead, after, before, generator=generator) < density
        weight = 4 * torch.rand(*lead, after, before + bias, generator=generator, dtype=torch.float64) - 2
        layers.append(Genome(mask, torch.where(active(Genome(mask, weight)), weight, torch.zeros_like(weight))))
    return layers


def dead_nodes(masks: list[Tensor], outputs_too: bool) -> list[set[int]]:
    """Hidden nodes to delete: again and again any without an input (or, if wanted, without an output) that is left."""
    matrices = [mask.tolist() for mask in masks]
    dead: list[set[int]] = [set() for _ in masks[:-1]]
    changed = True
    while changed:
        changed = False
        for layer, gone in enumerate(dead):
            before = dead[layer - 1] if layer else set()
            after = dead[layer + 1] if layer + 1 < len(dead) else set()
            for node, row in enumerate(matrices[layer]):
                inputs = [j for j, bit in enumerate(row) if bit and j not in before]
                outputs = [i for i, later in enumerate(matrices[layer + 1]) if later[node] and i not in after]
                if node not in gone and (not inputs or (outputs_too and not outputs)):
                    gone.add(node)
                    changed = True
    return dead


def output(masks: list[Tensor], weights: list[Tensor], row: list[float]) -> list[float]:
    """Output for one row; dead nodes give 0."""
    dead = dead_nodes(masks, outputs_too=True)
    signal = row
    for layer, (mask, weight) in enumerate(zip(masks, weights, strict=True)):
        after = []
        for node, (bits, reals) in enumerate(zip(mask.tolist(), weight.tolist(), strict=True)):
            total = sum(w * s for bit, w, s in zip(bits, reals, signal, strict=False) if bit)
            total += reals[len(bits)] if len(reals) > len(bits) else 0.0
            if layer < len(dead):
                after.append(0.0 if node in dead[layer] else 1 / (1 + math.exp(-total)))
            else:
                after.append(total)
        signal = after
    return signal
