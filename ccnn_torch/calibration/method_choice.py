"""`methods=auto`: cross-validation of the methods within a time budget."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ccnn_torch.calibration.dataset import Dataset
from ccnn_torch.calibration.early_stop import Choice, Plan, WatchPhase, choose
from ccnn_torch.calibration.statistics import spread
from ccnn_torch.errors import MethodFailedError
from ccnn_torch.learners import Learner
from ccnn_torch.report.results.run import Auto, Compared
from ccnn_torch.run_folder.folder import RunFolder

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
    for name, make in makers.items():
        found = _judge(name, make, dataset, plan, comparison, folder, watch)
        if isinstance(found, Choice):
            comparison.compared[name] = found
            comparison.spent += found.seconds
        else:
            comparison.skipped[name] = found
    if not comparison.compared:
        raise MethodFailedError("; ".join(f"{name}: {sentence}" for name, sentence in comparison.skipped.items()))
    return comparison


def _judge(
    name: str,
    make: Callable[[], Learner],
    dataset: Dataset,
    plan: Plan,
    comparison: Comparison,
    folder: RunFolder | None,
    watch: Callable[[str], WatchPhase],
) -> Choice | str:
    """Cross-validate one method; returns a sentence where that is not to be had."""
    budget = comparison.budget
    left = budget - comparison.spent
    if left <= 0:
        return f"the budget of {budget:g} s was spent before it began"
    began = time.perf_counter()
    try:
        choice = choose(name, make, dataset, plan, folder, watch(name), left)
    except MethodFailedError as problem:
        comparison.spent += time.perf_counter() - began
        return str(problem)
    if choice is None:
        comparison.spent = budget
        return f"the budget of {budget:g} s was spent before its first step"
    return choice
