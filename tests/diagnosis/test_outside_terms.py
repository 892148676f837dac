"""Jumps, products of two drivers, and the noise that records show without a model."""

import math
from dataclasses import replace

import pytest
import torch
from diagnosis._machines import NOISE, acting, reached_with, rows_of
from diagnosis.test_convergence import columns, looked_at
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.residual.noise_evidence import noise_of_repeats
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.dictionary import gain_beside
from ccnn_torch.evidence.marginal_likelihood import NO_COLUMNS, Prior, fit_single_groups, own_products

# Where no other effect is in question.
FEW = ["geometry", "joint_offset", "joint_gain", "backlash"]


def measured(situation: Situation, change: Tensor, times: float, seed: int) -> Tensor:
    """Poses of joints that are off by a change of this form, as large as so many times the noise, `s x p`."""
    still = situation.pose
    moved = situation.mechanism.forward_kinematics(situation.joints + 1e-6 * change) - still
    moved = moved * times * NOISE / moved.square().mean().sqrt()
    drawn = torch.randn(still.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return still + moved + NOISE * drawn


def test_jumps_of_a_joint_are_named_with_their_rows() -> None:
    situation = rows_of("five_bar", 200, 31)
    change = torch.zeros_like(situation.joints)
    change[60:, 1], change[120:, 1] = 1, -0.8
    found = diagnose_rows(situation, measured(situation, change, 10, 1), effects=FEW)
    assert found.verdict["outside_library"] and found.verdict["driver"] == "time" and not found.verdict["effects"]
    note = next(note for note in found.notes if "jump" in note)
    first, second = (int(row) for row in note.split("row ")[1].split(" on")[0].split(", "))
    assert "2 jumps of joint q2" in note and abs(first - 61) <= 1 and abs(second - 121) <= 1


def test_a_hose_that_goes_taut_is_no_slow_wave_of_a_gear() -> None:
    situation = rows_of("five_bar", 100, 32)
    q = situation.joints[:, 1]
    edge = float(q.min() + 0.6 * (q.max() - q.min()))
    change = torch.zeros_like(situation.joints)
    change[:, 1] = (q - edge).clamp_min(0) ** 2
    found = diagnose_rows(situation, measured(situation, change, 10, 1), effects=[*FEW, "transmission"])
    assert found.verdict["drivers"] == ["joint q2"] and not found.verdict["effects"]
    note = next(note for note in found.notes if "pulled above" in note)
    assert float(note.split()[-2]) == pytest.approx(edge, abs=0.1)


def test_a_product_of_two_drivers_names_both() -> None:
    situation = rows_of("five_bar", 250, 33)
    temperature = situation.covariates["temperature"] - situation.covariates["temperature"].mean()
    change = torch.zeros_like(situation.joints)
    change[:, 1] = temperature * situation.covariates["direction1"]
    found = diagnose_rows(situation, measured(situation, change, 10, 2), effects=[*FEW, "thermal"])
    assert found.verdict["outside_library"] and {*found.verdict["drivers"]} == {"temperature", "direction 1"}
    assert found.verdict["driver"] == found.verdict["drivers"][0]
    assert "follows the temperature and the direction of joint 1" in found.verdict["text"]
    assert any("their product moves joint q2" in note for note in found.notes)


def repeated(targets: int, readings: int, seed: int) -> Situation:
    situation = rows_of("five_bar", targets, seed)
    rows = torch.arange(targets).repeat_interleave(readings)
    covariates = {"time": torch.arange(len(rows), dtype=torch.float64) * 20}
    return Situation(situation.mechanism, situation.joints[rows], covariates, situation.gravity)


def test_repeats_show_the_noise_and_what_is_none() -> None:
    situation = repeated(60, 4, 40)
    change = torch.zeros_like(situation.joints)
    change[:, 0] = torch.sin(9 * situation.joints[:, 0]) * torch.cos(7 * situation.joints[:, 1])
    pose = measured(situation, change, 8, 3)
    noise = noise_of_repeats(situation, pose)
    assert noise is not None and noise.source == "repeats"
    torch.testing.assert_close(noise.sd[:2], torch.full((2,), NOISE, dtype=torch.float64), rtol=0.15, atol=0.0)
    assert noise_of_repeats(repeated(60, 1, 40), pose[::4]) is None
    backlash = rows_of("five_bar", 60, 41)
    play = reached_with(backlash, [acting(backlash, "backlash", q1=4e-4, q2=3e-4)], 4)
    found = diagnose_rows(backlash, play, effects=FEW)
    assert found.noise == "estimated" and "is noise is not known" in found.verdict["text"]
    # From "all that is left is another cause" to "all that is left is noise".
    whole = 1 - (found.gap["after"] / found.gap["before"]) ** 2
    low, high = found.verdict["shrink_ci95"]
    assert low <= whole + 1e-9 and high >= found.verdict["shrink"]


def test_two_causes_outside_the_library_are_told_by_both_drivers() -> None:
    situation = rows_of("five_bar", 300, 35)
    change = torch.zeros_like(situation.joints)
    off = situation.joints[:, 0] - situation.joints[:, 0].median()
    change[:, 0] = 2 * torch.exp(-((off / (0.15 * off.std())) ** 2))
    change[180:, 1] = 1
    found = diagnose_rows(situation, measured(situation, change, 6, 5), effects=FEW)
    assert found.verdict["outside_library"] and found.verdict["drivers"] == ["time", "joint q1"]
    assert "follows the time and joint q1" in found.verdict["text"]


def test_what_columns_add_to_a_set_is_their_evidence_under_what_the_set_leaves_open() -> None:
    dictionary, y, found = looked_at()
    groups = [columns(7, 2), 0.3 * y[..., None] + columns(8, 1), columns(9, 3)]
    kernel = torch.eye(y.numel(), dtype=y.dtype)
    for i, scale in zip(found[0].members, found[0].log_scale, strict=True):
        own = dictionary.columns[..., dictionary.groups[i]].flatten(0, 1)
        kernel += math.exp(scale) / found[0].noise * own @ own.mT
    factor = torch.linalg.cholesky(kernel)
    white = [torch.linalg.solve_triangular(factor, g.flatten(0, 1), upper=False) for g in (y[..., None], *groups)]
    products = [own_products(g[:, None], white[0]) for g in white[1:]]
    fits = fit_single_groups([NO_COLUMNS, *products], white[0].square().sum(), Prior(float(y.numel()), 0.0))[0]
    wanted = (fits.log_evidence[1:] - fits.log_evidence[0]).tolist()
    assert gain_beside(dictionary, found[0], groups) == pytest.approx(wanted, rel=1e-6)
    assert wanted[1] > 5 > max(wanted[0], wanted[2])


def test_a_load_that_moves_no_joint_is_no_error() -> None:
    rows = rows_of("five_bar", 100, 1)
    moment = torch.randn(100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    more = replace(rows, covariates={**rows.covariates, "load_rx": moment})
    pose = reached_with(more, [acting(more, "backlash", q1=6e-4)], 3)
    found = diagnose_rows(more, pose, effects=["backlash", "compliance"])
    assert found.verdict["effects"] == ["backlash"]
    # Its torques on the joints, all 0, are no columns.
    assert all(bool(a.columns.any()) for a in found.analysis.atoms)
