"""One screw or belt between two joints, beside an error of the geometry: a pair of joints is a cause of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ccnn_torch.diagnosis import diagnose_rows
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.evidence.priors import EFFECT
from ccnn_torch.mechanisms import SerialArm, fit_frames, load_mechanism

SCARA = """\
robot: scara
dof: 4
convention: standard Denavit-Hartenberg
units: {length: mm, angle: deg}
joint_types: [revolute, revolute, prismatic, revolute]
a: [225, 175, 0, 0]
alpha: [0, 180, 0, 0]
d: [0, 0, 0, 0]
theta: [0, 0, 0, 0]
joint_sign: [1, 1, 1, -1]
base_frame: identity
tool_offset: [20, 0, 0]
"""
NOISE = 8e-6


def test_the_screw_of_a_quill_is_named_beside_wrong_links_and_zeros(tmp_path: Path) -> None:
    """60 rows: the quill sinks 0.191 mm for each radian of the fourth joint; links and zeros are wrong as well."""
    (tmp_path / "scara.yaml").write_text(SCARA)
    arm = load_mechanism(str(tmp_path / "scara.yaml"), orientation="none")
    assert isinstance(arm, SerialArm)
    generator = torch.Generator().manual_seed(0)
    span = torch.tensor([[-2.0, 2.0], [-2.2, 2.2], [0.0, 0.15], [-3.0, 3.0]], dtype=torch.float64)
    joints = span[:, 0] + (span[:, 1] - span[:, 0]) * torch.rand(60, 4, generator=generator, dtype=torch.float64)
    truth, names = arm.nominal.clone(), [p.name for p in arm.geometry]
    for name, error in {"a1": 4e-4, "a2": -3e-4, "theta1": 2.1e-3, "theta2": -3.5e-3, "theta4": 5.2e-3}.items():
        truth[names.index(name)] += error
    moved = joints.clone()
    moved[:, 2] += 1.91e-4 * joints[:, 3]
    pose = arm.forward_kinematics(moved, truth)
    pose = pose + NOISE * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    here = Situation(arm, joints, {}, default_gravity(arm))
    found = diagnose_rows(here, pose)
    # Directions in which a candidate does nothing but rounding decided once.
    again = diagnose_rows(here, pose + 1e-12 * torch.randn(pose.shape, generator=generator, dtype=torch.float64))
    assert again.verdict["probability"] == pytest.approx(found.verdict["probability"], abs=1e-3)
    assert set(found.verdict["effects"]) == {"geometry", "coupling"} and not found.verdict["outside_library"]
    assert found.verdict["probability"] > 0.8
    coupling = next(e for e in found.effects if e["name"] == "coupling")["parameters"]
    assert coupling["q3 by q4"]["value"] == pytest.approx(1.91e-4, rel=0.05)


PANDA = """\
robot: seven
dof: 7
convention: modified Denavit-Hartenberg
units: {length: m, angle: rad}
a: [0, 0, 0, 0.0825, -0.0825, 0, 0.088]
alpha: [0, -1.5707963, 1.5707963, 1.5707963, -1.5707963, 1.5707963, 1.5707963]
d: [0.333, 0, 0.316, 0, 0.384, 0, 0.1]
theta: [0, 0, 0, 0, 0, 0, 0]
base_frame: unknown
tool_frame: unknown
"""


def test_a_belt_from_every_joint_to_every_other_one_is_many_causes(tmp_path: Path) -> None:
    """42 pairs at once fit whatever a device does smoothly; a few pairs are a cause."""
    (tmp_path / "seven.yaml").write_text(PANDA)
    arm = load_mechanism(str(tmp_path / "seven.yaml"))
    assert isinstance(arm, SerialArm)
    generator = torch.Generator().manual_seed(3)
    joints = arm.sample_joints(110, generator) / 3
    moved = joints.clone()
    moved[:, 5] += 3e-3 * joints[:, 4]
    pose = arm.forward_kinematics(moved)
    pose = pose + 1e-4 * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    here = Situation(arm, joints, {}, default_gravity(arm), fit_frames(arm, joints, pose))
    found = diagnose_rows(here, pose)
    assert found.verdict["effects"] == ["coupling"]
    for atom in (a for a in found.analysis.atoms if a.name == "coupling"):
        # More than eight pairs cost as much as that many more causes.
        assert atom.log_prior <= EFFECT * (1 + max(atom.columns.shape[-1] - 16, 0))
