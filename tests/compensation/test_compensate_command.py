"""`ccnn compensate` on tables: units, poses, the way back, and what is refused."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
import typer
from stand_ins import fields, tripod_joints
from typer.testing import CliRunner

from ccnn_torch.cli.with_model import compensate
from ccnn_torch.compensation import Compensator, fit_compensator, load_model, save_model
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, ModelFileError
from ccnn_torch.learners.constant import ConstantNetwork
from ccnn_torch.mechanisms import load_mechanism, mechanism_from_description
from ccnn_torch.records import read_table, write_table
from ccnn_torch.training import Scaling

PLANAR = """
dof: 2
convention: standard Denavit-Hartenberg
units: {length: m, angle: rad}
a: [0.5, 0.4]
alpha: [0.0, 0.0]
d: [0.0, 0.0]
theta: [0.0, 0.0]
base_frame: identity
tool_frame: identity
"""


def columns(path: Path, *names: str) -> np.ndarray:
    table = read_table(path)
    return np.stack([table.column(name) for name in names], -1)


@pytest.fixture
def ideal(tmp_path: Path) -> Path:
    """Twenty ideal joints that the model was trained on, the last row far outside; and a column of no concern."""
    joints = tripod_joints()[:20].numpy()
    joints[-1] += 3
    path = tmp_path / "ideal.csv"
    table = {"row[1]": np.arange(20), "q1[m]": joints[:, 0], "q2[mm]": 1e3 * joints[:, 1], "q3[m]": joints[:, 2]}
    write_table(path, table)
    return path


@pytest.mark.parametrize("form", ["safetensors", "onnx"])
def test_commands_and_the_way_back(folder: Path, tmp_path: Path, ideal: Path, form: str) -> None:
    model, out, again = folder / f"model.{form}", tmp_path / "out.csv", tmp_path / "again.csv"
    compensate(model, ideal, out)
    table = read_table(out)
    assert [f"{k}[{u}]" for k, u in table.units.items()] == [
        "row[1]", "q1[m]", "q2[mm]", "q3[m]",
        "command_q1[m]", "command_q2[mm]", "command_q3[m]",
        "deviation_q1[m]", "deviation_q2[mm]", "deviation_q3[m]",
        "inside_domain[1]", "status[1]",
    ]  # fmt: skip
    joints = columns(ideal, "q1", "q2", "q3")
    np.testing.assert_array_equal(columns(out, "q1", "q2", "q3"), joints)
    found = load_model(model)(joints)
    command = columns(out, "command_q1", "command_q2", "command_q3")
    np.testing.assert_allclose(command, found["command"], rtol=4e-16)
    np.testing.assert_array_equal(table.column("inside_domain"), found["inside_domain"])
    assert table.column("inside_domain")[-1] == 0 and table.column("inside_domain")[:-1].all()
    # From the commands in OUT, and from a table of commands alone.
    compensate(model, out, again, back=True)
    np.testing.assert_allclose(columns(again, "ideal_q1", "ideal_q2", "ideal_q3"), joints, rtol=1e-15)
    alone = tmp_path / "alone.csv"
    write_table(alone, {f"q{i + 1}[m]": command[:, i] for i in range(3)})
    compensate(model, alone, again, back=True)
    assert list(read_table(again).units) == [
        "q1",
        "q2",
        "q3",
        "ideal_q1",
        "ideal_q2",
        "ideal_q3",
        "inside_domain",
        "status",
    ]
    np.testing.assert_allclose(columns(again, "ideal_q1", "ideal_q2", "ideal_q3"), joints, rtol=1e-15)


@pytest.mark.parametrize("form", ["safetensors", "onnx"])
def test_standard_deviations_stand_after_the_other_columns(
    folder: Path, tmp_path: Path, ideal: Path, tripod: Compensator, form: str
) -> None:
    plain, out = tmp_path / "plain.csv", tmp_path / "out.csv"
    compensate(folder / f"model.{form}", ideal, plain)
    compensate(folder / f"model.{form}", ideal, out, sd=True)
    before, table = read_table(plain), read_table(out)
    added = {"deviation_sd_q1": "m", "deviation_sd_q2": "mm", "deviation_sd_q3": "m"}
    assert list(table.units.items()) == [*before.units.items(), *added.items()]
    command = torch.from_numpy(columns(out, "command_q1", "command_q2", "command_q3"))
    expected = tripod.sd(command).detach().numpy()
    np.testing.assert_allclose(columns(out, *added), expected, rtol=1e-9)
    np.testing.assert_allclose(expected[-1], tripod.safe_sd, rtol=1e-15)
    with pytest.raises(InputError, match="--sd and --back exclude each other"):
        compensate(folder / f"model.{form}", ideal, out, sd=True, back=True)


def test_it_says_how_many_rows_are_outside(folder: Path, tmp_path: Path, ideal: Path) -> None:
    app = typer.Typer()
    app.command()(compensate)
    arguments = [str(folder / "model.onnx"), str(ideal), str(tmp_path / "out.csv")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0 and "20 rows written" in result.output and "1 of them is outside" in result.output
    flat = " ".join(result.output.split())
    assert "1 of them is outside what was measured in q1, q2, q3 (inside_domain = 0)" in flat
    # A corner of the box of the joints, which no pose of the machine is near.
    model = load_model(folder / "model.safetensors")
    corner = np.where([True, False, False], *model.region.T[::-1]) * 0.99 + 0.01 * model.middle
    assert model.beyond(corner[None], None) == {"several inputs together"}
    assert CliRunner().invoke(app, [*arguments, "--quiet"]).output == ""


def test_covariates_come_from_the_table_in_any_unit(folder: Path, tmp_path: Path, arm: Compensator) -> None:
    table = {
        "q1[deg]": [20.0, 30.0],
        "q2[rad]": [1.0, -1.0],
        "time[min]": [10.0, 20.0],
        "temperature[degC]": [20.0, 22],
    }
    write_table(tmp_path / "in.csv", table)
    compensate(folder / "arm.onnx", tmp_path / "in.csv", tmp_path / "out.csv", quiet=True)
    joints = torch.tensor([[20.0, 30.0], [1.0, -1.0]], dtype=torch.float64).mT.clone()
    joints[:, 0] *= torch.pi / 180
    covariates = torch.tensor([[600.0, 293.15], [1200.0, 295.15]], dtype=torch.float64)
    expected = arm(joints, covariates)[0].numpy()
    np.testing.assert_allclose(columns(tmp_path / "out.csv", "command_q1", "command_q2"), expected, rtol=1e-14)
    write_table(tmp_path / "in.csv", {k: v for k, v in table.items() if not k.startswith("temp")})
    with pytest.raises(InputError, match="no column 'temperature'"):
        compensate(folder / "arm.onnx", tmp_path / "in.csv", tmp_path / "out.csv")


def test_poses_of_the_tripod(folder: Path, tmp_path: Path, tripod: Compensator) -> None:
    mechanism = load_mechanism("tripod")
    poses = mechanism.sample_workspace(30, torch.Generator().manual_seed(1))
    table = {"y[mm]": 1e3 * poses[:, 0].numpy(), "z[m]": poses[:, 1].numpy(), "phi[rad]": poses[:, 2].numpy()}
    write_table(tmp_path / "in.csv", table)
    compensate(folder / "model.onnx", tmp_path / "in.csv", tmp_path / "out.csv", pose=True)
    expected = tripod(mechanism.solve_inverse(poses))[0].numpy()
    command = columns(tmp_path / "out.csv", "command_q1", "command_q2", "command_q3")
    np.testing.assert_allclose(command, expected, rtol=1e-14)
    table["z[m]"][4] = 2.0
    write_table(tmp_path / "in.csv", table)
    reason = r"in\.csv: no joints of tripod were found for the pose at line 6 \(row 5\) \(z = 2 m; .* other 29 rows"
    with pytest.raises(InputError, match=reason):
        compensate(folder / "model.onnx", tmp_path / "in.csv", tmp_path / "out.csv", pose=True)
    reached = columns(tmp_path / "out.csv", "command_q1", "command_q2", "command_q3")
    np.testing.assert_array_equal(reached, np.delete(command, 4, 0))


@pytest.fixture
def planar(tmp_path: Path) -> Path:
    """A serial arm of two joints, described in the model by its DH table alone, with a constant deviation."""
    (tmp_path / "planar.yaml").write_text(PLANAR)
    mechanism = load_mechanism(str(tmp_path / "planar.yaml"))
    (tmp_path / "planar.yaml").unlink()
    joints = torch.rand(50, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 0.5
    ones, value = torch.ones(1, 50, dtype=torch.float64), torch.tensor([1e-3, -2e-3], dtype=torch.float64)
    zeros = torch.zeros(1, 50, 2, dtype=torch.float64)
    scaling = Scaling.fit(joints[None], zeros, ones, torch.zeros(2, dtype=torch.bool)).repeat(0)
    names = [Coordinate("q1", "rad"), Coordinate("q2", "rad")]
    compensator = fit_compensator(ConstantNetwork(value), scaling, joints, value.expand(50, 2), names)
    save_model(tmp_path, compensator, fields() | {"mechanism": mechanism.describe()}, forms=("safetensors",))
    return tmp_path / "model.safetensors"


def test_a_serial_arm_follows_its_branch_or_the_guess(planar: Path, tmp_path: Path) -> None:
    turn = np.linspace(0.2, 1.2, 4)
    elbow = {"up": -turn, "down": turn}
    x = 0.5 * np.cos(turn) + 0.4 * np.cos(2 * turn)
    y = 0.5 * np.sin(turn) + 0.4 * np.sin(2 * turn)
    poses = {"x[m]": x, "y[m]": y, "z[m]": 0 * x, "rx[rad]": 0 * x, "ry[rad]": 0 * x, "rz[rad]": 2 * turn}
    expected = np.stack([turn - 1e-3, elbow["down"] + 2e-3], -1)
    for guess in ({}, {"guess_q1[deg]": np.degrees(turn + 0.1), "guess_q2[deg]": np.degrees(turn - 0.1)}):
        write_table(tmp_path / "in.csv", poses | guess)
        compensate(planar, tmp_path / "in.csv", tmp_path / "out.csv", pose=True)
        command = columns(tmp_path / "out.csv", "command_q1", "command_q2")
        np.testing.assert_allclose(np.angle(np.exp(1j * (command - expected))), 0, atol=1e-9)
    write_table(tmp_path / "in.csv", {k: v for k, v in poses.items() if k[0] != "r"})
    with pytest.raises(InputError, match=r"need the columns rx\[rad\], ry\[rad\], rz\[rad\]"):
        compensate(planar, tmp_path / "in.csv", tmp_path / "out.csv", pose=True)
    write_table(tmp_path / "in.csv", poses | {"x[m]": x + 1})
    with pytest.raises(InputError, match="no joints of planar were found for the pose at lines"):
        compensate(planar, tmp_path / "in.csv", tmp_path / "out.csv", pose=True)


def test_branches_are_spoken_of_where_no_guess_chooses_one(
    planar: Path, tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = mechanism_from_description(load_model(planar).facts["mechanism"])
    there = arm.forward_kinematics(torch.tensor([0.3, 0.7], dtype=torch.float64)).tolist()
    poses = dict(zip([c.header for c in arm.pose], [[v] for v in there], strict=True))
    for guess, said in (({}, True), ({"guess_q1[rad]": [0.3], "guess_q2[rad]": [0.7]}, False)):
        write_table(tmp_path / "in.csv", poses | guess)
        compensate(planar, tmp_path / "in.csv", tmp_path / "out.csv", pose=True)
        assert ("give guess_q1[rad] to guess_q2[rad] near the joints wanted" in capsys.readouterr().out) is said
    mechanism = load_mechanism("tripod")
    y, z, phi = mechanism.home_pose.tolist()
    write_table(tmp_path / "in.csv", {"y[m]": [y], "z[m]": [z], "phi[rad]": [phi]})
    compensate(folder / "model.onnx", tmp_path / "in.csv", tmp_path / "out.csv", pose=True)
    assert "several branches" not in capsys.readouterr().out


def test_a_file_that_is_no_model_and_an_output_that_would_overwrite(folder: Path, ideal: Path, tmp_path: Path) -> None:
    out, model = tmp_path / "out.csv", folder / "model.onnx"
    with pytest.raises(ModelFileError, match=r"ideal\.csv: is no model file; one ends in \.safetensors, \.onnx, or"):
        compensate(ideal, ideal, out)
    config = tmp_path / "config.yaml"
    config.write_text("mechanism: five_bar\n")
    with pytest.raises(ModelFileError, match=r"config\.yaml is no model file: give identified\.yaml"):
        compensate(config, ideal, out)
    before = ideal.read_bytes()
    with pytest.raises(InputError, match=r"OUT\.csv is IN\.csv itself, which would be overwritten; name another file"):
        compensate(model, ideal, tmp_path / "x" / ".." / ideal.name)
    with pytest.raises(InputError, match=r"OUT\.csv is the model itself"):
        compensate(model, ideal, model)
    assert ideal.read_bytes() == before and not out.exists()


@pytest.mark.parametrize(
    ("header", "sentence"),
    [
        ("q1[m],q2[m]", "no column 'q3'"),
        ("q1[m],q2[m],q3[m],q4[m]", r"column 'q4' is no joint of this model, which was made for tripod \(q1\[m\]"),
        ("q1[rad],q2[m],q3[m]", "must be a length"),
        ("q1,q2[m],q3[m]", "has no unit"),
        ("q1[m],q2[m],q3[m],q3[m]", "occurs twice"),
    ],
)
def test_wrong_tables(folder: Path, tmp_path: Path, header: str, sentence: str) -> None:
    row = ",".join("1.0" for _ in header.split(","))
    (tmp_path / "in.csv").write_text(f"{header}\n{row}\n{row}\n")
    with pytest.raises(InputError, match=sentence):
        compensate(folder / "model.onnx", tmp_path / "in.csv", tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()


def test_degrees_headed_as_radians(folder: Path, tmp_path: Path) -> None:
    table = {"q1[rad]": [20.0, 30.0], "q2[rad]": [1.0, -1.0], "time[s]": [600.0, 1200], "temperature[K]": [293.0, 295]}
    write_table(tmp_path / "in.csv", table)
    with pytest.raises(InputError, match="looks like degrees"):
        compensate(folder / "arm.onnx", tmp_path / "in.csv", tmp_path / "out.csv")


def test_a_cell_that_is_no_number(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text("q1[m],q2[m],q3[m]\n1,1,1\n1,nan,1\n")
    with pytest.raises(InputError, match=r"column 'q2' has 'nan' at line 3"):
        compensate(folder / "model.onnx", tmp_path / "in.csv", tmp_path / "out.csv")


def test_pose_and_back_exclude_each_other(folder: Path, ideal: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="exclude each other"):
        compensate(folder / "model.onnx", ideal, tmp_path / "out.csv", pose=True, back=True)


def test_doors_of_packages_give_each_of_their_names() -> None:
    for package in ("", ".compensation", ".effects", ".learners", ".mechanisms", ".motion"):
        names = import_module(f"ccnn_torch{package}")
        assert names.__all__ and all(getattr(names, name) is not None for name in names.__all__)
    with pytest.raises(ImportError, match="cannot import name 'Tripd'"):
        exec("from ccnn_torch.mechanisms import Tripd")
