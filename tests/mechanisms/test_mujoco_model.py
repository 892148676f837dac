"""A MuJoCo model file as a simulator, against statics by hand and the closed forms of a five-bar."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import root

from ccnn_torch.diagnosis.engine import diagnose_rows
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import BlackBox, FiveBar, ModelParameter, load_mechanism, mujoco_simulator

EXAMPLES = Path(__file__).parents[2] / "experiments"
MODEL = EXAMPLES / "mujoco_arm.xml"
_G = 9.81
SERVOS = {"shoulder": (-1.2, -0.2), "elbow": (0.5, 1.5)}


@pytest.fixture(scope="module")
def arm() -> BlackBox:
    made = load_mechanism(f"{EXAMPLES / 'mujoco_arm.py'}:ARM")
    assert isinstance(made, BlackBox)
    return made


def _statics(command: np.ndarray, load: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Tool x, z of two links on servo springs under gravity and a force at the tool; joints turn about +y."""
    upper, fore, kp1, kp2, mass = values

    def torques(q: np.ndarray) -> np.ndarray:
        first, both = q[0], q[0] + q[1]
        slopes = [np.array([-np.sin(a), -np.cos(a)]) for a in (first, both)]
        down = np.array([0.0, -_G])
        # Centres of mass: the upper arm's at 0.15 m, the fore arm's at 0.125 m, whatever the parameters are.
        tau1 = 0.15 * slopes[0] @ down + mass * (upper * slopes[0] + 0.125 * slopes[1]) @ down
        tau1 += (upper * slopes[0] + fore * slopes[1]) @ load
        tau2 = mass * 0.125 * slopes[1] @ down + fore * slopes[1] @ load
        return np.array([kp1 * (command[0] - q[0]) + tau1, kp2 * (command[1] - q[1]) + tau2])

    q = root(torques, command, tol=1e-13).x
    first, both = q[0], q[0] + q[1]
    return np.array([upper * np.cos(first) + fore * np.cos(both), 0.3 - upper * np.sin(first) - fore * np.sin(both)])


def test_it_rests_where_statics_say(arm: BlackBox) -> None:
    """The servos' damping ratio needs no telling: at rest it does nothing."""
    joints = arm.sample_joints(6, torch.Generator().manual_seed(0))
    load = 40 * torch.randn(6, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    factors = 1 + 0.1 * torch.randn(6, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    values = arm.nominal * factors
    pose = arm.under({"load_x": load[:, 0], "load_z": load[:, 1]}).forward_kinematics(joints, values)
    rows = zip(joints.numpy(), load.numpy(), values.numpy(), strict=True)
    expected = torch.from_numpy(np.stack([_statics(*row) for row in rows]))
    assert float((arm.forward_kinematics(joints) - expected).abs().max()) > 1e-3
    torch.testing.assert_close(pose, expected, rtol=0, atol=1e-8)


def test_its_derivatives_are_those_of_statics(arm: BlackBox) -> None:
    joints = arm.sample_joints(3, torch.Generator().manual_seed(3))
    nominal = arm.nominal.numpy()
    slope = arm.parameter_jacobian(joints)[:, [0, 2]]
    for k, step in enumerate((1e-5, 1e-5, 1.0, 1.0, 1e-4)):
        shift = np.eye(5)[k] * step
        ends = [[_statics(q, np.zeros(2), nominal + s * shift) for q in joints.numpy()] for s in (1, -1)]
        expected = torch.from_numpy((np.array(ends[0]) - np.array(ends[1])) / (2 * step))
        torch.testing.assert_close(slope[..., k], expected, rtol=1e-3, atol=1e-9)


def test_a_heavier_forearm_is_found(arm: BlackBox) -> None:
    g = torch.Generator().manual_seed(4)
    joints = arm.sample_joints(24, g)
    load = {f"load_{c}": 20 * torch.randn(24, generator=g, dtype=torch.float64) for c in "xz"}
    built = arm.nominal.numpy() * np.array([1, 1, 1, 1, 1.25])
    force = torch.stack([*load.values()], -1).numpy()
    rows = zip(joints.numpy(), force, strict=True)
    pose = torch.from_numpy(np.stack([_statics(q, f, built) for q, f in rows]))
    pose = pose + 1e-5 * torch.randn(pose.shape, generator=g, dtype=torch.float64)
    rivals = ["parameter fore mass", "parameter elbow kp", "gravity", "compliance"]
    said = diagnose_rows(Situation(arm, joints, load, default_gravity(arm)), pose, effects=rivals)
    assert said.verdict["effects"] == ["parameter fore mass"]
    found = said.effects[0]["parameters"]["fore mass"]
    assert abs(found["value"] - 0.15) < 4 * found["sd"] < 0.03


def test_a_moment_turns_it() -> None:
    """phi, about +y, and its load: the servos' compliance under 4 N·m, without weight on the scales."""
    simulator = mujoco_simulator(MODEL, SERVOS, "tool", ("x", "z", "phi"))
    told = {"load_x": np.zeros(2), "load_z": np.zeros(2), "load_phi": np.array([0.0, 4.0])}
    still, turned = simulator.simulate(np.tile([-0.8, 1.0], (2, 1)), told, np.zeros((2, 0)))
    assert turned[2] - still[2] == pytest.approx(4 / 2000 + 4 / 1500, rel=2e-3)
    assert still[2] == pytest.approx(0.2, abs=5e-3)


_STIFF = 'solref="0.001 1" solimp="0.9999 0.9999 0.001 0.5 2"'
_LEG = """
  <body pos="{x} 0 0" euler="0 0 {turn}"><joint name="q{i}" axis="0 0 1" ref="{turn}"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0.75 0 0" mass="1"/>
    <body pos="0.75 0 0" euler="0 0 {elbow}"><joint axis="0 0 1" damping="0.1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 1.1 0 0" mass="0.5"/><site name="tool{i}" pos="1.1 0 0"/></body>
  </body>"""


def _five_bar_file(folder: Path, bar: FiveBar) -> Path:
    """A five-bar whose loop is closed in its first configuration."""
    cranks, legs = bar.home_joints.tolist(), ""
    for i, (angle, x) in enumerate(zip(cranks, (-0.5, 0.5), strict=True), 1):
        elbow = np.array([x + 0.75 * np.cos(angle), 0.75 * np.sin(angle)])
        along = bar.home_pose.numpy() - elbow
        legs += _LEG.format(i=i, x=x, turn=angle, elbow=np.arctan2(along[1], along[0]) - angle)
    servos = "".join(f'<position name="s{i}" joint="q{i}" kp="100000" dampratio="1"/>' for i in (1, 2))
    file = folder / "five_bar.xml"
    file.write_text(
        '<mujoco><compiler angle="radian"/><option timestep="0.0005" integrator="implicitfast" gravity="0 0 0"/>'
        '<default><geom contype="0" conaffinity="0"/></default>'
        f"<worldbody>{legs}</worldbody>"
        f'<equality><connect site1="tool1" site2="tool2" {_STIFF}/></equality><actuator>{servos}</actuator></mujoco>',
        encoding="utf-8",
    )
    return file


def test_a_closed_loop_goes_to_its_command_from_where_it_is_closed(tmp_path: Path) -> None:
    bar = FiveBar()
    file = _five_bar_file(tmp_path, bar)
    box = {f"s{i}": (q - 0.1, q + 0.1) for i, q in enumerate(bar.home_joints.tolist(), 1)}
    simulator = mujoco_simulator(file, box, "tool1", ("x", "y"), ramp=0.3, settle=0.3, still=1e-4)
    commands = bar.home_joints + torch.tensor([[0.1, -0.1], [-0.05, -0.1], [0.0, 0.0]], dtype=torch.float64)
    zero = {name: np.zeros(3) for name in ("load_x", "load_y")}
    pose = torch.from_numpy(simulator.simulate(commands.numpy(), zero, np.zeros((3, 0))))
    torch.testing.assert_close(pose, bar.forward_kinematics(commands), rtol=0, atol=2e-5)


def test_dry_friction_stops_on_the_side_that_it_comes_from(tmp_path: Path) -> None:
    file = tmp_path / "stiff.xml"
    stiff = 'solreffriction="0.004 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"'
    servo = f'<joint name="shoulder" axis="0 1 0" frictionloss="2" {stiff}/>'
    text = MODEL.read_text(encoding="utf-8").replace('<joint name="shoulder" axis="0 1 0"/>', servo)
    file.write_text(text.replace("0 0 -9.81", "0 0 0"), encoding="utf-8")
    simulator = mujoco_simulator(file, SERVOS, "tool", ("x", "z"), approach=5e-3, settle=0.5)
    assert [getattr(c, "name", c) for c in simulator.covariates] == ["load_x", "load_z", "direction1", "direction2"]
    commands = np.tile([-0.8, 1.0], (2, 1))
    told = {"load_x": np.zeros(2), "load_z": np.zeros(2), "direction1": np.array([1.0, -1.0]), "direction2": np.ones(2)}
    pose = simulator.simulate(commands, told, np.zeros((2, 0)))
    # 2 N·m on a servo of 2000 N·m/rad: up to a millirad short, to either side.
    reach = np.linalg.norm([0.3 * np.cos(0.8) + 0.25 * np.cos(0.2), 0.3 * np.sin(0.8) - 0.25 * np.sin(0.2)])
    assert 0.5e-3 * reach < np.linalg.norm(pose[0] - pose[1]) <= 2.1e-3 * reach


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"model": Path("none.xml")}, "none.xml: there is no such file"),
        ({"actuators": {"wrist": (0.0, 1.0)}}, "has no actuator 'wrist'; it has shoulder, elbow"),
        ({"measured": "hand"}, "has no site 'hand'; it has tool"),
        ({"pose": ("x", "u")}, "pose: 'u' is none of x, y, z"),
        ({"pose": ("x", "phi")}, "pose: 'phi' is none of x, y, z"),
        (
            {"parameters": [ModelParameter("body", "hand", "mass", 0.1)]},
            "has no body 'hand'; it has world, upper, fore",
        ),
        ({"parameters": [ModelParameter("body", "fore", "colour", 0.1)]}, "'body colour' is no parameter; there are"),
        ({"parameters": [ModelParameter("site", "tool", "pos", 0.1)]}, "'tool pos' is a place; give its axis"),
    ],
)
def test_what_the_model_lacks_is_one_sentence(change: dict[str, object], sentence: str) -> None:
    keys = {"model": MODEL, "actuators": SERVOS, "measured": "tool", "pose": ("x", "z"), **change}
    with pytest.raises(InputError, match=sentence):
        BlackBox(mujoco_simulator(**keys))


def test_what_does_not_come_to_rest_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"mujoco_arm.xml: is not at rest 0.01 s after the command q1 = .*more damping"
    ):
        BlackBox(mujoco_simulator(MODEL, SERVOS, "tool", ("x", "z"), settle=0.01))


def test_without_mujoco_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"pip install 'ccnn-torch\[mujoco\]'"):
        mujoco_simulator(MODEL, SERVOS, "tool")


def test_it_runs_where_the_system_does_not_tell_the_cores(arm: BlackBox, monkeypatch: pytest.MonkeyPatch) -> None:
    joints = arm.sample_joints(2, torch.Generator().manual_seed(0))
    monkeypatch.delattr("os.sched_getaffinity", raising=False)
    other = load_mechanism(f"{EXAMPLES / 'mujoco_arm.py'}:ARM")
    assert torch.equal(other.forward_kinematics(joints), arm.forward_kinematics(joints))
