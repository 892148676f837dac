"""Numbers for other stacks: read by formulas of their own, and held against the machine that was identified."""

from __future__ import annotations

import configparser
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from machines import known, parallel
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from stand_ins import fields, tripod_compensator

from ccnn_torch import export_model, load_mechanism
from ccnn_torch.compensation import load_compensation, save_model
from ccnn_torch.compensation.targets.lowered import Found, Stack, with_readme
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.mechanisms.mechanism_file import mechanism_text

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]
HALF = math.pi / 2
UR10 = ([0, -0.612, -0.5723, 0, 0, 0], [HALF, 0, 0, HALF, -HALF, 0], [0.1273, 0, 0, 0.163941, 0.1157, 0.0922])
FRAMES = torch.tensor([0.3, 0.2, 1.0, 0.1, 0.2, 2.0], dtype=torch.float64)
TOOL = torch.tensor([0.01, -0.02, 0.12, 0.3, -0.2, 0.1], dtype=torch.float64)


def identified(folder: Path, nominal: Mechanism, error: float, frames: bool = True) -> tuple[Path, Mechanism]:
    """An identified.yaml of a machine whose numbers are off, and the machine."""
    draw = torch.randn(nominal.nominal.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    values = nominal.nominal + error * draw
    if frames:
        values[:6], values[-6:] = FRAMES, TOOL
    real = nominal.with_nominal(values)
    return written(folder, nominal, real), real


def written(folder: Path, nominal: Mechanism, real: Mechanism) -> Path:
    before = dict(zip((p.name for p in nominal.geometry), nominal.nominal.tolist(), strict=True))
    (folder / "identified.yaml").write_text(mechanism_text(real, before), encoding="utf-8")
    return folder / "identified.yaml"


def drawn(count: int, joints: int, seed: int = 5) -> Array:
    return np.random.default_rng(seed).uniform(-2.5, 2.5, (count, joints))


def placed(place: Sequence[float], turn: Rotation) -> Array:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn.as_matrix(), place
    return found


def of_rpy(numbers: Sequence[float]) -> Array:
    """x, y, z, roll, pitch, yaw: fixed axes x, y, z."""
    return placed(numbers[:3], Rotation.from_euler("xyz", numbers[3:]))


def about_z(angle: float) -> Array:
    return placed([0, 0, 0], Rotation.from_euler("z", angle))


def told(text: str, before: str) -> Array:
    """A frame of a README: x, y, z and roll, pitch, yaw."""
    number = r"(-?\d+\.\d+)"
    found = re.search(re.escape(before) + rf"\W*xyz {number} {number} {number}, rpy {number} {number} {number}", text)
    assert found, text
    return of_rpy([float(v) for v in found.groups()])


def assert_same(found: Array, machine: Mechanism, joints: Array, within: float = 1e-9) -> None:
    assert isinstance(machine, SerialArm)
    position, rotation = machine.forward_frame(torch.from_numpy(joints))
    np.testing.assert_allclose(found[:, :3, 3], position.numpy(), rtol=0, atol=within)
    np.testing.assert_allclose(found[:, :3, :3], rotation.numpy(), rtol=0, atol=within)


def ur10() -> SerialArm:
    a, alpha, d = UR10
    links = [[a[i], alpha[i], d[i], 0.0] for i in range(6)]
    return SerialArm("ur10", "standard", links, unknown_frames=["base", "tool"], parallel_axes=[[2, 3, 4]])


# The numbers of a UR10, in the form of
# https://github.com/UniversalRobots/Universal_Robots_ROS2_Description/blob/rolling/config/ur10/default_kinematics.yaml
UR_SAMPLE = """kinematics:
  shoulder: {x: 0, y: 0, z: 0.1273, roll: 0, pitch: 0, yaw: 0}
  upper_arm: {x: 0, y: 0, z: 0, roll: 1.570796327, pitch: 0, yaw: 0}
  forearm: {x: -0.612, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}
  wrist_1: {x: -0.5723, y: 0, z: 0.163941, roll: 0, pitch: 0, yaw: 0}
  wrist_2:
    x: 0
    y: -0.1157
    z: -2.373046667922381e-11
    roll: 1.570796327
    pitch: 0
    yaw: 0
  wrist_3: {x: 0, y: 0.0922, z: -1.8910e-11, roll: 1.5707963265897932, pitch: 3.141592653589793, yaw: 3.141592653589793}
  hash: calib_6364616365313537
"""


def read_ur(text: str, joints: Array) -> Array:
    """`tool0` in `base_link_inertia`: each joint turns about z of its origin."""
    tree = parse_yaml(text, "kinematics.yaml")["kinematics"]
    assert isinstance(tree, Mapping) and [*tree][-1] == "hash" and re.fullmatch(r"\w+", tree["hash"])
    names = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
    origins = [of_rpy([float(tree[n][k]) for k in ("x", "y", "z", "roll", "pitch", "yaw")]) for n in names]
    found = []
    for row in joints:
        frame = np.eye(4)
        for origin, angle in zip(origins, row, strict=True):
            frame = frame @ origin @ about_z(angle)
        found.append(frame)
    return np.stack(found)


def test_the_public_form_of_ur_description_is_read_the_same_way() -> None:
    joints = drawn(5, 6)
    assert_same(read_ur(UR_SAMPLE, joints), ur10(), joints, 1e-8)


@pytest.mark.parametrize("form", ["DH", "leans", "URDF", "URDF turned by half"])
def test_ur_description_has_the_identified_arm(tmp_path: Path, form: str) -> None:
    arm = ur10().with_link_frames() if form.startswith("URDF") else ur10()
    arm = arm.with_leans() if form == "leans" else arm
    if form.endswith("half"):
        # As ur_description has it: base_link is turned by half against the first joint's frame.
        keys = arm.recipe["keys"]
        arm = SerialArm(**{**keys, "links": [[0, 0, 0, 0, 0, math.pi], *keys["links"][1:]]})
    path, real = identified(tmp_path, arm, 5e-4)
    files = export_model(path, "ur", tmp_path / "out")
    readme, joints = files["README.md"].read_text(), drawn(20, 6)
    base = told(readme, "in the frame of the measurement:")
    tool = told(readme, "The measured tool in `tool0`:")
    found = base @ read_ur(files["kinematics.yaml"].read_text(), joints) @ tool
    assert_same(found, real, joints)
    assert "ur_type:=ur10 " in readme and "kinematics_params_file:=" in readme
    # Frames are near those of the type: nothing is 439 m away.
    tree = parse_yaml(files["kinematics.yaml"].read_text(), "")["kinematics"]
    assert tree["hash"] == "ccnn_identified" and abs(tree["upper_arm"]["z"]) < 0.01
    assert "less than 0.001 um" in readme
    (tmp_path / "current.yaml").write_text(UR_SAMPLE)
    kept = export_model(path, "ur", tmp_path / "out", current=tmp_path / "current.yaml")
    assert "hash: calib_6364616365313537\n" in kept["kinematics.yaml"].read_text()


ROBOT = """<robot name="helper"><link name="base"/><link name="torso"/><link name="l0"/><link name="l1"/>
<link name="l2"/><link name="l3"/><link name="camera"/>
<joint name="torso_fixed" type="fixed"><parent link="base"/><child link="torso"/>
<origin xyz="0 0 .8" rpy="0 0 1"/></joint>
<joint name="arm_1_joint" type="revolute"><parent link="torso"/><child link="l0"/><origin xyz=".1 0 .2" rpy="0 .3 -.4"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
<joint name="plate" type="fixed"><parent link="l0"/><child link="l1"/><origin xyz="0 .05 .1" rpy=".2 0 0"/></joint>
<joint name="arm_2_joint" type="revolute"><parent link="l1"/><child link="l2"/>
<origin xyz=".2 0 0" rpy="-1.5708 0 3.5"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2"/></joint>
<joint name="arm_3_joint" type="continuous"><parent link="l2"/><child link="l3"/><origin xyz="0 .3 0" rpy="1.2 0 0"/>
<axis xyz="0 0 -1"/></joint>
<joint name="eye" type="fixed"><parent link="torso"/><child link="camera"/></joint></robot>
"""
# In the form that https://github.com/thanhndv212/figaroh-plus writes for PAL's robot_state_publisher (examples/tiago).
PAL_SAMPLE = """robot_state_publisher:
  geometric_calibration:
    arm_1_dx: 0.001
    arm_2_droll: -0.002
"""


def read_pal(text: str, urdf: str) -> tuple[list[Array], list[Array]]:
    """Origins of all joints from the base to the tip, before the moving ones merged, and axes of these."""
    added = parse_yaml(text, "master")["robot_state_publisher"]["geometric_calibration"]
    root, origins, axes = ElementTree.fromstring(urdf), [np.eye(4)], []
    for name in ("torso_fixed", "arm_1_joint", "plate", "arm_2_joint", "arm_3_joint"):
        joint = next(j for j in root.findall("joint") if j.get("name") == name)
        origin = joint.find("origin")
        assert origin is not None
        numbers = [float(v) for key in ("xyz", "rpy") for v in str(origin.get(key)).split()]
        keys = ("dx", "dy", "dz", "droll", "dpitch", "dyaw")
        moved = [
            v + added.pop(f"{name.removesuffix('_joint')}_{key}", 0.0) for v, key in zip(numbers, keys, strict=True)
        ]
        origins[-1] = origins[-1] @ of_rpy(moved)
        if (axis := joint.find("axis")) is not None:
            axes.append(np.array([float(v) for v in str(axis.get("xyz")).split()]))
            origins.append(np.eye(4))
    assert not added
    return origins[:-1], axes


def test_a_pal_robot_gets_what_is_added_to_its_origins(tmp_path: Path) -> None:
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(ROBOT)
    arm = load_mechanism(str(urdf), tip="l3")
    path, real = identified(tmp_path, arm, 2e-3)
    # The first origin is behind the torso, which is merged with it.
    files = export_model(path, "pal", tmp_path / "out", current=urdf)
    readme, joints = files["README.md"].read_text(), drawn(20, 3)
    base, tool = told(readme, "The frame of the measurement"), told(readme, "the measured tool")
    assert {k for k in read_pal(PAL_SAMPLE, ROBOT)[1][0]} == {0.0, 1.0}
    origins, axes = read_pal(files["master_calibration.yaml"].read_text(), ROBOT)
    found = []
    for row in joints:
        frame = base
        for origin, axis, angle in zip(origins, axes, row, strict=True):
            frame = frame @ origin @ placed([0, 0, 0], Rotation.from_rotvec(axis * angle))
        found.append(frame @ tool)
    assert_same(np.stack(found), real, joints)
    with pytest.raises(InputError, match=r"give its URDF as --current robot\.urdf"):
        export_model(path, "pal", tmp_path / "out")
    # The robot's own file with other origins is the same arm, as any reader has it.
    own = export_model(path, "urdf", tmp_path / "own", current=urdf)
    again = load_mechanism(str(own["robot.urdf"]), tip="l3")
    assert isinstance(again, SerialArm)
    assert_same(np.linalg.inv(base) @ np.stack(found) @ np.linalg.inv(tool), again, joints)
    for old, new, said in (
        ('xyz=".2 0 0"', 'xyz=".3 0 0"', "no 3 joints one after the other"),
        ('"arm_2_joint"', '"arm: 2"', "the name of joint 'arm: 2' can be no key"),
    ):
        urdf.write_text(ROBOT.replace(old, new))
        with pytest.raises(InputError, match=said):
            export_model(path, "pal", tmp_path / "out", current=urdf)


# In the form of the files of https://github.com/huggingface/lerobot (MotorCalibration in src/lerobot/motors).
LEROBOT_SAMPLE = """{
    "shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -1365, "range_min": 746, "range_max": 3477},
    "shoulder_lift": {"id": 2, "drive_mode": 1, "homing_offset": 986, "range_min": 822, "range_max": 3211},
    "elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": -12, "range_min": 901, "range_max": 3110},
    "gripper": {"id": 6, "drive_mode": 0, "homing_offset": 5, "range_min": 2000, "range_max": 3500}
}
"""


def shown(motor: Mapping[str, int], actual: Array) -> Array:
    """Joint [rad] at the actual position of a motor [counts]: present = actual - offset, zero in the middle."""
    present = actual - motor["homing_offset"]
    way = -1 if motor["drive_mode"] else 1
    return way * (present - (motor["range_min"] + motor["range_max"]) / 2) * 2 * math.pi / 4096


def test_lerobot_shows_joints_where_they_are(tmp_path: Path) -> None:
    links = [[0.0, HALF, 0.1, 0.2], [0.12, 0.0, 0.0, -0.3], [0.13, 0.0, 0.02, 0.4]]
    arm = SerialArm("so", "standard", links)
    zeros = np.array([0.031, -0.052, 0.017])
    values = arm.nominal.clone()
    values[[9, 13, 17]] += torch.from_numpy(zeros)
    path, current = written(tmp_path, arm, arm.with_nominal(values)), tmp_path / "calibration.json"
    current.write_text(LEROBOT_SAMPLE)
    files = export_model(path, "lerobot", tmp_path / "out", current=current)
    before, after = json.loads(LEROBOT_SAMPLE), json.loads(files["calibration.json"].read_text())
    assert before["gripper"] == after["gripper"] and [*before] == [*after]
    actual = np.arange(1000.0, 3000.0, 100.0)
    for name, zero in zip(before, zeros, strict=False):
        true = shown(before[name], actual) + zero
        assert np.abs(shown(after[name], actual) - true).max() <= math.pi / 4096
        assert {k: v for k, v in before[name].items() if k != "homing_offset"}.items() <= after[name].items()
    # Half a count of a motor is what is left.
    left = re.search(r"this leaves ([\d.]+) um", files["README.md"].read_text())
    assert left and 1 < float(left[1]) < 300
    for text, said in (("{}", "with a motor for each of the 3 joints"), ('{"a": 1}', "is no calibration.json")):
        current.write_text(text)
        with pytest.raises(InputError, match=said):
            export_model(path, "lerobot", tmp_path / "out", current=current)
    current.write_text(LEROBOT_SAMPLE.replace("986", "-2040"))
    with pytest.raises(MethodFailedError, match="shoulder_lift would be -207"):
        export_model(path, "lerobot", tmp_path / "out", current=current)


# In the form of https://www.klipper3d.org/Config_Reference.html#linear-delta-kinematics and of what SAVE_CONFIG adds.
KLIPPER_SAMPLE = """[stepper_a]
step_pin: PF0
position_endstop: 300
arm_length: 250.0
[stepper_b]
[printer]
kinematics: delta
delta_radius: 130.0
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# [stepper_b]
#*# position_endstop = 300.250000
#*#
#*# [stepper_c]
#*# position_endstop = 299.5
"""


def test_klipper_places_the_nozzle_where_the_printer_does(tmp_path: Path) -> None:
    nominal = load_mechanism("delta_linear", base=0.13, platform=0.0, rod=0.25)
    path, real = identified(tmp_path, nominal, 4e-4, frames=False)
    level = real.nominal.reshape(3, 7).clone()
    level[:, 2:4] = 0
    real = nominal.with_nominal(level.flatten())
    path = written(tmp_path, nominal, real)
    (tmp_path / "printer.cfg").write_text(KLIPPER_SAMPLE)
    files = export_model(path, "klipper", tmp_path / "out", current=tmp_path / "printer.cfg")
    cfg = configparser.ConfigParser(delimiters=(":", "="), inline_comment_prefixes=("#",))
    cfg.read_string(files["printer_delta.cfg"].read_text())
    steppers = [cfg[f"stepper_{k}"] for k in "abc"]
    radius = float(cfg["printer"]["delta_radius"])
    arm, angle, end = (
        np.array([float(s[key]) for s in steppers]) for key in ("arm_length", "angle", "position_endstop")
    )
    tower = radius * np.exp(1j * np.radians(angle))
    old = np.array([300, 300.25, 299.5]) + math.sqrt(250.0**2 - 130.0**2)
    readme = files["README.md"].read_text()
    at = re.search(r"its zero is at \(([-\d.]+), ([-\d.]+)\) mm, its axes are turned by ([-\d.]+) deg", readme)
    assert at
    centre, turn = complex(float(at[1]), float(at[2])), math.radians(float(at[3]))
    spots = 60 * np.random.default_rng(1).uniform(-1, 1, (30, 3))
    for x, y, z in spots:
        # The firmware's carriages at a nozzle's place, counted from the switches; the same steps in the old count.
        carriages = np.sqrt(arm**2 - np.abs(tower - (x + 1j * y)) ** 2) + z
        q = carriages - (end + np.sqrt(arm**2 - radius**2)) + old
        place = real.forward_kinematics(torch.from_numpy(1e-3 * q)).numpy() * 1e3
        wanted = centre + (x + 1j * y) * np.exp(1j * turn)
        np.testing.assert_allclose(place, [wanted.real, wanted.imag, z], atol=2e-4)
    # Without the file that is there the change is told.
    bare = export_model(path, "klipper", tmp_path / "out")["printer_delta.cfg"].read_text()
    assert re.search(r"# position_endstop: what is there [-+]\d+\.\d{6}", bare) and "less than" in readme
    (tmp_path / "printer.cfg").write_text("[stepper_b]\nposition_endstop: 3\n")
    with pytest.raises(InputError, match=r"\[stepper_a\] has no position_endstop"):
        export_model(path, "klipper", tmp_path / "out", current=tmp_path / "printer.cfg")


# In the form of https://linuxcnc.org/docs/html/motion/dh-parameters.html and of genhexkins(9).
HAL_SAMPLE = """setp genserkins.A-0 0
setp genserkins.ALPHA-1 -1.570796326
setp genhexkins.base.0.x -22.95
"""


def read_hal(text: str) -> dict[str, float]:
    lines = [line.split() for line in text.splitlines()]
    assert all(len(line) == 3 and line[0] == "setp" for line in lines)
    return {name: float(value) for _, name, value in lines}


@pytest.mark.parametrize("form", ["standard", "leans", "URDF", "signs"])
def test_genserkins_has_the_identified_arm(tmp_path: Path, form: str) -> None:
    assert read_hal(HAL_SAMPLE)["genserkins.ALPHA-1"] == -1.570796326
    arm = known("arm").mechanism
    assert isinstance(arm, SerialArm)
    if form == "signs":
        arm = SerialArm(**{**arm.recipe["keys"], "joint_sign": [1, -1, 1, 1, -1, 1]})
    arm = {"leans": SerialArm.with_leans, "URDF": SerialArm.with_link_frames}.get(form, lambda same: same)(arm)
    path, real = identified(tmp_path, arm, 5e-4)
    files = export_model(path, "linuxcnc_hal", tmp_path / "out")
    pins, readme = read_hal(files["kinematics.hal"].read_text()), files["README.md"].read_text()
    angles = {int(k): float(v) for k, v in re.findall(r"^\| (\d) \| ([-\d.]+) \|", readme, re.MULTILINE)}
    base, tool = told(readme, "Its base in the frame of the measurement:"), told(readme, "from its last frame:")
    joints, found = drawn(20, 6), []
    for row in joints:
        frame = base
        for i, q in enumerate(row):
            a, alpha, d = (pins[f"genserkins.{key}-{i}"] for key in ("A", "ALPHA", "D"))
            link = placed([1e-3 * a, 0, 0], Rotation.from_euler("x", alpha)) @ about_z(q + math.radians(angles[i]))
            link[:3, 3] += 1e-3 * d * link[:3, 2]
            frame = frame @ link
        found.append(frame @ tool)
    assert_same(np.stack(found), real, joints, 1e-9 if form != "link frames" else 1e-8)
    assert "`KINEMATICS = genserkins`" in readme and "HOME_OFFSET" in readme


def test_genhexkins_has_the_identified_hexapod(tmp_path: Path) -> None:
    about = parallel("stewart", 2e-4)
    path = written(tmp_path, about.mechanism, real := about.mechanism.with_nominal(about.identified))
    files = export_model(path, "linuxcnc_hal", tmp_path / "out")
    pins, readme = read_hal(files["kinematics.hal"].read_text()), files["README.md"].read_text()
    rows = re.findall(r"^\| \d \| ([\d.]+) \| ([\d.]+) \* what is there ([-+][\d.]+) \|", readme, re.MULTILINE)
    scale, gain, offset = np.array(rows, float).T
    np.testing.assert_allclose(scale * gain, 1, atol=1e-8)
    poses = real.forward_kinematics(about.joints[:20]).numpy()
    for pose, q in zip(poses, about.joints.numpy(), strict=False):
        turn = Rotation.from_rotvec(pose[3:]).as_matrix()
        for i in range(6):
            b, p = (np.array([pins[f"genhexkins.{part}.{i}.{c}"] for c in "xyz"]) for part in ("base", "platform"))
            length = np.linalg.norm(1e3 * pose[:3] + turn @ p - b)
            assert abs(length - (gain[i] * 1e3 * q[i] + offset[i])) < 2e-6
    assert not any(name.startswith("genserkins") for name in pins)


def test_what_a_stack_cannot_hold_is_said_on_the_screen_and_written(tmp_path: Path, cli: Cli) -> None:
    about = known("arm with effects")
    made, mechanism = about.compensator(1e-5), about.mechanism
    model = save_model(tmp_path, made, fields() | {"mechanism": mechanism.describe()}, forms=("safetensors",))
    code, screen, _ = cli("export", model["safetensors"], "--to", "linuxcnc_hal", "--out", tmp_path / "out")
    assert code == 0
    readme = (tmp_path / "out" / "README.md").read_text()
    assert "hold nothing of effects, and what was learned" in readme
    found = re.search(r"random joints of the domain of the model this leaves ([\d.]+) um and ([\d.]+) urad", screen)
    assert found and found[0] in readme
    # What the true machine is off by from its geometry.
    joints, inputs = about.joints, about.inputs
    frame = about.frame(joints, inputs[:, joints.shape[1] :])
    alone = mechanism.forward_kinematics(joints, about.identified)
    off = 1e6 * float((frame - alone)[:, :3].norm(dim=-1).square().mean().sqrt())
    # Parameters that were identified beside effects leave the effects; the nearest ones take most of these.
    assert float(found[1]) < 0.3 * off
    kept = load_compensation(tmp_path / "model.safetensors")
    worse = mechanism.with_nominal(mechanism.nominal + 10 * (about.identified - mechanism.nominal))
    with pytest.raises(MethodFailedError, match=r"would leave \d.* of the nominal machine; export c99"):
        with_readme(Stack({}, worse, ""), Found(kept), "Arm")


def test_an_arm_measured_by_positions_alone_is_written_with_the_pose_that_it_commands(tmp_path: Path) -> None:
    about = known("arm with effects")
    assert isinstance(about.mechanism, SerialArm)
    seen = about.mechanism.with_orientation("none")
    model = save_model(
        tmp_path, about.compensator(1e-5), fields() | {"mechanism": seen.describe()}, forms=("safetensors",)
    )
    for to in ("urdf", "linuxcnc_hal", "ros2_control"):
        files = export_model(model["safetensors"], to, tmp_path / to)
        assert to == "ros2_control" or re.search(
            r"this leaves [\d.]+ um and [\d.]+ urad", files["README.md"].read_text()
        )


def test_what_is_no_such_machine_is_refused_in_a_sentence(tmp_path: Path, cli: Cli) -> None:
    path = save_model(tmp_path, tripod_compensator(), fields(), forms=("safetensors",))["safetensors"]
    arm, _ = identified(tmp_path, known("scara").mechanism, 1e-4)
    for file, to, said, more in (
        (path, "ur", "of a serial arm", ()),
        (path, "klipper", "has kinematics of linear deltas", ()),
        (path, "linuxcnc_hal", "of hexapods and of arms of six turning joints", ()),
        (arm, "ur", "is no UR arm", ()),
        (arm, "linuxcnc_hal", "is neither", ()),
        (arm, "c99", "--current: is read by the targets urdf, mjcf, ur, pal, lerobot, klipper", ("--current", arm)),
        (arm, "lerobot", "has joints that slide", ()),
    ):
        code, _, err = cli("export", file, "--to", to, "--out", tmp_path / "out", *more)
        assert code == 2 and said in err and "Traceback" not in err and err.count("\n") == 1, err
    assert not (tmp_path / "out").exists()
