"""Train one method, or choose one of several: the number of steps by rows held out, then refit on all training rows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

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
from ccnn_torch.calibration.statistics import spread
from ccnn_torch.compensation.networks import describe_network
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.report.results.run import Auto, Compared
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


_SIMPLEST = "constant"


@dataclass
class Comparison:
    """Result of cross-validation for each method, and the method it chooses.

    A method that the budget ended between two steps is compared with what it has: its best step so far is what its
    refit would take, so the comparison is fair to the model that the user would get. One that did not get to its first
    step is not compared.

    Attributes:
        budget: seconds inside the learners that were given.
        compared: by name, in the order tried.
        skipped: why a method was not compared, a sentence each.
        spent: seconds of the budget that are gone.
    """

    budget: float
    folds: int
    compared: dict[str, Choice] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    spent: float = 0.0

    def error(self, name: str) -> float:
        """Mean cross-validation error over the repeats [1]; 1 is about that of a constant."""
        return float(self.compared[name].best_validation.mean())

    def standard_error(self, name: str) -> float:
        """Of that mean, from the scatter over the folds: mean over the repeats [1]."""
        errors = self.compared[name].errors
        return float(errors.std(1).mean()) / math.sqrt(errors.shape[1])

    @property
    def order(self) -> list[str]:
        """Best first; but the constant comes first where it is within one standard error of the best."""
        found = sorted(self.compared, key=self.error)
        if self._constant_will_do(found[0]):
            found.remove(_SIMPLEST)
            found.insert(0, _SIMPLEST)
        return found

    def why(self) -> str:
        """One sentence about the choice."""
        best = min(self.compared, key=self.error)
        error = f"{self.error(best):.4g} ± {self.standard_error(best):.2g}"
        if self._constant_will_do(best):
            return (
                f"The constant is chosen: its cross-validation error ({self.error(_SIMPLEST):.4g}) is within one "
                f"standard error of the best ({best}, {error}), so nothing more is to be learned from these rows."
            )
        return f"{best} is chosen: its cross-validation error is the lowest ({error})."

    def block(self, chosen: str) -> Auto:
        """For `results.json`."""
        compared = {
            name: Compared(
                cv=spread(choice.best_validation),
                standard_error=self.standard_error(name),
                seconds=choice.seconds,
                steps=choice.step,
                stopped=not choice.ended,
            )
            for name, choice in self.compared.items()
        }
        why = self.why() + f" It could not be refitted, so {chosen} is taken." * (chosen != self.order[0])
        return Auto(
            budget=self.budget,
            folds=self.folds,
            compared=compared,
            skipped=dict(self.skipped),
            chosen=chosen,
            why=why,
        )

    def _constant_will_do(self, best: str) -> bool:
        if _SIMPLEST not in self.compared or best == _SIMPLEST:
            return False
        return self.error(_SIMPLEST) <= self.error(best) + self.standard_error(best)


def compare(
    makers: Mapping[str, Callable[[], Learner]],
    dataset: Dataset,
    plan: Plan,
    budget: float,
    folder: RunFolder | None,
    watch: Callable[[str], WatchPhase],
) -> Comparison:
    """Cross-validate one method after the other while budget is left.

    A resumed run decides as it would have: the checkpoint of each method has the seconds that it took.

    Args:
        makers: what makes the learner of each method, in the order to try them.
        budget: seconds inside the learners, for all methods together.
        folder: where checkpoints go; None = nowhere.

    Raises:
        MethodFailedError: no method could be compared: they failed, or the budget was too small.
    """
    comparison = Comparison(budget, plan.folds)
    early = f"the budget of {budget:g} s was spent before"
    for name, make in makers.items():
        began = time.perf_counter()
        try:
            if comparison.spent >= budget:
                raise MethodFailedError(f"{early} it began")
            choice = choose(name, make, dataset, plan, folder, watch(name), budget - comparison.spent)
            if choice is None:
                comparison.spent = budget
                raise MethodFailedError(f"{early} its first step")
            comparison.compared[name] = choice
            comparison.spent += choice.seconds
        except MethodFailedError as problem:
            comparison.skipped[name] = str(problem)
            comparison.spent += time.perf_counter() - began
    if not comparison.compared:
        raise MethodFailedError("; ".join(f"{name}: {sentence}" for name, sentence in comparison.skipped.items()))
    return comparison
