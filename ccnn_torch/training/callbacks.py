"""The protocol of a callback of a training."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from ccnn_torch.learners.protocol import Learner, TrainingData


class Callback(Protocol):
    """Called by `train` in the order given; may add metrics for those after it, must not change the learner."""

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        """step: steps already done, more than 0 when a training was resumed."""

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        """step: 1 for the first; metrics by name, each `r` or `r x k`."""

    def on_end(self) -> None:
        """After the last step, also when the training was interrupted."""
