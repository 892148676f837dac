"""Which weights of a network share a prior precision."""

from __future__ import annotations

import torch
from torch import Tensor, nn


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
