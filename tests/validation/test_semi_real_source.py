"""Measured rows with a known cause: the same twice, of the stated strength, with fitting columns and truth."""

import os
import re
from functools import cache

import numpy as np
import pytest
import torch
from ccnn_validation.sources.semi_real import FAMILIES, make
from ccnn_validation.sources.semi_real.build import pose_columns
from ccnn_validation.sources.semi_real.causes import changes_joints, on_joints
from ccnn_validation.sources.semi_real.robots import directions, robot_of
from ccnn_validation.sources.semi_real.situation import draw_rows
from scipy.spatial.transform import Rotation

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism

NEEDED = {
    "added_backlash": ("direction1[1]",),
    "added_friction": ("direction1[1]", "load_x[N]"),
    "added_compliance": ("load_x[N]",),
    "added_thermal": ("temperature[degC]",),
    "added_drift": ("time[s]",),
    "added_jump": ("time[s]",),
    "added_latency": ("speed1[rad/s]",),
}


@pytest.fixture(autouse=True)
def rows_of_the_repository(monkeypatch):
    monkeypatch.delenv("CCNN_MEASURED", raising=False)


@cache
def kept(family):
    return make(family, 0)


def moved(case):
    return np.stack([case.columns[f"{a}[m]"] - case.baseline[f"{a}[m]"] for a in "xyz"], -1)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_case_is_reproducible_finite_and_complete(family):
    case = kept(family)
    # Every family draws as the others do: some are drawn twice.
    again = make(family, 0) if family in FAMILIES[::4] else case
    assert case.truth == again.truth
    assert list(case.columns) == list(again.columns)
    for header, values in case.columns.items():
        assert np.array_equal(values, again.columns[header])
        assert values.shape == (400,) and np.isfinite(values).all()
    for header in ("q1[rad]", "q6[rad]", "x[m]", "rz[rad]", *NEEDED.get(family, ())):
        assert header in case.columns
    assert case.noise is None and case.clean is None


@pytest.mark.parametrize("family", FAMILIES)
def test_the_baseline_differs_in_the_pose_alone_and_by_the_strength(family):
    case = kept(family)
    if family == "added_nothing":
        assert np.array_equal(moved(case), np.zeros((400, 3)))
        assert set(case.columns) > set(case.baseline)
        return
    assert set(case.columns) == set(case.baseline)
    for header in case.columns:
        if header not in ("x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"):
            assert np.array_equal(case.columns[header], case.baseline[header])
    size = np.linalg.norm(moved(case), axis=-1) / robot_of("ur10_b").seen.own_error
    if family == "added_outliers":
        assert 0.02 < np.mean(size > 5) < 0.07
        assert np.all((size < 1e-9) | (size > 5))
    else:
        stated = float(re.search(r" at ([\d.]+) of the arm's", case.truth.causes[0]).group(1))
        assert np.sqrt(np.mean(size**2)) == pytest.approx(stated, rel=1e-3)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_truth_is_consistent(family):
    truth = kept(family).truth
    assert truth.accepted and len(set(truth.accepted)) == len(truth.accepted)
    assert (truth.kind == "outside") == (truth.outside is True) == bool(truth.drivers)
    assert truth.kind in ("none", "single", "outside")
    if truth.kind != "single":
        assert frozenset() in truth.accepted


def test_the_arm_is_that_of_its_geometry_file(tmp_path):
    """Poses are those of the library's kinematics of the same file, without frames."""
    robot = robot_of("ur10_b")
    path = tmp_path / "arm.yaml"
    path.write_text(robot.text, encoding="utf-8")
    mechanism = load_mechanism(str(path))
    theirs = mechanism.forward_kinematics(torch.as_tensor(robot.joints[:50]))
    ours = robot.seen.arm.with_values(tool=np.zeros(3)).pose(robot.joints[:50]).position
    assert np.abs(ours - theirs[:, :3].numpy()).max() < 1e-9


def test_orientation_turns_with_the_position():
    """A first joint that is 1 mrad off turns the target about the base's upright axis, and shifts it across."""
    robot = robot_of("ur10_b")
    rows, upright = draw_rows(robot, np.random.default_rng(0)), robot.seen.base[:, 2]
    pose = changes_joints(rows, on_joints(rows, np.array([0]), np.full((400, 1), 1e-3)))
    before, after = pose_columns(rows, pose(0), pose(0)), pose_columns(rows, pose(0), pose(1))
    first, second = (Rotation.from_rotvec(np.stack([c[f"r{a}[rad]"] for a in "xyz"], -1)) for c in (before, after))
    assert np.abs((second * first.inv()).as_rotvec() - 1e-3 * upright).max() < 1e-12
    assert np.abs(sum(upright[i] * (after[f"{a}[m]"] - before[f"{a}[m]"]) for i, a in enumerate("xyz"))).max() < 1e-12


def test_a_joint_at_rest_keeps_its_direction():
    joints = np.array([[0.0], [1.0], [1.0], [0.5], [0.5]])
    assert directions(joints)[:, 0].tolist() == [1, 1, 1, -1, -1]


def test_missing_data_is_one_sentence(monkeypatch, tmp_path):
    with pytest.raises(InputError, match="set CCNN_MEASURED"):
        make("added_backlash", 1)
    monkeypatch.setitem(os.environ, "CCNN_MEASURED", str(tmp_path))
    with pytest.raises(InputError, match="there is no"):
        make("added_backlash", 2)
    with pytest.raises(InputError, match="no family"):
        make("added_magic", 0)
