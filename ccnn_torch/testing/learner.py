"""Conformance checks of a learner. See `ccnn_torch.learners.Learner`."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.learners.protocol import missing_verbs
from ccnn_torch.training import weighted_mse


def check_learner(factory: Callable[[], Learner], rows: int = 40) -> None:
    """Train fresh learners on small synthetic data, as one repeat and as three, and check the contract of `Learner`.

    Give a factory with small budgets: the learner is trained to its end about six times.

    Args:
        factory: makes a fresh learner.
        rows: training rows of each repeat.

    Raises:
        AssertionError: one sentence on what violates the contract.
    """
    for repeats in (1, 3):
        data = _data(repeats, rows)
        untouched = _data(repeats, rows)
        before = global_random_state()
        learner, error = _check_training(factory, data)
        _require(global_random_state() == before, "training changes a global random state; draw from data.seeds only")
        for part, expected in ((data.inputs, untouched.inputs), (data.targets, untouched.targets)):
            _require(torch.equal(part, expected), "training changes the data it was given")
        _check_network(learner, data)
        _check_variance(learner, data)
        _check_converged(learner, data)
        _check_padding(factory, learner, data)
        _check_training_error(learner, error, data)
        _check_repetition(factory, learner, data)


def _data(repeats: int, rows: int) -> TrainingData:
    """A smooth function of three inputs with noise; repeats differ in noise and in rows used."""
    generator = torch.Generator().manual_seed(7)
    inputs = 2 * torch.rand(repeats, rows, 3, generator=generator, dtype=torch.float64) - 1
    clean = torch.stack([inputs[..., 0] + 0.3 * inputs[..., 1] ** 2, torch.sin(2 * inputs[..., 2])], dim=-1)
    targets = clean + 0.05 * torch.randn(repeats, rows, 2, generator=generator, dtype=torch.float64)
    weights = torch.ones(repeats, rows, dtype=torch.float64)
    for repeat in range(repeats):
        weights[repeat, rows - 2 * repeat - 1 :] = 0
    there = weights.unsqueeze(-1) > 0
    mean = (targets * there).sum(1, keepdim=True) / there.sum(1, keepdim=True)
    deviation = (((targets - mean) ** 2 * there).sum(1, keepdim=True) / there.sum(1, keepdim=True)).sqrt()
    return TrainingData(
        torch.where(there, inputs, 0.0),
        torch.where(there, (targets - mean) / deviation, 0.0),
        weights,
        torch.arange(11, 11 + repeats),
    )


def _check_training(factory: Callable[[], Learner], data: TrainingData) -> tuple[Learner, Tensor]:
    """The trained learner, and `error_train` of its last step, `r`."""
    learner = factory()
    kind = type(learner).__name__
    missing = missing_verbs(learner)
    _require(not missing, f"{kind} lacks {', '.join(missing)} of ccnn_torch.learners.Learner")
    _require(learner.name != "", f"{kind}.name must be a text that is not empty")
    learner.start(data)
    _check_prediction(learner, data, "before the first step")
    planned = learner.steps
    _require(isinstance(planned, int) and planned >= 1, f"steps must be a whole number of at least 1, is {planned!r}")
    taken = 0
    error = evaluations = torch.zeros(len(data.seeds), dtype=torch.float64)
    while not learner.finished:
        _require(taken < planned, f"the learner is not finished after the {planned} steps that it planned")
        before = evaluations
        metrics = learner.step()
        _check_metrics(metrics, len(data.seeds))
        error, evaluations = metrics["error_train"], metrics["evaluations"]
        _require(bool((evaluations >= before).all()), "metric 'evaluations' falls; it counts all evaluations so far")
        taken += 1
    _require(bool((evaluations >= 1).all()), "metric 'evaluations' ends below 1; it counts passes of the training rows")
    _check_prediction(learner, data, "after the last step")
    return learner, error


def _check_metrics(metrics: dict[str, Tensor], repeats: int) -> None:
    for name, value in metrics.items():
        shape = tuple(value.shape)
        _require(
            len(shape) in (1, 2) and shape[0] == repeats,
            f"metric {name!r} has shape {shape}; write r or r x k, here r = {repeats}",
        )
        _require(not bool(value.isnan().any()), f"metric {name!r} is NaN")
    for name in ("error_train", "evaluations"):
        _require(
            name in metrics and metrics[name].dim() == 1, f"step gives no metric {name!r} with one number a repeat"
        )


def _check_prediction(learner: Learner, data: TrainingData, when: str) -> None:
    for rows in (data.inputs.shape[1], 5, 1):
        inputs = data.inputs[:, :rows]
        predicted = learner.predict(inputs)
        expected = (len(data.seeds), rows, data.targets.shape[-1])
        _require(
            tuple(predicted.shape) == expected,
            f"predict {when} gives shape {tuple(predicted.shape)} for inputs {tuple(inputs.shape)}; must be {expected}",
        )
        _require(predicted.dtype == torch.float64, f"predict {when} gives {predicted.dtype}; must be float64")
        _require(bool(predicted.isfinite().all()), f"predict {when} gives numbers that are not finite")


def _check_network(learner: Learner, data: TrainingData) -> None:
    predicted = learner.predict(data.inputs)
    for repeat in range(len(data.seeds)):
        network = learner.network(repeat)
        _require(isinstance(network, nn.Module), f"network({repeat}) must be an nn.Module")
        tensors = [*network.parameters(), *network.buffers()]
        single = {str(t.dtype) for t in tensors if t.is_floating_point() and t.dtype != torch.float64}
        _require(not single, f"network({repeat}) holds {', '.join(sorted(single))}; must be float64")
        for inputs, expected in (
            (data.inputs[repeat], predicted[repeat]),
            (data.inputs[repeat, 0], predicted[repeat, 0]),
            (data.inputs[repeat].expand(2, 3, -1, -1), predicted[repeat].expand(2, 3, -1, -1)),
        ):
            got = network(inputs).detach()
            _require(
                got.shape == expected.shape and got.dtype == torch.float64,
                f"network({repeat}) gives {got.dtype} of shape {tuple(got.shape)} for inputs {tuple(inputs.shape)}; "
                f"must be float64 of shape {tuple(expected.shape)}",
            )
            worst = float((got - expected).abs().max())
            _require(worst <= 1e-9, f"network({repeat}) differs from predict by {worst:.3g}")


def _check_training_error(learner: Learner, told: Tensor, data: TrainingData) -> None:
    error = weighted_mse(learner.predict(data.inputs), data.targets, data.weights)
    _require(
        bool(torch.isclose(told, error, rtol=1e-9, atol=1e-12).all()),
        "metric 'error_train' of the last step is not the model's weighted mean squared error on the training rows",
    )


def _check_variance(learner: Learner, data: TrainingData) -> None:
    """The optional method `variance`, near the data and far from them."""
    if not hasattr(type(learner), "variance"):
        return
    variance: Callable[[Tensor], Tensor] = getattr(learner, "variance")  # noqa: B009 - no verb of Learner
    for inputs in (data.inputs, 30 * data.inputs[:, :5], 1e6 * data.inputs[:, :1]):
        found = variance(inputs)
        expected = (len(data.seeds), inputs.shape[1], data.targets.shape[-1])
        _require(
            tuple(found.shape) == expected and found.dtype == torch.float64,
            f"variance gives {found.dtype} of shape {tuple(found.shape)}; must be float64 of shape {expected}",
        )
        _require(bool((found.isfinite() & (found > 0)).all()), "variance must be finite and above 0 everywhere")
    for inputs in (data.inputs, 30 * data.inputs[:, :5]):
        found = variance(inputs)
        for repeat in range(len(data.seeds)):
            network = learner.network(repeat)
            _require(hasattr(network, "variance"), f"network({repeat}) lacks variance, which the learner has")
            of_network: Callable[[Tensor], Tensor] = getattr(network, "variance")  # noqa: B009 - no method of Module
            worst = float((of_network(inputs[repeat]) / found[repeat] - 1).abs().max())
            _require(worst <= 1e-9, f"network({repeat}).variance differs from variance by a share of {worst:.3g}")


def _check_converged(learner: Learner, data: TrainingData) -> None:
    """The optional property `converged`."""
    if not hasattr(type(learner), "converged"):
        return
    found = getattr(learner, "converged")  # noqa: B009 - no verb of Learner
    _require(
        isinstance(found, Tensor) and found.dtype == torch.bool and tuple(found.shape) == (len(data.seeds),),
        f"converged must be one bool a repeat, shape ({len(data.seeds)},)",
    )


def _check_padding(factory: Callable[[], Learner], whole: Learner, data: TrainingData) -> None:
    padded = (data.weights == 0).unsqueeze(-1)
    other = replace(
        data,
        inputs=torch.where(padded, 3.0, data.inputs),
        targets=torch.where(padded, -1000.0, data.targets),
    )
    worst = float((whole.predict(data.inputs) - _train(factory(), other).predict(data.inputs)).abs().max())
    _require(worst <= 1e-9, f"values in rows of weight 0 change the predictions by {worst:.3g}")


def _check_repetition(factory: Callable[[], Learner], whole: Learner, data: TrainingData) -> None:
    """A second training, and others that go on from states of it, end where the first one did."""
    again, stops = factory(), {0, 1, whole.steps // 2}
    again.start(data)
    for step in range(whole.steps + 1):
        if step in stops:
            _check_resume(factory, whole, again, data, step)
        if not again.finished:
            again.step()
    _check_same(whole, again, data, "two learners on the same data and seeds differ")


def _check_resume(
    factory: Callable[[], Learner], whole: Learner, stopped: Learner, data: TrainingData, step: int
) -> None:
    state = {name: value.clone() for name, value in stopped.state_dict().items()}
    for name, value in state.items():
        _require(
            value.dim() == 0 or len(value) == len(data.seeds),
            f"state {name!r} has shape {tuple(value.shape)}; it must be a number or lead with the repeats",
        )
    resumed = factory()
    resumed.start(data)
    resumed.load_state_dict(state)
    _require(
        torch.equal(stopped.predict(data.inputs), resumed.predict(data.inputs)),
        f"predictions change when the state after step {step} is saved and loaded",
    )
    _finish(resumed)
    _check_same(whole, resumed, data, f"a training that was stopped after step {step} and resumed ends elsewhere")


def _train(learner: Learner, data: TrainingData) -> Learner:
    learner.start(data)
    return _finish(learner)


def _finish(learner: Learner) -> Learner:
    while not learner.finished:
        learner.step()
    return learner


def _check_same(one: Learner, other: Learner, data: TrainingData, sentence: str) -> None:
    first, second = one.state_dict(), other.state_dict()
    _require(first.keys() == second.keys(), f"{sentence}: the states have other names")
    for name, value in first.items():
        _require(torch.equal(value, second[name]), f"{sentence}: state {name!r} is not the same")
    _require(torch.equal(one.predict(data.inputs), other.predict(data.inputs)), f"{sentence}: other predictions")


def global_random_state() -> tuple[object, ...]:
    """Of torch, Python and numpy, to be compared."""
    numpy_state = np.random.get_state()  # noqa: NPY002 - the global state is what must stay untouched
    return (
        bytes(torch.random.get_rng_state().tolist()),
        random.getstate(),
        tuple(np.asarray(part).tobytes() for part in numpy_state),
    )


def _require(holds: bool, sentence: str) -> None:
    if not holds:
        raise AssertionError(sentence)
