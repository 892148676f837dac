"""Columns that belong to another row, are exchanged, or have the other sign; and poses of another row."""

from dataclasses import replace

import pytest
import torch
from _machines import acting, reached_with, rows_of

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.errors import RowsError


def test_loads_that_are_exchanged_are_named() -> None:
    situation = rows_of("five_bar", 150, 50)
    pose = reached_with(situation, [acting(situation, "compliance", q1=2e-6, q2=3e-6)], 51)
    loads = {"load_x": situation.covariates["load_y"], "load_y": situation.covariates["load_x"]}
    wrong = replace(situation, covariates={**situation.covariates, **loads})
    found = diagnose_rows(wrong, pose, effects=["geometry", "joint_offset", "compliance"])
    assert any(c.startswith("load_x and load_y seem to be swapped") for c in found.cautions)
    assert found.verdict["probability"] <= 0.5
    right = diagnose_rows(situation, pose, effects=["geometry", "joint_offset", "compliance"])
    assert not any("seem" in c for c in right.cautions)


def test_directions_of_the_row_before_are_named() -> None:
    situation = rows_of("five_bar", 150, 52)
    pose = reached_with(situation, [acting(situation, "backlash", q1=4e-4, q2=3e-4)], 53)
    late = {n: v.roll(1) if n.startswith("direction") else v for n, v in situation.covariates.items()}
    noise = torch.full((3,), 1e-5, dtype=torch.float64)
    found = diagnose_rows(replace(situation, covariates=late), pose, noise, ["geometry", "joint_offset", "backlash"])
    assert any("direction1 and direction2 seem to be shifted, one row late" in c for c in found.cautions)


@pytest.mark.parametrize(("step", "word"), [(1, "late"), (-1, "early")])
def test_poses_of_another_row_are_refused(step: int, word: str) -> None:
    situation = rows_of("five_bar", 100, 54)
    pose = situation.pose.clone()
    pose[60:] = situation.pose.roll(step, 0)[60:]
    with pytest.raises(RowsError, match=f"one row {word} from row 61 on"):
        diagnose_rows(situation, pose)
