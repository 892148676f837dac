"""Numeric inverse kinematics of a user's mechanism stay on the branch of its home joints, or it is said."""

import math
from pathlib import Path

import pytest
import torch

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.testing import check_mechanism

ARM = """\
import torch
from ccnn_torch.coordinates import Coordinate, Parameter
from ccnn_torch.mechanisms import Mechanism


class Planar2R(Mechanism):
    def __init__(self):
        super().__init__(
            "planar_2r",
            [Coordinate("q1", "rad"), Coordinate("q2", "rad")],
            [Coordinate("x", "m"), Coordinate("y", "m")],
            [Parameter("l1", "m", 0.4), Parameter("l2", "m", 0.3)],
            low=LOW,
            high=HIGH,
            home_joints=HOME,
        )

    def closure(self, pose, joints, parameters=None):
        l1, l2 = self.resolve(parameters).unbind(-1)
        q1, q2 = joints.unbind(-1)
        there = torch.stack([l1 * f(q1) + l2 * f(q1 + q2) for f in (torch.cos, torch.sin)], -1)
        return there - pose
"""
BOX = {"LOW": "(0.2, -0.2)", "HIGH": "(0.5, 0.2)"}
NEAR, EXACT = "[-0.7, 1.4]", "[-0.8127, 2.1309]"


def spec(folder: Path, name: str, **parts: str) -> str:
    text = ARM
    for word, value in {**BOX, "HOME": NEAR, **parts}.items():
        text = text.replace(word, value)
    path = folder / f"{name}.py"
    path.write_text(text)
    return f"{path}:Planar2R"


def elbow_up(mechanism: Mechanism) -> float:
    """Share of 4000 poses that are reached on the branch of home, whose second joint is positive."""
    joints = mechanism.sample_joints(4000, torch.Generator().manual_seed(1))
    return float((torch.remainder(joints[:, 1], 2 * torch.pi) < torch.pi).double().mean())


def test_home_joints_that_are_only_near_are_settled_when_a_class_is_loaded(tmp_path: Path) -> None:
    mechanism = load_mechanism(spec(tmp_path, "near"))
    assert float(mechanism.closure(mechanism.home_pose, mechanism.home_joints).abs().max()) < 1e-12
    expected = load_mechanism(spec(tmp_path, "exact", HOME=EXACT)).home_joints
    torch.testing.assert_close(mechanism.home_joints, expected, rtol=0, atol=1e-6)
    assert elbow_up(mechanism) == 1.0
    check_mechanism(mechanism)


def test_home_joints_on_the_other_branch_stay_there(tmp_path: Path) -> None:
    mechanism = load_mechanism(spec(tmp_path, "below", HOME="[0.7, -1.4]"))
    assert float(mechanism.home_joints[1]) == pytest.approx(-math.acos(-0.53125), abs=1e-9)
    assert elbow_up(mechanism) == 0.0


def test_a_box_over_which_the_branch_is_lost_is_one_sentence(tmp_path: Path) -> None:
    """The box has the base inside; straight from home Newton ends elbow down at some of its poses."""
    wide = {"LOW": "(-0.3, -0.6)", "HIGH": "(0.8, 0.6)"}
    path = spec(tmp_path, "wide", HOME="[-0.85, 2.47]", **wide)
    with pytest.raises(InputError, match=r"wide\.py:Planar2R: its numeric inverse .* leave the branch .* at x = .* m"):
        load_mechanism(path)


def test_check_mechanism_finds_a_jump_that_near_home_joints_make(tmp_path: Path) -> None:
    mechanism = load_mechanism(spec(tmp_path, "own"))
    mechanism.home_joints.copy_(torch.tensor([-0.7, 1.4], dtype=torch.float64))
    with pytest.raises(AssertionError, match=r"'planar_2r': its numeric inverse .* leave the branch of home_joints"):
        check_mechanism(mechanism)
