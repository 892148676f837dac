"""Rows that are not of the model are refused, the mistake named; what a verdict cannot rest on is said beside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diagnosis._machines import NOISE, acting, measured, reached_with, rows_of
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis._cautions import DOUBTED
from ccnn_torch.diagnosis.check import check_rows
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism

Mistake = Callable[[Situation, Tensor], tuple[Situation, Tensor]]


def _poses(change: Callable[[Tensor], Tensor]) -> Mistake:
    return lambda situation, pose: (replace(situation, guess=change(pose)), change(pose))


def _joints(change: Callable[[Tensor], Tensor]) -> Mistake:
    return lambda situation, pose: (replace(situation, joints=change(situation.joints)), pose)


def _other_axis(pose: Tensor) -> Tensor:
    return pose * torch.tensor([-1.0, 1.0], dtype=torch.float64)


def _shuffled(pose: Tensor) -> Tensor:
    return pose[torch.randperm(len(pose), generator=torch.Generator().manual_seed(0))]


@pytest.mark.parametrize(
    ("machine", "mistake", "said"),
    [
        ("five_bar", _poses(lambda pose: 1000 * pose), "records' lengths are about 1000 times too large: millimetres"),
        ("five_bar", _poses(lambda pose: pose / 1000), "model's lengths are about 1000 times too large: millimetres"),
        ("five_bar", _poses(_other_axis), "x of the pose seems to be reversed"),
        ("five_bar", _poses(lambda pose: pose.flip(-1)), "x and y of the pose seem to be swapped"),
        ("five_bar", _joints(lambda joints: joints.flip(-1)), "the joints q1 and q2 seem to be swapped"),
        ("five_bar", _joints(lambda joints: joints * math.pi / 180), "the joints seem to be in radians under deg"),
        ("five_bar", _joints(lambda joints: joints[:1].expand_as(joints)), "joints and pose of a row belong together"),
        ("five_bar", _poses(_shuffled), "joints and pose of a row belong together"),
        ("stewart", _poses(lambda pose: pose * torch.tensor([1.0] * 3 + [180 / math.pi] * 3)), "angles .* in degrees"),
        ("delta_linear", _joints(lambda joints: joints * 1000), "the joints seem to be in millimetres under m"),
    ],
)
def test_rows_of_another_model_are_refused_and_the_mistake_named(machine: str, mistake: Mistake, said: str) -> None:
    situation, pose = mistake(rows_of(machine, 60, 1), measured(rows_of(machine, 60, 1), {"joint_offset": 20.0}, 2))
    for look in (diagnose_rows, check_rows):
        with pytest.raises(InputError, match=said):
            look(situation, pose)


def test_some_rows_in_millimetres_are_set_aside_and_said() -> None:
    situation = rows_of("five_bar", 90, 3)
    pose = measured(situation, {"joint_offset": 20.0}, 4)
    pose[::3] *= 1000
    found = diagnose_rows(situation, pose)
    assert found.verdict["effects"] == ["joint_offset"]
    assert set(range(0, 90, 3)) <= set(found.rows_set_aside)
    assert "33 % of the rows are far from where their joints put them" in found.cautions[0]
    assert f"But {found.cautions[0]}." in found.verdict["text"] and found.verdict["probability"] <= DOUBTED
    assert "the records' lengths are about 1000 times too large" in found.cautions[0]
    assert "33 %" in check_rows(situation, pose).cautions[0]


def test_rows_as_they_should_be_cause_no_doubt() -> None:
    situation = rows_of("five_bar", 90, 3)
    pose = measured(situation, {"compliance": 20.0}, 4)
    assert diagnose_rows(situation, pose).cautions == [] and check_rows(situation, pose).cautions == []


def test_a_cause_a_thousand_times_too_large_is_doubted() -> None:
    """Loads in kilonewtons under N: the compliance is right, and its size cannot be."""
    situation = rows_of("five_bar", 120, 5)
    pose = reached_with(situation, [acting(situation, "compliance", q1=2e-6, q2=1e-6)], 6)
    columns = {n: v / 1000 if n.startswith("load") else v for n, v in situation.covariates.items()}
    found = diagnose_rows(replace(situation, covariates=columns), pose)
    assert found.verdict["effects"] == ["compliance"] and found.verdict["probability"] <= DOUBTED
    assert any("times as large as is plausible" in caution for caution in found.cautions)


def test_a_temperature_of_no_workshop_is_doubted() -> None:
    situation = rows_of("five_bar", 60, 7)
    columns = dict(situation.covariates) | {"temperature": situation.covariates["temperature"] + 273.15}
    found = check_rows(replace(situation, covariates=columns), measured(situation, {}, 8))
    assert "check the unit of its column" in found.cautions[0]


def test_noise_that_hides_everything_is_doubted() -> None:
    situation = rows_of("five_bar", 90, 9)
    pose = measured(situation, {"joint_offset": 5.0}, 10)
    far = diagnose_rows(situation, pose, noise=torch.full((3,), 50 * NOISE, dtype=torch.float64))
    assert any("times the noise that was given" in caution for caution in far.cautions)
    assert diagnose_rows(situation, pose, noise=torch.full((3,), NOISE, dtype=torch.float64)).cautions == []


def test_what_a_simulator_was_not_told_is_doubted_and_wanted() -> None:
    file = Path(__file__).parents[2] / "experiments" / "my_simulator.py"
    press = load_mechanism(f"{file}:PRESS")
    generator = torch.Generator().manual_seed(11)
    joints = press.sample_joints(80, generator)
    payload = 2 * torch.rand(80, generator=generator, dtype=torch.float64)
    loads = {f"load_{c}": 60 * torch.randn(80, generator=generator, dtype=torch.float64) for c in "xy"}
    whole = Situation(press, joints, loads | {"payload": payload}, default_gravity(press))
    pose = whole.pose + NOISE * torch.randn(80, 2, generator=generator, dtype=torch.float64)
    noise = torch.full((3,), NOISE, dtype=torch.float64)
    assert diagnose_rows(whole, pose, noise).cautions == []
    found = diagnose_rows(replace(whole, covariates=loads), pose, noise)
    assert any("press takes payload, which was not recorded" in caution for caution in found.cautions)
    wanted = {c: e["effects"] for e in found.missing_covariates for c in e["columns"]}
    assert wanted["payload[kg]"]["press"] > NOISE


def test_one_row_of_another_place_is_an_outlier() -> None:
    situation = rows_of("five_bar", 90, 12)
    pose = measured(situation, {}, 13)
    pose[7] += 3.0
    found = diagnose_rows(situation, pose)
    assert found.verdict["effects"] == ["outlier"] and found.rows_set_aside[:1] == [7] and not found.cautions
