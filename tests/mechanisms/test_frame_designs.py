"""Frames from the designs that people measure: every fit is near the truth or refused, and none ends in between."""

import pytest
import torch
from catalogue import make
from fitted import fitted_geometry

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import fit_frames, judge_frames, read_dh_file

CORNERS = torch.tensor([[0.0, 0, 0], [1, -1, 1], [-1, -1, 1], [-1, 1, -1], [1, 1, -1]], dtype=torch.float64)
DESIGNS = ["everywhere", "one_orientation", "cube", "plane", "line", "one_joint", "ten_rows"]


def _arm(name, folder):
    """A six-joint or a seven-joint arm whose frames nobody knows."""
    kind, _, seen = name.partition("_")
    make(kind, folder)
    path = folder / f"{kind}.yaml"
    lines = [line for line in path.read_text().splitlines() if not line.startswith(("base_frame", "tool_frame"))]
    path.write_text("\n".join([*lines, "base_frame: unknown", "tool_frame: unknown", ""]))
    return read_dh_file(str(path), **({"orientation": "none"} if seen else {}))


def _joints(arm, design, generator):
    """Commanded joints of a design; the targets of a cube are those of ISO 9283, in 30 cycles."""
    arm = arm.with_orientation("rotation_vector")
    if design == "everywhere":
        return arm.sample_joints(80, generator)
    if design == "ten_rows":
        return arm.sample_joints(10, generator)
    home = arm.home_joints
    if design == "one_joint":
        joints = home.repeat(40, 1)
        joints[:, 1] += torch.linspace(-0.8, 0.8, 40, dtype=torch.float64)
        return joints
    draw = 2 * torch.rand(60, 3, generator=generator, dtype=torch.float64) - 1
    offsets = {
        "one_orientation": draw,
        "cube": CORNERS.repeat(30, 1),
        "plane": draw * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64),
        "line": draw[:, :1] * torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64),
    }[design]
    pose = arm.forward_kinematics(home).repeat(len(offsets), 1)
    pose[:, :3] += 0.1 * offsets
    joints = arm.nearest_joints(pose, None, home.expand(len(pose), -1), 0.3)
    # No controller reaches a target exactly.
    return joints + 1e-4 * torch.randn(joints.shape, generator=generator, dtype=torch.float64)


def _measured(arm, joints, generator):
    """Poses of a machine with link errors of 0.5 mm and 0.5 mrad and 0.05 mm of noise, and its true frames."""
    truth = arm.nominal.clone()
    truth[:6] = torch.tensor([1.5, -2.0, 0.7, 0.4, -0.9, 1.7], dtype=torch.float64)
    truth[-6:] = torch.tensor([0.05, -0.08, 0.15, 0.3, -0.6, 0.2], dtype=torch.float64)
    real = truth.clone()
    real[6:-6] += 5e-4 * torch.randn(len(truth) - 12, generator=generator, dtype=torch.float64)
    pose = arm.forward_kinematics(joints, real)
    return pose + 5e-5 * torch.randn(pose.shape, generator=generator, dtype=torch.float64), truth


def _rms(arm, joints, pose, values):
    error = arm.pose_error(arm.forward_kinematics(joints, values), pose)
    square = error.position.square()
    return float((square if error.rotation is None else square + 0.09 * error.rotation.square()).mean().sqrt())


@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize("name", ["panda_positions"])
def test_a_design_leaves_no_more_than_the_true_frames(name, design, tmp_path):
    arm, generator = _arm(name, tmp_path), torch.Generator().manual_seed(5)
    joints = _joints(arm, design, generator)
    pose, truth = _measured(arm, joints, generator)
    fitted = fit_frames(arm, joints, pose)
    assert _rms(arm, joints, pose, fitted) < 1.02 * _rms(arm, joints, pose, truth)
    assert judge_frames(arm, joints, pose, fitted) == []
    # What the rows cannot show is held: the tool stays within the arm's size.
    assert float(fitted[-6:-3].norm()) < arm.reach


def test_links_that_are_fitted_next_stay_within_reach(tmp_path):
    arm, generator = _arm("ur10", tmp_path), torch.Generator().manual_seed(5)
    joints = _joints(arm, "cube", generator)
    pose, _ = _measured(arm, joints, generator)
    fitted = fit_frames(arm, joints[:75], pose[:75])
    links = fitted_geometry(arm, joints[:75], pose[:75], fitted)
    assert _rms(arm, joints[75:], pose[75:], links) < 1.001 * _rms(arm, joints[75:], pose[75:], fitted)
    assert float(links[-6:-3].norm()) < arm.reach


@pytest.mark.parametrize(("name", "kind"), [("ur10", "thrown"), ("ur10_positions", "swapped"), ("panda", "swapped")])
def test_gross_outliers_move_neither_frames_nor_links(name, kind, tmp_path):
    arm, generator = _arm(name, tmp_path), torch.Generator().manual_seed(6)
    joints = arm.sample_joints(200, generator)
    pose, _ = _measured(arm, joints, generator)
    bad = torch.randperm(150, generator=generator)[:15]
    train, test = slice(0, 150), slice(150, None)
    wrong = pose.clone()
    wrong[bad, :3] += 0.05 * torch.randn(15, 3, generator=generator, dtype=torch.float64)
    if kind == "swapped":
        wrong[bad] = pose[bad.roll(1)]
    weights = (torch.arange(200) < 150).double()
    frames = [fit_frames(arm, joints, p, weights) for p in (pose, wrong)]
    links = [fitted_geometry(arm, joints[train], p[train], f) for p, f in zip((pose, wrong), frames, strict=True)]
    for clean, robust in (frames, links):
        best = _rms(arm, joints[test], pose[test], clean)
        assert _rms(arm, joints[test], pose[test], robust) < 1.1 * best
    (note,) = judge_frames(arm, joints, wrong, frames[1], weights, name_rows=lambda rows: str(sorted(rows)))
    named = [int(row) for row in note.partition("[")[2].partition("]")[0].split(",")]
    assert set(named) <= set(bad.tolist()) and len(named) >= 12


@pytest.mark.parametrize("mistake", ["sign", "robot"])
def test_a_model_of_another_robot_is_refused(mistake, tmp_path):
    arm, generator = _arm("ur10", tmp_path), torch.Generator().manual_seed(7)
    joints = arm.sample_joints(60, generator)
    pose, _ = _measured(arm, joints, generator)
    if mistake == "sign":
        joints = joints * torch.tensor([1.0, 1.0, -1.0, 1.0, 1.0, 1.0], dtype=torch.float64)
    else:
        path = tmp_path / "ur10.yaml"
        text = path.read_text()
        path.write_text(text.replace("612", "425"))
        assert path.read_text() != text
        arm = read_dh_file(str(path))
    with pytest.raises(InputError, match=r"R\.csv: with base and tool frame fitted, .* still misses half of"):
        judge_frames(arm, joints, pose, fit_frames(arm, joints, pose), where="R.csv")


def test_as_many_repeats_as_rows_are_judged_each_by_itself(tmp_path):
    arm, generator = _arm("ur10", tmp_path), torch.Generator().manual_seed(8)
    joints = arm.sample_joints(20, generator)
    pose, _ = _measured(arm, joints, generator)
    fitted = fit_frames(arm, joints, pose, torch.ones(20, 20, dtype=torch.float64))
    assert judge_frames(arm, joints, pose, fitted[:, None], torch.ones(20, 20)) == []
    fitted[3, :3] += 1.0
    with pytest.raises(InputError, match="misses half of"):
        judge_frames(arm, joints, pose, fitted[:, None], torch.ones(20, 20))
