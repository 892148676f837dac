"""A batch of networks with their periodic nodes, as one value."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ccnn_torch.evolution.network import average, average_waves
from ccnn_torch.evolution.waves import Waves
from ccnn_torch.numerics.trees import mapped


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
        named = {f"mask_{layer}": mask for layer, mask in enumerate(self.masks)}
        named |= {f"weight_{layer}": weight for layer, weight in enumerate(self.weights)}
        return named | {"source": self.waves.source, "frequency": self.waves.frequency}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> Bundle:
        """Inverse of `tensors`."""
        layers = range(sum(name.startswith("mask_") for name in tensors))
        return cls(
            [tensors[f"mask_{layer}"] for layer in layers],
            [tensors[f"weight_{layer}"] for layer in layers],
            Waves(tensors["source"], tensors["frequency"]),
        )


def resized(bundle: Bundle, slots: int) -> Bundle:
    """The same networks with fewer free slots for periodic nodes (the last ones go), or more."""
    have = bundle.slots
    hidden = bundle.masks[-1].shape[-1] - 2 * have

    def fitted(values: Tensor) -> Tensor:
        return nn.functional.pad(values, (0, slots - have)) if slots > have else values[..., :slots]

    def columns(values: Tensor) -> Tensor:
        parts = torch.split(values, [hidden, have, have, values.shape[-1] - hidden - 2 * have], -1)
        return torch.cat([parts[0], fitted(parts[1]), fitted(parts[2]), parts[3]], -1)

    return Bundle(
        [*bundle.masks[:-1], columns(bundle.masks[-1])],
        [*bundle.weights[:-1], columns(bundle.weights[-1])],
        mapped(fitted, bundle.waves),
    )


def without_waves(bundle: Bundle) -> Bundle:
    """The sigmoid networks alone."""
    return resized(bundle, 0)


def averaged(bundle: Bundle) -> Bundle:
    """The mean of the networks along the last leading dimension, as one network each."""
    masks, weights = average(bundle.masks, bundle.weights, bundle.slots)
    return Bundle(masks, weights, average_waves(bundle.waves))
