"""Jumps, products of two drivers, and the noise that records show without a model."""

import pytest
import torch
from _machines import NOISE, acting, reached_with, rows_of
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.diagnosis.residual.noise_evidence import noise_of_repeats
from ccnn_torch.effects import Situation


def measured(situation: Situation, change: Tensor, times: float, seed: int) -> Tensor:
    """Poses of joints that are off by a change of this form, as large as so many times the noise, `s x p`."""
    still = situation.pose
    moved = situation.mechanism.forward_kinematics(situation.joints + 1e-6 * change) - still
    moved = moved * times * NOISE / moved.square().mean().sqrt()
    drawn = torch.randn(still.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return still + moved + NOISE * drawn


@pytest.mark.parametrize("joint", [0, 1])
def test_a_jump_of_a_joint_is_named_with_its_row(joint: int) -> None:
    situation = rows_of("five_bar", 200, 30 + joint)
    change = torch.zeros_like(situation.joints)
    change[120:, joint] = 1
    found = diagnose_rows(situation, measured(situation, change, 10, 1))
    assert found.verdict["outside_library"] and found.verdict["driver"] == "time" and not found.verdict["effects"]
    note = next(note for note in found.notes if "jump" in note)
    first = int(note.split("row ")[1].split()[0])
    assert f"a jump of joint q{joint + 1}" in note and abs(first - 121) <= 1


def test_a_product_of_two_drivers_names_both() -> None:
    situation = rows_of("five_bar", 250, 33)
    temperature = situation.covariates["temperature"] - situation.covariates["temperature"].mean()
    change = torch.zeros_like(situation.joints)
    change[:, 1] = temperature * situation.covariates["direction1"]
    found = diagnose_rows(situation, measured(situation, change, 10, 2))
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
    found = diagnose_rows(backlash, reached_with(backlash, [acting(backlash, "backlash", q1=4e-4, q2=3e-4)], 4))
    assert found.noise == "estimated" and found.verdict["text"].startswith("The noise is not known:")
    # From "all that is left is another cause" to "all that is left is noise".
    whole = 1 - (found.gap["after"] / found.gap["before"]) ** 2
    low, high = found.verdict["shrink_ci95"]
    assert low <= whole + 1e-9 and high >= found.verdict["shrink"]
