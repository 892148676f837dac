"""Cross-validation: folds as repeats of one training give what they give one by one."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from hypothesis import given, settings, strategies as st
from test_uncertainty import linear_dataset
from toy import Descent

from ccnn_torch.calibration.early_stop import Plan, choose, fold_dataset
from ccnn_torch.calibration.fitting import fit_method
from ccnn_torch.errors import InputError
from ccnn_torch.evolution.settings import CCNNSettings
from ccnn_torch.learners import TrainingData
from ccnn_torch.learners.ccnn import CCNN
from ccnn_torch.learners.rows import thinned
from ccnn_torch.records.splits import Split, fold_splits, split_rows
from ccnn_torch.training import train, weighted_mse


@settings(deadline=None, max_examples=40)
@given(
    kind=st.sampled_from(["random", "group", "block"]),
    rows=st.integers(40, 90),
    folds=st.integers(2, 6),
    seed=st.integers(0, 99),
)
def test_every_training_row_is_held_out_once_and_groups_stay_whole(kind: str, rows: int, folds: int, seed: int) -> None:
    positions = torch.rand(rows, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    group = torch.arange(rows) % 24
    by = None if kind == "random" else "which"
    split = split_rows(positions, kind, by, {"which": group.double()}, 0.3, 0.2, seed)
    parts = fold_splits(split, kind, folds, seed)
    kept = torch.cat([split.train, split.validation]).sort().values
    assert torch.equal(torch.cat([part.validation for part in parts]).sort().values, kept)
    for part in parts:
        assert torch.equal(torch.cat([part.train, part.validation]).sort().values, kept)
        assert torch.equal(part.test, split.test)
        if kind != "random":
            assert not set(group[part.train].tolist()) & set(group[part.validation].tolist())
    again = fold_splits(split, kind, folds, seed)
    assert all(torch.equal(a.validation, b.validation) for a, b in zip(parts, again, strict=True))


def test_the_folds_of_a_block_split_are_blocks() -> None:
    positions = torch.stack([torch.linspace(0, 1, 100, dtype=torch.float64)] * 3, -1)
    split = split_rows(positions, "block", "position:1mm", {}, 0.3, 0.2)
    blocks = [part.validation for part in fold_splits(split, "block", 5, 0)]
    assert [int(block[-1] - block[0]) + 1 for block in blocks] == [len(block) for block in blocks] == [14] * 5
    with pytest.raises(InputError, match="70 groups cannot be dealt to 71 folds"):
        fold_splits(split, "block", 71, 0)


def test_folds_side_by_side_are_those_run_one_by_one() -> None:
    dataset = linear_dataset(repeats=2, train=40, held=11, test=20)
    small = CCNNSettings(hidden=(3,), population=8, generations=6, members=1, refinement_iterations=0)
    together = CCNN(small)
    plan = Plan(True, None, 20, folds=4)
    folded = fold_dataset(dataset, "random", 4)
    data, _ = folded.scaled("train", True, CCNN(small))
    training = train(together, data, folds=4)
    errors = training.history["error_validation"]
    assert errors.shape == (6, 8)
    for k in range(8):
        alone = dataclasses.replace(
            folded, inputs=folded.inputs[k : k + 1], deviation=folded.deviation[k : k + 1],
            usable=folded.usable[k : k + 1],
            splits=folded.splits[k : k + 1], seeds=folded.seeds[k : k + 1],
        )  # fmt: skip
        single = train(CCNN(small), alone.scaled("train", True, CCNN(small))[0])
        assert torch.allclose(single.history["error_validation"][:, 0], errors[:, k], rtol=1e-9)
    # The folds of a repeat share one step, that of their lowest mean error, and are left in their states there.
    best = errors.view(6, 2, 4).mean(2).argmin(0) + 1
    assert torch.equal(training.best_step.view(2, 4), best.unsqueeze(1).expand(2, 4))
    held = data.validation
    assert held is not None
    reached = weighted_mse(together.predict(held.inputs), held.targets, held.weights)
    assert torch.allclose(reached, errors.gather(0, (training.best_step - 1).unsqueeze(0))[0], rtol=1e-12)
    choice = choose("ccnn", lambda: CCNN(small), dataset, plan, None, lambda *_: [])
    assert choice is not None and torch.equal(choice.best_step, best)
    assert torch.allclose(choice.errors, reached.view(2, 4), rtol=1e-12)
    counted = training.history["evaluations"][-1].double().view(2, 4).sum(1)
    assert choice.evaluations is not None and torch.equal(choice.evaluations, counted)
    fitted = fit_method("ccnn", lambda: CCNN(small), dataset, plan, None, lambda *_: [])
    assert torch.equal(fitted.training.best_step, best) and torch.equal(fitted.score, choice.best_validation)


def test_a_refit_goes_on_from_the_networks_of_the_first_training_on_all_rows() -> None:
    dataset = linear_dataset(repeats=2, train=40, held=11, test=20)
    settings = CCNNSettings(
        hidden=(3,), rival_hidden=(2,), population=8, generations=2, members=2, refinement_iterations=4, wave_searches=0
    )
    fitted = fit_method("ccnn", lambda: CCNN(settings), dataset, Plan(True, None, 20), None, lambda *_: [])
    choice = fitted.choice
    assert choice is not None and choice.state is not None and choice.scaling is not None
    assert fitted.data.inputs.shape[1] == 51 and bool((choice.best_step > 2).all())
    torch.testing.assert_close(fitted.scaling.centre, choice.scaling.centre)
    found = fitted.learner.state_dict()
    both = [torch.stack([part[f"structure_{n}_evidence"].mean(1) for n in (0, 1)]) for part in (choice.state, found)]
    # Of each repeat only the structure that it took is refined again; the steps in which it is done are the same.
    taken = both[0].argmax(0)
    assert torch.equal(taken, both[1].argmax(0)) and bool((both[1].amin(0) == -torch.inf).all())
    for repeat, structure in enumerate(taken.tolist()):
        for layer in range(2):
            name = f"structure_{structure}_refined_mask_{layer}"
            assert torch.equal(found[name][repeat], choice.state[name][repeat])
    first = CCNN(settings)
    first.start(fitted.data)
    first.load_state_dict(choice.state)
    before, after = (
        weighted_mse(learner.predict(fitted.data.inputs), fitted.data.targets, fitted.data.weights)
        for learner in (first, fitted.learner)
    )
    assert float(after.mean()) < float(before.mean())
    assert bool((both[0].amax(0) != both[1].amax(0)).all())


def test_many_rows_are_thinned_evenly_and_padding_stays_behind() -> None:
    place = torch.arange(10.0).double().expand(2, -1)
    weights = torch.stack([torch.ones(10).double(), (torch.arange(10) % 3 != 0).double()])
    data = TrainingData(place.unsqueeze(-1), 2 * place.unsqueeze(-1), weights, torch.tensor([0, 1]))
    found = thinned(data, 7)
    assert found.inputs[..., 0].tolist() == [[0, 1, 2, 4, 5, 7, 8], [1, 2, 4, 5, 7, 8, 0]]
    assert torch.equal(found.targets, 2 * found.inputs) and found.weights[1].tolist() == [1] * 6 + [0]
    assert thinned(data, 10) is data


def test_without_early_stopping_folds_judge_the_learners_end() -> None:
    dataset = linear_dataset(repeats=2)
    choice = choose("toy", Descent, dataset, Plan(False, None, 20, folds=3), None, lambda *_: [])
    assert choice is not None and choice.best_step.tolist() == [30, 30] and choice.errors.shape == (2, 3)
    plain = fit_method("toy", Descent, dataset, Plan(False, None, 20), None, lambda *_: [])
    folded = fit_method("toy", Descent, dataset, Plan(False, None, 20, folds=3), None, lambda *_: [])
    inputs = dataset.inputs
    assert torch.equal(plain.predict(inputs), folded.predict(inputs))
    assert not torch.equal(plain.score, folded.score)


def test_a_budget_ends_a_training_between_two_steps() -> None:
    dataset = linear_dataset(repeats=2)
    plan = Plan(True, None, 20)
    assert choose("toy", Descent, dataset, plan, None, lambda *_: [], budget=0.0) is None
    choice = choose("toy", Descent, dataset, plan, None, lambda *_: [], budget=1e-9)
    assert choice is None
    whole = choose("toy", Descent, dataset, plan, None, lambda *_: [], budget=1e9)
    assert whole is not None and whole.ended and whole.step == 30


def test_rows_that_stand_for_themselves_have_no_groups() -> None:
    assert split_rows(torch.zeros(20, 3), "random").groups is None
    assert Split(torch.arange(3), torch.arange(3, 4), torch.arange(4, 5)).groups is None
