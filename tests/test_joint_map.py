"""`joint_map`: joints as sums of what a controller shows, in and out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from ccnn_torch.compensation import load_compensation
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix
from ccnn_torch.records import load_records, read_table, write_table
from ccnn_torch.records.joint_map import read_joint_map
from ccnn_torch.verification.job import verify_model

Cli = Callable[..., tuple[int, str, str]]
Array = NDArray[np.float64]
JOINTS = tuple(Coordinate(f"q{k}", "rad") for k in (1, 2, 3))
ARM = """
dof: 6
convention: standard Denavit-Hartenberg
units: {length: m, angle: rad}
a: [0.05, 0.5, 0.05, 0.0, 0.0, 0.0]
alpha: [1.5707963267948966, 0.0, 1.5707963267948966, -1.5707963267948966, 1.5707963267948966, 0.0]
d: [0.3, 0.0, 0.0, 0.4, 0.0, 0.1]
theta: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
base_frame: unknown
tool_frame: unknown
"""


def test_a_sum_of_columns_both_ways() -> None:
    found = read_joint_map({"q3": "J3 - 0.5*J2 + 90 deg", "q1": "-'Axis 1'", "q2": "J2"}, JOINTS, {"J3[deg]": "q3"})
    assert found is not None and found.columns == ("Axis 1", "J2", "q3")
    shown = np.array([[0.1, 0.2, 0.3], [1.0, -2.0, 3.0]])
    expected = np.stack([-shown[:, 0], shown[:, 1], shown[:, 2] - 0.5 * shown[:, 1] + np.pi / 2], -1)
    np.testing.assert_allclose(found.of_shown(shown), expected, rtol=1e-15)
    np.testing.assert_allclose(found.shown(expected), shown, rtol=1e-14)
    np.testing.assert_allclose(found.change_shown(np.array([0.0, 0.1, 0.0])), [0.0, 0.1, 0.05], rtol=1e-14)
    assert read_joint_map({}, JOINTS) is None


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ({"q4": "J4"}, "'q4' is no joint of the mechanism; the joints are q1, q2, q3"),
        ({"q3": "J3 * J2"}, "q3: 'J3 [*] J2' is no sum of columns at '[*] J2'"),
        ({"q3": "__import__('os')"}, "is no sum of columns"),
        ({"q3": "J3 J2"}, "is no sum of columns at 'J2'"),
        ({"q3": "q3 + 2 mm"}, "is in 'mm', a length, but must be an angle"),
        ({"q3": "90 deg"}, "names no column"),
        ({"q3": ""}, "names no column"),
        ({"q3": "J3 - J2"}, "the 3 joints follow from 4 columns"),
        ({"q3": "q2"}, "the 3 joints follow from 2 columns"),
        ({"q3": "q3 - q2", "q2": "q2 - q3"}, "do not follow from the joints"),
    ],
)
def test_what_is_no_map(entries: dict[str, str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        read_joint_map(entries, JOINTS)


def test_a_column_of_another_kind(tmp_path: Path) -> None:
    write_table(tmp_path / "r.csv", {"q1[rad]": [0.1] * 9, "J2[mm]": [1.0] * 9, "x[m]": [0.0] * 9, "y[m]": [0.0] * 9})
    with pytest.raises(InputError, match=r"q2 is in rad, and the column 'J2' of .*r\.csv in mm"):
        load_records(tmp_path / "r.csv", load_mechanism("five_bar"), joint_map={"q2": "J2"})


def shown_by_fanuc(joints: Array) -> Array:
    """Degrees, the third counted from the horizontal."""
    shown = np.degrees(joints)
    shown[:, 2] += shown[:, 1]
    return shown


@pytest.fixture
def fanuc(tmp_path: Path) -> tuple[Path, SerialArm, Array]:
    """Rows of an arm as a Fanuc writes them; the arm in the frames of the measuring device, and its joints."""
    (tmp_path / "arm.yaml").write_text(ARM)
    arm = load_mechanism(str(tmp_path / "arm.yaml"))
    assert isinstance(arm, SerialArm)
    frames = torch.tensor([1.2, -0.3, 0.15, 0.01, -0.02, 0.7], dtype=torch.float64)
    values = arm.nominal.clone()
    values[:6] = frames
    values[-6:-3] = torch.tensor([0.02, 0.01, 0.1], dtype=torch.float64)
    draw = torch.Generator().manual_seed(0)
    low = torch.tensor([-1.0, 0.3, -1.6, -1.5, 0.4, -2.0], dtype=torch.float64)
    joints = low + torch.tensor([2.0, 1.0, 1.2, 3.0, 1.0, 4.0], dtype=torch.float64) * torch.rand(60, 6, generator=draw)
    there = arm.with_nominal(values)
    pose = there.forward_kinematics(joints).numpy()
    write_rows(tmp_path / "rows.csv", joints.numpy(), pose)
    return tmp_path / "rows.csv", there, joints.numpy()


def write_rows(path: Path, joints: Array, pose: Array) -> None:
    turn = rotation_vector_to_matrix(torch.from_numpy(pose[:, 3:])).numpy()
    # R = Rz(r) Ry(p) Rx(w)
    angles = np.degrees(
        np.stack(
            [
                np.arctan2(turn[:, 2, 1], turn[:, 2, 2]),
                -np.arcsin(turn[:, 2, 0]),
                np.arctan2(turn[:, 1, 0], turn[:, 0, 0]),
            ],
            -1,
        )
    )
    table = np.concatenate([shown_by_fanuc(joints), 1e3 * pose[:, :3], angles], -1)
    names = ["J1", "J2", "J3", "J4", "J5", "J6", "X", "Y", "Z", "W", "P", "R"]
    write_table(path, dict(zip(names, table.T, strict=True)))


def test_from_new_to_commands_in_the_count_of_the_controller(
    fanuc: tuple[Path, SerialArm, Array], tmp_path: Path, cli: Cli
) -> None:
    rows, _, joints = fanuc
    config = tmp_path / "robot.yaml"
    words = ("new", rows, "--mechanism", tmp_path / "arm.yaml", "--units", "mm,deg", "--out", config, "--quiet")
    assert cli(*words)[0] == 0
    assert 'joint_map: {q3: "J3 - J2"}' in config.read_text()
    assert cli("check", config, "--quiet")[0] == 0
    assert cli("identify", config, "--out", tmp_path / "i", "--quiet", "save_report=false")[0] == 0
    run = ("run", config, "--out", tmp_path / "r", "--quiet", "save_report=false", "methods=[constant]")
    assert cli(*run, "geometry=none", "effects=none")[0] == 0
    assert cli("plan", config, "--poses", 10, "--out", tmp_path / "p.csv", "--quiet", "candidates=50")[0] == 0
    plan = read_table(tmp_path / "p.csv")
    planned, commands = (np.stack([plan.column(f"{w}q{k}") for k in range(1, 7)], -1) for w in ("", "command_"))
    np.testing.assert_allclose(np.degrees(commands), shown_by_fanuc(planned), rtol=1e-12)
    for file in (tmp_path / "i" / "identified.yaml", tmp_path / "r" / "model.onnx"):
        model = load_compensation(file)
        assert model.joint_map == {"q3": "J3 - J2"}
        assert verify_model(model, rows)[0]["position"]["after"]["rms"] < 1e-4
        found = model(joints)
        out, again = tmp_path / "out.csv", tmp_path / "again.csv"
        assert cli("compensate", file, rows, out)[0] == 0
        table = read_table(out)
        command = np.stack([table.raw(f"command_q{k}") for k in range(1, 7)], -1)
        np.testing.assert_allclose(command, shown_by_fanuc(found["command"]), atol=1e-9)
        deviation = np.stack([table.raw(f"deviation_q{k}") for k in range(1, 7)], -1)
        np.testing.assert_allclose(command + deviation, shown_by_fanuc(joints), atol=1e-9)
        assert cli("compensate", file, out, again, "--back")[0] == 0
        ideal = np.stack([read_table(again).raw(f"ideal_q{k}") for k in range(1, 7)], -1)
        np.testing.assert_allclose(ideal, shown_by_fanuc(joints), atol=1e-6)
        # Joints under the mechanism's own names are the mechanism's.
        write_table(tmp_path / "own.csv", {f"q{k + 1}[rad]": joints[:, k] for k in range(6)})
        assert cli("compensate", file, tmp_path / "own.csv", out)[0] == 0
        own = np.stack([read_table(out).raw(f"command_q{k}") for k in range(1, 7)], -1)
        np.testing.assert_allclose(own, found["command"], atol=1e-12)
    exported = cli("export", tmp_path / "r" / "model.safetensors", "--to", "c99", "--out", tmp_path / "c", "--quiet")
    assert exported[0] == 0 and "q3 = J3 - J2" in (tmp_path / "c" / "compensator.h").read_text()


def test_poses_give_commands_in_the_count_of_the_controller(
    fanuc: tuple[Path, SerialArm, Array], tmp_path: Path, cli: Cli
) -> None:
    rows, _, joints = fanuc
    config = tmp_path / "robot.yaml"
    assert (
        cli("new", rows, "--mechanism", tmp_path / "arm.yaml", "--units", "mm,deg", "--out", config, "--quiet")[0] == 0
    )
    assert cli("identify", config, "--out", tmp_path / "i", "--quiet", "save_report=false")[0] == 0
    table = read_table(rows)
    shown = shown_by_fanuc(joints)
    poses = {name: table.raw(name) for name in ("X", "Y", "Z", "W", "P", "R")}
    guess = {f"guess_q{k + 1}[deg]": shown[:, k] + 0.5 for k in range(6)}
    write_table(tmp_path / "poses.csv", poses | guess)
    model = tmp_path / "i" / "identified.yaml"
    assert cli("compensate", model, tmp_path / "poses.csv", tmp_path / "out.csv", "--pose")[0] == 0
    command = np.stack([read_table(tmp_path / "out.csv").raw(f"command_q{k}") for k in range(1, 7)], -1)
    np.testing.assert_allclose(command, shown, atol=1e-4)


def test_frames_that_fit_with_another_count_are_refused_with_the_map(
    fanuc: tuple[Path, SerialArm, Array], tmp_path: Path, cli: Cli
) -> None:
    rows, _, _ = fanuc
    config = tmp_path / "robot.yaml"
    assert (
        cli("new", rows, "--mechanism", tmp_path / "arm.yaml", "--units", "mm,deg", "--out", config, "--quiet")[0] == 0
    )
    lines = [line for line in config.read_text().splitlines() if not line.startswith("joint_map")]
    config.write_text("\n".join(lines) + "\n")
    for words in (("identify", "--out", tmp_path / "o"), ("check",), ("run", "methods=[constant]", "effects=none")):
        code, _, said = cli(words[0], config, *words[1:])
        assert code == 2 and 'write joint_map: {q3: "q3 - q2"}' in said, words
    # The hint holds.
    config.write_text("\n".join([*lines, 'joint_map: {q3: "q3 - q2"}']) + "\n")
    assert cli("check", config, "--quiet")[0] == 0


def test_a_file_of_another_arm_gets_no_map(tmp_path: Path, fanuc: tuple[Path, SerialArm, Array], cli: Cli) -> None:
    rows, arm, joints = fanuc
    plain = joints.copy()
    plain[:, 2] -= plain[:, 1]
    # What the controller shows is then q3 itself.
    write_rows(rows, plain, arm.forward_kinematics(torch.from_numpy(joints)).numpy())
    config = tmp_path / "robot.yaml"
    assert (
        cli("new", rows, "--mechanism", tmp_path / "arm.yaml", "--units", "mm,deg", "--out", config, "--quiet")[0] == 0
    )
    assert "joint_map" not in config.read_text()
