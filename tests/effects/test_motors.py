"""Motors that turn with other joints as well: what acts in the drives is of them, and numbers of theirs are told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from physical_rows import ARM, acting, columns, situation
from torch import Tensor

from ccnn_torch import diagnose
from ccnn_torch.diagnosis.checks import unrecorded
from ccnn_torch.effects import Situation, default_gravity, make_effect, moved_joints, reached
from ccnn_torch.effects.covariates import directions
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm, load_mechanism, mechanism_from_description
from ccnn_torch.records import load_records, write_table

MOTORS = "motors: {q5: {q4: 0.6}, q6: {q4: 0.4, q5: -0.5}}\n"
# Of q4, q5, q6: how far each motor turns, over its gear; and joints by these.
TURNS = np.array([[1, 0, 0], [0.6, 1, 0], [0.4, -0.5, 1]])
BACK = np.linalg.inv(TURNS)


@pytest.fixture
def wrist(tmp_path: Path) -> str:
    (tmp_path / "wrist.yaml").write_text(Path(ARM).read_text() + MOTORS)
    return str(tmp_path / "wrist.yaml")


def _of_motors(joints: Tensor) -> np.ndarray:
    turned = joints.numpy().copy()
    turned[..., 3:] = turned[..., 3:] @ TURNS.T
    return turned


def test_waves_and_backlash_are_of_the_motors_turn_and_move_what_these_turn(wrist: str) -> None:
    rows = situation(wrist)
    motors = _of_motors(rows.joints)
    wave = moved_joints(rows, [acting("transmission", rows, q4_sin=1e-4, q4_frequency=7.0)])
    expected = np.zeros_like(motors)
    expected[:, 3:] = np.outer(1e-4 * np.sin(7 * motors[:, 3]), BACK[:, 0])
    np.testing.assert_allclose(wave.numpy(), expected, atol=1e-16)
    wave = moved_joints(rows, [acting("transmission", rows, q6_cos=1e-4, q6_frequency=3.0)])
    np.testing.assert_allclose(wave.numpy()[:, 5], 1e-4 * np.cos(3 * motors[:, 5]), atol=1e-16)
    assert float(wave[:, :5].abs().max()) == 0.0
    way = torch.tensor([1.0, -1, 1, 1, -1, 1, -1, -1, 1], dtype=torch.float64)
    held = replace(rows, covariates={"direction5": way})
    lost = moved_joints(held, [acting("backlash", held, q5=4e-4, hold=60.0, width=0.3)])
    np.testing.assert_allclose(lost.numpy()[:, 4:], -2e-4 * np.outer(way.numpy(), BACK[1:, 1]), rtol=1e-4)


def test_springs_carry_what_the_motors_do_and_work_is_the_same(wrist: str) -> None:
    rows, plain = situation(wrist), situation(ARM)
    for name in ("load_torque", "own_weight_torque", "weight_torque"):
        of_joints, of_motors = getattr(plain, name).numpy(), getattr(rows, name).numpy()
        speed = np.random.default_rng(0).normal(size=of_joints.shape)
        work = (of_motors * _of_motors(torch.as_tensor(speed))).sum(-1)
        np.testing.assert_allclose(work, (of_joints * speed).sum(-1), rtol=1e-10)
    give = 1e-6
    there = (reached(rows, [acting("compliance", rows, q4=give)]) - reached(rows, []))[:, :3]
    turned = np.zeros((9, 6))
    turned[:, 3:] = give * np.outer(rows.load_torque[:, 3].numpy(), BACK[:, 0])
    moved = (plain.jacobian @ torch.as_tensor(turned)[..., None])[:, :3, 0]
    torch.testing.assert_close(there, moved, rtol=1e-3, atol=1e-8)
    sagged = moved_joints(rows, [acting("gravity", rows, q6=1e-4)]).numpy()
    np.testing.assert_allclose(sagged[:, 5], 1e-4 * rows.own_weight_torque[:, 5].numpy(), rtol=1e-9)


def test_directions_that_follow_from_the_order_are_those_of_the_motors(wrist: str) -> None:
    rows = situation(wrist, rows=30)
    drawn = directions(rows.mechanism, rows.joints, torch.ones(1, 6))
    for way in (unrecorded._directions(rows, torch.arange(30)), drawn):
        found = torch.stack([way[f"direction{k}"] for k in range(1, 7)], -1).numpy()[1:]
        np.testing.assert_array_equal(found, np.sign(np.diff(_of_motors(rows.joints), axis=0)))
    # Of the joints some are others.
    assert (np.sign(np.diff(rows.joints.numpy(), axis=0)) != found)[:, 4:].any()


def test_without_common_motors_nothing_is_another(wrist: str) -> None:
    rows = situation(ARM)
    single = load_mechanism(ARM, motors={"q5": {"q5": 1.0}})
    same = Situation(single, rows.joints, rows.covariates, default_gravity(single))
    for name in ("transmission", "backlash", "compliance", "gravity", "thermal_compliance"):
        effect = make_effect(name)
        shape = torch.tensor([s.grid[1] for s in effect.shapes(rows)], dtype=torch.float64)
        for label, column in columns(effect, rows, shape).items():
            torch.testing.assert_close(columns(effect, same, shape)[label], column)
    assert not load_mechanism(ARM).motors and load_mechanism(wrist).motors[5] == (0, 0, 0, 0.4, -0.5, 1)


def test_a_ratio_that_is_off_is_a_number_of_the_arm_and_stays_in_its_other_forms(wrist: str) -> None:
    arm = load_mechanism(wrist)
    assert isinstance(arm, SerialArm) and arm.drives == ((5, 4), (6, 4), (6, 5))
    values = arm.nominal.clone()
    names = [p.name for p in arm.geometry]
    off = np.zeros((3, 3))
    off[1, 0], off[2, 1] = 3e-4, -2e-4
    # The real shafts have other ratios than the controller's, which takes the joints apart by its own.
    wrong = np.linalg.inv(TURNS + off) @ TURNS - np.eye(3)
    for i, j in arm.drives:
        values[names.index(f"drive{i}{j}")] = wrong[i - 4, j - 4]
    joints = arm.sample_joints(5, torch.Generator().manual_seed(0))
    really = joints.numpy().copy()
    really[:, 3:] = joints.numpy()[:, 3:] @ (np.eye(3) + wrong).T
    assert abs(np.diag(wrong)).max() < 1e-12
    pose = arm.forward_kinematics(joints, values)
    torch.testing.assert_close(pose, arm.forward_kinematics(torch.as_tensor(really)), rtol=0, atol=1e-12)
    arm.set_parameters(dict(zip(names, values.tolist(), strict=True)))
    for other in (mechanism_from_description(arm.describe()), arm.with_link_frames(), arm.with_leans()):
        assert other.motors == arm.motors
        torch.testing.assert_close(other.forward_kinematics(joints), pose, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ("[q5]", r"key 'motors' must be as \{q5: \{q4: 0.667\}\}"),
        ("{q5: 0.6}", "must be as"),
        ("{q7: {q4: 1}}", "'q7' is no joint of the machine; they are q1"),
        ("{q5: {q4: much}}", "q5: q4: must be a number of turns a turn, got 'much'"),
        ("{q5: {q4: .inf}}", "must be a number of turns a turn"),
        ("{q5: {q4: 1, q5: 0}, q4: {q4: 1}}", "the joints do not follow from these motors"),
    ],
)
def test_faulty_motors_are_named(tmp_path: Path, told: str, said: str) -> None:
    (tmp_path / "wrist.yaml").write_text(Path(ARM).read_text() + f"motors: {told}\n")
    with pytest.raises(InputError, match=said):
        load_mechanism(str(tmp_path / "wrist.yaml"))


def test_joints_of_two_units_share_no_motor() -> None:
    with pytest.raises(InputError, match="q1 is in m, and q2 in rad"):
        SerialArm("lift", "standard", [[0.0] * 4] * 2, ["prismatic", "revolute"], motors={"q2": {"q1": 1.0}})


def test_a_gear_of_a_wrist_is_found_and_its_commands_reach(
    cli: Callable[..., tuple[int, str, str]], tmp_path: Path, wrist: str
) -> None:
    """The true machine in numpy: one motor's gear is off, and a reading shows it in three joints."""
    Path(wrist).write_text(Path(wrist).read_text() + "gears: [null, null, null, 40, null, null]\n")
    arm, plain = load_mechanism(wrist), load_mechanism(ARM)
    rng = np.random.default_rng(2)

    def taken(joints: np.ndarray) -> Tensor:
        real = joints.copy()
        real[:, 3:] += np.outer(3e-4 * np.sin(40 * _of_motors(torch.as_tensor(joints))[:, 3] + 1), BACK[:, 0])
        return plain.forward_kinematics(torch.as_tensor(real))

    joints = np.array([0, -1, 1, 0, 1.6, 0]) + rng.uniform(-1.2, 1.2, (120, 6))
    pose = taken(joints).numpy() + rng.normal(0, [1e-5] * 3 + [3e-5] * 3, (120, 6))
    names = [*(f"q{k}[rad]" for k in range(1, 7)), "x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"]
    write_table(tmp_path / "r.csv", dict(zip(names, np.c_[joints, pose].T, strict=True)))
    said = diagnose(load_records(tmp_path / "r.csv", arm), arm, effects=["transmission", "coupling", "joint_gain"])
    assert said.verdict["effects"] == ["transmission"] and said.verdict["shrink"] > 0.95
    found = {k: v["value"] for k, v in said.effects[0]["parameters"].items() if k.startswith("q4 ")}
    assert found["q4 frequency"] == 40 and np.hypot(found["q4 sin"], found["q4 cos"]) == pytest.approx(3e-4, rel=0.1)
    made = cli("run", f"records={tmp_path / 'r.csv'}", f"mechanism={wrist}", f"out={tmp_path / 'run'}", "--quiet")
    assert made[0] == 0, made
    wanted = np.array([0, -1, 1, 0, 1.6, 0]) + rng.uniform(-1.1, 1.1, (50, 6))
    targets = arm.forward_kinematics(torch.as_tensor(wanted)).numpy()
    write_table(tmp_path / "t.csv", dict(zip(names, np.c_[wanted, targets].T, strict=True)))
    assert cli("compensate", tmp_path / "run/model.onnx", tmp_path / "t.csv", tmp_path / "c.csv")[0] == 0
    sent = np.genfromtxt(tmp_path / "c.csv", delimiter=",", names=True, deletechars="")
    commands = np.stack([sent[f"command_q{k}[rad]"] for k in range(1, 7)], -1)
    before, after = (
        np.sqrt(((taken(q).numpy()[:, :3] - targets[:, :3]) ** 2).sum(1).mean()) for q in (wanted, commands)
    )
    assert after < 0.2 * before, (before, after)
