"""Directions that were not recorded, from the order of the rows."""

from __future__ import annotations

from dataclasses import replace

import torch
from _machines import measured, rows_of

from ccnn_torch.diagnosis.checks.unrecorded import measured_order, of_order
from ccnn_torch.diagnosis.engine import diagnose_rows
from ccnn_torch.effects import Situation


def directions_of_order(situation: Situation) -> dict[str, torch.Tensor]:
    return of_order(situation)["direction"].columns(situation, measured_order(situation))


def test_directions_follow_the_time_and_last_while_a_joint_stands_still() -> None:
    rows = rows_of("five_bar", 20, 2)
    joints = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.5, 2.0]], dtype=torch.float64)
    here = replace(rows, joints=joints, covariates={}, guess=None)
    assert directions_of_order(here)["direction1"].tolist() == [0, 1, 1, -1]
    assert directions_of_order(here)["direction2"].tolist() == [0, 0, 1, 1]
    turned = replace(here, joints=joints.flip(0), covariates={"time": torch.arange(4.0).flip(0).double()})
    assert directions_of_order(turned)["direction1"].tolist() == [-1, 1, 1, 0]
    assert set(of_order(replace(here, covariates={"direction2": joints[:, 0]}))) == {"row"}
    assert not of_order(replace(here, covariates={"direction2": joints[:, 0], "time": joints[:, 1]}))


def test_backlash_is_named_by_directions_from_the_order_of_the_rows() -> None:
    rows = rows_of("five_bar", 200, 2)
    bare = replace(rows, covariates={n: v for n, v in rows.covariates.items() if not n.startswith("direction")})
    pose = measured(replace(bare, covariates=bare.covariates | directions_of_order(bare)), {"backlash": 6.0}, 12)
    found = diagnose_rows(bare, pose, effects=["geometry", "joint_offset", "backlash", "friction"])
    assert found.verdict["effects"] == ["backlash"] and found.verdict["probability"] <= 0.9, found.verdict
    assert any("taken from the order of the rows: record direction1[1]" in text for text in found.cautions)
    # Not where the joints are said to have been approached from one side.
    told = diagnose_rows(
        bare, pose, effects=["geometry", "joint_offset", "backlash", "friction"], constant=["direction1"]
    )
    assert found.inferred and not told.inferred
    # The same rows in another order show no direction.
    shuffled = replace(bare, covariates=bare.covariates | {"time": bare.covariates["time"].flip(0).sin()})
    said = diagnose_rows(shuffled, pose)
    assert "backlash" not in said.verdict["effects"] and not said.inferred
