"""Train one method on a dataset: choose how long by validation if asked, then refit on all training rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.runs.dataset import Dataset
from ccnn_torch.runs.folder import RunFolder
from ccnn_torch.training import Callback, Scaling, Training, train, weighted_mse

__all__ = ["Fitted", "Plan", "fit_method"]

_Phase = tuple[Learner, TrainingData, Scaling, Training]


@dataclass(frozen=True)
class Plan:
    """How to train: with early stopping or without, where, and how often to write a checkpoint.

    Attributes:
        early_stop: hold the validation rows out, find the best step, then refit on all training rows for so long.
        patience: steps without improvement after which the search for the best step ends; None = go to the end.
    """

    early_stop: bool
    patience: int | None
    checkpoint_every: int
    device: str = "cpu"


@dataclass
class Fitted:
    """A trained method: the learner in its chosen state, its scaling, and how it went.

    Attributes:
        training, choice: the fit on all training rows, and the search for the best step before it (or None).
        score: what repeats and methods are compared by, lower is better, `r`: the mean squared standardised error on
            the validation rows, or where none were held out on the training rows.
    """

    name: str
    learner: Learner
    scaling: Scaling
    training: Training
    choice: Training | None
    score: Tensor
    seconds: float

    def predict(self, inputs: Tensor) -> Tensor:
        """Joint deviations. inputs: `r x s x i` [SI]; returns `r x s x n` [SI]."""
        device = self.training.best_step.device
        with torch.no_grad():
            return self.scaling.restore(self.learner.predict(self.scaling.features(inputs).to(device)).cpu())


def fit_method(
    name: str,
    make: Callable[[], Learner],
    dataset: Dataset,
    plan: Plan,
    folder: RunFolder | None,
    watch: Callable[[str, Scaling], list[Callback]],
) -> Fitted:
    """Train one method in one or two phases, each with its own checkpoint.

    Args:
        make: makes a fresh learner.
        folder: where checkpoints go; None = nowhere.
        watch: callbacks of a phase (`choose` or `fit`), given that phase's scaling.
    """

    def phase(label: str, part: str, validate: bool, stop_at: Tensor | None) -> _Phase:
        data, scaling = dataset.scaled(part, validate)
        data = _to(data, plan.device)
        learner = make()
        training = train(
            learner,
            data,
            callbacks=watch(label, scaling),
            checkpoint=folder.checkpoint(name, label) if folder else None,
            every=plan.checkpoint_every,
            patience=plan.patience if validate else None,
            stop_at=stop_at,
        )
        return learner, data, scaling, training

    choice, seconds, stop_at = None, 0.0, None
    if plan.early_stop:
        *_, choice = phase("choose", "train", True, None)
        seconds, stop_at = choice.seconds, choice.best_step
    learner, data, scaling, training = phase("fit", "fit", False, stop_at)
    if choice is not None:
        score = choice.best_validation
    else:
        score = weighted_mse(learner.predict(data.inputs), data.targets, data.weights)
    return Fitted(name, learner, scaling, training, choice, score.cpu(), seconds + training.seconds)


def _to(data: TrainingData, device: str) -> TrainingData:
    return TrainingData(
        data.inputs.to(device),
        data.targets.to(device),
        data.weights.to(device),
        data.seeds.to(device),
        None if data.validation is None else _to(data.validation, device),
        None if data.metric is None else data.metric.to(device),
    )
