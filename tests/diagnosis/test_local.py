"""What happens in one place, and what follows the time and not the temperature."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diagnosis._machines import NOISE, acting, measured, reached_with, rows_of

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.mechanisms import load_mechanism


def off(situation: Situation, change: torch.Tensor, seed: int) -> torch.Tensor:
    """Poses measured where the joints stand off by `change`, `s x n`, in five times the noise, `s x p`."""
    mechanism = situation.mechanism
    moved = (situation.jacobian @ change[..., None])[..., 0]
    size = 5 * NOISE / moved[:, :3].square().sum(-1).mean().sqrt()
    pose = mechanism.forward_kinematics(situation.joints + size * change, None, situation.guess)
    drawn = torch.randn(pose.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return pose + NOISE * drawn


def test_a_dent_in_a_track_is_no_slow_wave_of_its_gear() -> None:
    situation = rows_of("delta", 60, 20)
    q = situation.joints[:, 1]
    change = torch.zeros_like(situation.joints)
    place = (q - q.quantile(0.4)) / (0.12 * (q.max() - q.min()))
    change[:, 1] = torch.exp(-(place**4))
    said = diagnose_rows(situation, off(situation, change, 0)).verdict
    assert said["outside_library"] and said["driver"] == "joint q2" and not said["effects"]


def test_a_pull_in_one_corner_of_the_workspace_is_told_from_the_machines_own_errors() -> None:
    situation = rows_of("tripod", 40, 20)
    low, high = situation.pose.amin(0), situation.pose.amax(0)
    place = ((situation.pose - low) / (high - low) - 0.4)[:, :2]
    pull = torch.exp(-((place.square().sum(-1) / 0.25**2) ** 1.5))
    sign = torch.tensor([1.0, -0.7, 0.5], dtype=torch.float64)
    effects = ["geometry", "joint_offset", "joint_gain", "gravity", "compliance"]
    said = diagnose_rows(situation, off(situation, pull[:, None] * sign, 0), effects=effects).verdict
    assert said["outside_library"] and said["driver"] == "workspace" and not said["effects"]


def test_waves_of_several_joints_are_no_other_effect() -> None:
    situation = rows_of("tripod", 200, 20)
    low, high = situation.workspace
    change = torch.sin(2 * torch.pi * 6 * (situation.joints - low) / (high - low))
    effects = ["geometry", "joint_offset", "joint_gain", "backlash", "compliance"]
    said = diagnose_rows(situation, off(situation, change, 0), effects=effects).verdict
    assert said["outside_library"] and said["driver"].startswith("joint") and not said["effects"]


def test_a_quick_sway_follows_the_time_and_is_no_noise() -> None:
    situation, periods = rows_of("five_bar", 150, 20), 18.7
    time = situation.covariates["time"]
    wave = torch.sin(2 * torch.pi * periods * (time - time.min()) / (time.max() - time.min()))
    way = torch.tensor([1.0 if c.unit == "m" else 0.0 for c in situation.mechanism.pose], dtype=torch.float64)
    drawn = torch.randn(situation.pose.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    effects = ["geometry", "joint_offset", "joint_gain", "backlash", "drift"]
    diagnosis = diagnose_rows(situation, situation.pose + NOISE * (5 * wave[:, None] * way + drawn), effects=effects)
    said = diagnosis.verdict
    assert said["outside_library"] and said["driver"] == "time" and not said["effects"]
    (note,) = [n for n in diagnosis.notes if "sway" in n]
    assert float(note.split()[-2]) == pytest.approx(float(time.max() - time.min()) / periods, rel=0.02)


def test_what_wanders_with_the_time_is_not_taken_for_mounts_that_warm() -> None:
    situation = rows_of("stewart", 60, 0)
    morning = 293.15 + 6 * (1 - torch.exp(-situation.covariates["time"] / 5000))
    situation = replace(situation, covariates={**situation.covariates, "temperature": morning})
    effects = ["geometry", "joint_offset", "joint_gain", "thermal"]
    said = diagnose_rows(situation, measured(situation, {"drift": 8.0}, 1), effects=effects).verdict
    assert said["outside_library"] and said["driver"] == "time" and "thermal" not in said["effects"]


def test_mounts_that_follow_the_temperature_are_thermal() -> None:
    situation = rows_of("five_bar", 150, 11)
    cause = acting(situation, "thermal", q1_mount=2e-5, q2_mount=-3e-5)
    said = diagnose_rows(situation, reached_with(situation, [cause], 12)).verdict
    assert said["effects"] == ["thermal"] and not said["outside_library"]


def test_what_pulls_the_platform_itself_in_a_corner_is_no_device() -> None:
    """Its middle is far off, and no reason to set those rows aside."""
    arm = load_mechanism(str(Path(__file__).parents[1] / "effects" / "arm.yaml"))
    joints = arm.sample_joints(200, torch.Generator().manual_seed(1))
    pose = arm.forward_kinematics(joints)
    near = ((pose[:, :3] - pose[:, :3].median(0).values) / 0.25).square().sum(-1)
    pull = 4e-4 * torch.exp(-near / 2)[:, None] * torch.tensor([0.0, -1.0, 0.5], dtype=torch.float64)
    drawn = torch.randn(pose.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    measured = pose + 1e-5 * drawn
    measured[:, :3] += pull
    found = diagnose_rows(
        Situation(arm, joints, {}, default_gravity(arm), None, pose), measured, torch.full((6,), 1e-5)
    )
    assert found.verdict["outside_library"] and found.verdict["driver"] == "workspace" and not found.verdict["effects"]
