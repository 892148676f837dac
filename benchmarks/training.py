"""Training of the default network on smooth rows with noise, beside scikit-learn's multilayer perceptrons."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from sklearn.neural_network import MLPRegressor

from benchmarks.generation import toy_rows
from benchmarks.measure import Row, compare, operations
from ccnn_torch.learners import TrainingData, make_learner
from ccnn_torch.training import train

# Members of the default network; the peer trains as many.
MEMBERS = 6


def run(quick: bool, model: Path | None = None) -> Iterator[Row]:
    """Three inputs and outputs, as a tripod; nodes and members of the default network, the peer's other defaults."""
    for rows in (60, 120, 240) if quick else (125, 500, 2000):
        data = training_rows(rows)
        x, y = data.inputs[0].numpy(), data.targets[0].numpy()

        def perceptrons(x: object = x, y: object = y) -> list[MLPRegressor]:
            keys = {"activation": "logistic", "solver": "lbfgs", "max_iter": 2000}
            return [MLPRegressor(hidden_layer_sizes=(24,), random_state=k, **keys).fit(x, y) for k in range(MEMBERS)]

        def ours(data: TrainingData = data) -> object:
            return train(make_learner("ccnn"), data)

        yield from compare(
            "train the default network, 3 outputs",
            rows,
            "rows",
            ours,
            {"scikit-learn MLPRegressor (lbfgs), 6 members": perceptrons},
            rounds=1,
            flops=operations(ours),
        )


def training_rows(rows: int) -> TrainingData:
    """Inputs in [-1, 1], targets with a hundredth of their deviation as noise."""
    inputs, targets = (torch.from_numpy(part)[None] for part in toy_rows([3, 3], rows))
    noise = torch.randn(targets.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ones = torch.ones(1, rows, dtype=torch.float64)
    return TrainingData(inputs, targets + 0.01 * noise, ones, torch.zeros(1, dtype=torch.int64))
