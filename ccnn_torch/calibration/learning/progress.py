"""Callbacks of a run: the progress bar on a terminal, and held-out errors in SI at every step."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ccnn_torch.calibration.rows.dataset import Dataset
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.report.screen import progress_bar
from ccnn_torch.training import Scaling


def genome(learner: Learner, repeat: int) -> tuple[list[Tensor], list[Tensor]]:
    """Masks `out x in` and weights `out x in [+ 1]` of one repeat's network; empty for a learner without masks."""
    found = getattr(learner, "genome", None)
    return ([], []) if found is None else found(repeat)


class ProgressBar:
    """One line on stderr: what is trained, steps done, time left, the error so far. Silent off a terminal."""

    def __init__(self, label: str, quiet: bool) -> None:
        self._label = label
        self._progress = progress_bar(quiet, steps=True)

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        self._task = self._progress.add_task(self._label, total=learner.steps, completed=step, note="")
        self._progress.start()

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        note = ""
        for name, text in (("error_validation", "validation mse"), ("error_train", "training error")):
            if name in metrics:
                note = f"{text} {float(metrics[name].median()):.4g} (standardised)"
                break
        self._progress.update(self._task, completed=step, note=note)

    def on_end(self) -> None:
        self._progress.stop()


@dataclass
class HeldOut:
    """Adds the held-out mse [SI²], mae [SI] and sse [SI²] of every joint to the metrics of a step, to be watched.

    Nothing is chosen by these figures: they are for the curves alone.
    """

    dataset: Dataset
    scaling: Scaling
    joints: tuple[str, ...]
    one_unit: bool
    every: int = 1
    last: dict[str, Tensor] = field(default_factory=dict)

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        rows = self.dataset.usable_rows("test")
        device = data.inputs.device
        inputs = rows.take(self.dataset.inputs)
        self._learner = learner
        self._features = self.scaling.features(inputs).to(device)
        self._truth = rows.take(self.dataset.deviation)
        self._weights = rows.weights

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        if step % self.every == 0 or not self.last or self._learner.finished:
            self.last = self._errors()
        metrics.update(self.last)

    def on_end(self) -> None:
        pass

    def _errors(self) -> dict[str, Tensor]:
        predicted = self.scaling.restore(self._learner.predict(self._features).cpu())
        error = (predicted - self._truth) * self._weights.unsqueeze(-1)
        rows = self._weights.sum(-1, keepdim=True)
        squared, absolute = error.square().sum(1), error.abs().sum(1)
        errors: dict[str, Tensor] = {}
        for j, joint in enumerate(self.joints):
            errors[f"heldout_mse_{joint}"] = squared[:, j] / rows[:, 0]
            errors[f"heldout_mae_{joint}"] = absolute[:, j] / rows[:, 0]
            errors[f"heldout_sse_{joint}"] = squared[:, j]
        if self.one_unit:
            errors["heldout_mse_all"] = squared.mean(-1) / rows[:, 0]
        return {name: value.to(torch.float64) for name, value in errors.items()}
