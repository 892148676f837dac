"""Training rows without padding, and the error on them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners.protocol import TrainingData


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
    index = order.gather(1, torch.where(count > most, place * count // most, place))
    repeat = torch.arange(len(index), device=index.device).unsqueeze(1)
    inputs, targets, weights = (part[repeat, index] for part in (data.inputs, data.targets, data.weights))
    metric = None if data.metric is None else data.metric[repeat, index]
    return replace(data, inputs=inputs, targets=targets, weights=weights, metric=metric)


def mean_square(error: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean over rows, mean over outputs. error: `... x s x o`; weights: `... x s`; returns `...`."""
    return (error.square().mean(-1) * weights).sum(-1) / weights.sum(-1)
