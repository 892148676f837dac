"""Early stopping, score and scale of the predictive standard deviation, on rows held out from training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.calibration.dataset import Dataset
from ccnn_torch.calibration.statistics import sd_scale
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.records.splits import fold_splits
from ccnn_torch.run_folder.folder import RunFolder
from ccnn_torch.training import Callback, Scaling, Training, train

WatchPhase = Callable[[str, Scaling], list[Callback]]
"""Callbacks of a phase (`choose` or `fit`), given that phase's scaling."""

_SMALLEST_VARIANCE = 1e-24


@dataclass(frozen=True)
class Plan:
    """How to train: with early stopping or without, where, and how often to write a checkpoint.

    Attributes:
        early_stop: find the best step on rows held out from training, then refit on all training rows for so long;
            without it every training goes to the learner's end.
        patience: steps without improvement after which the search for the best step ends; None = go to the end.
        folds: how rows are held out: 1 = the validation rows of the split (only with early stopping), more = in so
            many folds of the training rows, each once.
        kind: of the split, which the folds keep to.
    """

    early_stop: bool
    patience: int | None
    checkpoint_every: int
    device: str = "cpu"
    folds: int = 1
    kind: str = "random"

    @property
    def holds_out(self) -> bool:
        """Whether rows are held out from a first training, to choose by."""
        return self.early_stop or self.folds > 1


@dataclass(frozen=True)
class Choice:
    """Result on the held-out rows of the choosing phase; every tensor leads with the repeats.

    Attributes:
        best_step: steps after which the mean error over the folds was lowest, `r` int64.
        errors: mean squared standardised error on the held-out rows then, `r x folds`.
        sd_scale: by `sd_scale` from all held-out rows, `r x n`.
        converged: the learner's own report at its end, over all folds, `r` bool; None = it does not report it.
        evaluations: of all folds together, `r`; None = the learner does not count.
        step, seconds: steps done, and time spent inside the learner.
        ended: false where the budget ended it.
        state, scaling: of the learner in its chosen state, where every repeat held out one set of rows.
    """

    best_step: Tensor
    errors: Tensor
    sd_scale: Tensor
    converged: Tensor | None
    evaluations: Tensor | None
    step: int
    seconds: float
    ended: bool = True
    state: dict[str, Tensor] | None = None
    scaling: Scaling | None = None

    @property
    def best_validation(self) -> Tensor:
        """What repeats and methods are compared by, lower is better, `r`: the mean over the folds."""
        return self.errors.mean(1)


def choose(
    name: str,
    make: Callable[[], Learner],
    dataset: Dataset,
    plan: Plan,
    folder: RunFolder | None,
    watch: WatchPhase,
    budget: float | None = None,
) -> Choice | None:
    """Train with rows held out. All folds of all repeats are repeats of one training.

    Args:
        folder: folder of the checkpoint; None = none is written.
        budget: seconds inside the learner after which no further step begins.

    Returns:
        None where the budget was spent before the first step.

    Raises:
        InputError: too few rows to hold some out.
        MethodFailedError: the learner cannot go on, or gives numbers that are not finite.
    """
    learner = make()
    data, scaling = fold_dataset(dataset, plan.kind, plan.folds).scaled("train", True, learner)
    data = moved(data, plan.device)
    held = data.validation
    assert held is not None
    training = train(
        learner,
        data if plan.early_stop else replace(data, validation=None),
        callbacks=watch("choose", scaling),
        checkpoint=folder.checkpoint(name, "choose") if folder else None,
        facts=folder.facts if folder else None,
        every=plan.checkpoint_every,
        patience=plan.patience if plan.early_stop else None,
        folds=plan.folds,
        budget=budget,
    )
    if training.step == 0:
        return None
    with torch.no_grad():
        residuals = held.targets - learner.predict(held.inputs)
        sd = predictive_variance(learner, data, held.inputs).sqrt()
    errors = (residuals.square().mean(-1) * held.weights).sum(-1) / held.weights.sum(-1)
    if not bool(errors.isfinite().all()) or (plan.early_stop and int(training.best_step.min()) == 0):
        raise MethodFailedError(f"{name} gives predictions that are not finite on the rows held out from training")
    repeats = len(dataset.seeds)
    outputs = residuals.shape[-1]

    def by_repeat(values: Tensor | None) -> Tensor | None:
        return None if values is None else values.cpu().view(repeats, -1)

    converged = by_repeat(training.converged)
    counted = by_repeat(training.history["evaluations"][-1] if "evaluations" in training.history else None)
    return Choice(
        best_step=training.best_step.cpu().view(repeats, -1)[:, 0],
        errors=errors.cpu().view(repeats, -1),
        sd_scale=sd_scale(
            residuals.cpu().reshape(repeats, -1, outputs),
            sd.cpu().reshape(repeats, -1, outputs),
            held.weights.cpu().reshape(repeats, -1),
        ),
        converged=None if converged is None else converged.all(1),
        evaluations=None if counted is None else counted.to(torch.float64).sum(1),
        step=training.step,
        seconds=training.seconds,
        ended=training.ended,
        state=learner.state_dict() if plan.folds == 1 else None,
        scaling=scaling if plan.folds == 1 else None,
    )


def fold_dataset(dataset: Dataset, kind: str, folds: int) -> Dataset:
    """The same rows with every repeat standing there once a fold, its seed and test rows kept; `r * folds` repeats.

    Args:
        kind: of the split, see `fold_splits`.
        folds: 1 leaves the dataset as it is.
    """
    if folds == 1:
        return dataset
    pairs = zip(dataset.splits, dataset.seeds, strict=True)
    return replace(
        dataset,
        inputs=dataset.inputs.repeat_interleave(folds, 0),
        deviation=dataset.deviation.repeat_interleave(folds, 0),
        usable=dataset.usable.repeat_interleave(folds, 0),
        splits=[part for split, seed in pairs for part in fold_splits(split, kind, folds, seed)],
        seeds=[seed for seed in dataset.seeds for _ in range(folds)],
        jacobian=None if dataset.jacobian is None else dataset.jacobian.repeat_interleave(folds, 0),
    )


def predictive_variance(learner: Learner, data: TrainingData, inputs: Tensor) -> Tensor:
    """Variance of newly measured standardised outputs, `r x s x o` [1]; inputs: `r x s x i` [1].

    A learner without `variance` gets that of its residuals on the training rows, the same everywhere.

    Raises:
        MethodFailedError: the learner's variance is not finite, or not above 0.
    """
    variance = getattr(learner, "variance", None)
    if variance is None:
        error = (learner.predict(data.inputs) - data.targets).square() * data.weights.unsqueeze(-1)
        found = error.sum(1, keepdim=True) / data.weights.sum(1).view(-1, 1, 1)
        return found.clamp_min(_SMALLEST_VARIANCE).expand(-1, inputs.shape[1], -1)
    given: Tensor = variance(inputs)
    if not bool((given.isfinite() & (given > 0)).all()):
        raise MethodFailedError(f"{learner.name} gives a predictive variance that is not finite, or not above 0")
    return given


def moved(data: TrainingData, device: str) -> TrainingData:
    """The same data on a device."""
    values = {field.name: getattr(data, field.name) for field in fields(data)}
    tensors: dict[str, Any] = {name: value.to(device) for name, value in values.items() if isinstance(value, Tensor)}
    held = None if data.validation is None else moved(data.validation, device)
    return replace(data, **tensors, validation=held)


def evaluations_until(training: Training) -> Tensor | None:
    """Evaluations up to the step whose state each repeat was left in, `r`; None where the learner does not count."""
    counted = training.history.get("evaluations")
    if counted is None:
        return None
    last = (training.best_step.to(counted.device) - 1).clamp_min(0)
    return counted.gather(0, last.unsqueeze(0))[0].to(torch.float64).cpu()
