"""The training loop: choice of the step per repeat, checkpoints, and going on after a stop."""

from __future__ import annotations

import dataclasses
import signal
from pathlib import Path

import pytest
import torch
from torch import Tensor
from toy import Descent, linear_data

from ccnn_torch.errors import InputError
from ccnn_torch.learners import Learner, TrainingData
from ccnn_torch.training import Scaling, Training, load_checkpoint, save_checkpoint, train, weighted_mse


class Stop(Exception):
    pass


class StopAfter:
    """Stands for a kill: leaves the loop in the middle of a step's callbacks."""

    def __init__(self, step: int) -> None:
        self._step = step

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        pass

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        if step == self._step:
            raise Stop

    def on_end(self) -> None:
        pass


def same(one: tuple[Descent, Training], other: tuple[Descent, Training]) -> None:
    for name, value in one[0].state_dict().items():
        assert torch.equal(value, other[0].state_dict()[name]), name
    assert one[1].history.keys() == other[1].history.keys()
    for name, value in one[1].history.items():
        assert torch.equal(value, other[1].history[name]), name
    assert torch.equal(one[1].best_step, other[1].best_step)
    assert torch.equal(one[1].best_validation, other[1].best_validation)


@pytest.mark.parametrize("stop", [1, 6, 7, 13, 29])
@pytest.mark.parametrize("validation", [False, True])
def test_a_stopped_training_goes_on_to_the_same_tensors(tmp_path: Path, stop: int, validation: bool) -> None:
    data = linear_data(validation=validation)
    whole = Descent()
    expected = (whole, train(whole, data, every=7))
    path = tmp_path / "a" / "checkpoint.safetensors"
    with pytest.raises(Stop):
        train(Descent(), data, callbacks=[StopAfter(stop)], checkpoint=path, every=7)
    again = Descent()
    same(expected, (again, train(again, data, checkpoint=path, every=7)))
    # Once more from the last checkpoint: nothing is left to do, and nothing changes.
    done = Descent()
    same(expected, (done, train(done, data, checkpoint=path, every=7)))


class Writer:
    """Is interrupted in the middle of writing a step."""

    def __init__(self) -> None:
        self.written: list[str] = []

    def on_start(self, learner: Learner, data: TrainingData, step: int) -> None:
        self.written.append("start")

    def on_step(self, step: int, metrics: dict[str, Tensor]) -> None:
        self.written.append(f"begin {step}")
        if step == 2:
            signal.raise_signal(signal.SIGINT)
        self.written.append(f"end {step}")

    def on_end(self) -> None:
        self.written.append("closed")


def test_an_interrupt_waits_until_a_step_is_written() -> None:
    # Where the tests were started in a shell's background, the signal is ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    writer = Writer()
    try:
        with pytest.raises(KeyboardInterrupt):
            train(Descent(), linear_data(), callbacks=[writer])
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert writer.written == ["start", "begin 1", "end 1", "begin 2", "end 2", "closed"]


def test_the_first_checkpoint_is_written_before_the_first_step(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    with pytest.raises(Stop):
        train(Descent(), linear_data(), callbacks=[StopAfter(1)], checkpoint=path, every=100)
    assert load_checkpoint(path)[1]["step"] == 0


def test_each_repeat_is_left_in_its_step_of_lowest_validation_error() -> None:
    data = linear_data(repeats=4, validation=True)
    learner = Descent(steps=60, rate=0.9)
    training = train(learner, data)
    errors = training.history["error_validation"]
    assert errors.shape == (60, 4)
    assert torch.equal(training.best_step, errors.argmin(0) + 1)
    assert torch.equal(training.best_validation, errors.amin(0))
    held = data.validation
    assert held is not None
    reached = weighted_mse(learner.predict(held.inputs), held.targets, held.weights)
    assert torch.equal(reached, training.best_validation)


def test_patience_ends_the_loop_and_a_repeat_does_not_depend_on_its_neighbours() -> None:
    data = linear_data(repeats=3, validation=True)
    learner = Descent(steps=500)
    training = train(learner, data, patience=5)
    assert training.step < 500
    for k in range(3):
        alone = _repeat(data, k)
        single = Descent(steps=500)
        assert int(train(single, alone, patience=5).best_step) == int(training.best_step[k])
        assert torch.allclose(single.state_dict()["map"][0], learner.state_dict()["map"][k], rtol=1e-12)


def test_a_refit_stops_each_repeat_after_its_own_number_of_steps() -> None:
    data = linear_data(repeats=3)
    learner = Descent(steps=30)
    training = train(learner, data, stop_at=torch.tensor([0, 4, 9]))
    assert training.step == 9
    for k, steps in enumerate([0, 4, 9]):
        single = Descent(steps=30)
        single.start(_repeat(data, k))
        for _ in range(steps):
            single.step()
        assert torch.allclose(single.state_dict()["map"][0], learner.state_dict()["map"][k], rtol=1e-12)


def test_a_damaged_or_foreign_checkpoint_is_refused_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    data = linear_data()
    train(Descent(), data, checkpoint=path)
    other = dataclasses.replace(data, targets=data.targets + 1)
    with pytest.raises(InputError, match="records unchanged"):
        train(Descent(), other, checkpoint=path)
    good = path.read_bytes()
    # A number that stands beside the tensors, in a file that is whole by its form.
    path.write_bytes(good.replace(b'\\"step\\": ', b'\\"step\\":1', 1))
    assert path.read_bytes() != good
    with pytest.raises(InputError, match="altered"):
        train(Descent(), data, checkpoint=path)
    content = bytearray(good)
    content[-3] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="altered"):
        train(Descent(), data, checkpoint=path)
    path.write_bytes(content[:50])
    with pytest.raises(InputError, match="cannot be read"):
        train(Descent(), data, checkpoint=path)


def test_checkpoints_keep_every_type_bit_by_bit(tmp_path: Path) -> None:
    tensors = {
        "mask": torch.tensor([[True, False]]),
        "weight": torch.tensor([[0.1, -0.0, torch.nan]], dtype=torch.float64).T,
        "count": torch.tensor(7),
    }
    save_checkpoint(tmp_path / "c.safetensors", tensors, {"step": 3})
    loaded, about = load_checkpoint(tmp_path / "c.safetensors")
    assert about == {"step": 3}
    for name, value in tensors.items():
        assert loaded[name].dtype == value.dtype
        assert loaded[name].numpy().tobytes() == value.numpy().tobytes()


def _repeat(data: TrainingData, k: int) -> TrainingData:
    one = slice(k, k + 1)
    held = None if data.validation is None else _repeat(data.validation, k)
    return TrainingData(data.inputs[one], data.targets[one], data.weights[one], data.seeds[one], held)


class Impatient(Descent):
    """Ends by itself after five steps, whatever was planned."""

    @property
    def finished(self) -> bool:
        return int(self._step) >= 5


def test_a_refit_that_ends_by_itself_keeps_its_last_state() -> None:
    data = linear_data()
    learner, alone = Impatient(), Impatient()
    training = train(learner, data, stop_at=torch.tensor([2, 5, 9]))
    train(alone, data)
    assert training.best_step.tolist() == [2, 5, 5]
    assert torch.equal(learner.state_dict()["map"][1:], alone.state_dict()["map"][1:])
    assert not torch.equal(learner.state_dict()["map"][0], alone.state_dict()["map"][0])


def test_an_output_of_rounding_size_is_taken_for_constant() -> None:
    """Standardised, it would count as much as a real one."""
    generator = torch.Generator().manual_seed(0)
    inputs = torch.rand(1, 30, 2, generator=generator, dtype=torch.float64)
    targets = torch.stack([1e-4 * inputs[..., 0], 1e-17 * inputs[..., 1], torch.zeros(1, 30, dtype=torch.float64)], -1)
    weights = torch.ones(1, 30, dtype=torch.float64)
    scaling = Scaling.fit(inputs, targets, weights, torch.zeros(2, dtype=torch.bool))
    standardised = scaling.standardise(targets)
    assert scaling.deviation[0, 1:].tolist() == [1.0, 1.0]
    assert float(standardised[..., 0].std(correction=0)) == pytest.approx(1.0)
    assert float(standardised[..., 1:].abs().max()) < 1e-15
