"""Masked networks with periodic nodes: forward pass, dead nodes (the paper, section III-E), averages, pruning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ccnn_torch.evolution.genome import Genome, genomes_of, kept, named_genomes
from ccnn_torch.evolution.waves import Waves, wave_signal
from ccnn_torch.numerics.trees import mapped


def fed_nodes(masks: Sequence[Tensor]) -> list[Tensor]:
    """Hidden nodes that some network input reaches; biases do not count as inputs.

    The others are forced to output 0 (sigmoid(0) is not 0, and a node fed by its bias alone is a constant that belongs
    into the next bias). A node without outputs needs no forcing: it is not read.

    Args:
        masks: one a layer, `... x out x in`, bool.

    Returns:
        One a hidden layer, `... x out`, bool.
    """
    fed: list[Tensor] = []
    for mask in masks[:-1]:
        reaching = mask & fed[-1].unsqueeze(-2) if fed else mask
        fed.append(reaching.any(-1))
    return fed


def alive_nodes(masks: Sequence[Tensor]) -> list[Tensor]:
    """Hidden nodes on a path from an input to an output: all others can be deleted without changing a number.

    Returns:
        One a hidden layer, `... x out`, bool.
    """
    alive = fed_nodes(masks)
    for layer in range(len(alive) - 1, -1, -1):
        # Behind the nodes of the last hidden layer, the output's connections to periodic nodes may follow.
        after = masks[layer + 1][..., : masks[layer].shape[-2]]
        if layer + 1 < len(alive):
            after = after & alive[layer + 1].unsqueeze(-1)
        alive[layer] = alive[layer] & after.any(-2)
    return alive


def forward(masks: Sequence[Tensor], weights: Sequence[Tensor], inputs: Tensor, waves: Waves | None = None) -> Tensor:
    """Sigmoid hidden layers, linear output; unfed nodes give 0.

    Args:
        masks, weights: one a layer, `... x out x in` and `... x out x (in or in + 1)`; weights without a connection
            are ignored.
        inputs: `... x s x i`; the first layer reads as many of them, from the first on, as its mask has columns.
        waves: periodic nodes beside the last hidden layer, `... x k`, for which the output's mask and weights have
            columns behind those of that layer: k sines, then k cosines.

    Returns:
        `... x s x o`.
    """
    signal = hidden_signal(masks, weights, inputs, waves)
    return _affine(signal, kept(masks[-1], weights[-1]))


def hidden_signal(
    masks: Sequence[Tensor], weights: Sequence[Tensor], inputs: Tensor, waves: Waves | None = None
) -> Tensor:
    """What the output layer reads, `... x s x h`: last hidden layer (or inputs), then waves; arguments as `forward`."""
    fed = fed_nodes(masks)
    signal = inputs[..., : masks[0].shape[-1]] if len(masks) > 1 else inputs[..., : _width(masks, waves)]
    for mask, weight, reached in zip(masks[:-1], weights[:-1], fed, strict=True):
        signal = torch.sigmoid(_affine(signal, kept(mask, weight))) * reached.unsqueeze(-2)
    if waves is None:
        return signal
    periodic = wave_signal(waves, inputs)
    leading = np.broadcast_shapes(signal.shape[:-2], periodic.shape[:-2])
    return torch.cat([part.expand(*leading, *part.shape[-2:]) for part in (signal, periodic)], -1)


def _width(masks: Sequence[Tensor], waves: Waves | None) -> int:
    """Columns of the output's mask that are not of waves."""
    return masks[-1].shape[-1] - (0 if waves is None else 2 * waves.frequency.shape[-1])


def _affine(signal: Tensor, weight: Tensor) -> Tensor:
    width = signal.shape[-1]
    product = signal @ weight[..., :width].transpose(-2, -1)
    return product + weight[..., width].unsqueeze(-2) if weight.shape[-1] > width else product


def _side_by_side(blocks: Tensor, first: bool, last: bool) -> Tensor:
    """Matrices `... x m x out x in` of networks that share the inputs (first layer) or add up in the outputs (last)."""
    if first and last:
        return blocks.sum(-3)
    if first:
        return blocks.flatten(-3, -2)
    if last:
        return blocks.transpose(-3, -2).flatten(-2)
    members = blocks.shape[-3]
    apart = torch.eye(members, dtype=blocks.dtype, device=blocks.device)[:, None, :, None]
    return (blocks.unsqueeze(-2) * apart).flatten(-2).flatten(-3, -2)


def prune(masks: Sequence[Tensor], weights: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """One network without its dead nodes; the same numbers from smaller matrices.

    A network without any path from input to output keeps no hidden layer: one layer without connections is left,
    whose bias is the constant output.

    Args:
        masks, weights: one a layer, `out x in` and `out x (in or in + 1)`.
    """
    weights = [kept(m, w) for m, w in zip(masks, weights, strict=True)]
    alive = alive_nodes(masks)
    if alive and not bool(alive[0].any()):
        outputs, inputs = len(masks[-1]), masks[0].shape[-1]
        behind = weights[-1][:, masks[-2].shape[-2] :]
        waves = masks[-1][:, masks[-2].shape[-2] :]
        return (
            [torch.cat([waves.new_zeros(outputs, inputs), waves], dim=-1)],
            [torch.cat([behind.new_zeros(outputs, inputs), behind], dim=-1)],
        )
    small_masks, small_weights = [], []
    for layer, (mask, weight) in enumerate(zip(masks, weights, strict=True)):
        rows = alive[layer] if layer < len(alive) else mask.new_ones(len(mask))
        columns = alive[layer - 1] if layer > 0 else mask.new_ones(mask.shape[-1])
        columns = torch.cat([columns, columns.new_ones(mask.shape[-1] - len(columns))])
        with_bias = torch.cat([columns, columns.new_ones(weight.shape[-1] - mask.shape[-1])])
        small_masks.append(mask[rows][:, columns])
        small_weights.append(weight[rows][:, with_bias])
    return small_masks, small_weights


class Bundle(NamedTuple):
    """Networks of one shape.

    Attributes:
        masks, weights: one a layer, `... x out x in` and `... x out x (in or in + 1)`; those of the output have two
            columns for each slot of a periodic node behind those of the last hidden layer.
        waves: `... x k`.
    """

    masks: list[Tensor]
    weights: list[Tensor]
    waves: Waves

    @property
    def slots(self) -> int:
        """Slots for periodic nodes of each network."""
        return self.waves.frequency.shape[-1]

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return named_genomes("", map(Genome, self.masks, self.weights)) | self.waves._asdict()

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> Bundle:
        """Inverse of `tensors`."""
        masks, weights = zip(*genomes_of(tensors), strict=True)
        return cls(list(masks), list(weights), Waves(tensors["source"], tensors["frequency"]))


def resized(bundle: Bundle, slots: int) -> Bundle:
    """The same networks with fewer free slots for periodic nodes (the last ones go), or more."""
    have = bundle.slots
    hidden = bundle.masks[-1].shape[-1] - 2 * have

    def fitted(values: Tensor) -> Tensor:
        return nn.functional.pad(values, (0, slots - have)) if slots > have else values[..., :slots]

    return Bundle(
        [*bundle.masks[:-1], with_slots(bundle.masks[-1], hidden, have, fitted)],
        [*bundle.weights[:-1], with_slots(bundle.weights[-1], hidden, have, fitted)],
        mapped(fitted, bundle.waves),
    )


def with_slots(values: Tensor, hidden: int, slots: int, fitted: Callable[[Tensor], Tensor]) -> Tensor:
    """Columns of hidden nodes, then those of the slots' sines and of their cosines as `fitted` makes them, the rest."""
    parts = torch.split(values, [hidden, slots, slots, values.shape[-1] - hidden - 2 * slots], -1)
    return torch.cat([parts[0], fitted(parts[1]), fitted(parts[2]), parts[3]], -1)


def averaged(bundle: Bundle) -> Bundle:
    """The mean of the `m` networks along the last leading dimension, `... x m`, as one: they stand side by side.

    A hidden layer has m times the nodes, with blocks of zeros between networks, and there are m times the slots.
    """
    masks, weights, waves = bundle
    members, last, slots = masks[0].shape[-3], len(masks) - 1, bundle.slots
    wide_masks, wide_weights = [], []
    for layer, (mask, weight) in enumerate(zip(masks, weights, strict=True)):
        width = mask.shape[-1]
        connected = kept(mask, weight)
        parts = [mask, connected[..., :width], connected[..., width:]]
        if layer == last:
            # Outputs are summed, so every share is divided.
            parts = [mask, connected[..., :width] / members, connected[..., width:].mean(-3)]
        if layer == last and slots:
            hidden = width - 2 * slots
            connections = [
                torch.cat(
                    [_side_by_side(piece[0], layer == 0, True), *(_side_by_side(p, False, True) for p in piece[1:])], -1
                )
                for piece in (torch.split(part, [hidden, slots, slots], -1) for part in parts[:2])
            ]
        else:
            connections = [_side_by_side(part, layer == 0, layer == last) for part in parts[:2]]
        bias = parts[2] if layer == last else parts[2].flatten(-3, -2)
        wide_masks.append(connections[0] > 0)
        wide_weights.append(torch.cat([connections[1], bias], dim=-1))
    return Bundle(wide_masks, wide_weights, Waves(waves.source.flatten(-2), waves.frequency.flatten(-2)))
