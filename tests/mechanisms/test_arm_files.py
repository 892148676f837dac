"""Geometry files with a mistake: one sentence that names the file, the key or joint, and what would be right."""

import re

import pytest
import torch
from catalogue import PANDA, UR10, URDF

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism, read_dh_file, read_urdf
from ccnn_torch.mechanisms.mechanism_file import dh_text


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "convention: standard",
            "convention: Standard",
            "'standard Denavit-Hartenberg' or 'modified Denavit-Hartenberg'",
        ),
        ("convention: standard", "convention: 3 # standard", "key 'convention' must be a text"),
        ("dof: 6", "dof: six", "key 'dof' must be a finite number, got 'six'"),
        ("dof: 6", "dof: 2.5", "whole number"),
        ("dof: 6\n", "", "key 'dof' is missing"),
        ("theta: [0.0, ", "theta: [", "key 'theta' must list 6 numbers, one per joint, got 5"),
        ("theta: [0.0, 0.0", "theta: [0.0, 1mm", "key 'theta', entry 2 must be a finite number, got '1mm'"),
        ("theta: [0.0", "theta: [.nan", "key 'theta', entry 1 must be a finite number"),
        ("units: {length: mm", "units: {length: furlong", "key 'units.length' must be one of m, cm, mm"),
        (", angle: rad}", "}", "key 'units.angle' must be one of rad, deg"),
        ("joint_sign: [1,", "joint_sign: [2,", "key 'joint_sign' must list 6 times 1 or -1"),
        ("parallel_axes: [[2, 3, 4]]", "parallel_axes: [[2, 3, 7]]", "groups of joints from 1 to 6"),
        (
            "tool_frame: unknown",
            "tool_frame: [1, 2, 3]",
            r"key 'tool_frame' must be 'unknown', 'identity' or \[x, y, z, rx",
        ),
        ("tool_frame: unknown", "tool_frame: [1, 2, 3, 4, 5, x]", "key 'tool_frame', entry 6"),
        ("tool_frame: unknown", "frame_per: robot", "key 'frame_per' must be a list of names"),
        ("tool_frame: unknown", "joint_types: [revolute]", "key 'joint_types' must list 6 times"),
        ("dof: 6", "dof: 6\nlimits: [[0, 1]]", r"key 'limits' must list 6 times \[lowest, highest\]"),
        (
            "dof: 6",
            "dof: 6\nlimits: [[1, 0], [0, 1], [0, 1], [0, 1], [0, 1], [0, 1]]",
            "lowest value of each joint before",
        ),
        ("dof: 6", "dof: 6\ngears: [100]", "key 'gears' must list 6 numbers"),
        ("dof: 6", "dof: 6\ngears: [1, 1, 1, 1, 1, x]", "key 'gears' must be a finite number"),
        ("dof: 6", "dof: 6\ngears: [1, -1, 1, 1, 1, 1]", "key 'gears' must be above 0, or null"),
        ("dof: 6", "dof: 6\nmasses: [1, 1]", "key 'masses' must list 6 numbers, one per joint, got 2"),
        ("dof: 6", "dof: 6\nmasses: [1, 1, 1, 1, 1, -1]", r"must list 6 masses \[kg\] of at least 0, got"),
        ("dof: 6", "dof: 6\nmasses: [0, 0, 0, 0, 0, 0]", "key 'masses' must list 6 masses"),
        ("dof: 6", "dof: 6\ncentres: [[], [], [], [], [], []]", "'centres' must list 6 times .*beside 'masses'"),
        (
            "dof: 6",
            "dof: 6\nmasses: [1, 1, 1, 1, 1, 1]\ncentres: [[], [], [1, 2], [], [], []]",
            r"key 'centres', entry 3 must be \[x, y, z\] or \[\]",
        ),
        ("dof: 6", "dof: 6\ndof: 6", "line 3: not valid YAML"),
        ("dof: 6", "dof: [6", "not valid YAML"),
    ],
)
def test_dh_file_mistakes(tmp_path, old, new, said):
    assert old in UR10
    path = tmp_path / "arm.yaml"
    path.write_text(UR10.replace(old, new, 1))
    with pytest.raises(InputError, match=said) as caught:
        load_mechanism(str(path))
    assert "arm.yaml" in str(caught.value)


def test_limits_and_gears_of_a_dh_file_are_those_of_the_arm(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(
        "dof: 2\nconvention: standard Denavit-Hartenberg\nunits: {length: mm, angle: deg}\na: [0, 300]\n"
        "alpha: [-90, 0]\nd: [0, 0]\ntheta: [0, 0]\njoint_types: [prismatic, revolute]\n"
        "limits: [[0, 4000], [-90, 45]]\ngears: [20, 121]\n"
    )
    arm = read_dh_file(str(path))
    assert arm.gears == arm.with_link_frames().gears == pytest.approx((0.02, 121))
    assert arm.limits.flatten().tolist() == pytest.approx([0, 4, -1.5707963267948966, 0.7853981633974483])
    path.write_text(dh_text(arm))
    again = read_dh_file(str(path))
    assert torch.equal(again.limits, arm.limits) and again.gears == arm.gears


def test_dh_file_that_is_none(tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        load_mechanism(str(tmp_path / "no.yaml"))
    path = tmp_path / "list.yaml"
    path.write_text("- 1\n")
    with pytest.raises(InputError, match="must hold keys"):
        load_mechanism(str(path))
    path.write_bytes(b"\xff\xfe\x00dof")
    with pytest.raises(InputError, match=r"list\.yaml"):
        load_mechanism(str(path))


def test_tool_offset_replaces_the_tool_for_positions_only(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(PANDA + "tool_offset: [0, 0, 137]\nframe_per: [robot, placement]\ntool_per: [robot]\n")
    assert read_dh_file(str(path)).nominal[-6:-3].tolist() == pytest.approx([0, 0, 0.1])
    arm = read_dh_file(str(path), orientation="none")
    assert arm.nominal[-6:].tolist() == pytest.approx([0, 0, 0.137, 0, 0, 0]) and arm.unknown_frames == ()
    late = read_dh_file(str(path)).with_orientation("none")
    assert torch.equal(late.nominal, arm.nominal) and late.unknown_frames == arm.unknown_frames
    assert torch.equal(late.with_orientation("none").nominal, arm.nominal)
    assert arm.frame_per == ("robot", "placement") and arm.tool_per == ("robot",)
    path.write_text(PANDA + "tool_offset: ball centre, unknown per robot, near [0, 0, 137] mm; estimate it\n")
    assert read_dh_file(str(path), orientation="none").unknown_frames == ("tool",)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('type="prismatic"', 'type="floating"', "joint 'slide' is of type 'floating'"),
        ('<limit lower="-2" upper="2"/></joint>', '<mimic joint="pan"/></joint>', "joint 'lift' follows another joint"),
        ('xyz="0 0.1 0"', 'xyz="0 0.1"', "joint 'slide' needs three numbers in origin xyz, got '0 0.1'"),
        ('axis xyz="0 0 2"', 'axis xyz="0 0 0"', "joint 'pan' has the axis 0 0 0"),
        ('<parent link="rail"/>', "", "joint 'slide' lacks <parent"),
        ('lower="-0.4"', 'lower="low"', "joint 'slide' has limits that are no numbers"),
        (
            '<link name="plate"/>',
            '<link name="plate"><inertial><mass value="-1"/></inertial></link>',
            "link 'plate' needs a mass of at least 0 kg, <mass value=…>, got '-1'",
        ),
        (
            '<link name="fore"/>',
            '<link name="fore"><inertial><origin xyz="0 a 0"/><mass value="1"/></inertial></link>',
            "link 'fore' needs three numbers in origin xyz, got '0 a 0'",
        ),
        ("</robot>", "", "no valid XML"),
    ],
)
def test_urdf_mistakes(tmp_path, old, new, said):
    assert old in URDF
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.replace(old, new, 1))
    with pytest.raises(InputError, match=said) as caught:
        load_mechanism(str(path))
    assert "arm.urdf" in str(caught.value)


@pytest.mark.parametrize("tip", [None, "gripper"])
def test_a_joint_that_a_urdf_lacks_is_missed(tmp_path, tip):
    path = tmp_path / "arm.urdf"
    path.write_text(re.sub(r'<joint name="lift".*?</joint>', "", URDF, flags=re.DOTALL))
    with pytest.raises(InputError, match=r"no joint leads to link '.+', so that the chain is in 2 pieces: a joint is"):
        read_urdf(str(path), tip=tip)


def test_a_urdf_without_joints_is_named(tmp_path):
    (tmp_path / "arm.urdf").write_text('<robot name="x"><link name="a"/></robot>')
    with pytest.raises(InputError, match="has no joint at the end of a chain"):
        load_mechanism(str(tmp_path / "arm.urdf"))


def test_urdf_branches_ask_for_the_tip(tmp_path):
    path = tmp_path / "arm.urdf"
    branch = '<link name="camera"/><joint name="eye" type="fixed"><parent link="hand"/><child link="camera"/></joint>'
    path.write_text(URDF.replace("</robot>", branch + "</robot>"))
    with pytest.raises(InputError, match=r"the chain branches; give the last link as tip=, one of gripper, camera"):
        read_urdf(str(path))
    assert len(read_urdf(str(path), tip="gripper").joints) == 5
    assert len(read_urdf(str(path), tip="camera", base="pillar").joints) == 3
    with pytest.raises(InputError, match="has no link 'hend'; it has world, rail"):
        read_urdf(str(path), tip="hend")
    with pytest.raises(InputError, match="does not hang on"):
        read_urdf(str(path), base="camera", tip="gripper")
    with pytest.raises(InputError, match="no joint that moves"):
        read_urdf(str(path), base="world", tip="rail")
    with pytest.raises(InputError, match="there is no such file"):
        read_urdf(str(tmp_path / "no.urdf"))


def test_urdf_masses_of_fixed_parts_count_for_the_link_that_moves_them(tmp_path):
    """Plate and upper are one link: 2 kg at its origin, 1 kg 0.1 m up in the spacer's frame at (0, 0.05, 0.1)."""
    path = tmp_path / "arm.urdf"
    assert len(load_mechanism(str(_written(path, URDF))).masses) == 0
    heavy = URDF.replace('<link name="plate"/>', '<link name="plate"><inertial><mass value="2"/></inertial></link>')
    one = '<link name="upper"><inertial><origin xyz="0 0 0.1"/><mass value="1"/></inertial></link>'
    arm = load_mechanism(str(_written(path, heavy.replace('<link name="upper"/>', one))))
    assert arm.masses.tolist() == [0, 3, 0, 0, 0]
    joints = torch.tensor([[0.1, 0.4, 0.2, -0.3, 0.5]], dtype=torch.float64)
    frames = arm.link_frames(joints, arm.nominal)
    places, shares = arm.weighs(frames, frames[-1][1])
    wanted = (frames[2][0] @ torch.tensor([0, 0.05 / 3, 0.2 / 3], dtype=torch.float64) + frames[2][1])[0]
    assert shares.tolist() == [0, 1, 0, 0, 0]
    torch.testing.assert_close(places[0, 1], wanted, rtol=0, atol=1e-15)


def _written(path, text):
    path.write_text(text)
    return path


def test_urdf_limits_are_the_sampling_box(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    arm = read_urdf(str(path))
    assert arm.limits[0].tolist() == [-0.4, 0.6] and [j.unit for j in arm.joints] == ["m", "rad", "rad", "rad", "rad"]
    assert arm.unknown_frames == ("base", "tool") and arm.name == "gantry_arm"
