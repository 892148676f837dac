"""The chainable controller of ros2_control, compiled against a minimal interface and run beside the model."""

from __future__ import annotations

import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from fitted import six_axis_arm
from kinds import KINDS
from scipy.spatial.transform import Rotation
from stand_ins import fields

from ccnn_torch import export_model, load_mechanism
from ccnn_torch.compensation import save_model
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import parse_yaml
from ccnn_torch.mechanisms.mechanism_file import mechanism_text, urdf_text

# What the controller calls, with the signatures of ros2_control in ROS 2 Jazzy; made after
# https://control.ros.org/jazzy/doc/api (controller_interface::ChainableControllerInterface), and nothing of its code.
MINIMAL = """#pragma once
#include <any>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>
namespace rclcpp { struct Time {}; struct Duration {}; }
namespace rclcpp_lifecycle { struct State {}; }
namespace hardware_interface {
class CommandInterface {
public:
  CommandInterface(const std::string & prefix, const std::string & name, double * value)
  : name_(prefix + "/" + name), value_(value) {}
  std::string get_name() const { return name_; }
  [[nodiscard]] bool set_value(double value) { *value_ = value; return true; }
private:
  std::string name_;
  double * value_;
};
}
namespace controller_interface {
enum class CallbackReturn { SUCCESS, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration { interface_configuration_type type; std::vector<std::string> names; };
struct Parameter {
  std::any value;
  std::vector<std::string> as_string_array() const { return std::any_cast<std::vector<std::string>>(value); }
  std::vector<double> as_double_array() const { return std::any_cast<std::vector<double>>(value); }
};
struct Node {
  std::map<std::string, Parameter> parameters;
  const char * get_name() const { return "ccnn_compensation"; }
  Parameter get_parameter(const std::string & name) const { return parameters.at(name); }
};
class ChainableControllerInterface {
public:
  virtual ~ChainableControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  return_type update(const rclcpp::Time & time, const rclcpp::Duration & period)
  {
    const auto found = update_reference_from_subscribers(time, period);
    return found == return_type::OK ? update_and_write_commands(time, period) : found;
  }
  std::vector<hardware_interface::CommandInterface> export_reference_interfaces()
  {
    return on_export_reference_interfaces();
  }
  std::shared_ptr<Node> get_node() const { return node_; }
  std::vector<hardware_interface::CommandInterface> command_interfaces_;
protected:
  virtual std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() = 0;
  virtual return_type update_reference_from_subscribers(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  virtual return_type update_and_write_commands(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  template <typename T> void auto_declare(const std::string & name, const T & value)
  {
    node_->parameters.insert({name, Parameter{value}});
  }
  std::vector<double> reference_interfaces_;
private:
  std::shared_ptr<Node> node_ = std::make_shared<Node>();
};
}
"""
HEADERS = {
    "controller_interface/chainable_controller_interface.hpp": MINIMAL,
    "hardware_interface/types/hardware_interface_type_values.hpp": "#pragma once\n"
    'namespace hardware_interface { constexpr char HW_IF_POSITION[] = "position"; }\n',
    "pluginlib/class_list_macros.hpp": "#pragma once\n#define PLUGINLIB_EXPORT_CLASS(a, b)\n",
}
# Positions wanted come in as doubles; the commands go out, and after each row how the update ended.
MAIN = """#include "compensation.cpp"
#include <cstdio>
using namespace ccnn_controller;
int main()
{
  Compensation one;
  double command[CCNN_JOINTS] = {};
  std::vector<std::string> names;
  for (int i = 0; i < CCNN_JOINTS; ++i) { names.push_back("arm_" + std::to_string(i)); }
  if (one.on_init() != CallbackReturn::SUCCESS) { return 2; }
  if (one.on_configure({}) != CallbackReturn::ERROR) { return 3; }
  one.get_node()->parameters["joints"] = {names};
  if (one.on_configure({}) != CallbackReturn::SUCCESS) { return 4; }
  const auto wanted_names = one.command_interface_configuration();
  for (int i = 0; i < CCNN_JOINTS; ++i) {
    if (wanted_names.names[i] != names[i] + "/position") { return 5; }
    one.command_interfaces_.emplace_back(names[i], "position", &command[i]);
  }
  auto references = one.export_reference_interfaces();
  if (references[0].get_name() != "ccnn_compensation/arm_0/position") { return 6; }
  if (one.on_activate({}) != CallbackReturn::SUCCESS) { return 6; }
  /* Nothing is written before something is wanted. */
  if (one.update({}, {}) != return_type::OK || command[0] != 0.0) { return 7; }
  double wanted[CCNN_JOINTS];
  while (fread(wanted, sizeof wanted, 1, stdin) == 1) {
    for (int i = 0; i < CCNN_JOINTS; ++i) { static_cast<void>(references[i].set_value(wanted[i])); }
    const double ended = one.update({}, {}) == return_type::OK ? 0.0 : 1.0;
    fwrite(command, sizeof command, 1, stdout);
    fwrite(&ended, sizeof ended, 1, stdout);
  }
  return 0;
}
"""


def test_the_controller_writes_the_commands_of_the_model(tmp_path: Path) -> None:
    made, mechanism = KINDS["covariates"](), load_mechanism("five_bar")
    model = save_model(tmp_path, made, fields() | {"mechanism": mechanism.describe()}, forms=("safetensors",))
    files = export_model(model["safetensors"], "ros2_control", tmp_path / "out")
    for name, text in HEADERS.items():
        path = tmp_path / "ros" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "out" / "main.cpp").write_text(MAIN)
    strict = ["-Wall", "-Wextra", "-Wshadow", "-Werror"]
    for words in (
        ["gcc", "-std=c99", *strict, "-c", "compensator.c"],
        ["g++", "-std=c++17", *strict, "-I", str(tmp_path / "ros"), "main.cpp", "compensator.o", "-lm", "-o", "one"],
    ):
        subprocess.run(words, cwd=tmp_path / "out", check=True)
    draw = torch.rand(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    joints = made.domain.centre[:2] + made.domain.half_range[:2] * (draw - 0.5)
    rows = torch.cat([joints, torch.full((1, 2), torch.inf, dtype=torch.float64)]).numpy()
    ran = subprocess.run([str(tmp_path / "out" / "one")], input=rows.tobytes(), capture_output=True)
    assert ran.returncode == 0, ran.returncode
    found = np.frombuffer(ran.stdout).reshape(-1, 3)
    centre = made.domain.centre[2:].expand(len(joints), -1)
    np.testing.assert_allclose(found[:-1, :2], made(joints, centre)[0].detach().numpy(), atol=1e-9)
    assert found[:-1, 2].max() == 0 and found[-1, 2] == 1 and (found[-1, :2] == found[-2, :2]).all()
    readme = files["README.md"].read_text()
    covariates = all(c.header in readme for c in made.covariates)
    assert "minimal interface of our own" in readme and covariates and readme.isascii()
    assert parse_yaml(files["controllers.yaml"].read_text(), "")["ccnn_compensation"]["ros__parameters"]["joints"]
    plugin = ElementTree.fromstring(files["plugin.xml"].read_text())
    assert plugin[0].get("type") == "ccnn_controller::Compensation" and "REGISTER" not in plugin[0].attrib
    assert ElementTree.fromstring(files["package.xml"].read_text()).findtext("name") == "ccnn_controller"
    with pytest.raises(InputError, match="computes in double"):
        export_model(model["safetensors"], "ros2_control", tmp_path / "out", dtype="float32")


def test_where_offsets_of_the_joints_suffice_they_are_all_that_is_written(tmp_path: Path) -> None:
    arm = six_axis_arm()
    zeros, values = np.array([1e-3, -2e-3, 5e-4, 3e-3, -1e-3, 2e-3]), arm.nominal.clone()
    # A zero of a joint about z: the origin of the URDF turned by it.
    for i, zero in enumerate(zeros):
        row = values[6 + 6 * i : 12 + 6 * i]
        turned = Rotation.from_euler("xyz", row[3:].numpy()) * Rotation.from_euler("z", zero)
        row[3:] = torch.from_numpy(turned.as_euler("xyz"))
    before = dict(zip((p.name for p in arm.geometry), arm.nominal.tolist(), strict=True))
    (tmp_path / "identified.yaml").write_text(mechanism_text(arm.with_nominal(values), before))
    files = export_model(tmp_path / "identified.yaml", "ros2_control", tmp_path / "out")
    assert {*files} == {"transmissions.xml", "README.md"}
    tree = ElementTree.fromstring(f"<robot>{files['transmissions.xml'].read_text()}</robot>")
    found = [float(str(entry.findtext("joint/offset"))) for entry in tree.findall("transmission")]
    np.testing.assert_allclose(found, zeros, atol=1e-9)
    readme = files["README.md"].read_text()
    assert "Offsets of the joints suffice" in readme and "hold nothing of" not in readme
    # With the URDF of the robot its names; a joint at which nothing was found stays where it is.
    row = slice(6 + 6 * 4, 12 + 6 * 4)
    values[row] = arm.nominal[row]
    (tmp_path / "identified.yaml").write_text(mechanism_text(arm.with_nominal(values), before))
    urdf = urdf_text(arm)
    (tmp_path / "robot.urdf").write_text(urdf)
    files = export_model(
        tmp_path / "identified.yaml", "ros2_control", tmp_path / "out", current=tmp_path / "robot.urdf"
    )
    tree = ElementTree.fromstring(f"<robot>{files['transmissions.xml'].read_text()}</robot>")
    names = [entry.get("name") for entry in ElementTree.fromstring(urdf).findall("joint")]
    assert {str(entry.get("name")) for entry in tree.findall("transmission/joint")} <= {*names}
    assert float(str(tree.findall("transmission")[4].findtext("joint/offset"))) == 0.0
