"""What learners share whose model is one masked network a repeat."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from ccnn_torch.evolution.masked_network import MaskedNetwork
from ccnn_torch.evolution.network import forward
from ccnn_torch.evolution.spread import Spread, readout_spread, spread_variance
from ccnn_torch.learners.protocol import TrainingData


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

    def genome(self, repeat: int) -> tuple[list[Tensor], list[Tensor]]:
        """Masks and weights of one repeat's model, dead nodes included: `out x in` and `out x (in or in + 1)`."""
        masks, weights = self._model()
        return [mask[repeat, 0] for mask in masks], [weight[repeat, 0] for weight in weights]

    def network(self, repeat: int) -> MaskedNetwork:
        """The model of one repeat, pruned of its dead nodes."""
        spread = self._spread()
        return MaskedNetwork(*self.genome(repeat), spread.factors[repeat], spread.noise[repeat])

    def _spread(self) -> Spread:
        return readout_spread(*self._model(), self._data.inputs, self._data.targets, self._data.weights)
