"""The identified machine out again: our own file, DH file, URDF."""

import re
from pathlib import Path

import pytest
import torch
from mechanisms.catalogue import make

from ccnn_torch.compensation import load_compensation
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.mechanisms.mechanism_file import (
    dh_text,
    mechanism_text,
    patched_urdf,
    read_mechanism_file,
    urdf_text,
    write_machine,
)

ARMS = ("ur10", "ur10_positions", "panda", "scara", "urdf")


def changed(mechanism: Mechanism, seed: int = 0) -> Mechanism:
    """The mechanism with other parameters, all of them."""
    noise = torch.randn(len(mechanism.nominal), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return mechanism.with_nominal(mechanism.nominal + 1e-3 * noise)


@pytest.mark.parametrize("name", ["tripod", "five_bar", "machine_tool", "ur10", "urdf"])
def test_own_file_gives_the_same_parameters_bit_by_bit(name: str, tmp_path: Path) -> None:
    mechanism = changed(make(name, tmp_path))
    names = [p.name for p in mechanism.geometry]
    nominal = dict.fromkeys(names, 0.25)
    path = tmp_path / "identified.yaml"
    path.write_text(mechanism_text(mechanism, nominal))
    again = load_mechanism(str(path))
    assert torch.equal(again.nominal, mechanism.nominal)
    assert again.describe()["parameters"] == mechanism.describe()["parameters"]
    file = read_mechanism_file(str(path))
    assert file is not None
    assert file.parameters_of(again, "nominal") == nominal


def test_where_rows_were_measured_is_inside_the_domain_of_what_they_identified(tmp_path: Path) -> None:
    machine, path = load_mechanism("delta"), tmp_path / "identified.yaml"
    nominal = dict(zip((p.name for p in machine.geometry), machine.nominal.tolist(), strict=True))
    lower = [[1.29, 1.3, 1.31]]
    for measured, inside in (({}, False), ({j.name: [1.2, 1.4] for j in machine.joints}, True)):
        path.write_text(mechanism_text(changed(machine), nominal, measured=measured))
        assert load_compensation(path)(lower, ways=("command",))["inside_domain"].tolist() == [inside]
    path.write_text(path.read_text().replace("1.2", "low"))
    with pytest.raises(InputError, match="measured: must map joints to their lowest and highest number"):
        read_mechanism_file(str(path), path.read_bytes())


@pytest.mark.parametrize("name", ARMS)
def test_urdf_reaches_the_same_frames(name: str, tmp_path: Path) -> None:
    arm = changed(make(name, tmp_path))
    assert isinstance(arm, SerialArm)
    path = tmp_path / "out.urdf"
    path.write_text(urdf_text(arm))
    again = load_mechanism(str(path))
    assert isinstance(again, SerialArm)
    joints = arm.sample_joints(20, torch.Generator().manual_seed(1))
    for ours, theirs in zip(arm.forward_frame(joints), again.forward_frame(joints), strict=True):
        torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-12)
    torch.testing.assert_close(again.limits, arm.limits)
    assert torch.equal(again.revolute, arm.revolute)


@pytest.mark.parametrize("name", ["ur10", "ur10_positions", "panda", "scara"])
def test_dh_file_gives_the_same_parameters_bit_by_bit(name: str, tmp_path: Path) -> None:
    arm = changed(make(name, tmp_path))
    assert isinstance(arm, SerialArm)
    path = tmp_path / "out.yaml"
    path.write_text(dh_text(arm))
    again = load_mechanism(str(path), orientation=arm.orientation)
    assert isinstance(again, SerialArm)
    assert torch.equal(again.nominal, arm.nominal)
    assert again.unknown_frames == ()
    assert again.parallel_axes == arm.parallel_axes
    joints = arm.sample_joints(5, torch.Generator().manual_seed(1))
    assert torch.equal(again.forward_kinematics(joints), arm.forward_kinematics(joints))


def test_a_urdf_arm_has_no_dh_table(tmp_path: Path) -> None:
    arm = make("urdf", tmp_path)
    assert isinstance(arm, SerialArm)
    with pytest.raises(InputError, match="has no Denavit-Hartenberg table"):
        dh_text(arm)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("L: {", "K: {", "check K, L"),
        ("unit: m}", "unit: mm}", "parameters.L.unit: must be m, not 'mm'"),
        ("value: 1.0,", "value: .nan,", "parameters.L.value: must be a finite number, not nan"),
        ("keys: {}", "keys: 3", "a mechanism file has mechanism, keys and parameters"),
    ],
)
def test_a_damaged_file_is_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    mechanism = load_mechanism("tripod")
    path = tmp_path / "tripod.yaml"
    text = mechanism_text(mechanism, dict(zip("Lr", mechanism.nominal.tolist(), strict=True)))
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load_mechanism(str(path))


OWN = """<?xml version="1.0"?>\r
<!-- kept: <joint name="a"><origin xyz="9 9 9"/></joint> -->
<robot name='cell'><material name="grey é"/>
  <link name="base"/><link name="arm"><inertial><mass value="3.5"/><origin xyz="0 0 .1"/><inertia ixx="1" ixy="0"
    ixz="0" iyy="1" iyz="0" izz="1"/></inertial><visual><origin xyz="0 0 .2"/></visual></link>
  <link name="hand"/><link name="flange"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="150" velocity="3"/></joint>
  <joint type="revolute" name='b'><parent link="arm"/><child link="hand"/><origin  rpy='0 1.5707963 0'
    xyz = "0.3 0 0" ></origin><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="28" velocity="3"/></joint>
  <joint name="end" type="fixed"><parent link="hand"/><child link="flange"/><origin xyz="0 0 .1"/></joint>
  <transmission name="t"><joint name="a"/></transmission>
</robot>
"""


def test_a_urdf_gets_other_origins_and_stays_as_it_is_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "own.urdf"
    path.write_bytes(OWN.encode())
    before = load_mechanism(str(path))
    after = changed(before)
    assert isinstance(before, SerialArm) and isinstance(after, SerialArm)
    nominal = dict(zip((p.name for p in before.geometry), before.nominal.tolist(), strict=True))
    write_machine(after, nominal, tmp_path, "identified", source=str(path))
    text = (tmp_path / "identified.urdf").read_bytes().decode()
    again = load_mechanism(str(tmp_path / "identified.urdf"))
    assert isinstance(again, SerialArm)
    # Base and tool are told, and no part of the file.
    alone = after.nominal.clone()
    alone[:6], alone[-6:] = before.nominal[:6], before.nominal[-6:]
    joints = before.sample_joints(20, torch.Generator().manual_seed(1))
    for ours, theirs in zip(before.forward_frame(joints, alone), again.forward_frame(joints), strict=True):
        torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-12)
    assert torch.equal(again.masses, before.masses) and len(before.masses) == 2
    new = re.compile(r"""<origin xyz="[^"]*" rpy="[^"]*"/?><!-- corrected by ccnn_torch; was [^>]*-->""")
    assert len(new.findall(text)) == 2
    rest = re.sub(r"<!-- ccnn_torch corrected[^>]*-->\n", "", new.sub("", text))
    assert rest == re.sub(r"""<origin  rpy='0 1.5707963 0'\s+xyz = "0.3 0 0" >""", "", OWN)
    assert "the measurement, xyz " in text and 'was xyz="0.3 0.0 0.0" rpy="0.0 1.5707963 0.0"' in text
    # A file that is the arm's no more is not touched, and the arm is written as a chain of its own.
    path.write_text(OWN.replace("0.3 0 0", "0.4 0 0"))
    write_machine(after, nominal, tmp_path, "identified", source=str(path))
    text = (tmp_path / "identified.urdf").read_text()
    assert '<link name="measurement" />' in text and "has no 2 joints one after the other" in text
    path.write_text(OWN.replace('name="end" type="fixed"', 'name="b" type="fixed"'))
    with pytest.raises(InputError, match="has 3 joints of the names a, b; give each its own name"):
        patched_urdf(str(path), before, after)
