"""Identified arms for ROS, PAL robots, LeRobot and simulators: numbers in the files that these read."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

import numpy as np
import torch

from ccnn_torch.compensation.targets.c99 import print_c99
from ccnn_torch.compensation.targets.form import Form
from ccnn_torch.compensation.targets.golden import Golden
from ccnn_torch.compensation.targets.lowered import (
    Array,
    Chain,
    Found,
    Stack,
    arm_of,
    chain,
    left_over,
    matrix,
    nearest_on,
    of_rpy,
    place_of,
    rms,
    rpy,
    told_frame,
    written,
    zeros_of,
)
from ccnn_torch.compensation.targets.printing import filled, wrapped
from ccnn_torch.display import plain, visible
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.files.read import CONFIG_LIMIT, parse_json, read_text
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.mechanism_file import (
    chain_of,
    dh_text,
    joints_of,
    mjcf_text,
    moved_origins,
    patched_urdf,
    urdf_text,
)

_HALF = math.pi / 2


def arm_in(found: Found) -> tuple[SerialArm, SerialArm]:
    """The nominal and the identified arm.

    Raises:
        MethodFailedError: the machine is no serial arm.
    """
    nominal = found.nominal
    if not isinstance(nominal, SerialArm):
        raise MethodFailedError(
            f"this format is of a serial arm, and '{nominal.name}' is none; its parameters are in identified.yaml"
        )
    identified = found.identified
    assert isinstance(identified, SerialArm)
    return nominal, identified


def print_robot(found: Found) -> Stack:
    """`robot.urdf` (the user's own where it was given), `robot.xml` (MJCF), `robot.yaml` where the arm has a DH table.

    Raises:
        MethodFailedError: the model has no identified links, or its machine is no serial arm.
        InputError: the URDF that was given is not that of the arm.
    """
    compensator = None if found.model.machine is not None else found.model.compensator
    if found.model.machine is None and (compensator is None or compensator.machine is None):
        raise MethodFailedError(
            "this model has no identified links of an arm to write; train with geometry=identify, or give the "
            "identified.yaml of ccnn identify"
        )
    nominal, arm = arm_in(found)
    made = chain(arm)
    own = found.current
    texts = {"robot.urdf": urdf_text(arm) if own is None else patched_urdf(str(own), nominal, arm)}
    texts |= {"robot.xml": mjcf_text(arm)} | ({} if arm.convention == "urdf" else {"robot.yaml": dh_text(arm)})
    if own is None:
        load = (
            "`robot.urdf` is a chain `base_link` to `tool`, without masses, efforts and speeds; `--current robot.urdf` "
            "writes yours with other origins instead."
        )
    else:
        load = (
            f"`robot.urdf` is `{plain(own.name)}` with other origins of the joints, and comments that say what they "
            "were; all else is as it was."
        )
    load += (
        f" The base of the robot in the frame of the measurement: {told_frame(made.base)}; the measured tool behind "
        f"the last joint: {told_frame(matrix(*chain_of(arm)[2]))} [m, rad].\n\n`robot.xml` loads with "
        '`mujoco.MjModel.from_xml_path("robot.xml")`. Masses are 1 kg a link.'
    )
    return Stack(texts, arm, load)


# UR arms: a2, a3, d4, d5, d6 [m], as in default_kinematics.yaml of ur_description.
_UR = {
    "ur3": (-0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "ur3e": (-0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5": (-0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "ur5e": (-0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10": (-0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "ur10e": (-0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "ur16e": (-0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    "ur20": (-0.862, -0.7287, 0.201, 0.1593, 0.1543),
    "ur30": (-0.637, -0.5037, 0.201, 0.1593, 0.1543),
}
_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
# How far axes may be from those of a type [m, rad]; types differ by 3 mm and more.
_SAME = 1.5e-3


def print_ur(found: Found) -> Stack:
    """`kinematics.yaml` in the form of ur_description.

    Raises:
        MethodFailedError: the machine is no serial arm, or no UR.
        InputError: the file that is there has no `kinematics`.
    """
    nominal, identified = arm_in(found)
    kind, frames = _ur_frames(chain(nominal))
    real = chain(identified)
    # d1 is how far the first two axes' crossing is above the arm's own base.
    fixed = frames[0] @ np.linalg.inv(of_rpy((0, 0, frames[0][2, 3]), (0, 0, 0)))
    made = real.through(fixed, [nearest_on(*pair) for pair in zip(real.frames, frames, strict=True)])
    lines = ["kinematics:"]
    for name, m in zip(_UR_LINKS, made.origins, strict=True):
        numbers = zip(("x", "y", "z", "roll", "pitch", "yaw"), [*place_of(m), *rpy(m)], strict=True)
        lines += [f"  {name}:", *(f"    {key}: {written(value)}" for key, value in numbers)]
    given = "ccnn_identified"
    if found.current is not None:
        current = parse_yaml(read_text(found.current, CONFIG_LIMIT), str(found.current))
        inner = current.get("kinematics") if isinstance(current, dict) else None
        if not isinstance(inner, dict) or not re.fullmatch(r"\w+", str(inner.get("hash"))):
            raise InputError(f"{found.current}: has no kinematics.hash; give the file that ur_calibration wrote")
        given = str(inner["hash"])
    lines.append(f"  hash: {given}")
    load = (
        f"`ros2 launch ur_robot_driver ur_control.launch.py ur_type:={kind} robot_ip:=IP "
        "kinematics_params_file:=$PWD/kinematics.yaml`, and the same argument for `ur_description` and MoveIt.\n\n"
        "The driver compares `hash` with that of the robot and prints an error where they differ: give the file that "
        "`ur_calibration` wrote as `--current`, whose hash is kept. The controller itself keeps its own numbers.\n\n"
        f"Frames are no part of it. `base_link_inertia` in the frame of the measurement: {told_frame(made.base)}. "
        f"The measured tool in `tool0`: {told_frame(made.last)} [m, rad]."
    )
    return Stack({"kinematics.yaml": "\n".join(lines) + "\n"}, arm_of(made, identified), load)


def _ur_frames(made: Chain) -> tuple[str, list[Array]]:
    """The type of a UR, and the frames of its joints as ur_description has them, in the arm's own base.

    The first two axes say where its base is; the others must be where those of the type are.
    """
    if len(made.origins) == 6:
        first, second = made.frames[:2]
        gap = np.linalg.inv(first) @ second
        # x is across the first two axes, which meet.
        x = np.cross(first[:3, 2], second[:3, 2])
        size = float(np.linalg.norm(x))
        up = second[:3, 3] - second[:3, 2] * float(_along(gap))
        for kind, sizes in _UR.items() if size > 0.5 else ():
            turned = np.stack([x / size, np.cross(first[:3, 2], x / size), first[:3, 2]], -1)
            frames = [matrix(turned, up)]
            for step in _ur_origins(*sizes):
                frames.append(frames[-1] @ step)
            if all(_apart(*pair) < _SAME for pair in zip(made.frames, frames, strict=True)):
                return kind, frames
    raise MethodFailedError(
        f"this is no UR arm in its own count of the joints: its axes are none of those of {', '.join(_UR)}; export urdf"
    )


def _along(gap: Array) -> float:
    """How far from the origin of the second frame, against its z, that axis is nearest to the first one [m]."""
    flat = gap[:2, 2]
    return float(flat @ gap[:2, 3] / (flat @ flat))


def _ur_origins(a2: float, a3: float, d4: float, d5: float, d6: float) -> list[Array]:
    turns = ((0, 0, 0, _HALF), (a2, 0, 0, 0), (a3, 0, d4, 0), (0, -d5, 0, _HALF), (0, d6, 0, -_HALF))
    return [of_rpy(step[:3], (step[3], 0, 0)) for step in turns]


def _apart(frame: Array, other: Array) -> float:
    """How far two axes are apart, at the origin of the second, and by angle [m, rad]."""
    gap = np.linalg.inv(frame) @ other
    turned = math.hypot(gap[0, 2], gap[1, 2]) if gap[2, 2] > 0 else math.inf
    return max(math.hypot(gap[0, 3], gap[1, 3]), turned)


def print_pal(found: Found) -> Stack:
    """`master_calibration.yaml`: what is added to the origins of the joints in the URDF of the robot.

    Raises:
        InputError: no URDF was given, or its joints are not those of the arm.
        MethodFailedError: the machine is no serial arm.
    """
    nominal, identified = arm_in(found)
    chain(identified)
    if found.current is None:
        raise InputError("--to pal names the joints of the robot: give its URDF as --current robot.urdf")
    path, (base, _, tool) = str(found.current), chain_of(identified)
    lines = ["robot_state_publisher:", "  geometric_calibration:"]
    for joint, before, after in moved_origins(path, nominal, identified):
        deltas = [a - b for a, b in zip(after, before, strict=True)]
        name = joint.removesuffix("_joint")
        if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise InputError(
                f"{path}: the name of joint '{visible(name)}' can be no key; ROS has letters, digits and _"
            )
        for suffix, delta in zip(("dx", "dy", "dz", "droll", "dpitch", "dyaw"), deltas, strict=True):
            if abs(delta) > 1e-12:
                lines.append(f"    {name}_{suffix}: {written(delta)}")
    load = (
        "Merge it into `/etc/calibration/master_calibration.yaml` on the robot and start it again; "
        "`robot_state_publisher` adds the numbers to `xyz` and `rpy` of the joints' origins in the URDF [m, rad]. "
        f"They were made for `{plain(found.current.name)}`.\n\nThe frame of the measurement "
        f"({told_frame(matrix(*base))}) and the measured tool ({told_frame(matrix(*tool))} from the last joint) are no "
        "part."
    )
    return Stack({"master_calibration.yaml": "\n".join(lines) + "\n"}, identified, load)


def print_lerobot(found: Found) -> Stack:
    """`calibration.json` with other `homing_offset`s.

    Raises:
        InputError: no calibration.json was given, or it is none.
        MethodFailedError: the machine is no serial arm, or an offset is more than a motor takes.
    """
    arm = arm_in(found)[0]
    if not bool(arm.revolute.all()):
        raise MethodFailedError(f"lerobot counts turns of motors, and '{arm.name}' has joints that slide; export urdf")
    path, n = found.current, len(arm.joints)
    if path is None:
        raise InputError("--to lerobot changes a calibration.json of LeRobot: give it as --current calibration.json")
    motors = parse_json(read_text(path, CONFIG_LIMIT), str(path))
    whole = isinstance(motors, dict) and all(
        isinstance(m, dict) and all(isinstance(m.get(k), int) for k in ("homing_offset", "drive_mode"))
        for m in motors.values()
    )
    if not whole or len(motors) < n:
        raise InputError(
            f"{path}: is no calibration.json of LeRobot with a motor for each of the {n} joints: "
            '{"shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": …, "range_min": …, "range_max": …}, …}'
        )
    named = list(motors)[:n]
    changed, rounded, rows = dict(motors), [], []
    for name, zero in zip(named, zeros_of(found, arm), strict=True):
        way = -1 if motors[name]["drive_mode"] else 1
        counts = round(zero * way * _COUNTS / (2 * math.pi))
        now = motors[name]["homing_offset"] - counts
        if abs(now) > _MOST_COUNTS:
            raise MethodFailedError(
                f"{path}: homing_offset of {visible(name)} would be {now}; a motor takes {_MOST_COUNTS} at most: turn "
                "the horn by a tooth and calibrate again"
            )
        changed[name] = motors[name] | {"homing_offset": now}
        rounded.append(counts * way * 2 * math.pi / _COUNTS)
        rows.append(f"`{plain(name)}` {-counts:+d}")
    load = (
        "Put it in the place of the file that you gave (`~/.cache/huggingface/lerobot/calibration/robots/`) and "
        "answer with Enter when LeRobot asks whether to use it. Joints are the motors in the order of the file: "
        f"{', '.join(rows)} counts of 4096 a turn. That is for Feetech motors, whose present position is the actual "
        "one less `homing_offset`; Dynamixel adds it: change its sign there. Ranges stay, as the middle of a range is "
        "the zero in degrees; with `drive_mode` 1 a joint counts against its motor."
    )
    held = arm_of(chain(arm), arm, rounded)
    return Stack({"calibration.json": json.dumps(changed, indent=4) + "\n"}, held, load)


# Of a motor of 12 bits, and the most that its register holds.
_COUNTS, _MOST_COUNTS = 4096, 2047


# What offsets may leave of the nominal machine's error, so that no controller is worth its while [1].
_SUFFICES = 0.02


def offsets_alone(found: Found) -> tuple[Stack | None, str]:
    """The offsets of an arm's joints as transmissions, None where they do not suffice, and what they leave."""
    if found.model.machine is None and "spec" not in found.model.facts["mechanism"]:
        return None, "the model does not have the machine's kinematics."
    arm = found.nominal
    if not isinstance(arm, SerialArm) or arm.drives:
        return None, "the machine has none."
    zeros = zeros_of(found, arm)
    held = arm_of(chain(arm), arm, zeros)
    said = left_over(held, found)
    if any(left > _SUFFICES * before for left, before in zip(rms(held, found), rms(arm, found), strict=True)):
        return None, said
    names = [joint.name for joint in arm.joints]
    lines = ["<!-- In the URDF: replace the names, and add the offset to the one that is there. -->"]
    if found.current is not None:
        names = [quoteattr(visible(str(joint.get("name"))))[1:-1] for joint in joints_of(str(found.current), arm)]
        lines = ["<!-- In the URDF: add the offset to the one that is there. -->"]
    for name, zero in zip(names, zeros, strict=True):
        lines += [
            f'<transmission name="{name}_transmission">',
            "  <plugin>transmission_interface/SimpleTransmission</plugin>",
            f'  <joint name="{name}" role="joint1"><offset>{zero:.12f}</offset></joint>',
            f'  <actuator name="{name}_motor" role="actuator1"/>',
            "</transmission>",
        ]
    load = (
        "Offsets of the joints suffice: put `<offset>` [rad or m] into the transmissions of the URDF "
        "(`transmission_interface/SimpleTransmission`: joint = actuator / reduction + offset). Where the hardware "
        "component does not use transmissions, add the offsets to what it calls the zero of a joint."
    )
    return Stack({"transmissions.xml": "\n".join(lines) + "\n"}, held, load), said


def print_ros2_control(form: Form, golden: Golden, covariates: Mapping[str, float], offsets: str) -> dict[str, str]:
    """Contents of a package by name.

    Args:
        form: of the compensation, in double.
        golden: its vectors.
        covariates: header and middle [SI].
        offsets: what offsets of the joints alone leave.
    """
    joints = len(form.joints)
    names = ", ".join(f"{plain(header)} = {value:.6g}" for header, value in covariates.items())
    about = "\n".join(["/*", *(f" * {line}" for line in wrapped([*form.facts, "Chainable controller."])), " */"])
    values = [repr(float(v)) for v in covariates.values()]
    listed = ", ".join(f"joint{i + 1}" for i in range(joints))
    return {
        **print_c99(form, golden),
        "compensation.cpp": filled("ros2_controller.cpp.jinja", about=about, covariates=values),
        "README.md": filled("ros2_control.md.jinja", names=names, offsets=offsets),
        "CMakeLists.txt": _CMAKE,
        "package.xml": _PACKAGE,
        "plugin.xml": _PLUGIN,
        "controllers.yaml": _CONTROLLERS.format(joints=listed),
    }


_CMAKE = """cmake_minimum_required(VERSION 3.16)
project(ccnn_controller C CXX)
set(CMAKE_CXX_STANDARD 17)
find_package(ament_cmake REQUIRED)
find_package(controller_interface REQUIRED)
find_package(hardware_interface REQUIRED)
find_package(pluginlib REQUIRED)
add_library(ccnn_controller SHARED compensation.cpp compensator.c)
ament_target_dependencies(ccnn_controller controller_interface hardware_interface pluginlib)
pluginlib_export_plugin_description_file(controller_interface plugin.xml)
install(TARGETS ccnn_controller LIBRARY DESTINATION lib)
ament_package()
"""
_PACKAGE = """<?xml version="1.0"?>
<package format="3">
  <name>ccnn_controller</name>
  <version>0.1.0</version>
  <description>Compensation of joints, written by ccnn_torch</description>
  <maintainer email="you@example.org">you</maintainer>
  <license>Proprietary</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <depend>controller_interface</depend>
  <depend>hardware_interface</depend>
  <depend>pluginlib</depend>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
_PLUGIN = """<library path="ccnn_controller">
  <class name="ccnn_controller/Compensation" type="ccnn_controller::Compensation"
         base_class_type="controller_interface::ChainableControllerInterface">
    <description>Commands that bring the machine to the positions that are wanted.</description>
  </class>
</library>
"""
_CONTROLLERS = """controller_manager:
  ros__parameters:
    ccnn_compensation:
      type: ccnn_controller/Compensation
ccnn_compensation:
  ros__parameters:
    joints: [{joints}]
"""


def middle_of(found: Found) -> dict[str, float]:
    """Covariates of a compensator by header, at the middle of its domain [SI]."""
    compensator = found.model.compensator
    assert compensator is not None
    centre: torch.Tensor = compensator.domain.centre[len(compensator.joints) :]
    return {c.header: v for c, v in zip(compensator.covariates, centre.tolist(), strict=True)}
