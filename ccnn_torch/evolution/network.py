"""Masked networks: forward pass, dead nodes (paper 000, section III-E), pruning, and the plain module for export."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from ccnn_torch.evolution.genome import Genome, active

__all__ = ["MaskedNetwork", "alive_nodes", "average", "fed_nodes", "forward", "hidden_signal", "prune"]


def fed_nodes(masks: Sequence[Tensor]) -> list[Tensor]:
    """Hidden nodes that some network input reaches; biases do not count as inputs.

    The others are forced to output 0 (sigmoid(0) is not 0, and a node fed by its bias alone is a constant that belongs
    into the next bias). A node without outputs needs no forcing: nobody reads it.

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
        after = masks[layer + 1]
        if layer + 1 < len(alive):
            after = after & alive[layer + 1].unsqueeze(-1)
        alive[layer] = alive[layer] & after.any(-2)
    return alive


def forward(masks: Sequence[Tensor], weights: Sequence[Tensor], inputs: Tensor) -> Tensor:
    """Sigmoid hidden layers, linear output; unfed nodes give 0.

    Args:
        masks, weights: one a layer, `... x out x in` and `... x out x (in or in + 1)`; weights without a connection
            are ignored.
        inputs: `... x s x i`.

    Returns:
        `... x s x o`.
    """
    signal = hidden_signal(masks, weights, inputs)
    return _affine(signal, _kept(masks[-1], weights[-1]))


def hidden_signal(masks: Sequence[Tensor], weights: Sequence[Tensor], inputs: Tensor) -> Tensor:
    """Output of the last hidden layer, `... x s x h`, or the inputs where there is none; arguments as `forward`."""
    fed = fed_nodes(masks)
    signal = inputs
    for mask, weight, reached in zip(masks[:-1], weights[:-1], fed, strict=True):
        signal = torch.sigmoid(_affine(signal, _kept(mask, weight))) * reached.unsqueeze(-2)
    return signal


def _kept(mask: Tensor, weight: Tensor) -> Tensor:
    return torch.where(active(Genome(mask, weight)), weight, torch.zeros_like(weight))


def _affine(signal: Tensor, weight: Tensor) -> Tensor:
    width = signal.shape[-1]
    product = signal @ weight[..., :width].transpose(-2, -1)
    return product + weight[..., width].unsqueeze(-2) if weight.shape[-1] > width else product


def average(masks: Sequence[Tensor], weights: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """The mean of several networks of one shape as one masked network: their hidden nodes stand side by side.

    Args:
        masks, weights: one a layer, `... x m x out x in` and `... x m x out x (in or in + 1)`, m = networks.

    Returns:
        The same without the dimension `m`; a hidden layer has m times the nodes, blocks of zeros between networks.
    """
    members, last = masks[0].shape[-3], len(masks) - 1
    wide_masks, wide_weights = [], []
    for layer, (mask, weight) in enumerate(zip(masks, weights, strict=True)):
        width = mask.shape[-1]
        kept = torch.where(active(Genome(mask, weight)), weight, 0.0)
        parts = [mask, kept[..., :width], kept[..., width:]]
        if layer == last:
            # Outputs are summed, so every share is divided.
            parts = [mask, kept[..., :width] / members, kept[..., width:].mean(-3)]
        connections = [_side_by_side(part, layer == 0, layer == last) for part in parts[:2]]
        bias = parts[2] if layer == last else parts[2].flatten(-3, -2)
        wide_masks.append(connections[0] > 0)
        wide_weights.append(torch.cat([connections[1], bias], dim=-1))
    return wide_masks, wide_weights


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
    weights = [torch.where(active(Genome(m, w)), w, torch.zeros_like(w)) for m, w in zip(masks, weights, strict=True)]
    alive = alive_nodes(masks)
    if alive and not bool(alive[0].any()):
        outputs, inputs = len(masks[-1]), masks[0].shape[-1]
        bias = weights[-1][:, masks[-1].shape[-1] :]
        return (
            [masks[-1].new_zeros(outputs, inputs)],
            [torch.cat([bias.new_zeros(outputs, inputs), bias], dim=-1)],
        )
    small_masks, small_weights = [], []
    for layer, (mask, weight) in enumerate(zip(masks, weights, strict=True)):
        rows = alive[layer] if layer < len(alive) else mask.new_ones(len(mask))
        columns = alive[layer - 1] if layer > 0 else mask.new_ones(mask.shape[-1])
        with_bias = torch.cat([columns, columns.new_ones(weight.shape[-1] - mask.shape[-1])])
        small_masks.append(mask[rows][:, columns])
        small_weights.append(weight[rows][:, with_bias])
    return small_masks, small_weights


class MaskedNetwork(nn.Module):
    """A pruned network as dense double-precision linear layers with sigmoids between, ready for export.

    Args:
        masks, weights: one a layer, `out x in` and `out x (in or in + 1)`; missing connections become zeros.
        factors, noise: its predictive variance (`evolution.spread.Spread`), `o x q x (h + 1)` and `o`; 1 without them.
    """

    factors: Tensor
    noise: Tensor
    _sums: Tensor

    def __init__(
        self,
        masks: Sequence[Tensor],
        weights: Sequence[Tensor],
        factors: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> None:
        super().__init__()
        layers = []
        for mask, weight in zip(*prune(masks, weights), strict=True):
            outputs, inputs = mask.shape
            # Without its usual start values: those would be drawn from the global random state.
            with torch.device("meta"):
                linear = nn.Linear(inputs, outputs, dtype=torch.float64)
            linear.to_empty(device=weight.device)
            linear.requires_grad_(False)
            linear.weight.copy_(weight[:, :inputs])
            linear.bias.copy_(weight[:, inputs] if weight.shape[-1] > inputs else torch.zeros_like(weight[:, 0]))
            layers.append(linear)
        self.layers = nn.ModuleList(layers)
        outputs = layers[-1].out_features
        if factors is None or noise is None:
            factors = layers[-1].weight.new_zeros(outputs, 0, layers[-1].in_features + 1)
            noise = layers[-1].weight.new_ones(outputs)
        else:
            factors = _pruned_columns(masks, factors, layers[-1].in_features)
        self.register_buffer("factors", factors.flatten(0, 1).contiguous())
        self.register_buffer("noise", noise.clone())
        # A sum over q as a product: engines with a narrow operator list have no other reduction.
        each = torch.eye(outputs, dtype=factors.dtype, device=factors.device)
        self.register_buffer("_sums", each.repeat_interleave(factors.shape[1], 0), persistent=False)

    def describe(self) -> dict[str, Any]:
        """What a model file needs to build the module again, beside its tensors."""
        first, *others = cast("list[nn.Linear]", list(self.layers))
        sizes = [first.in_features, first.out_features, *(layer.out_features for layer in others)]
        return {"kind": "masked", "sizes": sizes, "spread": len(self.factors) // sizes[-1]}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> MaskedNetwork:
        """A module of the described shape, for its tensors to be loaded into."""
        sizes = [int(size) for size in description["sizes"]]
        shapes = list(zip(sizes[1:], sizes, strict=False))
        masks = [torch.ones(shape, dtype=torch.bool) for shape in shapes]
        factors = torch.zeros(sizes[-1], int(description["spread"]), sizes[-2] + 1, dtype=torch.float64)
        empty = [torch.zeros(out, width + 1, dtype=torch.float64) for out, width in shapes]
        network = cls(masks, empty)
        return network if factors.shape[1] == 0 else cls(masks, empty, factors, network.noise)

    def forward(self, inputs: Tensor) -> Tensor:
        """inputs: `... x i` [1]; returns `... x o` [1]."""
        output: Tensor = self.layers[-1](self._hidden(inputs))
        return output

    def variance(self, inputs: Tensor) -> Tensor:
        """Predictive variance of a newly measured output. inputs: `... x i` [1]; returns `... x o` [1]."""
        if len(self.factors) == 0:
            return self.noise.expand(*inputs.shape[:-1], len(self.noise))
        hidden = self._hidden(inputs)
        scatter = hidden @ self.factors[:, :-1].mT + self.factors[:, -1]
        return (scatter * scatter) @ self._sums + self.noise

    def _hidden(self, inputs: Tensor) -> Tensor:
        signal = inputs
        for layer in self.layers[:-1]:
            signal = torch.sigmoid(layer(signal))
        return signal


def _pruned_columns(masks: Sequence[Tensor], factors: Tensor, width: int) -> Tensor:
    """Columns of the nodes that `prune` keeps, and the last one."""
    if len(masks) == 1:
        return factors
    alive = alive_nodes(masks)
    if not bool(alive[0].any()):
        # One layer without connections is left, from the inputs; what a constant is unsure of is its value.
        constant = factors[..., -1:]
        return torch.cat([constant.new_zeros(*constant.shape[:-1], width), constant], -1)
    return torch.cat([factors[..., :-1][..., alive[-1]], factors[..., -1:]], -1)
