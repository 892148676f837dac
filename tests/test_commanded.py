"""Records without joints: what was commanded is a pose, and the joints are the controller's inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from arm_text import arm_text
from numpy.typing import NDArray
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.records import load_records, write_table
from ccnn_torch.records.read_table import read_table
from ccnn_torch.starter import starter_config

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]

# A delta printer in millimetres: rods of 250 on towers at a radius of 130 less that of the platform, 0.3 mm wrong.
ROD, RADIUS, ANGLES = 250.0, 130.0, np.deg2rad([0.0, 120.0, 240.0])
TRUE = (ROD + np.array([0.3, -0.2, 0.4]), RADIUS + np.array([0.4, -0.5, 0.2]), ANGLES + np.deg2rad([0.1, -0.15, 0.05]),
        np.array([0.3, -0.2, 0.1]))  # fmt: skip
NOMINAL = (np.full(3, ROD), np.full(3, RADIUS), ANGLES, np.zeros(3))
KEYS = "mechanism_keys={base: 0.16, platform: 0.03, rod: 0.25}"


def carriages(place: Array, machine: tuple[Array, ...]) -> Array:
    """Heights of the carriages, `... x 3` [mm]."""
    rod, radius, angle, offset = machine
    across = radius * np.cos(angle) - place[..., :1], radius * np.sin(angle) - place[..., 1:2]
    return np.asarray(place[..., 2:] + np.sqrt(rod**2 - across[0] ** 2 - across[1] ** 2) - offset)


def reached(commanded: Array) -> Array:
    """Where the true printer goes when its controller is told to go somewhere, `s x 3` [mm]."""
    heights = carriages(commanded, NOMINAL)
    return np.array([fsolve(lambda p, h=h: carriages(p, TRUE) - h, c) for h, c in zip(heights, commanded, strict=True)])


def places(count: int, seed: int) -> Array:
    return np.random.default_rng(seed).uniform([-70, -70, 0], [70, 70, 150], (count, 3))


def columns(values: Array, name: str) -> dict[str, Array]:
    return {f"{name.format(axis)}[mm]": values[:, k] for k, axis in enumerate("xyz")}


def test_a_printer_without_joints_is_identified_and_corrected(
    tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    commanded = places(60, 0)
    noise = np.random.default_rng(1).normal(0, 0.01, commanded.shape)
    write_table(tmp_path / "r.csv", columns(commanded, "goal_{}") | columns(reached(commanded) + noise, "{}"))
    about = ["records=r.csv", "mechanism=delta_linear", KEYS]
    code, _, err = cli("identify", *about, "out=found")
    assert code == 0, err
    assert "the joints are the nominal inverse kinematics of the commanded poses goal_x, goal_y, goal_z" in " ".join(
        (tmp_path / "found" / "report.html").read_text().split()
    )
    wanted = places(40, 2)
    for name, option in (("{}", ["--pose"]), ("goal_{}", [])):
        write_table(tmp_path / "wanted.csv", columns(wanted, name))
        if option:
            code, _, err = cli("compensate", "found/identified.yaml", "wanted.csv", "commands.csv")
            assert code == 2 and "add --pose" in err
        code, _, err = cli("compensate", "found/identified.yaml", "wanted.csv", "commands.csv", *option)
        assert code == 0, err
        table = read_table(tmp_path / "commands.csv")
        commands = np.stack([table.raw(f"command_{axis}") for axis in "xyz"], -1)
        before, after = (np.linalg.norm(reached(c) - wanted, axis=1) for c in (wanted, commands))
        assert before.mean() > 0.3 and after.max() < 0.04, (before.mean(), after.max())


def test_distances_between_commanded_places(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, second = places(80, 3), places(80, 4)
    distance = np.linalg.norm(reached(first) - reached(second), axis=1) + np.random.default_rng(5).normal(0, 0.01, 80)
    both = columns(first, "goal_{}") | columns(second, "goal_{}_b")
    write_table(tmp_path / "d.csv", both | {"distance[mm]": distance})
    joints = carriages(first, NOMINAL), carriages(second, NOMINAL)
    plain = {f"q{k + 1}{e}[mm]": q[:, k] for q, e in zip(joints, ("", "_b"), strict=True) for k in range(3)}
    write_table(tmp_path / "q.csv", plain | {"distance[mm]": distance})
    found = []
    for name in ("d", "q"):
        args = (f"records={name}.csv", "mechanism=delta_linear", KEYS, "constraint={kind: distances}", f"out={name}")
        code, _, err = cli("identify", *args)
        assert code == 0, err
        found.append(load_mechanism(str(tmp_path / name / "identified.yaml")).nominal.numpy())
        assert ("inverse kinematics of the commanded poses" in (tmp_path / name / "identified.md").read_text()) == (
            name == "d"
        )
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)


def arm(tmp_path: Path, tool: str = "unknown") -> SerialArm:
    (tmp_path / "arm.yaml").write_text(arm_text(f"base_frame: unknown\ntool_frame: {tool}\n"))
    machine = load_mechanism(str(tmp_path / "arm.yaml"))
    assert isinstance(machine, SerialArm)
    return machine


def path_of(machine: SerialArm, rows: int = 6) -> tuple[torch.Tensor, Array]:
    """Joints of a walk from home, and the flange's poses there."""
    steps = 0.15 * torch.randn(rows, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    joints = machine.home_joints + steps.cumsum(0)
    return joints, machine.forward_kinematics(joints).numpy()


def test_an_arms_joints_are_those_of_the_previous_rows_branch(tmp_path: Path) -> None:
    machine = arm(tmp_path)
    joints, pose = path_of(machine)
    angles = np.rad2deg(Rotation.from_rotvec(pose[:, 3:]).as_euler("ZYX"))
    goals = {f"goal_{c}[mm]": 1e3 * pose[:, k] for k, c in enumerate("xyz")}
    goals |= {f"goal_kuka_{c}[deg]": angles[:, k] for k, c in enumerate("abc")}
    measured = {f"{c}[m]": pose[:, k] for k, c in enumerate("xyz")}
    write_table(tmp_path / "r.csv", goals | measured)
    records = load_records(tmp_path / "r.csv", machine, learns=False)
    assert float(machine.wrap(records.joints - joints).abs().max()) < 1e-6
    assert any("nearest to the previous row's" in note for note in records.notes)
    # The base of the model is where the tracker is; commands are in the arm's own base, at the tool of its file.
    at = machine.with_nominal(
        machine.nominal + torch.cat([torch.full((6,), 0.3), torch.zeros(len(machine.nominal) - 6)])
    )
    assert float((load_records(tmp_path / "r.csv", at, learns=False).joints - records.joints).abs().max()) < 1e-9
    # The controller's tool is not what was measured, whatever form the links have.
    other = arm(tmp_path, "[0, 0.2, 0, 0, 0, 0]\ngoal_tool: identity")
    for one in (other, other.with_leans(), other.with_link_frames()):
        found = load_records(tmp_path / "r.csv", one, learns=False).joints
        assert float(machine.wrap(found - machine.commanded_joints(torch.from_numpy(pose))).abs().max()) < 1e-6
    longer = arm(tmp_path, "[0, 0, 0.1, 0, 0, 0]")
    away = load_records(tmp_path / "r.csv", longer, learns=False).joints
    assert (
        float((longer.controlled().forward_kinematics(away)[:, :3] - torch.from_numpy(pose[:, :3])).abs().max()) < 1e-6
    )


def test_an_arms_joints_are_those_with_which_its_errors_fit(tmp_path: Path) -> None:
    machine = arm(tmp_path)
    generator = torch.Generator().manual_seed(0)
    low, high = (torch.tensor(q).deg2rad() for q in ([-40.0, 20, -100, -40, 20, -70], [40.0, 60, -60, 40, 60, 70]))
    joints = low + (high - low) * torch.rand(15, 6, generator=generator, dtype=torch.float64)
    wrong = machine.nominal.clone()
    wrong[6:-6] += 3e-4 * torch.randn(len(wrong) - 12, generator=generator, dtype=torch.float64)
    goal, pose = machine.forward_kinematics(joints).numpy(), machine.forward_kinematics(joints, wrong).numpy()
    names = ("x[m]", "y[m]", "z[m]", "rx[rad]", "ry[rad]", "rz[rad]")
    goals = {f"goal_{name}": goal[:, k] for k, name in enumerate(names)}
    measured = {name: pose[:, k] + 1e-5 * np.random.default_rng(k).normal(size=15) for k, name in enumerate(names)}
    write_table(tmp_path / "r.csv", goals | measured)
    # Home is on another branch: rows that follow it are wrong in the joints of shoulder and elbow.
    near = machine.controlled().commanded_joints(torch.from_numpy(goal))
    assert float(machine.wrap(near - joints)[:, :3].abs().max(-1).values.min()) > 0.1
    records = load_records(tmp_path / "r.csv", machine, learns=False)
    assert float(machine.wrap(records.joints - joints)[:, :3].abs().max()) < 1e-6
    assert "guess_q1[rad]" in records.doubt and records.doubt in records.notes
    guesses = {f"guess_q{k + 1}[rad]": joints[:, k].numpy() for k in range(6)}
    write_table(tmp_path / "g.csv", goals | measured | guesses)
    assert load_records(tmp_path / "g.csv", machine, learns=False).doubt == ""


def test_what_was_commanded_is_refused_by_row(tmp_path: Path) -> None:
    machine = arm(tmp_path)
    _, pose = path_of(machine, 12)
    place = {f"{c}[m]": pose[:, k] for k, c in enumerate("xyz")}
    goals = {f"goal_{name}": values for name, values in place.items()}
    turns = {f"goal_{c}[rad]": pose[:, k + 3] for k, c in enumerate(("rx", "ry", "rz"))}
    file = tmp_path / "r.csv"

    def refused(columns: dict[str, Array], *parts: str) -> None:
        write_table(file, columns)
        with pytest.raises(InputError) as error:
            load_records(file, machine, learns=False)
        assert all(part in str(error.value) for part in parts), error.value

    refused(
        place, "there is no column 'q1'; give the joints (q1[rad] …), or the commanded pose as goal_x[m], goal_y[m]"
    )
    refused(goals | place, "do not determine the 6 joints", "goal_rx, goal_ry, goal_rz")
    far = goals | turns | {"goal_x[m]": np.where(np.arange(12) == 7, 9.0, pose[:, 0])}
    refused(far | place, "no joints for the pose goal_x = 9 m", "line 9 (row 8)")
    lacking = {name: values for name, values in (goals | turns).items() if name != "goal_z[m]"}
    refused(lacking | place, "there is no column 'goal_z'")
    # Joints count where a file has them.
    joints = {f"q{k + 1}[rad]": path_of(machine, 12)[0][:, k].numpy() for k in range(6)}
    write_table(file, far | place | joints)
    assert np.array_equal(load_records(file, machine, learns=False).joints[:, 0].numpy(), joints["q1[rad]"])


def test_a_coordinate_that_a_machine_cannot_move_is_not_needed(tmp_path: Path) -> None:
    gantry = SerialArm("gantry", "urdf", [[0, 0, 0, 0, 0, 0]] * 3, ["prismatic"] * 3, axes=np.eye(3).tolist())
    place = places(20, 6)
    write_table(tmp_path / "r.csv", columns(place, "goal_{}") | columns(place, "{}"))
    found = load_records(tmp_path / "r.csv", gantry, learns=False)
    np.testing.assert_allclose(found.joints.numpy(), place / 1e3, atol=1e-9)


def test_new_recognises_a_commanded_pose(tmp_path: Path) -> None:
    place = places(20, 6)
    write_table(tmp_path / "r.csv", {f"Cmd_{c}": place[:, k] for k, c in enumerate("XYZ")} | columns(place, "{}"))
    text, ready = starter_config(tmp_path / "r.csv", tmp_path / "c.yaml", "delta_linear", "mm,deg")
    assert ready and '"Cmd_X": "goal_x[mm]"' in text and "inverse kinematics of the commanded pose" in text
    write_table(tmp_path / "r.csv", columns(place, "{}"))
    with pytest.raises(InputError, match=r"no column looks like a joint .* or a commanded pose \(goal_x"):
        starter_config(tmp_path / "r.csv", tmp_path / "c.yaml")
