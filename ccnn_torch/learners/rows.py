"""What learners share: rows without padding, the error on them, and predictions by one masked network a repeat."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.errors import MethodFailedError
from ccnn_torch.evolution.masked_network import MaskedNetwork, Spread, readout_spread, spread_variance
from ccnn_torch.evolution.network import forward
from ccnn_torch.learners.protocol import TrainingData
from ccnn_torch.numerics.trees import mapped


def usable_rows(data: TrainingData) -> TrainingData:
    """The same rows with zeros in those of weight 0, which may hold anything, NaN included.

    Raises:
        MethodFailedError: a row that counts is not finite.
    """
    there = (data.weights > 0).unsqueeze(-1)
    inputs, targets = (torch.where(there, part, 0.0) for part in (data.inputs, data.targets))
    metric = None if data.metric is None else torch.where(there.unsqueeze(-1), data.metric, 0.0)
    for part, name in ((inputs, "inputs"), (targets, "outputs"), (metric, "metric")):
        if part is not None and not bool(part.isfinite().all()):
            raise MethodFailedError(f"the training rows' {name} are not all finite; remove those rows")
    return replace(data, inputs=inputs, targets=targets, metric=metric)


def thinned(data: TrainingData, most: int) -> TrainingData:
    """At most so many rows of each repeat, evenly spread over those that count; validation rows stay."""
    there = data.weights > 0
    if there.shape[1] <= most:
        return data
    count = there.sum(1, keepdim=True)
    place = torch.arange(most, device=count.device).expand(len(count), -1)
    # Rows that count first, in their order.
    order = (~there).to(torch.int8).sort(dim=1, stable=True).indices
    return taken(data, order.gather(1, torch.where(count > most, place * count // most, place)))


def taken(data: TrainingData, index: Tensor) -> TrainingData:
    """The rows with these numbers, `r x n` int64; validation rows stay."""
    repeat = torch.arange(len(index), device=index.device).unsqueeze(1)
    rows = mapped(lambda part: part[repeat, index], (data.inputs, data.targets, data.weights, data.metric))
    return replace(data, inputs=rows[0], targets=rows[1], weights=rows[2], metric=rows[3])


class OneNetwork(ABC):
    """Predictions and networks of a learner that has the data and says its model."""

    _data: TrainingData

    @abstractmethod
    def _model(self) -> tuple[list[Tensor], list[Tensor]]:
        """Masks and weights of the model, one a layer, `r x 1 x ...`."""

    def predict(self, inputs: Tensor) -> Tensor:
        """Output of the model of each repeat. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        masks, weights = self._model()
        return forward(masks, weights, inputs.unsqueeze(1)).squeeze(1)

    def variance(self, inputs: Tensor) -> Tensor:
        """Predictive variance of newly measured outputs. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        masks, weights = self._model()
        return spread_variance([m[:, 0] for m in masks], [w[:, 0] for w in weights], self._spread(), inputs)

    def network(self, repeat: int) -> MaskedNetwork:
        """The model of one repeat, pruned of its dead nodes."""
        masks, weights = ([part[repeat, 0] for part in parts] for parts in self._model())
        spread = self._spread()
        return MaskedNetwork(masks, weights, spread.factors[repeat], spread.noise[repeat])

    def _spread(self) -> Spread:
        return readout_spread(*self._model(), self._data.inputs, self._data.targets, self._data.weights)
