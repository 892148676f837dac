"""The protocol of a learner. A new learner is one file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor, nn


@dataclass(frozen=True)
class TrainingData:
    """Scaled data of `r` repeats at once; a repeat with fewer rows than another is padded with weight 0.

    Attributes:
        inputs: features in about [-1, 1], `r x s x i` [1].
        targets: outputs standardised by the training rows (mean 0, unit deviation), `r x s x o` [1].
        weights: row weights, `r x s` [1]; 0 marks a padded row.
        seeds: one seed a repeat, `r`, int64.
        validation: rows held out from training for early stopping and model choice, or None.
        metric: in which channels the error of a row is judged, `r x s x c x o`: this matrix times (output - target),
            such as the pose error that joint deviations cause. None = the outputs themselves. Learners may leave it
            aside.
        angles: how many of the features, the last ones, are scaled angles given by their sines
            and cosines; 0 unless the learner's `reads_angles` asks for them.
        angle_step: size of these features, `r x angles` [rad]; None = not known.
        angle_outputs: the output that is the deviation of each of these joints itself; () = not known.
    """

    inputs: Tensor
    targets: Tensor
    weights: Tensor
    seeds: Tensor
    validation: TrainingData | None = None
    metric: Tensor | None = None
    angles: int = 0
    angle_step: Tensor | None = None
    angle_outputs: tuple[int, ...] = ()


@runtime_checkable
class Learner(Protocol):
    """`start`, then `step` until `finished`; `predict` and `network` at any time after `start`.

    A learner with the attribute `reads_angles` set gets the scaled angles of turning joints as its last features.

    All repeats advance together in one call, as the leading dimension of every tensor. Two learners started on the
    same data with the same seeds give the same tensors; a learner whose state was saved and loaded continues to the
    same result, bit by bit. No global random state is read or set.

    A learner may also have
        variance(inputs: Tensor) -> Tensor: predictive variance of a *newly measured* standardised output, that of the
            model and of the noise together, above 0 and finite for every finite input. inputs: `r x s x i` [1]; returns
            `r x s x o` [1]. Its networks then have a method `variance` that gives the same numbers.
        refits, begin_from(state): whether, and how, it goes on from the state of an earlier training on fewer of the
            same rows in the same scaling; called after `start`, in place of beginning anew.
        condition(state): takes what a model on other rows has learned beside them (hyperparameters), for those of
            `start`; a learner without it is trained again.
        converged -> Tensor: property, `r`, bool: False where the learner's own criterion was not met when its steps
            ended, or where the data let it do no more than the constant.

    A learner that cannot go on in any repeat raises `MethodFailedError` with one sentence; one repeat that fails among
    others falls back to the constant and counts as not converged. No learner gives NaN.
    """

    name: str

    def start(self, data: TrainingData) -> None:
        """Take the data and make the initial state."""

    def step(self) -> dict[str, Tensor]:
        """One generation, iteration or candidate step; metrics by name, each `r` or `r x k`.

        Of every learner: `error_train`, `r`, the weighted mean squared standardised error of the current model on the
        training rows, and `evaluations`, `r`, how often so far all training rows were passed through one model: a
        joined network counts one, a Jacobian one for each output, a leave-one-out error one, a marginal likelihood one.
        """

    @property
    def finished(self) -> bool:
        """True when a further step would change nothing or the budget is spent."""

    @property
    def steps(self) -> int:
        """Steps planned in all, for the progress bar (an upper bound)."""

    def predict(self, inputs: Tensor) -> Tensor:
        """Current best model. inputs: `r x s x i` [1]; returns `r x s x o` [1]."""

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that changes in `step`, flat, as tensors.

        A counter is a 0-d int64 tensor; every other tensor leads with the repeats, since early stopping puts together
        the states of different steps, one a repeat.
        """

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back a state; call `start` with the same data first."""

    def network(self, repeat: int) -> nn.Module:
        """The current best model of one repeat as a plain module, `... x i` -> `... x o`, float64.

        Only operators that ONNX Runtime has in double (matmul, add, mul, div, sqrt, max, sum, sigmoid, tanh, relu, exp,
        sin, cos, where). Where the learner has `variance`, so has the module: `... x i` -> `... x o`.
        """


def weighted_mse(predicted: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
    """Mean squared error over rows and outputs. predicted, targets: `r x s x o`; weights: `r x s`; returns `r`."""
    per_row = (predicted - targets).square().mean(-1)
    return (per_row * weights).sum(-1) / weights.sum(-1)


_VERBS = ("start", "step", "finished", "steps", "predict", "state_dict", "load_state_dict", "network")


def missing_verbs(learner: object) -> list[str]:
    """What `learner` lacks of `Learner`.

    The verbs are asked of its class: `isinstance` would read the properties, which a learner that was not started may
    not have yet (Python before 3.12).
    """
    missing = [verb for verb in _VERBS if not hasattr(type(learner), verb)]
    return missing if isinstance(getattr(learner, "name", None), str) else ["name", *missing]
