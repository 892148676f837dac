"""Joint torques at rest beside the poses: an arm of point masses on springs, whose formulas are its own, in numpy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from arm_text import ALPHA, A, D, arm_text
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ccnn_torch.api import identify
from ccnn_torch.diagnosis import diagnose
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.effects.registry import make_effect
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm, load_mechanism, read_dh_file
from ccnn_torch.mechanisms.mechanism_file import dh_text
from ccnn_torch.records import load_records, write_table

Array = NDArray[np.float64]
GIVES = np.array([2e-6, 12e-6, 9e-6, 20e-6, 15e-6, 30e-6])
"""Of each joint [rad/(N·m)]."""
# On which link, where in its frame [m], and how heavy [kg].
MASSES = ((2, (0.3, 0, 0.1), 8.4), (3, (0.28, 0.01, 0), 2.3), (5, (0, 0, 0.03), 2.4), (6, (0.05, 0.02, 0.1), 3.0))
TOOL = (0.05, -0.02, 0.12)
NOISE, TURN_NOISE, TORQUE_NOISE = 2e-5, 5e-5, 0.1


def _links(joints: Array, errors: Array) -> list[Array]:
    at, found = np.eye(4), [np.eye(4)]
    for q, a, d, alpha, e in zip(joints, A, D, ALPHA, errors.T, strict=True):
        c, s, ca, sa = np.cos(q + e[0]), np.sin(q + e[0]), np.cos(alpha + e[3]), np.sin(alpha + e[3])
        x, z = a + e[2], d + e[1]
        at = at @ np.array([[c, -s * ca, s * sa, x * c], [s, c * ca, -c * sa, x * s], [0, sa, ca, z], [0, 0, 0, 1]])
        found.append(at)
    return found


def _held(joints: Array, load: float, errors: Array) -> Array:
    """Torques with which the drives hold, `6` [N·m]: differences of the height of all weights."""

    def energy(q: Array) -> float:
        links = _links(q, errors)
        masses = (*MASSES, (6, (0, 0, 0.15), load))
        return sum(9.80665 * m * float((links[k] @ np.array([*at, 1]))[2]) for k, at, m in masses)

    steps = 1e-5 * np.eye(6)
    return np.array([(energy(joints + one) - energy(joints - one)) / 2e-5 for one in steps])


def _stands(command: Array, load: float, errors: Array, gives: Array = GIVES) -> tuple[Array, Array]:
    """Where the springs let the tool of a command be, `4 x 4`, and the torques there."""
    joints = command
    for _ in range(8):
        torques = _held(joints, load, errors)
        joints = command - gives * torques
    at = np.eye(4)
    at[:3, 3] = TOOL
    return _links(joints, errors)[6] @ at, torques


def _measured(folder: Path, rows: int, geometry: float) -> Array:
    """Writes records and the arm's file; the errors of its links."""
    draw = np.random.default_rng(4)
    errors: Array = geometry * draw.normal(0, 1, (4, 6)) * np.array([[2e-3], [4e-4], [4e-4], [1e-3]])
    lines = []
    for _ in range(rows):
        q = draw.uniform([-2.5, -2.2, 0.4, -2.5, -2.2, -3], [2.5, -0.6, 2.2, 0.5, -0.4, 3])
        at, torques = _stands(q, draw.choice([0.0, 2.0, 5.0]), errors)
        turn = Rotation.from_matrix(at[:3, :3]) * Rotation.from_rotvec(draw.normal(0, TURN_NOISE, 3))
        pose = [*(at[:3, 3] + draw.normal(0, NOISE, 3)), *turn.as_rotvec()]
        lines.append([*q, *pose, *(torques + draw.normal(0, TORQUE_NOISE, 6))])
    header = [f"q{i + 1}[rad]" for i in range(6)] + ["x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"]
    header += [f"torque_q{i + 1}[Nm]" for i in range(6)]
    np.savetxt(folder / "r.csv", np.array(lines), "%.12g", ",", header=",".join(header), comments="")
    tool = ", ".join(map(str, TOOL))
    frames = "unknown" if geometry else "identity"
    (folder / "arm.yaml").write_text(
        arm_text(f"base_frame: {frames}\ntool_frame: {'unknown' if geometry else f'[{tool}, 0, 0, 0]'}\n")
    )
    return errors


@pytest.mark.parametrize("geometry", [0.0, 1.0])
def test_what_each_joint_gives_for_its_measured_torque_is_told(geometry: float, tmp_path: Path) -> None:
    _measured(tmp_path, 90, geometry)
    arm = load_mechanism(str(tmp_path / "arm.yaml"))
    effects = ["geometry", "joint_offset", "joint_gain", "gravity", "sag"]
    said = diagnose(load_records(tmp_path / "r.csv", arm, learns=False), arm, effects=effects)
    assert set(said.verdict["effects"]) == ({"sag", "geometry"} if geometry else {"sag"})
    found = next(e for e in said.effects if e["name"] == "sag")["parameters"]
    assert {block["unit"] for block in found.values()} == {"rad/N/m"}
    for joint, gives in zip((2, 3, 4, 5), GIVES[1:], strict=False):
        block = found[f"q{joint}"]
        # The records have the torque with which a drive holds: the joint gives the other way.
        assert abs(block["value"] + gives) < 4 * block["sd"] + 0.02 * gives and block["sd"] < 0.1 * gives


def test_springs_that_soften_with_warmth_are_told_beside_what_they_give(tmp_path: Path) -> None:
    draw, warm, path = np.random.default_rng(1), 6 * np.sin(np.linspace(0, 5, 60)), tmp_path / "arm.yaml"
    path.write_text(arm_text(f"base_frame: identity\ntool_frame: [{', '.join(map(str, TOOL))}, 0, 0, 0]\n"))
    joints = draw.uniform([-2.5, -2.2, 0.4, -2.5, -2.2, -3], [2.5, -0.6, 2.2, 0.5, -0.4, 3], (60, 6))
    gives = GIVES * (1 + 0.05 * warm[:, None])
    frames = [_stands(q, 0.0, np.zeros((4, 6)), c)[0] for q, c in zip(joints, gives, strict=True)]
    turns = Rotation.from_matrix([at[:3, :3] for at in frames]) * Rotation.from_rotvec(draw.normal(0, 5e-5, (60, 3)))
    pose = np.c_[[at[:3, 3] for at in frames] + draw.normal(0, NOISE, (60, 3)), turns.as_rotvec()]
    names = [*(f"q{i + 1}[rad]" for i in range(6)), "x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]"]
    table = dict(zip([*names, "temperature[degC]"], np.c_[joints, pose, 20 + warm].T, strict=True))
    write_table(tmp_path / "r.csv", table)
    arm = load_mechanism(str(path))
    effects = ["joint_offset", "gravity", "thermal", "thermal_compliance"]
    said = diagnose(load_records(tmp_path / "r.csv", arm), arm, effects=effects)
    assert set(said.verdict["effects"]) == {"gravity", "thermal_compliance"} and said.verdict["shrink"] > 0.99


def test_identify_does_not_bend_the_geometry_to_what_joints_give(tmp_path: Path) -> None:
    errors = _measured(tmp_path, 100, 1.0)
    noise = {**dict.fromkeys("xyz", NOISE), **dict.fromkeys(("rx", "ry", "rz"), TURN_NOISE)}
    keys = {"mechanism": str(tmp_path / "arm.yaml"), "noise": noise, "save_report": False}
    found = identify(records=str(tmp_path / "r.csv"), **keys)
    told = found.results["parameters"]
    for joint, gives in zip((2, 3, 4, 5), GIVES[1:], strict=False):
        block = told[f"compliance q{joint}"]
        assert abs(block["value"] + gives) < 4 * block["sd"] + 0.02 * gives and block["unit"] == "rad/N/m"
    names = [f"{name}{j}" for name, j in (("a", 2), ("a", 3), ("alpha", 1), ("alpha", 2), ("theta", 3), ("theta", 5))]
    rows = {"theta": 0, "d": 1, "a": 2, "alpha": 3}
    right = np.array([errors[rows[name[:-1]], int(name[-1]) - 1] for name in names])
    off = [told[n]["value"] - told[n]["nominal"] - e for n, e in zip(names, right, strict=True)]
    assert np.all(np.abs(off) < 4.5 * np.array([told[n]["sd"] for n in names]))
    assert found.results["test"]["position"]["after"] < 1.5 * np.sqrt(3) * NOISE
    # What is written is the arm alone, whose commands know no torque.
    assert "compliance q2" not in [p.name for p in found.mechanism().geometry] and found.results["promise"] is None


def test_commands_hold_the_sag_that_the_torques_of_the_targets_tell(
    cli: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    _measured(tmp_path, 60, 0.0)
    words = (
        "--records",
        tmp_path / "r.csv",
        "--mechanism",
        tmp_path / "arm.yaml",
        "--no-network",
        "--out",
        tmp_path / "d",
    )
    code, told, error = cli("diagnose", *words, "--effects", "sag,gravity,joint_gain")
    assert code == 0 and "Compliance of joints 2 to" in told, error
    # What a joint holds at rest is no choice of whoever measures next.
    next_rows = (tmp_path / "d" / "next_measurements.csv").read_text()
    assert "q6[deg]" in next_rows and "torque" not in next_rows
    draw, none = np.random.default_rng(9), np.zeros((4, 6))
    wanted = draw.uniform([-2, -2, 0.6, -2, -1.8, -2], [2, -0.8, 2, 0.2, -0.8, 2], (12, 6))
    torques = np.array([_held(q, 4.0, none) for q in wanted])
    names = [f"q{i + 1}[rad]" for i in range(6)]
    for count, file in ((6, "t.csv"), (5, "less.csv")):
        header = [*names, *(f"torque_q{i + 1}[N*m]" for i in range(count))]
        table = np.c_[wanted, torques[:, :count]]
        np.savetxt(tmp_path / file, table, "%.12g", ",", header=",".join(header), comments="")
    code, _, error = cli("compensate", tmp_path / "d" / "diagnosis.json", tmp_path / "t.csv", tmp_path / "c.csv")
    assert code == 0, error
    with (tmp_path / "c.csv").open() as lines:
        columns = lines.readline().strip().split(",")
    table = np.loadtxt(tmp_path / "c.csv", delimiter=",", skiprows=1)
    commands = table[:, [columns.index(f"command_{n}") for n in names]]
    tool = np.array([*TOOL, 1])
    right = np.array([(_links(q, none)[6] @ tool)[:3] for q in wanted])

    def off(sent: Array) -> float:
        there = np.array([_stands(q, 4.0, none)[0][:3, 3] for q in sent])
        return float(np.sqrt(np.mean(np.sum((there - right) ** 2, axis=1))))

    assert off(wanted) > 5e-4 and off(commands) < 2e-5
    code, _, error = cli("compensate", tmp_path / "d" / "diagnosis.json", tmp_path / "less.csv", tmp_path / "c.csv")
    assert code == 2 and "torque_q6" in error


def test_a_torque_in_another_quantity_is_refused(tmp_path: Path) -> None:
    _measured(tmp_path, 20, 0.0)
    arm, file = load_mechanism(str(tmp_path / "arm.yaml")), tmp_path / "r.csv"
    file.write_text(file.read_text().replace("torque_q3[Nm]", "torque_q3[N]", 1))
    with pytest.raises(InputError, match=r"torque_q3.*N\*m"):
        load_records(file, arm, learns=False)


@pytest.mark.parametrize("link_frames", [False, True])
def test_weight_acts_where_the_file_says(tmp_path: Path, link_frames: bool) -> None:
    centres: list[list[float]] = [[], [], [], [], [], []]
    masses = [0.0] * 6
    for link, at, mass in MASSES:
        centres[link - 1], masses[link - 1] = [float(v) for v in at], mass
    text = arm_text(f"base_frame: [0, 0, 0.3, 0.2, -0.1, 0.4]\nmasses: {masses}\ncentres: {centres}\n")
    (tmp_path / "arm.yaml").write_text(text)
    arm = load_mechanism(str(tmp_path / "arm.yaml"))
    assert isinstance(arm, SerialArm)
    (tmp_path / "again.yaml").write_text(dh_text(arm))
    arm = read_dh_file(str(tmp_path / "again.yaml"))
    arm = arm.with_link_frames() if link_frames else arm
    joints = np.random.default_rng(5).uniform(-2, 2, (4, 6))
    situation = Situation(arm, torch.from_numpy(joints), {}, default_gravity(arm))
    base = Rotation.from_rotvec([0.2, -0.1, 0.4]).as_matrix()

    def height(q: Array) -> float:
        links = _links(q, np.zeros((4, 6)))
        return sum(m * float((base @ links[k][:3] @ [*at, 1])[2]) for k, at, m in MASSES) / sum(masses)

    steps = 1e-5 * np.eye(6)
    pulls = [[(height(q - one) - height(q + one)) / 2e-5 for one in steps] for q in joints]
    np.testing.assert_allclose(situation.own_weight_torque, pulls, rtol=0, atol=1e-9)


def _two_links(folder: Path, turn: float) -> Situation:
    """Links of 0.4 and 0.2 m that weigh 3 and 1 kg, turned about x [rad], at 0.3 and 0.5 rad."""
    links = "a: [400, 200]\nalpha: [0, 0]\nd: [0, 0]\ntheta: [0, 0]\ntool_frame: identity\nmasses: [3, 1]\n"
    text = f"dof: 2\nconvention: standard Denavit-Hartenberg\nunits: {{length: mm, angle: rad}}\n{links}"
    (folder / "arm.yaml").write_text(f"{text}base_frame: [0, 0, 0, {turn}, 0, 0]\n")
    arm = load_mechanism(str(folder / "arm.yaml"))
    return Situation(arm, torch.tensor([[0.3, 0.5]], dtype=torch.float64), {}, default_gravity(arm))


def test_masses_alone_are_halfway_to_the_next_axis(tmp_path: Path) -> None:
    found = _two_links(tmp_path, np.pi / 2).own_weight_torque[0]
    far, near = 0.1 * np.cos(0.8), 0.2 * np.cos(0.3)
    np.testing.assert_allclose(found, [-0.75 * near - 0.25 * (2 * near + far), -0.25 * far], rtol=0, atol=1e-12)


def test_a_lift_carries_all_of_its_link() -> None:
    lift = SerialArm(
        "lift", "standard", [[0] * 4, [0.2, 0, 0, 0]], joint_types=["prismatic", "revolute"], masses=[3, 1]
    )
    found = Situation(lift, torch.tensor([[0.3, 0.5]], dtype=torch.float64), {}, default_gravity(lift))
    np.testing.assert_allclose(found.own_weight_torque, [[-1, 0]], rtol=0, atol=1e-15)


def test_a_base_tilts_under_the_moment_of_the_masses(tmp_path: Path) -> None:
    situation, effect = _two_links(tmp_path, 0.0), make_effect("bending")
    names = [c.name for c in effect.coefficients(situation)]
    columns = effect.basis(situation, torch.zeros(0, dtype=torch.float64))[0]

    def place(first: float, second: float) -> Array:
        return np.array([first * np.cos(0.3) + second * np.cos(0.8), first * np.sin(0.3) + second * np.sin(0.8), 0])

    centre, tool = 0.75 * place(0.2, 0) + 0.25 * place(0.4, 0.1), place(0.4, 0.2)
    moment = np.cross(centre, [0, 0, -1])
    for name, tilt in (("x", [moment[0], 0, 0]), ("y", [0, moment[1], 0]), ("xy", [moment[1], moment[0], 0])):
        wanted = [*np.cross(tilt, tool), *tilt]
        np.testing.assert_allclose(columns[:, names.index(f"base weight {name}")], wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("types", "alpha", "down"),
    [
        # On a track; with z of the base up already; on a lift; a gantry of two slides under which an arm hangs.
        (["prismatic", "revolute"], [-90, 0], [0, -1, 0]),
        (["revolute", "revolute"], [-90, 0], [0, 0, -1]),
        (["prismatic", "revolute"], [0, 0], [0, 0, -1]),
        (["prismatic", "prismatic", "revolute"], [90, 90, 0], [0, 0, -1]),
    ],
)
def test_an_arm_on_a_track_stands_along_its_first_axis_that_turns(
    tmp_path: Path, types: list[str], alpha: list[int], down: list[int]
) -> None:
    zero, n = [0] * len(types), len(types)
    (tmp_path / "arm.yaml").write_text(
        f"dof: {n}\nconvention: standard Denavit-Hartenberg\nunits: {{length: m, angle: deg}}\njoint_types: {types}\n"
        f"a: {zero}\nalpha: {alpha}\nd: {zero}\ntheta: {zero}\nbase_frame: identity\ntool_frame: [0.3, 0, 0, 0, 0, 0]\n"
    )
    gravity = default_gravity(load_mechanism(str(tmp_path / "arm.yaml")))
    np.testing.assert_allclose(gravity / 9.80665, down, rtol=0, atol=1e-12)
