"""Six parameters a link: the same kinematics, and what four of them cannot tell."""

from __future__ import annotations

import math

import pytest
import torch
from fitted import fitted_geometry

from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.frames.fit import fit_frames

HALF = math.pi / 2
LINKS = [[0.1, HALF, 0.4, 0.2], [-0.5, 0, 0.0, -0.3], [-0.4, 0, 0, 0], [0, HALF, 0.12, 0.4], [0.05, -HALF, 0.1, 0]]


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_link_frames_leave_the_kinematics_as_they_are(convention: str) -> None:
    arm = SerialArm(
        "arm",
        convention,
        LINKS,
        joint_types=["revolute", "revolute", "prismatic", "revolute", "revolute"],
        joint_sign=[1, -1, -1, 1, 1],
        base=[0.3, 0.1, 0.2, 0.1, 0.4, -0.2],
        tool=[0.02, 0.0, 0.1, 0.3, -0.1, 0.5],
        unknown_frames=["tool"],
    )
    twin = arm.with_link_frames()
    joints = arm.sample_joints(50, torch.Generator().manual_seed(1))
    error = arm.pose_error(arm.forward_kinematics(joints), twin.forward_kinematics(joints))
    assert error.rotation is not None and float(error.rotation.max()) < 1e-7
    assert float(error.position.max()) < 1e-14
    assert twin.convention == "urdf" and twin.unknown_frames == ("tool",) and twin.with_link_frames() is twin


def test_a_tilt_between_parallel_axes_needs_them() -> None:
    limits = [(-2.0, 2.0)] * 5
    arm = SerialArm("arm", "standard", LINKS, limits=limits, unknown_frames=["base", "tool"])
    full = arm.with_link_frames()
    truth = full.nominal.clone()
    names = [p.name for p in full.geometry]
    truth[names.index("pitch3")] += 2e-3
    joints = arm.sample_joints(150, torch.Generator().manual_seed(2))
    pose = full.forward_kinematics(joints, truth)
    left = []
    for kind in (arm, full):
        found = fitted_geometry(kind, joints[:100], pose[:100], fit_frames(kind, joints[:100], pose[:100]))
        error = kind.pose_error(kind.forward_kinematics(joints[100:], found), pose[100:])
        left.append(float(error.position.square().mean().sqrt()))
    assert left[1] < 1e-5 < 5e-5 < left[0]
