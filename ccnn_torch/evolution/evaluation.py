"""Errors of individuals joined with representatives of the other layers (paper 000, section III-A, eq. 11, III-E).

An individual is evaluated in `k` complete networks: set k of representatives with the individual in its own layer. What
joined networks share is computed once: layers before the individual once a set, and layers after it as one wide matrix
product a set over all individuals. Activations lie as ``[r, k, out, p, s]``, samples last: products write them in
place over the bias, and the sigmoid (most of the time) runs over contiguous memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evolution.genome import Genome
from ccnn_torch.numerics.blocks import block_size

# Input of an unfed node: sigmoid(-1e4) is exactly 0, and unlike -inf it never makes a NaN.
_FORCED_OFF = -1e4
# Doubles in one block of activations. On a CPU small blocks lose more to thin matrix products than they win in the
# cache (measured: flat from 2^18 to 2^20, a third slower at 2^22); an accelerator wants to be filled.
_BLOCK = {"cpu": 1 << 19}
_BLOCK_ELSEWHERE = 1 << 26
# Copies of a block that are held at a time.
_COPIES = 3


class Task(NamedTuple):
    """Training rows, laid out for evaluation.

    Attributes:
        inputs: `r x i x s`.
        targets: `r x o x s`.
        shares: row weights that sum to 1, `r x s`; padded rows have 0.
    """

    inputs: Tensor
    targets: Tensor
    shares: Tensor


def make_task(inputs: Tensor, targets: Tensor, weights: Tensor) -> Task:
    """Rows as a learner gets them (`r x s x i`, `r x s x o`, `r x s`) to a `Task`."""
    there = (weights > 0).unsqueeze(-1)
    # A padded row may hold anything, NaN included: 0 times NaN would still spoil the mean.
    clean = [torch.where(there, rows, torch.zeros_like(rows)) for rows in (inputs, targets)]
    return Task(
        clean[0].transpose(-2, -1).contiguous(),
        clean[1].transpose(-2, -1).contiguous(),
        weights / weights.sum(-1, keepdim=True),
    )


EPSILON = 1e-6
"""Added to the error in eq. 11, on standardised outputs."""


def fitness(errors: Tensor) -> Tensor:
    """Eq. 11: 1 / (mean Euclidean output error + epsilon)."""
    return 1 / (errors + EPSILON)


class _Signal(NamedTuple):
    """Activations `b x out x (p s)` with b = r k (or r, while all sets share them), and fed nodes `b x out x p`."""

    values: Tensor
    fed: Tensor
    shared: bool


class _Step(NamedTuple):
    """One layer for one batch of matrices: `b x (out p) x in`, the same for the mask, and biases `b x out x p`."""

    weight: Tensor
    connected: Tensor
    offset: Tensor


def joined_errors(
    layer: int, population: Genome, representatives: Sequence[Genome], task: Task, block: int | None = None
) -> Tensor:
    """Mean Euclidean output error of every joined network.

    Args:
        layer: the layer that the individuals belong to.
        population: `r x p x ...`.
        representatives: one a layer, `r x k x ...`; that of `layer` itself is not read.
        block: number of activations computed at a time; None = what suits the device.

    Returns:
        `r x p x k` [1].
    """
    repeats, individuals = population.mask.shape[:2]
    sets = representatives[0].mask.shape[1]
    widest = max(genome.mask.shape[-2] for genome in representatives)
    each = max(1, sets * widest * task.inputs.shape[-1])
    block = block or _block(population.weight.device)
    columns = min(individuals, max(1, block // each))
    rows = max(1, block // (each * columns))
    if rows >= repeats and columns >= individuals:
        return _errors(layer, population, representatives, task)
    parts = []
    for start in range(0, repeats, rows):
        here = slice(start, start + rows)
        fixed = [Genome(g.mask[here], g.weight[here]) for g in representatives]
        rows_task = Task(*(part[here] for part in task))
        pieces = [
            _errors(
                layer,
                Genome(population.mask[here, c : c + columns], population.weight[here, c : c + columns]),
                fixed,
                rows_task,
            )
            for c in range(0, individuals, columns)
        ]
        parts.append(torch.cat(pieces, dim=1))
    return torch.cat(parts)


def network_errors(networks: Sequence[Genome], task: Task, block: int | None = None) -> Tensor:
    """Mean Euclidean output error of whole networks: sets of representatives without an individual among them.

    Args:
        networks: one layer of all networks each, `r x p x ...`.
        block: as in `joined_errors`.

    Returns:
        `r x p` [1].
    """
    repeats, count = networks[0].mask.shape[:2]
    each = max(genome.mask.shape[-2] for genome in networks) * task.inputs.shape[-1]
    block = block or _block(task.inputs.device)
    columns = min(count, max(1, block // each))
    rows = max(1, block // (each * columns))
    parts = []
    for start in range(0, repeats, rows):
        here = slice(start, start + rows)
        rows_task = Task(*(part[here] for part in task))
        pieces = [
            _errors(
                None,
                None,
                [Genome(g.mask[here, c : c + columns], g.weight[here, c : c + columns]) for g in networks],
                rows_task,
            )
            for c in range(0, count, columns)
        ]
        parts.append(torch.cat(pieces, dim=-1))
    return torch.cat(parts)[:, 0]


def _block(device: torch.device) -> int:
    """Activations at a time: what suits the device, and the budget of memory holds (in, out, and the masks')."""
    return block_size(_COPIES * 8, _COPIES * 8 * _BLOCK.get(device.type, _BLOCK_ELSEWHERE))


def _errors(layer: int | None, population: Genome | None, representatives: Sequence[Genome], task: Task) -> Tensor:
    """Errors of the individuals of one layer with every set, or (no layer) of the sets themselves: `r x p x k`."""
    repeats = len(task.inputs)
    individuals = 1 if population is None else population.mask.shape[1]
    sets, samples = representatives[0].mask.shape[1], task.inputs.shape[-1]
    signal = _Signal(task.inputs, task.inputs.new_ones(repeats, task.inputs.shape[1], 1), True)
    last = len(representatives) - 1
    for number, genome in enumerate(representatives):
        if population is not None and number == layer:
            step = _individuals(population, 1 if signal.shared else sets)
        else:
            step = _sets(genome, signal.shared)
        signal = _advance(signal, step, samples, task.targets if number == last else None, sets)
        if number != layer and signal.shared:
            # The wide product has the sets beside each other in its rows: `r x (k out) x (p s)`.
            signal = _Signal(
                signal.values.view(repeats * sets, -1, signal.values.shape[-1]),
                signal.fed.view(repeats * sets, -1, signal.fed.shape[-1]),
                False,
            )
    outputs = task.targets.shape[1]
    kept = 1 if signal.shared else sets
    distances = signal.values.view(repeats, kept, outputs, individuals, samples).square_().sum(2).sqrt_()
    means = torch.matmul(distances.flatten(1, 2), task.shares.unsqueeze(-1)).view(repeats, kept, individuals)
    return means.transpose(1, 2).expand(repeats, individuals, sets)


def _individuals(population: Genome, sets: int) -> _Step:
    """The individuals' layer as one tall matrix a repeat, rows ordered (out, p), repeated for each set."""
    mask, weight = population
    repeats, count, out, width = mask.shape

    def tall(values: Tensor) -> Tensor:
        rows = values.transpose(1, 2).reshape(repeats, 1, out * count, width)
        return rows.expand(-1, sets, -1, -1).reshape(repeats * sets, out * count, width)

    offset = _bias(population).transpose(1, 2).unsqueeze(1).expand(-1, sets, -1, -1)
    return _Step(tall(weight[..., :width]), tall(mask.to(weight.dtype)), offset.reshape(-1, out, count))


def _sets(genome: Genome, shared: bool) -> _Step:
    """A layer of representatives: one wide matrix over all sets for shared signals, else one matrix a set."""
    mask, weight = genome
    repeats, sets, out, width = mask.shape
    shape = (repeats, sets * out) if shared else (repeats * sets, out)
    return _Step(
        weight[..., :width].reshape(*shape, width),
        mask.to(weight.dtype).view(*shape, width),
        _bias(genome).reshape(*shape, 1),
    )


def _bias(genome: Genome) -> Tensor:
    width = genome.mask.shape[-1]
    if genome.weight.shape[-1] > width:
        return genome.weight[..., width]
    return genome.weight.new_zeros(genome.weight.shape[:-1])


def _advance(signal: _Signal, step: _Step, samples: int, targets: Tensor | None, sets: int) -> _Signal:
    """One layer: hidden (targets None) with sigmoid and forced zeros, or output, from which the targets are taken."""
    batch = len(step.weight)
    fed = torch.bmm(step.connected, signal.fed).view(batch, step.offset.shape[1], -1) > 0
    if targets is None:
        start = torch.where(fed, step.offset, _FORCED_OFF).unsqueeze(-1)
        values = start.expand(*fed.shape, samples).contiguous()
    else:
        repeats, outputs, _ = targets.shape
        offset = step.offset.view(repeats, -1, outputs, step.offset.shape[-1], 1)
        offset = offset.expand(-1, -1, -1, fed.shape[-1], -1)
        values = targets.new_empty(repeats, offset.shape[1], outputs, fed.shape[-1], samples)
        torch.sub(offset, targets.view(repeats, 1, outputs, 1, samples), out=values)
    values = values.view(batch, step.weight.shape[1], -1)
    values.baddbmm_(step.weight, signal.values)
    if targets is None:
        values.sigmoid_()
    return _Signal(values.view(batch, step.offset.shape[1], -1), fed.to(values.dtype), signal.shared)
