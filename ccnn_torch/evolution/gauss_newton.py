"""Outputs, gradient and Gauss-Newton matrix of masked sigmoid networks with periodic nodes, in closed form.

The derivative of output k with respect to weight (a, b) of layer l is a product, D[k, a] h[b], of what flows back to
node a and what flows in from node b. For the output's weights D is the same in every network, so that the sum over rows
of their outer products is a product of signals for each pair of outputs; only the derivatives with respect to the
weights before the output layer, those that are kept, are laid out. All sums are products of large matrices.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.evolution.network import alive_nodes
from ccnn_torch.evolution.waves import Waves, wave_inputs
from ccnn_torch.numerics.blocks import blocks


def prior_groups(shapes: list[torch.Size], bias: bool, slots: int = 0) -> Tensor:
    """Group of every weight in the flat order, `k`, int64; the last group holds the output's biases and frequencies.

    Weights of a layer share a precision, its biases apart; but there is one for each input of the network, one for each
    of its outputs, and for each output one of the two weights of a periodic node.
    """
    last = len(shapes) - 1
    labels: list[tuple[int, int, int]] = []
    for layer, (outputs, inputs) in enumerate(shapes):
        waves = 2 * slots if layer == last else 0
        for row in range(outputs):
            by_output = row if layer == last else 0
            for column in range(inputs):
                if column >= inputs - waves:
                    labels.append((_wave_layer(last), row, (column - inputs + waves) % slots))
                else:
                    labels.append((2 * layer, by_output, column if layer == 0 else 0))
            if bias:
                labels.append((-1, 0, 0) if layer == last else (2 * layer + 1, 0, 0))
    labels += [(-1, 0, 0)] * slots
    order = {label: index for index, label in enumerate(sorted(set(labels) - {(-1, 0, 0)}))}
    return torch.tensor([order.get(label, len(order)) for label in labels])


def wave_groups(last_group: int, outputs: int, slots: int) -> Tensor:
    """Their labels sort last, before the group that is never held back."""
    return torch.arange(last_group - outputs * slots, last_group) if slots else torch.zeros(0, dtype=torch.int64)


def _wave_layer(last: int) -> int:
    """Label of the waves' groups, behind those of all layers."""
    return 2 * last + 2


def resized_prior(prior: Tensor, outputs: int, before: int, after: int) -> Tensor:
    """Prior precisions `... x g` for another number of slots; those of new ones are 0 (not known)."""
    plain, waves, last = torch.split(prior, [prior.shape[-1] - outputs * before - 1, outputs * before, 1], -1)
    waves = waves.reshape(*waves.shape[:-1], outputs, before)
    kept = waves[..., : min(before, after)]
    return torch.cat([plain, nn.functional.pad(kept, (0, after - kept.shape[-1])).flatten(-2), last], -1)


# Bytes of rows that are worked on at a time: what the caches of one core hold, measured with 6 and 24 networks.
_CACHED = 1 << 25


@dataclass(frozen=True)
class Network:
    """The fixed part of `b` masked networks of one shape.

    Attributes:
        masks: per layer `b x out x in`, float64, 1 where a connection counts.
        alive: per hidden layer `b x 1 x out`, float64, 0 where a node is dead and its output forced to 0.
        active: `b x k`, bool, the weights that take part: connected, and on a way from an input to an output.
        bias: whether the last column of every weight matrix is a bias.
        source: which input each periodic node reads, `b x waves` int64; the output's mask has two columns for each
            behind those of the last hidden layer, and the flat weights end with the frequencies.
        kept: of each layer, and of the frequencies, the active weights, `b x k_l` int64 in the order of that layer,
            filled up with inactive ones to the same number in every network.
    """

    masks: list[Tensor]
    alive: list[Tensor]
    active: Tensor
    bias: bool
    source: Tensor
    kept: list[Tensor]

    @property
    def slots(self) -> int:
        """Periodic nodes of each network."""
        return self.source.shape[-1]

    @property
    def hidden(self) -> int:
        """Nodes of the last hidden layer, or inputs where there is none."""
        return self.masks[-1].shape[-1] - 2 * self.slots

    def split(self, flat: Tensor) -> list[Tensor]:
        """flat: `b x k`; returns the weights per layer, `b x out x in (+ 1)`."""
        shapes = [(m.shape[-2], m.shape[-1] + int(self.bias)) for m in self.masks]
        parts = torch.split(flat[:, : flat.shape[-1] - self.slots], [rows * columns for rows, columns in shapes], -1)
        return [p.reshape(-1, *shape) for p, shape in zip(parts, shapes, strict=True)]

    @property
    def kept_flat(self) -> Tensor:
        """Numbers of the kept weights in the flat order of all, `b x m`: those of the output, then all others."""
        shapes = [(mask.shape[-2], mask.shape[-1] + int(self.bias)) for mask in self.masks]
        starts = itertools.accumulate((rows * columns for rows, columns in shapes), initial=0)
        parts = [part + start for part, start in zip(self.kept, starts, strict=False)]
        return torch.cat([parts.pop(len(self.masks) - 1), *parts], -1)

    @property
    def linear(self) -> int:
        """How many of the kept weights are the output's."""
        return self.kept[len(self.masks) - 1].shape[-1]

    def frequencies(self, flat: Tensor) -> Tensor:
        """flat: `b x k`; returns `b x waves`."""
        return flat[:, flat.shape[-1] - self.slots :]


def network_of(masks: list[Tensor], bias: bool, waves: Waves | None = None) -> Network:
    """masks: per layer `b x out x in`, bool. A node without inputs (bias not counted) or without outputs is dead."""
    source = masks[0].new_zeros(len(masks[0]), 0, dtype=torch.int64) if waves is None else waves.source
    slots = source.shape[-1]
    hidden = masks[-1].shape[-1] - 2 * slots
    periodic = masks[-1][..., hidden:].to(torch.float64)
    counts = [m.to(torch.float64) for m in (*masks[:-1], masks[-1][..., :hidden])]
    ends = counts[0].new_ones(len(source), masks[0].shape[-1]), counts[0].new_ones(len(source), masks[-1].shape[-2])
    alive = [ends[0], *(nodes.to(torch.float64) for nodes in alive_nodes(masks)), ends[1]]
    effective = [
        mask * alive[index + 1].unsqueeze(-1) * alive[index].unsqueeze(-2) for index, mask in enumerate(counts)
    ]
    effective[-1] = torch.cat([effective[-1], periodic], -1)
    columns = [
        torch.cat([mask, node.unsqueeze(-1)], dim=-1) if bias else mask
        for mask, node in zip(effective, alive[1:], strict=True)
    ]
    read = periodic.sum(-2)
    lines = [read[:, :slots] + read[:, slots:]] if slots else []
    parts = [part > 0 for part in (*(c.flatten(1) for c in columns), *lines)]
    kept = [_first(part) for part in parts]
    return Network(effective, [a.unsqueeze(1) for a in alive[1:-1]], torch.cat(parts, -1), bias, source, kept)


def _first(active: Tensor) -> Tensor:
    """Numbers of the active weights, then of as many others as make every network's list as long: `b x m`."""
    longest = int(active.sum(-1).max()) if active.shape[-1] else 0
    return (~active).to(torch.int8).sort(dim=-1, stable=True).indices[:, :longest]


@dataclass(frozen=True)
class Linearised:
    """Half the weighted squared residual of `b` networks, to second order (Gauss-Newton) in their kept weights.

    Attributes:
        gradient: `b x m`, 0 for weights that are not active.
        matrix: `b x m x m`, sum over rows and channels of the outer product of the residual's derivative, likewise.
    """

    gradient: Tensor
    matrix: Tensor


def _activations(network: Network, flat: Tensor, inputs: Tensor) -> list[Tensor]:
    """What flows into each layer, then the output: `b x s x nodes (+ 1)` each, the last without the constant 1."""
    flows = []
    weights = network.split(torch.where(network.active, flat, 0))
    signal = inputs[..., : network.hidden if len(weights) == 1 else network.masks[0].shape[-1]]
    one = inputs.new_ones(inputs.shape[0], inputs.shape[1], 1)
    for index, weight in enumerate(weights):
        if network.slots and index == len(weights) - 1:
            phase = wave_inputs(network.source, inputs) * network.frequencies(flat).unsqueeze(-2)
            signal = torch.cat([signal, torch.sin(phase), torch.cos(phase)], dim=-1)
        if network.bias:
            signal = torch.cat([signal, one], dim=-1)
        flows.append(signal)
        signal = signal @ weight.mT
        if index < len(weights) - 1:
            signal = torch.sigmoid(signal) * network.alive[index]
    return [*flows, signal]


def residual(network: Network, flat: Tensor, inputs: Tensor, targets: Tensor, factor: Tensor | None) -> Tensor:
    """Output minus target, in the channels of `factor`.

    Args:
        network: `b` networks.
        flat: weights, `b x k`.
        inputs: `b x s x i`.
        targets: `b x s x o`.
        factor: `b x s x c x o`, or None for the outputs themselves (c = o).

    Returns:
        `b x s x c`.
    """
    nodes = sum(sum(mask.shape[-2:]) for mask in network.masks)
    parts = []
    for rows in blocks(inputs.shape[-2], 8 * len(inputs) * nodes):
        error = _activations(network, flat, inputs[:, rows])[-1] - targets[:, rows]
        parts.append(error if factor is None else (factor[:, rows] @ error.unsqueeze(-1)).squeeze(-1))
    return parts[0] if len(parts) == 1 else torch.cat(parts, 1)


def _backward(
    network: Network, flat: Tensor, flows: list[Tensor], seed: Tensor, inputs: Tensor
) -> tuple[list[Tensor], list[Tensor]]:
    """Derivative of `seed` times the output with respect to each layer's sums, `b x s x c x out`, and what flows in.

    Where there are periodic nodes, one more pair is at the end: the derivative with respect to the frequencies,
    beside an inflow of 1.
    """
    weights = network.split(torch.where(network.active, flat, 0))
    back = [seed]
    for index in range(len(weights) - 1, 0, -1):
        count = network.masks[index - 1].shape[-2]
        signal = flows[index][..., :count]
        slope = signal * (1 - signal)
        back.insert(0, (back[0] @ weights[index][..., :count].unsqueeze(1)) * slope.unsqueeze(-2))
    inflows = flows[:-1]
    if network.slots:
        sine, cosine = flows[-2][..., network.hidden : network.hidden + 2 * network.slots].chunk(2, -1)
        to_sine, to_cosine = weights[-1][..., network.hidden : network.hidden + 2 * network.slots].chunk(2, -1)
        rate = (seed @ to_sine.unsqueeze(1)) * cosine.unsqueeze(-2) - (seed @ to_cosine.unsqueeze(1)) * sine.unsqueeze(
            -2
        )
        back.append(rate * wave_inputs(network.source, inputs).unsqueeze(-2))
        inflows = [*inflows, torch.ones_like(sine[..., :1])]
    return back, inflows


def _seed(targets: Tensor, factor: Tensor | None) -> Tensor:
    outputs = targets.shape[-1]
    identity = torch.eye(outputs, dtype=targets.dtype, device=targets.device)
    return identity.expand(*targets.shape, outputs) if factor is None else factor


def linearise(
    network: Network,
    flat: Tensor,
    inputs: Tensor,
    targets: Tensor,
    factor: Tensor | None,
    precision: Tensor,
) -> Linearised:
    """Gradient and Gauss-Newton matrix of half the sum over rows and channels of precision times squared residual.

    Args:
        network, flat, inputs, targets, factor: as in `residual`.
        precision: weight of every squared residual, `b x s x c`; 0 leaves it out.
    """
    sums: _Sums | None = None
    for rows in blocks(inputs.shape[-2], 8 * len(inputs) * _numbers_a_row(network, precision.shape[-1]), _CACHED):
        part = None if factor is None else factor[:, rows]
        more = _summed(network, flat, inputs[:, rows], targets[:, rows], part, precision[:, rows])
        sums = more if sums is None else _Sums(*(one.add_(other) for one, other in zip(sums, more, strict=True)))
    assert sums is not None
    return _picked(network, sums, factor is None)


class _Sums(NamedTuple):
    """Sums over rows of the products of derivatives, k weights before the output layer and i signals that it reads.

    Attributes:
        inner: of two weights before the output layer, `b x k x k`.
        across: of one and a weight of the output, `b x o k x i`.
        signals: of two signals for each pair of outputs, or for each output where they are judged apart, `b x i x p i`.
        slope: gradient of the weights before the output layer, `b x k`.
        readout: gradient of the output's weights, `b x o x i`.
    """

    inner: Tensor
    across: Tensor
    signals: Tensor
    slope: Tensor
    readout: Tensor


def _numbers_a_row(network: Network, channels: int) -> int:
    """About how many numbers `_summed` holds for a row of one network."""
    flowing = sum(mask.shape[-2] * (channels + 1) + mask.shape[-1] + 1 for mask in network.masks)
    outputs, ins = network.masks[-1].shape[-2], network.masks[-1].shape[-1] + 1
    inner = sum(
        part.shape[-1] for part in (*network.kept[: len(network.masks) - 1], *network.kept[len(network.masks) :])
    )
    return flowing + (3 * channels + outputs) * inner + outputs * (outputs + 1) // 2 * ins


def _summed(
    network: Network, flat: Tensor, inputs: Tensor, targets: Tensor, factor: Tensor | None, precision: Tensor
) -> _Sums:
    flows = _activations(network, flat, inputs)
    error = flows[-1] - targets
    if factor is not None:
        error = (factor @ error.unsqueeze(-1)).squeeze(-1)
    root = precision.sqrt()
    seed = _seed(targets, factor) * root.unsqueeze(-1)
    error = error * root
    back, inflows = _backward(network, flat, flows, seed, inputs)
    last, kept = len(network.masks) - 1, network.kept
    parts = [_columns(back[i], inflows[i], kept[i]) for i in range(len(back)) if i != last]
    inner = torch.cat(parts, -1) if parts else seed[..., :0]
    signals = inflows[last]
    wide = inner.flatten(1, 2)
    mixed = (seed.mT @ inner).flatten(2)
    if factor is None:
        products = precision
    else:
        above, beside, _ = _pairs(seed.shape[-1], seed.device)
        products = (seed.mT @ seed)[..., above, beside]
    return _Sums(
        wide.mT @ wide,
        mixed.mT @ signals,
        signals.mT @ (products.unsqueeze(-1) * signals.unsqueeze(-2)).flatten(2),
        (wide.mT @ error.flatten(1).unsqueeze(-1)).squeeze(-1),
        (error.unsqueeze(-2) @ seed).squeeze(-2).mT @ signals,
    )


def _columns(back: Tensor, flow: Tensor, kept: Tensor) -> Tensor:
    """Derivatives with respect to the kept weights of one layer, laid out: `b x s x c x k`."""
    ins, (batch, rows, channels) = flow.shape[-1], back.shape[:3]
    node, signal = kept // ins, kept % ins
    columns = back.gather(-1, node[:, None, None].expand(batch, rows, channels, -1))
    return columns.mul_(flow.gather(-1, signal.unsqueeze(1).expand(batch, rows, -1)).unsqueeze(2))


def _picked(network: Network, sums: _Sums, apart: bool) -> Linearised:
    """Gradient and matrix of the kept weights; `apart`: whether every output has a channel of its own."""
    outputs, ins = sums.readout.shape[-2:]
    inner = sums.inner.shape[-1]
    readout = network.kept[len(network.masks) - 1]
    node, signal = readout // ins, readout % ins
    if apart:
        count, place = outputs, node.unsqueeze(-1).expand(*readout.shape, readout.shape[-1])
    else:
        count = outputs * (outputs + 1) // 2
        place = _pairs(outputs, readout.device)[-1].flatten()[(node * outputs).unsqueeze(-1) + node.unsqueeze(-2)]
    place = (signal * (count * ins)).unsqueeze(-1) + place * ins + signal.unsqueeze(-2)
    across = sums.across.unflatten(1, (outputs, inner)).transpose(1, 2).flatten(2)  # type: ignore[no-untyped-call]
    linear = network.linear
    active = network.active.gather(1, network.kept_flat).to(across.dtype)
    matrix = across.new_empty(len(active), linear + inner, linear + inner)
    matrix[:, :linear, :linear] = sums.signals.flatten(1).gather(1, place.flatten(1)).view(place.shape)
    if apart:
        matrix[:, :linear, :linear].mul_(node.unsqueeze(-1) == node.unsqueeze(-2))
    matrix[:, linear:, :linear] = across.gather(-1, readout.unsqueeze(1).expand(-1, inner, -1))
    matrix[:, :linear, linear:] = matrix[:, linear:, :linear].mT
    matrix[:, linear:, linear:] = sums.inner
    gradient = torch.cat([sums.readout.flatten(1).gather(1, readout), sums.slope], -1)
    return Linearised(gradient * active, matrix.mul_(active.unsqueeze(-1)).mul_(active.unsqueeze(-2)))


def _pairs(count: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column of every pair i <= j, and the number of the pair for every i and j, `count x count`."""
    rows, columns = torch.triu_indices(count, count, device=device)
    place = torch.zeros(count, count, dtype=torch.int64, device=device)
    place[rows, columns] = place[columns, rows] = torch.arange(len(rows), device=device)
    return rows, columns, place
