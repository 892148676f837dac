"""Zeros that are found anew after each pause: made-up planar arms with kinematics of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ccnn_torch.diagnosis.engine import diagnose_rows
from ccnn_torch.diagnosis.from_records import named_machine
from ccnn_torch.effects import Situation, default_gravity, make_effect, missing_on
from ccnn_torch.mechanisms import SerialArm

Array = NDArray[np.float64]
LENGTHS = (0.3, 0.25)
ARM = SerialArm(
    "arm", "standard", [[a, 0.0, 0.0, 0.0] for a in LENGTHS], tool_offset=[0.0, 0.0, 0.0], orientation="none"
)


def reached(joints: Array, longer: float = 0.0) -> Array:
    first, both = joints[:, 0], joints.sum(1)
    inner, outer = LENGTHS[0] + longer, LENGTHS[1]
    x = inner * np.cos(first) + outer * np.cos(both)
    return np.stack([x, inner * np.sin(first) + outer * np.sin(both), 0 * x], 1)


def measured(seed: int, wrong: str, days: int = 4, rows: int = 80) -> tuple[Situation, torch.Tensor]:
    """Rows of some days of an arm on which something is wrong, and the poses measured."""
    draw = np.random.default_rng(seed)
    joints = np.stack([draw.uniform(-2, 2, rows), draw.uniform(0.5, 2.2, rows)], 1)
    day = np.arange(rows) * days // rows
    time = np.cumsum(draw.uniform(20, 70, rows)) + day * 86400.0 * draw.uniform(0.8, 1.2)
    temperature = 293.15 + 2 * np.sin(2 * np.pi * time / 86400) + draw.normal(0, 0.05, rows)
    sizes = draw.choice([-1, 1], 2) * draw.uniform(2e-4, 5e-4, 2)
    off = {
        "homing": draw.normal(0, 2e-4, (days, 2))[day],
        "tooth": np.outer(np.arange(rows) >= int(rows * 0.6), [0.0, sizes[1]]),
        "drift": np.outer(time / time[-1], sizes),
        "joint_offset": np.tile(sizes, (rows, 1)),
    }
    poses = reached(joints + off.get(wrong.partition(" ")[0], 0.0), 8e-4 * wrong.endswith("geometry"))
    poses += draw.normal(0, 1e-5, poses.shape)
    covariates = {"time": torch.tensor(time), "temperature": torch.tensor(temperature)}
    return Situation(ARM, torch.tensor(joints), covariates, default_gravity(ARM)), torch.tensor(poses)


def test_a_new_zero_each_day_is_named_alone() -> None:
    said = diagnose_rows(*measured(0, "homing"))
    assert said.verdict["effects"] == ["homing"] and not said.verdict["outside_library"]
    assert said.verdict["probability"] > 0.85 and said.verdict["shrink"] > 0.98
    assert named_machine(said) is None


@pytest.mark.parametrize("wrong", ["", "drift", "joint_offset"])
def test_pauses_alone_are_no_new_zeros(wrong: str) -> None:
    said = diagnose_rows(*measured(0, wrong)).verdict
    assert said["effects"] == ([wrong] if wrong else []), said


def test_it_needs_times_and_has_sessions_where_pauses_are_few() -> None:
    homing = make_effect("homing")
    assert "time[s]" in homing.missing(ARM, [])
    # Without pauses, and with one at every other row, there is one new zero, of an unknown time.
    for days, zeros in ((1, 2), (4, 8), (40, 2)):
        rows, _ = measured(0, "", days)
        assert not missing_on(homing, rows) and len(homing.coefficients(rows)) == zeros


@pytest.mark.parametrize("timed", [True, False])
def test_a_zero_that_is_another_one_from_a_row_on_is_named_with_its_joint(timed: bool) -> None:
    situation, poses = measured(3, "tooth", days=1)
    if not timed:
        situation = replace(situation, covariates={})
    said = diagnose_rows(situation, poses, torch.full((3,), 1e-5, dtype=torch.float64))
    assert said.verdict["effects"] == ["homing"] and not said.verdict["outside_library"]
    assert said.verdict["shrink"] > 0.9
    told = next(e for e in said.effects if e["name"] == "homing")["parameters"]
    assert set(told) == {"q2 from then on", "begin"} and abs(told["q2 from then on"]["value"]) > 1.9e-4


@pytest.mark.parametrize("rows", range(800, 805))
def test_it_begins_at_its_row_also_where_that_was_not_among_those_searched(rows: int) -> None:
    """A row on the wrong side leaves far more than noise, and the time as a driver outside the library."""
    situation, poses = measured(rows, "tooth", days=1, rows=rows)
    said = diagnose_rows(situation, poses, torch.full((3,), 1e-5, dtype=torch.float64))
    assert said.verdict["effects"] == ["homing"] and said.verdict["probability"] > 0.8
    before, after = (
        situation.covariates["time"][int(rows * 0.6) - k] - situation.covariates["time"][0] for k in (1, 0)
    )
    told = next(e for e in said.effects if e["name"] == "homing")["parameters"]["begin"]["value"]
    assert before < told <= after


def test_geometry_is_fitted_beside_it_and_the_machine_has_no_zero_of_a_day() -> None:
    said = diagnose_rows(*measured(2, "homing geometry"))
    assert set(said.verdict["effects"]) == {"homing", "geometry"}
    machine = named_machine(said)
    assert machine is not None and not machine["effects"]
    assert machine["parameters"]["x2"] == pytest.approx(LENGTHS[0] + 8e-4, abs=1e-5)


def test_simulated_days_are_told_and_no_line_promises_to_correct_tomorrow(
    cli: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = ("--effect", "homing", "--rows", "60", "--noise", "1e-5", "--out", "r.csv", "--quiet")
    assert cli("simulate", "--mechanism", "five_bar", *made)[0] == 0
    asked = ("--noise", "1e-5", "--no-network", "--out", "d")
    code, shown, _ = cli("diagnose", "--records", "r.csv", "--mechanism", "five_bar", *asked)
    assert code == 0 and "New zero by session of joints 1 and 2" in shown
    assert "commands are not corrected for it" in " ".join(shown.split())
    assert "Compensate:" not in shown and "ccnn compensate" not in shown
