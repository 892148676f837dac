"""Where the gap lies: errors put into one joint, one region or one regime are found there, and intervals hold."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from _machines import NOISE, pose_of, rows_of
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.effects import Situation, reached


def _measured(rows: Situation, deviation: Tensor, seed: int = 0) -> Tensor:
    """Poses of a machine whose joints deviate, `s x n`, and noise."""
    there = reached(replace(rows, joints=rows.joints + deviation), [])
    noise = torch.randn(there.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return pose_of(rows.mechanism, there + NOISE * noise)


def test_an_error_of_one_joint_is_found_in_that_joint_and_its_leg() -> None:
    rows, joint = rows_of("delta", 120, 0), 2
    deviation = torch.zeros_like(rows.joints)
    deviation[:, joint] = 5e-4
    said = diagnose_rows(rows, _measured(rows, deviation), effects=["joint_offset", "joint_gain"])
    for group, name in (("joints", f"q{joint + 1}"), ("legs", f"leg {joint + 1}")):
        shares, intervals = said.where[group], said.where_ci95[group]
        assert max(shares, key=shares.get) == name and shares[name] > 0.95
        assert intervals[name][0] > 0.9 and all(high < 0.1 for n, (_, high) in intervals.items() if n != name)


def test_an_error_in_one_region_is_found_in_that_region() -> None:
    rows = rows_of("five_bar", 400, 1)
    x, y = rows.pose[:, 0], rows.pose[:, 1]
    inside = (x > x.quantile(2 / 3)) & (y < y.quantile(1 / 3))
    deviation = 3e-4 * inside[:, None].double() * torch.tensor([1.0, -1.0], dtype=torch.float64)
    said = diagnose_rows(rows, _measured(rows, deviation), effects=["joint_offset", "joint_gain"])
    regions, intervals = said.where["regions"], said.where_ci95["regions"]
    assert len(regions) == 9 and sum(r["rows"] for r in regions) > 300
    best = max(range(9), key=lambda i: regions[i]["share"])
    assert regions[best]["center"]["x"] > float(x.median()) and regions[best]["center"]["y"] < float(y.median())
    assert regions[best]["share"] > 0.9 and intervals[best][0] > 0.8
    assert all(high < 0.15 for i, (_, high) in enumerate(intervals) if i != best)


def test_an_error_in_the_cold_and_one_from_one_side_are_found_in_their_regimes() -> None:
    rows = rows_of("five_bar", 200, 2)
    cold = rows.covariates["temperature"] < rows.covariates["temperature"].quantile(1 / 3)
    came_back = rows.covariates["direction1"] < 0
    deviation = 3e-4 * (cold & came_back)[:, None].double().expand(-1, 2)
    said = diagnose_rows(rows, _measured(rows, deviation), effects=["joint_offset", "joint_gain"])
    regimes, intervals = said.where["covariates"], said.where_ci95["covariates"]
    assert regimes["temperature"][0]["share"] > 0.9 and intervals["temperature"][0][0] > 0.85
    assert [r["from"] for r in regimes["direction1"]] == [-1.0, 1.0]
    assert regimes["direction1"][0]["share"] > 0.9 and intervals["direction1"][1][1] < 0.1
    # Which way the other joint came has nothing to do with it.
    low, high = intervals["direction2"][0]
    assert low < 0.5 < high


def test_every_list_of_shares_sums_to_one_inside_its_intervals() -> None:
    rows = rows_of("delta", 60, 3)
    said = diagnose_rows(
        rows, _measured(rows, 2e-4 * torch.sin(5 * rows.joints)), effects=["joint_offset", "joint_gain"]
    )
    where, known = said.where, said.where_ci95
    lists = [(list(where[g].values()), list(known[g].values())) for g in ("outputs", "joints", "legs")]
    lists.append(([r["share"] for r in where["regions"]], known["regions"]))
    lists += [([r["share"] for r in where["covariates"][n]], known["covariates"][n]) for n in where["covariates"]]
    assert len(lists) == 4 + len(rows.covariates)
    for shares, intervals in lists:
        assert sum(shares) == pytest.approx(1.0)
        assert all(0 <= low <= share <= high <= 1 for share, (low, high) in zip(shares, intervals, strict=True))
