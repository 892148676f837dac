"""The trivial baseline: the mean deviation of the training rows, in every pose."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.learners.protocol import TrainingData, weighted_mse
from ccnn_torch.learners.rows import usable_rows

_SMALLEST_VARIANCE = 1e-12


class ConstantNetwork(nn.Module):
    """Returns `value` for every row.

    Args:
        value: `o` [1].
        variance: predictive variance of a newly measured output, `o` [1]; 1 when None.
    """

    value: Tensor
    spread: Tensor

    def __init__(self, value: Tensor, variance: Tensor | None = None) -> None:
        super().__init__()
        self.register_buffer("value", value)
        self.register_buffer("spread", torch.ones_like(value) if variance is None else variance)

    def forward(self, features: Tensor) -> Tensor:
        """features: `... x i`; returns `... x o`."""
        return self.value.expand(*features.shape[:-1], self.value.shape[-1])

    def variance(self, features: Tensor) -> Tensor:
        """features: `... x i`; returns `... x o`."""
        return self.spread.expand(*features.shape[:-1], self.spread.shape[-1])

    def describe(self) -> dict[str, Any]:
        """What a model file needs to build the module again, beside its tensors."""
        return {"kind": "constant", "outputs": self.value.shape[-1]}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> ConstantNetwork:
        """An empty module of the described shape, for its tensors to be loaded into."""
        return cls(torch.zeros(int(description["outputs"]), dtype=torch.float64))


class Constant:
    """Weighted mean of the targets; one step.

    Variance: the unbiased one of the training targets, times (1 + 1 / n) for the error of the mean.
    """

    name = "constant"

    def __init__(self) -> None:
        self._value = torch.zeros(0)
        self._step = torch.zeros((), dtype=torch.int64)

    def start(self, data: TrainingData) -> None:
        self._data = usable_rows(data)
        self._value = torch.zeros_like(data.targets[:, 0])
        self._step = torch.zeros((), dtype=torch.int64)

    def step(self) -> dict[str, Tensor]:
        weights = self._data.weights.unsqueeze(-1)
        self._value = (self._data.targets * weights).sum(1) / weights.sum(1)
        self._step = self._step + 1
        error = weighted_mse(self._data.targets, self._value.unsqueeze(1), self._data.weights)
        return {"error_train": error, "evaluations": torch.ones_like(error)}

    @property
    def finished(self) -> bool:
        return int(self._step) > 0

    @property
    def steps(self) -> int:
        return 1

    def predict(self, inputs: Tensor) -> Tensor:
        return self._value.unsqueeze(1).expand(-1, inputs.shape[1], -1)

    def variance(self, inputs: Tensor) -> Tensor:
        """Of a newly measured output. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""
        return self._variance().unsqueeze(1).expand(-1, inputs.shape[1], -1)

    def _variance(self) -> Tensor:
        weights = self._data.weights.unsqueeze(-1)
        count = weights.sum(1)
        squares = ((self._data.targets - self._value.unsqueeze(1)).square() * weights).sum(1)
        return (squares / (count - 1).clamp_min(1) * (1 + 1 / count)).clamp_min(_SMALLEST_VARIANCE)

    def state_dict(self) -> dict[str, Tensor]:
        return {"value": self._value, "step": self._step}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._value, self._step = state["value"], state["step"]

    def network(self, repeat: int) -> nn.Module:
        return ConstantNetwork(self._value[repeat].clone(), self._variance()[repeat].clone())
