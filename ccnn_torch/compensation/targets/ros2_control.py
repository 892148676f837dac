"""A chainable controller of ros2_control around the C export, where offsets of the joints do not suffice."""

from __future__ import annotations

from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

import torch

from ccnn_torch.compensation.targets.c99 import print_c99
from ccnn_torch.compensation.targets.form import Form
from ccnn_torch.compensation.targets.golden import Golden
from ccnn_torch.compensation.targets.lowered import Found, Stack, arm_of, chain, left_over, rms, zeros_of
from ccnn_torch.compensation.targets.printing import filled, wrapped
from ccnn_torch.compensation.targets.robots import joints_of
from ccnn_torch.display import plain, visible
from ccnn_torch.mechanisms import SerialArm

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
