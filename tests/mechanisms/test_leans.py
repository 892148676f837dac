"""Leans of parallel axes: what they do, that four parameters a link cannot, and that a file holds them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from fitted import fitted_geometry

from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.dh_file import read_dh_file
from ccnn_torch.mechanisms.frames.fit import fit_frames
from ccnn_torch.mechanisms.mechanism_file import dh_text

HALF = math.pi / 2
LINKS = [[0.1, HALF, 0.4, 0.2], [-0.5, 0, 0.0, -0.3], [-0.4, 0, 0, 0], [0, HALF, 0.12, 0.4], [0.05, -HALF, 0.1, 0]]


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_links_between_parallel_axes_have_a_lean(convention: str, tmp_path: Path) -> None:
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
    leaning = arm.with_leans()
    names = [p.name for p in leaning.geometry]
    assert [n for n in names if n.startswith("beta")] == ["beta2", "beta3"]
    joints = arm.sample_joints(50, torch.Generator().manual_seed(1))
    assert torch.equal(leaning.forward_kinematics(joints), arm.forward_kinematics(joints))
    assert leaning.unknown_frames == ("tool",) and leaning.with_leans() is leaning
    # Of everything at once, against differentiation and against the same arm by six parameters a link.
    values = leaning.nominal + 0.02 * torch.randn(
        len(names), generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    by_screws = leaning.parameter_jacobian(joints, values)
    torch.testing.assert_close(by_screws, Mechanism.parameter_jacobian(leaning, joints, values), rtol=0, atol=1e-12)
    moved = leaning.with_nominal(values)
    assert isinstance(moved, SerialArm)
    wanted = moved.forward_kinematics(joints)
    torch.testing.assert_close(moved.with_link_frames().forward_kinematics(joints), wanted, rtol=0, atol=1e-12)
    (tmp_path / "arm.yaml").write_text(dh_text(moved))
    again = read_dh_file(str(tmp_path / "arm.yaml"))
    assert again.leans == (2, 3) and torch.equal(again.forward_kinematics(joints), wanted)


def test_groups_of_parallel_axes_lean_though_the_table_has_an_angle() -> None:
    links = [[0.3, 0.05, 0.1, 0.0], [0.3, HALF, 0.0, 0.0], [0.1, 0.0, 0.1, 0.0]]
    assert SerialArm("arm", "standard", links).with_leans().leans == ()
    assert SerialArm("arm", "standard", links, parallel_axes=[[1, 2]]).with_leans().leans == (1,)
    # From the frame before the link on.
    assert SerialArm("arm", "modified", links, parallel_axes=[[1, 2]]).with_leans().leans == (2, 3)


def test_a_tilt_between_parallel_axes_needs_them() -> None:
    limits = [(-2.0, 2.0)] * 5
    arm = SerialArm("arm", "standard", LINKS, limits=limits, unknown_frames=["base", "tool"])
    full = arm.with_link_frames()
    truth = full.nominal.clone()
    truth[[p.name for p in full.geometry].index("pitch3")] += 2e-3
    joints = arm.sample_joints(150, torch.Generator().manual_seed(2))
    pose = full.forward_kinematics(joints, truth)
    left = []
    for kind in (arm, arm.with_leans()):
        found = fitted_geometry(kind, joints[:100], pose[:100], fit_frames(kind, joints[:100], pose[:100]))
        error = kind.pose_error(kind.forward_kinematics(joints[100:], found), pose[100:])
        left.append(float(error.position.square().mean().sqrt()))
    assert left[1] < 1e-5 < 5e-5 < left[0]
