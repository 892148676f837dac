"""Train one method: choose the number of steps on rows held out, then refit on all training rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccnn_torch.calibration.dataset import Dataset
from ccnn_torch.calibration.early_stop import (
    Choice,
    Plan,
    WatchPhase,
    choose,
    evaluations_until,
    moved,
    predictive_variance,
)
from ccnn_torch.compensation.networks import describe_network
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.run_folder.folder import RunFolder
from ccnn_torch.training import Scaling, Training, train, weighted_mse


@dataclass
class Fitted:
    """A trained method: the learner in its chosen state, its scaling, and how it went.

    Attributes:
        data: the training rows that the learner was fitted to.
        training, choice: the fit on all training rows, and the result on held-out rows before it (None = none were).
        score: what repeats and methods are compared by, lower is better, `r`: the mean squared standardised error on
            the held-out rows, or where none were held out on the training rows.
        sd_scale: what the learner's predictive sd is multiplied by so that its intervals cover what they claim, by the
            held-out rows; 1 where there were none. `r x n` [1].
        seconds: inside the learner, both trainings.
    """

    name: str
    learner: Learner
    scaling: Scaling
    data: TrainingData
    training: Training
    choice: Choice | None
    score: Tensor
    sd_scale: Tensor
    seconds: float

    def predict(self, inputs: Tensor) -> Tensor:
        """Joint deviations. inputs: `r x s x i` [SI]; returns `r x s x n` [SI]."""
        device = self.training.best_step.device
        with torch.no_grad():
            return self.scaling.restore(self.learner.predict(self.scaling.features(inputs).to(device)).cpu())

    def sd(self, inputs: Tensor) -> Tensor:
        """Standard deviation of a newly measured joint deviation. inputs: `r x s x i` [SI]; returns `r x s x n` [SI].

        Raises:
            MethodFailedError: the learner's variance is not finite, or not above 0.
        """
        device = self.training.best_step.device
        with torch.no_grad():
            features = self.scaling.features(inputs).to(device)
            variance = predictive_variance(self.learner, self.data, features).cpu()
        return variance.sqrt() * (self.scaling.deviation * self.sd_scale).unsqueeze(1)

    @property
    def converged(self) -> Tensor | None:
        """Whether the learner met its own criterion by its last step, `r` bool; None = it does not report it.

        Where rows were held out this is of the training before the refit, since the refit ends where they decided.
        """
        found = self.training.converged if self.choice is None else self.choice.converged
        return None if found is None else found.cpu()

    @property
    def evaluations(self) -> Tensor | None:
        """Passes of all training rows through one model, both trainings, `r`; None = the learner does not count."""
        own = evaluations_until(self.training)
        before = None if self.choice is None else self.choice.evaluations
        return own if own is None or before is None else own + before


def check_storable(name: str, learner: Learner) -> None:
    """Look at the network of a learner that was started on a few random rows.

    Raises:
        InputError: no model file can hold it.
    """
    rows = torch.rand(1, 40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    weights, seeds = torch.ones(1, 40, dtype=torch.float64), torch.zeros(1, dtype=torch.int64)
    learner.start(TrainingData(rows, rows.flip(-1), weights, seeds))
    try:
        describe_network(learner.network(0))
    except InputError as problem:
        raise InputError(f"methods: {name}: {problem}; or write no model files: save_models=false") from None


def fit_method(
    name: str,
    make: Callable[[], Learner],
    dataset: Dataset,
    plan: Plan,
    folder: RunFolder | None,
    watch: WatchPhase,
) -> Fitted:
    """Train one method in one or two phases, each with its own checkpoint.

    Raises:
        InputError: too few rows.
        MethodFailedError: the learner cannot go on, or gives numbers that are not finite.
    """
    choice = choose(name, make, dataset, plan, folder, watch) if plan.holds_out else None
    return refit(name, make, dataset, plan, choice, folder, watch)


def refit(
    name: str,
    make: Callable[[], Learner],
    dataset: Dataset,
    plan: Plan,
    choice: Choice | None,
    folder: RunFolder | None,
    watch: WatchPhase,
) -> Fitted:
    """The second phase of `fit_method`: train on all training rows, for as many steps as were chosen.

    A learner that can go on from the model of the first phase does, in that phase's scaling.
    """
    learner = make()
    goes_on = choice is not None and choice.state is not None and getattr(learner, "refits", False)
    data, scaling = dataset.scaled("fit", False, learner, choice.scaling if choice is not None and goes_on else None)
    data = moved(data, plan.device)
    training = train(
        learner,
        data,
        begin_from=choice.state if choice is not None and goes_on else None,
        callbacks=watch("fit", scaling),
        checkpoint=folder.checkpoint(name, "fit") if folder else None,
        facts=folder.facts if folder else None,
        every=plan.checkpoint_every,
        stop_at=choice.best_step.to(plan.device) if choice is not None and plan.early_stop else None,
    )
    if choice is not None:
        score, scale, before = choice.best_validation, choice.sd_scale, choice.seconds
    else:
        score = weighted_mse(learner.predict(data.inputs), data.targets, data.weights).cpu()
        scale, before = torch.ones_like(scaling.deviation), 0.0
    fitted = Fitted(name, learner, scaling, data, training, choice, score, scale, before + training.seconds)
    bad = ~(fitted.predict(dataset.inputs).isfinite() & fitted.sd(dataset.inputs).isfinite()).all((1, 2))
    if bool(bad.any()):
        which = ", ".join(str(k) for k in torch.nonzero(bad).squeeze(-1).tolist())
        raise MethodFailedError(f"{name} gives predictions that are not finite in repeat {which}")
    return fitted


def on_other_rows(fitted: Fitted, make: Callable[[], Learner], dataset: Dataset, plan: Plan) -> Fitted:
    """A trained method of one repeat with what it chose, on other rows.

    A learner whose model is conditioned on its rows (`condition`) keeps its hyperparameters, another is trained again
    for as many steps.

    Raises:
        MethodFailedError: as `refit`.
    """
    learner = make()
    condition = getattr(learner, "condition", None)
    if condition is None:
        return replace(
            refit(fitted.name, make, dataset, plan, fitted.choice, None, lambda *_: []), sd_scale=fitted.sd_scale
        )
    data = moved(dataset.scaled("fit", False, learner, fitted.scaling)[0], plan.device)
    learner.start(data)
    condition(fitted.learner.state_dict())
    return replace(fitted, learner=learner, data=data)
