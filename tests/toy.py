"""A learner small enough to reason about: gradient descent on a linear map, with momentum as hidden state."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ccnn_torch.learners import TrainingData
from ccnn_torch.training import weighted_mse


class Descent:
    """Fills in the Learner protocol; starts from numbers drawn per repeat."""

    name = "descent"

    def __init__(self, steps: int = 30, rate: float = 0.2) -> None:
        self._steps, self._rate = steps, rate

    def start(self, data: TrainingData) -> None:
        self._data = data
        shape = (data.inputs.shape[-1] + 1, data.targets.shape[-1])
        starts = [
            torch.randn(shape, generator=torch.Generator().manual_seed(int(s)), dtype=torch.float64) for s in data.seeds
        ]
        self._map = torch.stack(starts)
        self._velocity = torch.zeros_like(self._map)
        self._step = torch.zeros((), dtype=torch.int64)

    def step(self) -> dict[str, Tensor]:
        design = _with_one(self._data.inputs)
        weights = self._data.weights.unsqueeze(-1)
        error = (design @ self._map - self._data.targets) * weights
        gradient = design.transpose(1, 2) @ error / weights.sum(1, keepdim=True)
        self._velocity = 0.5 * self._velocity - self._rate * gradient
        self._map = self._map + self._velocity
        self._step = self._step + 1
        data = self._data
        return {
            "error_train": weighted_mse(self.predict(data.inputs), data.targets, data.weights),
            "evaluations": torch.full_like(weights[:, 0, 0], float(self._step)),
        }

    @property
    def finished(self) -> bool:
        return int(self._step) >= self._steps

    @property
    def steps(self) -> int:
        return self._steps

    def predict(self, inputs: Tensor) -> Tensor:
        return _with_one(inputs) @ self._map

    def state_dict(self) -> dict[str, Tensor]:
        return {"map": self._map, "velocity": self._velocity, "step": self._step}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self._map, self._velocity, self._step = state["map"], state["velocity"], state["step"]

    def network(self, repeat: int) -> nn.Module:
        matrix = self._map[repeat]
        linear = nn.Linear(matrix.shape[0] - 1, matrix.shape[1], dtype=torch.float64)
        with torch.no_grad():
            linear.weight.copy_(matrix[:-1].T)
            linear.bias.copy_(matrix[-1])
        return linear


def _with_one(inputs: Tensor) -> Tensor:
    return torch.cat([inputs, torch.ones_like(inputs[..., :1])], -1)


def linear_data(repeats: int = 3, rows: int = 40, validation: bool = False, seed: int = 0) -> TrainingData:
    """Rows of a noisy linear map, other ones in each repeat."""
    generator = torch.Generator().manual_seed(seed)
    slope = torch.tensor([[1.0, -0.5], [0.3, 0.8], [-0.2, 0.1]], dtype=torch.float64)

    def draw(count: int, held: TrainingData | None) -> TrainingData:
        inputs = 2 * torch.rand(repeats, count, 3, generator=generator, dtype=torch.float64) - 1
        noise = 0.05 * torch.randn(repeats, count, 2, generator=generator, dtype=torch.float64)
        ones = torch.ones(repeats, count, dtype=torch.float64)
        return TrainingData(inputs, inputs @ slope + noise, ones, torch.arange(repeats), held)

    return draw(rows, draw(15, None) if validation else None)
