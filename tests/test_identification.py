"""Link parameters from noisy poses of arms that the fit has not seen."""

from __future__ import annotations

import math

import pytest
import torch
from fitted import fitted_geometry
from torch import Tensor

from ccnn_torch.mechanisms.frames.fit import fit_frames
from ccnn_torch.mechanisms.machines.serial import SerialArm

HALF = math.pi / 2
SIX = [
    [0.1, HALF, 0.4, 0.0],
    [-0.5, 0, 0.0, 0.0],
    [-0.4, 0, 0, 0],
    [0, HALF, 0.12, 0],
    [0, -HALF, 0.1, 0],
    [0, 0, 0.09, 0],
]
SEVEN = [
    [0.0, 0.0, 0.333, 0.0],
    [0.0, -HALF, 0.0, 0.0],
    [0.0, HALF, 0.316, 0.0],
    [0.0825, HALF, 0.0, 0.0],
    [-0.0825, -HALF, 0.384, 0.0],
    [0.0, HALF, 0.0, 0.0],
    [0.088, HALF, 0.107, 0.0],
]


def arm_of(kind: str) -> SerialArm:
    links, convention = (SIX, "standard") if kind == "six" else (SEVEN, "modified")
    return SerialArm(
        name=kind,
        convention=convention,
        links=links,
        limits=[(-2.0, 2.0)] * len(links),
        unknown_frames=("base", "tool"),
    )


def machine(kind: str, seed: int) -> tuple[SerialArm, Tensor, Tensor, Tensor]:
    """Arm, its true parameters (0.5 mm and 0.5 mrad off, frames anywhere), joints, poses with 20 µm and 50 µrad."""
    generator = torch.Generator().manual_seed(seed)
    arm = arm_of(kind)
    truth = arm.nominal + 5e-4 * torch.randn(arm.nominal.shape, generator=generator, dtype=torch.float64)
    truth[:6] = torch.tensor([1.0, -2.0, 0.3, 0.1, -0.4, 2.0], dtype=torch.float64)
    truth[-6:] = torch.tensor([0.02, 0.05, 0.11, 0.3, 1.0, -0.2], dtype=torch.float64)
    joints = arm.sample_joints(160, generator)
    pose = arm.forward_kinematics(joints, truth)
    noise = torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    scale = torch.tensor([2e-5] * 3 + [5e-5] * 3, dtype=torch.float64)
    return arm, truth, joints, pose + noise * scale


@pytest.mark.parametrize("kind", ["six", "seven"])
def test_links_predict_held_out_poses(kind: str) -> None:
    arm, truth, joints, pose = machine(kind, seed=1)
    rows = torch.ones(2, 160, dtype=torch.bool)
    rows[0, 100:] = False
    rows[1, :60] = False
    pose[100:101, 0] += 0.5  # a held-out row of the first repeat must not be looked at
    frames = fit_frames(arm, joints, pose, rows.double())
    fitted = [fitted_geometry(arm, joints, pose, *own) for own in zip(frames, rows, strict=True)]
    assert frames.shape == (2, len(arm.geometry))
    held_out = slice(101, 160)
    real = arm.forward_kinematics(joints[held_out], truth)
    before = arm.pose_error(arm.forward_kinematics(joints[held_out], frames[0]), real).position.square().mean().sqrt()
    after = arm.pose_error(arm.forward_kinematics(joints[held_out], fitted[0]), real).position.square().mean().sqrt()
    assert float(after) < 3e-5 < 3e-4 < float(before)
