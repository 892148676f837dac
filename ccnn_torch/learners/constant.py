"""The trivial baseline: the mean deviation of the training rows, wherever the machine stands."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.learners._protocol import TrainingData

__all__ = ["Constant", "ConstantNetwork"]


class ConstantNetwork(nn.Module):
    """Returns `value` for every row."""

    value: Tensor

    def __init__(self, value: Tensor) -> None:
        super().__init__()
        self.register_buffer("value", value)

    def forward(self, features: Tensor) -> Tensor:
        """features: `... x i`; returns `... x o`."""
        return self.value.expand(*features.shape[:-1], self.value.shape[-1])

    def describe(self) -> dict[str, Any]:
        """What a model file needs to build the module again, beside its tensors."""
        return {"kind": "constant", "outputs": self.value.shape[-1]}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> ConstantNetwork:
        """An empty module of the described shape, for its tensors to be loaded into."""
        return cls(torch.zeros(int(description["outputs"]), dtype=torch.float64))


class Constant:
    """Weighted mean of the targets; one step."""

    name = "constant"

    def __init__(self) -> None:
        self._value = torch.zeros(0)
        self._step = torch.zeros((), dtype=torch.int64)

    def start(self, data: TrainingData) -> None:
        self._data = data
        self._value = torch.zeros_like(data.targets[:, 0])
        self._step = torch.zeros((), dtype=torch.int64)

    def step(self) -> dict[str, Tensor]:
        weights = self._data.weights.unsqueeze(-1)
        self._value = (self._data.targets * weights).sum(1) / weights.sum(1)
        self._step = self._step + 1
        return {"error_train": ((self._data.targets - self._value.unsqueeze(1)).square() * weights).mean((1, 2))}

    @property
    def finished(self) -> bool:
        return int(self._step) > 0

    @property
    def steps(self) -> int:
        return 1

    def predict(self, inputs: Tensor) -> Tensor:
        return self._value.unsqueeze(1).expand(-1, inputs.shape[1], -1)

    def state_dict(self) -> dict[str, Tensor]:
        return {"value": self._value, "step": self._step}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._value, self._step = state["value"], state["step"]

    def network(self, repeat: int) -> nn.Module:
        return ConstantNetwork(self._value[repeat].clone())
