"""Noise that rows share: with the row before, or with the other readings of their target."""

from dataclasses import replace

import pytest
import torch
from _machines import NOISE, acting, reached_with, rows_of

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.residual.correlation import Correlation
from ccnn_torch.effects import Situation

TARGETS = torch.arange(12) // 3

# Where no other effect is in question.
FEW = ["geometry", "joint_offset", "joint_gain", "backlash", "compliance", "drift"]


@pytest.mark.parametrize("target", [None, TARGETS])
def test_the_operator_makes_rows_independent(target: torch.Tensor | None) -> None:
    correlation, rows = Correlation(0.7, target), torch.arange(12)
    operator = correlation(torch.eye(12, dtype=torch.float64)[:, None])[:, 0]
    if target is None:
        covariance = 0.7 ** (rows[:, None] - rows).abs().to(torch.float64)
    else:
        covariance = 0.3 * torch.eye(12, dtype=torch.float64) + 0.7 * (target[:, None] == target)
    torch.testing.assert_close(operator @ covariance @ operator.mT, torch.eye(12, dtype=torch.float64))
    assert float(torch.linalg.slogdet(operator).logabsdet) == pytest.approx(correlation.log_determinant(12, 1))


def test_the_operator_of_noise_that_drifts_and_scatters() -> None:
    correlation, rows = Correlation(0.9, alone=0.4), torch.arange(12)
    operator = correlation(torch.eye(12, dtype=torch.float64)[:, None])[:, 0]
    covariance = 0.6 * 0.9 ** (rows[:, None] - rows).abs().to(torch.float64) + 0.4 * torch.eye(12, dtype=torch.float64)
    torch.testing.assert_close(operator @ covariance @ operator.mT, torch.eye(12, dtype=torch.float64))
    assert float(torch.linalg.slogdet(operator).logabsdet) == pytest.approx(correlation.log_determinant(12, 1))


def test_a_device_that_wanders_less_than_it_scatters_is_no_cause() -> None:
    situation = rows_of("five_bar", 250, 15)
    g = torch.Generator().manual_seed(16)
    walk = 0.2 * torch.randn(250, 2, generator=g, dtype=torch.float64).cumsum(0)
    scatter = torch.randn(250, 2, generator=g, dtype=torch.float64)
    found = diagnose_rows(situation, situation.pose + NOISE * (walk + scatter), effects=FEW)
    assert not found.verdict["effects"]
    assert any("drifts slowly from row to row" in note for note in found.notes)


def drifting(situation: Situation, seed: int) -> torch.Tensor:
    """Errors of a measuring device with a correlation of 0.9 from row to row, `s x 2` [m]."""
    drawn = NOISE * torch.randn(len(situation.joints), 2, generator=torch.Generator().manual_seed(seed)).double()
    for row in range(1, len(drawn)):
        drawn[row] = 0.9 * drawn[row - 1] + 0.19**0.5 * drawn[row]
    return drawn


def test_noise_that_follows_itself_is_no_cause() -> None:
    situation = rows_of("five_bar", 200, 3)
    found = diagnose_rows(situation, situation.pose + drifting(situation, 3), effects=FEW)
    assert found.verdict["none"]
    assert any("correlation of about 0.90 with that of the row before" in note for note in found.notes)


def test_a_cause_under_such_noise_is_named_alone() -> None:
    situation = rows_of("five_bar", 200, 5)
    pose = reached_with(situation, [acting(situation, "backlash", q1=4e-4, q2=3e-4)], 6, noise=0.0)
    found = diagnose_rows(situation, pose + drifting(situation, 7), effects=FEW)
    assert found.verdict["effects"] == ["backlash"] and not found.verdict["outside_library"]


def test_readings_of_a_target_that_share_their_error_count_by_targets() -> None:
    situation = rows_of("five_bar", 40, 8)
    rows = torch.arange(40).repeat_interleave(5)
    columns = {n: v[rows] for n, v in situation.covariates.items()}
    many = replace(situation, joints=situation.joints[rows], covariates=columns, guess=None)
    g = torch.Generator().manual_seed(9)
    shared = torch.randn(40, 2, generator=g, dtype=torch.float64)[rows]
    own = torch.randn(200, 2, generator=g, dtype=torch.float64)
    found = diagnose_rows(many, many.pose + NOISE * (0.95 * shared + 0.3 * own), effects=FEW)
    assert found.verdict["none"] and any("190 rows of 38 targets" in note for note in found.notes)
