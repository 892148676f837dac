"""Outputs, gradient and Gauss-Newton matrix of masked sigmoid networks with periodic nodes, in closed form.

The derivative of output k with respect to weight (a, b) of layer l is a product, D[k, a] h[b], of what flows back to
node a and what flows in from node b. The sum over samples of its outer products is therefore one matrix product of
`samples x a a'` with `samples x b b'` for each pair of layers: the derivative of every sample and output with respect
to every weight is never laid out, which saves a factor of the number of outputs in work and in memory. Within one layer
both factors are symmetric, so that each pair of nodes is multiplied once, and each pair of signals where they are few.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.evolution.waves import Waves, wave_inputs
from ccnn_torch.numerics.blocks import blocks

__all__ = ["Linearised", "Network", "dense_jacobian", "linearise", "network_of", "residual"]

# Signals a node from which the products of `_within` are made node by node, measured on one core.
_MANY_SIGNALS = 4


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
        """`kept` in the flat order of all weights, `b x m`."""
        shapes = [(mask.shape[-2], mask.shape[-1] + int(self.bias)) for mask in self.masks]
        starts = itertools.accumulate((rows * columns for rows, columns in shapes), initial=0)
        return torch.cat([part + start for part, start in zip(self.kept, starts, strict=False)], -1)

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
    fed = [torch.ones_like(counts[0][:, 0, :])]
    for mask in counts:
        fed.append(((mask @ fed[-1].unsqueeze(-1)).squeeze(-1) > 0).to(torch.float64))
    used = [torch.ones_like(counts[-1][:, :, 0])]
    for mask in reversed(counts):
        used.insert(0, ((used[0].unsqueeze(-2) @ mask).squeeze(-2) > 0).to(torch.float64))
    alive = [f * u for f, u in zip(fed, used, strict=True)]
    alive[-1] = used[-1]  # an output without inputs keeps its bias: it is then a constant
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
    channels = precision.shape[-1]
    found: Linearised | None = None
    for rows in blocks(inputs.shape[-2], 8 * len(inputs) * _numbers_a_row(network, channels)):
        part = None if factor is None else factor[:, rows]
        more = _linearise(network, flat, inputs[:, rows], targets[:, rows], part, precision[:, rows])
        found = more if found is None else Linearised(found.gradient + more.gradient, found.matrix.add_(more.matrix))
    assert found is not None
    return found


def _numbers_a_row(network: Network, channels: int) -> int:
    """About how many numbers `_linearise` holds for a row of one network: flows, derivatives, the largest products."""
    layers = [(mask.shape[-2], mask.shape[-1] + 1) for mask in network.masks]
    flowing = sum(out * (channels + 1) + into for out, into in layers)
    pairs = max(a * b for _, a in layers for _, b in layers) + max(a * b for a, _ in layers for b, _ in layers)
    return flowing + 2 * pairs


def _linearise(
    network: Network, flat: Tensor, inputs: Tensor, targets: Tensor, factor: Tensor | None, precision: Tensor
) -> Linearised:
    flows = _activations(network, flat, inputs)
    error = flows[-1] - targets
    if factor is not None:
        error = (factor @ error.unsqueeze(-1)).squeeze(-1)
    root = precision.sqrt()
    back, inflows = _backward(network, flat, flows, _seed(targets, factor) * root.unsqueeze(-1), inputs)
    error = (error * root).unsqueeze(-2)
    gradient = torch.cat(
        [
            ((error @ b).squeeze(-2).mT @ f).flatten(1).gather(1, kept)
            for b, f, kept in zip(back, inflows, network.kept, strict=True)
        ],
        dim=-1,
    )
    readout = len(network.masks) - 1
    rows: list[list[Tensor]] = []
    for i, (back_i, flow_i) in enumerate(zip(back, inflows, strict=True)):
        blocks = [rows[j][i].mT for j in range(i)]
        blocks.append(_within(back_i, flow_i, network.kept[i], apart=factor is None and i == readout))
        for j in range(i + 1, len(back)):
            blocks.append(_between(back_i, flow_i, network.kept[i], back[j], inflows[j], network.kept[j]))
        rows.append(blocks)
    matrix = torch.cat([torch.cat(blocks, dim=-1) for blocks in rows], dim=-2)
    active = network.active.gather(1, network.kept_flat).to(flat.dtype)
    return Linearised(gradient * active, matrix * active.unsqueeze(-1) * active.unsqueeze(-2))


def _within(back: Tensor, flow: Tensor, kept: Tensor, apart: bool) -> Tensor:
    """Sum over rows of the outer products of one layer's derivatives, `b x k x k`.

    Args:
        back: D, `b x s x c x out`.
        flow: h, `b x s x in`.
        kept: which weights, `b x k` in the flat order `out x in`.
        apart: whether every node has a channel of its own (the output's nodes, judged as they are).
    """
    ins = flow.shape[-1]
    node, signal = kept // ins, kept % ins
    if apart:
        nodes, row = back.diagonal(dim1=-2, dim2=-1).square(), node.unsqueeze(-1)
    else:
        above, beside, place = _pairs(back.shape[-1], back.device)
        nodes, row = (back.mT @ back)[..., above, beside], place[node.unsqueeze(-1), node.unsqueeze(-2)]
    if ins >= _MANY_SIGNALS * back.shape[-1]:
        # Many signals to few nodes: one product for each pair of nodes is quicker than laying out all pairs of signals.
        table = ((flow.mT.unsqueeze(1) * nodes.mT.unsqueeze(2)) @ flow.unsqueeze(1)).flatten(2)
        column = (signal * ins).unsqueeze(-1) + signal.unsqueeze(-2)
    else:
        first, second, place = _pairs(ins, flow.device)
        table = nodes.mT @ (flow[..., first] * flow[..., second])
        column = place[signal.unsqueeze(-1), signal.unsqueeze(-2)]
    picked = _picked(table, row.expand_as(column), column)
    return picked * (node.unsqueeze(-1) == node.unsqueeze(-2)) if apart else picked


def _between(back: Tensor, flow: Tensor, kept: Tensor, back_2: Tensor, flow_2: Tensor, kept_2: Tensor) -> Tensor:
    """The same of two layers, `b x k x k_2`."""
    nodes = (back.mT @ back_2).flatten(2)
    signals = (flow.unsqueeze(-1) * flow_2.unsqueeze(-2)).flatten(2)
    ins, ins_2 = flow.shape[-1], flow_2.shape[-1]
    row = (kept // ins * back_2.shape[-1]).unsqueeze(-1) + (kept_2 // ins_2).unsqueeze(-2)
    column = (kept % ins * ins_2).unsqueeze(-1) + (kept_2 % ins_2).unsqueeze(-2)
    return _picked(nodes.mT @ signals, row, column)


def _picked(table: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """table: `b x p x q`; row, column: `b x k x l`; returns `b x k x l`."""
    return table.flatten(1).gather(1, (row * table.shape[-1] + column).flatten(1)).view(row.shape)


def _pairs(count: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column of every pair i <= j, and the number of the pair for every i and j, `count x count`."""
    rows, columns = torch.triu_indices(count, count, device=device)
    place = torch.zeros(count, count, dtype=torch.int64, device=device)
    place[rows, columns] = place[columns, rows] = torch.arange(len(rows), device=device)
    return rows, columns, place


def dense_jacobian(
    network: Network, flat: Tensor, inputs: Tensor, targets: Tensor, factor: Tensor | None = None
) -> Tensor:
    """Derivative of `residual` with respect to the weights, laid out in full: `b x s x c x k`. Costly; for checks."""
    flows = _activations(network, flat, inputs)
    back, inflows = _backward(network, flat, flows, _seed(targets, factor), inputs)
    parts = [(b.unsqueeze(-1) * f.unsqueeze(-2).unsqueeze(-2)).flatten(-2) for b, f in zip(back, inflows, strict=True)]
    return torch.cat(parts, dim=-1) * network.active.unsqueeze(1).unsqueeze(1)
