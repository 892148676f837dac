"""A learner of your own in one file: ridge regression on the features, their products and their squares.

ccnn run experiments/tripod.yaml 'methods=[experiments/my_learner.py:Ridge, ccnn]' out=runs/ridge
"""

from typing import Any

import torch
from torch import Tensor, nn

from ccnn_torch.compensation import register_network
from ccnn_torch.learners import TrainingData


def _terms(inputs: Tensor) -> Tensor:
    """1, the features, and their products, `... x i` -> `... x k`."""
    i = inputs.shape[-1]
    products = [inputs[..., a] * inputs[..., b] for a in range(i) for b in range(a, i)]
    return torch.cat([torch.ones_like(inputs[..., :1]), inputs, torch.stack(products, -1)], -1)


class RidgeNetwork(nn.Module):
    """What a model file holds: outputs = terms · weight."""

    def __init__(self, weight: Tensor) -> None:
        super().__init__()
        self.register_buffer("weight", weight)

    def forward(self, inputs: Tensor) -> Tensor:
        """`... x i` -> `... x o`."""
        return _terms(inputs) @ self.get_buffer("weight")

    def describe(self) -> dict[str, Any]:
        """JSON by which `from_description` makes a network of the same shape; its tensors are stored beside it."""
        return {"kind": "my_ridge", "shape": list(self.get_buffer("weight").shape)}

    @classmethod
    def from_description(cls, description: dict[str, Any]) -> "RidgeNetwork":
        """The network of a file, before its tensors are loaded."""
        return cls(torch.zeros(*description["shape"], dtype=torch.float64))


# Files with a network of this kind are read where this file was imported.
register_network("my_ridge", RidgeNetwork)


class Ridge:
    """Minimises the weighted squared error plus `ridge` times the squared coefficients, of all repeats at once."""

    name = "ridge"
    steps = 1  # planned in all
    ridge = 1e-2

    def start(self, data: TrainingData) -> None:
        """Take the data; before the first step the model is 0."""
        self._data, self._terms = data, _terms(data.inputs)
        size = (len(data.inputs), self._terms.shape[-1], data.targets.shape[-1])
        self._weight = torch.zeros(size, dtype=torch.float64)
        self._step = torch.zeros((), dtype=torch.int64)

    def step(self) -> dict[str, Tensor]:
        """Solve the normal equations; rows of weight 0 are padding."""
        weights = self._data.weights.unsqueeze(-1)
        normal = self._terms.mT @ (weights * self._terms)
        normal = normal + self.ridge * torch.eye(normal.shape[-1], dtype=torch.float64)
        self._weight = torch.linalg.solve(normal, self._terms.mT @ (weights * self._data.targets))
        self._step = self._step + 1
        square = (self._data.targets - self._terms @ self._weight).square().mean(-1)
        error = (square * self._data.weights).sum(1) / self._data.weights.sum(1)
        return {"error_train": error, "evaluations": torch.ones_like(error)}

    @property
    def finished(self) -> bool:
        """After one step."""
        return int(self._step) > 0

    def predict(self, inputs: Tensor) -> Tensor:
        """`r x s x i` -> `r x s x o`."""
        return _terms(inputs) @ self._weight

    def state_dict(self) -> dict[str, Tensor]:
        """All that a step changes."""
        return {"weight": self._weight, "step": self._step}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a state."""
        self._weight, self._step = state["weight"], state["step"]

    def network(self, repeat: int) -> nn.Module:
        """The model of one repeat."""
        return RidgeNetwork(self._weight[repeat].clone())
