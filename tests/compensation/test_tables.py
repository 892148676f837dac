"""`ccnn export --to table|urdf|onnx`: error tables with what they leave, and identified arms in a simulator."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from kinds import masked
from machines import known, small_network
from stand_ins import fields, tripod_compensator
from torch import Tensor

from ccnn_torch import export_model
from ccnn_torch.compensation import Compensator, fit_compensator, load_model, save_model
from ccnn_torch.compensation.model_files.metadata import open_onnx
from ccnn_torch.compensation.targets.table import print_tables
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError, MethodFailedError, ModelFileError
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism
from ccnn_torch.mechanisms.kinds.machine_file import template
from ccnn_torch.mechanisms.mechanism_file import mechanism_text
from ccnn_torch.training import Scaling

Cli = Callable[..., tuple[int, str, str]]


class _Screws(torch.nn.Module):
    """Each joint's deviation follows from that joint alone, but the last one's from the first."""

    def forward(self, features: Tensor) -> Tensor:
        bent = torch.sigmoid(3 * features)
        return torch.cat([bent[..., :-1], bent[..., :1]], -1)


class _Backlash(torch.nn.Module):
    """As `_Screws`, but each joint stops short by a tenth on the way up, and beyond by as much on the way down."""

    def __init__(self, joints: int) -> None:
        super().__init__()
        self.joints = joints

    def forward(self, features: Tensor) -> Tensor:
        return torch.sigmoid(3 * features[..., : self.joints]) - 0.1 * features[..., self.joints :]


def on(machine: Mechanism, network: torch.nn.Module, size: float) -> Compensator:
    joints = machine.sample_joints(150, torch.Generator().manual_seed(3))
    n = joints.shape[1]
    blank, flat = torch.ones(1, len(joints), dtype=torch.float64), torch.zeros(n, dtype=torch.bool)
    scaling = Scaling.fit(joints[None], torch.zeros_like(joints)[None], blank, flat).repeat(0)
    scaling.deviation.fill_(size)
    with torch.no_grad():
        deviations = scaling.restore(network(scaling.features(joints)))
    return fit_compensator(network, scaling, joints, deviations, machine.joints)


def numbers(text: str) -> np.ndarray:
    return np.array([[float(v) for v in row] for row in [*csv.reader(text.splitlines())][1:]])


def test_the_grid_is_the_model_and_says_how_far_off_it_is_between() -> None:
    compensator = tripod_compensator()
    tables = print_tables(compensator, load_mechanism("tripod"))
    rows = numbers(tables["table.csv"])
    assert rows.shape == (27**3, 6)
    with torch.no_grad():
        found = compensator.deviation(torch.from_numpy(rows[:, :3].copy())).numpy()
    np.testing.assert_allclose(rows[:, 3:], found, rtol=0, atol=1e-18)
    # Between the points: what is stated is what a user finds at points of his own.
    stated = float(tables["README.md"].partition("the table is off by ")[2].split()[0])
    grid = rows.reshape(27, 27, 27, 6)
    middle = torch.from_numpy((grid[:-1, :-1, :-1, :3] + grid[1:, 1:, 1:, :3]).reshape(-1, 3) / 2)
    mean = sum(grid[i : i + 26, j : j + 26, k : k + 26, 3:] for i in (0, 1) for j in (0, 1) for k in (0, 1)) / 8
    inside = (compensator.domain.excess(middle) <= 0).squeeze(-1).numpy()
    with torch.no_grad():
        off = (compensator.deviation(middle).numpy() - mean.reshape(-1, 3))[inside]
    assert 0.2 * stated < np.sqrt(np.mean(off**2)) < 5 * stated < 0.02 * float(compensator.limit.max())
    # A tripod has no mesh.
    assert "klipper_mesh.cfg" not in tables


def test_tables_of_single_axes_where_one_suffices() -> None:
    machine = load_mechanism("delta_linear")
    compensator = on(machine, _Screws(), 2e-4)
    tables = print_tables(compensator, machine)
    assert {f"linuxcnc_q{j}.comp" for j in (1, 2)} < {*tables} and "linuxcnc_q3.comp" not in tables
    # Position, and what is added to it, in mm: the deviation with the other sign.
    screw = np.array([[float(v) for v in line.split()] for line in tables["linuxcnc_q1.comp"].splitlines()])
    assert screw.shape == (64, 3) and (screw[:, 1] == screw[:, 2]).all() and (np.diff(screw[:, 0]) > 0).all()
    joints = compensator.domain.centre.repeat(40, 1)
    joints[:, 0] += torch.linspace(-0.55, 0.55, 40, dtype=torch.float64) * compensator.domain.half_range[0]
    with torch.no_grad():
        wanted = compensator.deviation(joints)[:, 0].numpy() * 1e3
    found = -np.interp(joints[:, 0] * 1e3, screw[:, 0], screw[:, 1])
    assert np.abs(found - wanted).max() < 0.1 * np.ptp(wanted)
    table = tables["heidenhain_q1.com"].splitlines()
    assert (
        table[0] == "BEGIN Q1.COM MM"
        and table[-1] == "[END]"
        and table[1].split() == [*("NR", "AXISPOS", "BACKLASH", "Q1")]
    )
    np.testing.assert_allclose([float(line.split()[3]) for line in table[2:-1]], -screw[:, 1], atol=1e-5)
    # The mesh: what is added to z, so that the tool is there.
    mesh = dict(line.split(" = ") for line in tables["klipper_mesh.cfg"].splitlines() if " = " in line)
    rows = [line for line in tables["klipper_mesh.cfg"].splitlines() if line.startswith("    ")]
    assert len(rows) == int(mesh["y_count"]) == 9
    low, high = machine.bounds
    pose = ((low + high) / 2).unsqueeze(0)
    with torch.no_grad():
        joints = machine.solve_inverse(pose)
        missed = machine.forward_kinematics(joints + compensator.deviation(joints)) - pose
    assert abs(float(rows[4].split(",")[4]) + 1e3 * float(missed[0, 2])) < 1e-6
    assert float(mesh["min_x"]) == pytest.approx(1e3 * float(low[0]))


# In the form of https://infosys.beckhoff.com, TF5200 axis compensation, "Example of a compensation value list", and of
# https://www.isg-stuttgart.de/fileadmin/kernel/kernel-html/en-GB/296429067.html.
SSFK_SAMPLE = (
    "kopf.log_achs_nr      2\nkw.ssfk.unit    1\nkw.ssfk.table[0].setpoint   -200000\nkw.ssfk.table[0].pos   24\n"
)
ISG_SAMPLE = "// Comment.\nX      EXX    EYX\n0.0    0.02   0.01\n10.0   0.00   -0.1\n"


def read_ssfk(text: str) -> dict[str, str]:
    return dict(line.split() for line in text.splitlines())


def read_isg(text: str) -> tuple[list[str], np.ndarray]:
    header, *rows = (line.split() for line in text.splitlines() if not line.startswith("//"))
    return header, np.array(rows, float)


def test_beckhoff_has_both_directions_of_an_axis_and_the_grid_of_a_gantry(tmp_path: Path) -> None:
    assert read_ssfk(SSFK_SAMPLE)["kw.ssfk.table[0].pos"] == "24"
    assert read_isg(ISG_SAMPLE)[0] == ["X", "EXX", "EYX"] and read_isg(ISG_SAMPLE)[1][1, 2] == -0.1
    tables = print_tables(with_backlash(together=False), None)
    entries = read_ssfk(tables["beckhoff_axis_q2.lis"])
    count = int(entries["kw.ssfk.kw_nr_max"])
    screw = np.array([[float(v) for v in line.split()] for line in tables["linuxcnc_q2.comp"].splitlines()])
    found = [[int(entries[f"kw.ssfk.table[{i}].{k}"]) for k in ("setpoint", "pos", "neg")] for i in range(count)]
    # Actual less commanded in 0.1 um, where LinuxCNC has what is added [mm].
    np.testing.assert_allclose(1e-4 * np.array(found) * [1, -1, -1], screw, atol=6e-5)
    assert entries["kopf.log_achs_nr"] == "2" and entries["kw.ssfk.unit"] == entries["kw.ssfk.bilateral"] == "1"
    (tmp_path / "gantry.yaml").write_text(template("gantry").replace("base_frame: unknown", "base_frame: identity"))
    nominal = load_mechanism(str(tmp_path / "gantry.yaml"))
    values = dict(zip((p.name for p in nominal.geometry), nominal.nominal.tolist(), strict=True))
    changed = values | {"lead_x": 3e-4, "squareness_xy": -4e-4, "squareness_yz": 5e-4}
    real = nominal.with_nominal(torch.tensor([*changed.values()], dtype=torch.float64))
    (tmp_path / "identified.yaml").write_text(mechanism_text(real, values))
    files = export_model(tmp_path / "identified.yaml", "beckhoff", tmp_path / "out")
    header, rows = read_isg(files["beckhoff_grid.csv"].read_text())
    assert header == ["X", "Y", "Z", "EXX", "EYX", "EZX"] and len(rows) < 2000
    x, y, z = rows[:, :3].T
    # Written out: the true place less the commanded one.
    wanted = np.stack([3e-4 * x - 4e-4 * y, 5e-4 * z, 0 * z], -1)
    np.testing.assert_allclose(rows[:, 3:], wanted, atol=5e-4)
    readme = files["README.md"].read_text()
    assert "`file_format[0] ISG_CSV`" in readme and "beckhoff_grid.csv`: X, Y, Z, linear between the points" in readme


def with_backlash(together: bool) -> Compensator:
    machine = load_mechanism("delta_linear")
    generator = torch.Generator().manual_seed(3)
    joints = machine.sample_joints(300, generator)
    ways = (torch.randint(0, 2, joints.shape, generator=generator) * 2 - 1).double()
    ways = ways[:, :1].expand_as(ways) if together else ways
    inputs, network = torch.cat([joints, ways], -1), _Backlash(3)
    blank, flat = torch.ones(1, len(joints), dtype=torch.float64), torch.zeros(6, dtype=torch.bool)
    scaling = Scaling.fit(inputs[None], torch.zeros_like(joints)[None], blank, flat).repeat(0)
    scaling.deviation.fill_(2e-4)
    with torch.no_grad():
        deviations = scaling.restore(network(scaling.features(inputs)))
    names = [Coordinate(f"direction{k}", "1") for k in (1, 2, 3)]
    return fit_compensator(network, scaling, inputs, deviations, machine.joints, names)


def test_tables_of_single_axes_hold_both_directions_of_approach() -> None:
    compensator = with_backlash(together=False)
    tables = print_tables(compensator, None)
    screw = np.array([[float(v) for v in line.split()] for line in tables["linuxcnc_q2.comp"].splitlines()])
    table = [line.split() for line in tables["heidenhain_q2.com"].splitlines()[2:-1]]
    joints = compensator.domain.centre[:3].repeat(30, 1)
    joints[:, 1] += torch.linspace(-0.5, 0.5, 30, dtype=torch.float64) * compensator.domain.half_range[1]
    for column, way in ((1, 1.0), (2, -1.0)):
        ways = torch.tensor([0.0, way, 0.0], dtype=torch.float64).expand(30, 3)
        with torch.no_grad():
            wanted = compensator.deviation(joints, ways)[:, 1].numpy() * 1e3
        found = -np.interp(joints[:, 1] * 1e3, screw[:, 0], screw[:, column])
        assert np.abs(found - wanted).max() < 2e-3
    # 2e-4 m times 0.1 short of the command upwards, and so much beyond it downwards.
    np.testing.assert_allclose(screw[:, 1] - screw[:, 2], 0.04, atol=2e-3)
    np.testing.assert_allclose([float(row[2]) for row in table], screw[:, 1] - screw[:, 2], atol=1e-5)
    np.testing.assert_allclose([float(row[3]) for row in table], -screw[:, 1], atol=1e-5)
    assert "leaves in either direction 0.02" in tables["README.md"] and "(not those of" not in tables["README.md"]
    assert "`direction1 = 0`" in tables["README.md"]


def test_directions_that_are_known_only_together_are_not_told_apart() -> None:
    tables = print_tables(with_backlash(together=True), None)
    screw = [line.split() for line in tables["linuxcnc_q2.comp"].splitlines()]
    assert all(up == down for _, up, down in screw)
    assert (
        "not those of `q1`, `q2`, `q3`" in tables["README.md"]
        and "leaves in either direction 0.02" in tables["README.md"]
    )


def test_identified_links_go_back_into_a_simulator(tmp_path: Path, cli: Cli) -> None:
    about_arm = known("sliding arm")
    made = about_arm.compensator(0.0)
    arm, identified, joints = about_arm.mechanism, about_arm.identified, about_arm.joints
    assert isinstance(arm, SerialArm) and made.machine is not None
    about = fields() | {"mechanism": arm.describe()}
    path = save_model(tmp_path, made, about, forms=("safetensors",))["safetensors"]
    assert cli("export", path, "--to", "urdf", "--out", tmp_path / "robot")[0] == 0
    assert {p.name for p in (tmp_path / "robot").iterdir()} == {"robot.urdf", "robot.xml", "robot.yaml", "README.md"}
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot" / "robot.xml"))
    data, site = mujoco.MjData(model), 0
    # The tool's rotation is not determined by positions: that of the model counts.
    truth, nominal = arm.forward_frame(joints, made.machine.identified), arm.forward_frame(joints)
    torch.testing.assert_close(truth[0], arm.forward_frame(joints, identified)[0], rtol=0, atol=1e-12)
    assert (truth[0] - nominal[0]).norm(dim=-1).min() > 1e-7
    for k in range(10):
        data.qpos[:] = joints[k].numpy()
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.site_xpos[site], truth[0][k].numpy(), rtol=0, atol=1e-12)
        # MuJoCo takes a site that is turned by less than 1e-6 for one that is not.
        np.testing.assert_allclose(data.site_xmat[site].reshape(3, 3), truth[1][k].numpy(), rtol=0, atol=3e-6)
    # The table and the URDF are the same arm.
    again = load_mechanism(str(tmp_path / "robot" / "robot.yaml"))
    torch.testing.assert_close(again.forward_frame(joints)[0], truth[0], rtol=0, atol=1e-15)  # type: ignore[attr-defined]
    # From identified.yaml, as well.
    real = arm.with_nominal(made.machine.identified)
    names = [p.name for p in arm.geometry]
    text = mechanism_text(real, dict(zip(names, arm.nominal.tolist(), strict=True)))
    (tmp_path / "identified.yaml").write_text(text)
    export_model(tmp_path / "identified.yaml", "urdf", tmp_path / "second")
    assert (tmp_path / "second" / "robot.xml").read_text() == (tmp_path / "robot" / "robot.xml").read_text()
    files = export_model(tmp_path / "identified.yaml", "linuxcnc", tmp_path / "kins")
    assert "double ccnn_nominal" not in files["ccnnkins.comp"].read_text().replace("static void", "")
    assert "table.csv" in export_model(tmp_path / "identified.yaml", "table", tmp_path / "table")


def test_onnx_as_a_target(tmp_path: Path) -> None:
    compensator = masked(0.5)
    path = save_model(tmp_path, compensator, fields(), forms=("safetensors",))["safetensors"]
    files = export_model(path, "onnx", tmp_path / "out")
    assert {*files} == {"model.safetensors", "model.onnx", "model.float32.onnx", "card.json", "controller.onnx"}
    point = compensator.domain.centre[None].numpy()
    wanted = load_model(path)(point)
    assert np.abs(load_model(files["model.onnx"])(point)["command"] - wanted["command"]).max() < 1e-15
    session = open_onnx(files["controller.onnx"].read_bytes())
    assert [o.name for o in session.get_outputs()] == ["command", "deviation", "inside_domain", "status"]
    assert np.abs(session.run(["command"], {"joints": point})[0] - wanted["command"]).max() < 1e-15


def test_what_cannot_be_exported_says_so(tmp_path: Path, cli: Cli) -> None:
    path = save_model(tmp_path, tripod_compensator(), fields(), forms=("safetensors",))["safetensors"]
    for to, sentence in (
        ("urdf", "no identified links of an arm"),
        ("matlab", "there is no target 'matlab'; there are c99, st, linuxcnc, onnx, "),
    ):
        code, _, err = cli("export", path, "--to", to, "--out", tmp_path / "out")
        assert code == 2 and sentence in err and "Traceback" not in err
    assert not (tmp_path / "out").exists()
    with pytest.raises(MethodFailedError, match="too coarse"):
        wide = torch.rand(60, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        network, scaling, deviations = small_network(wide, 1e-5)
        names = [Coordinate(f"q{k}", "m") for k in range(10)]
        print_tables(fit_compensator(network, scaling, wide, deviations, names), None)
    bare = save_model(tmp_path / "bare", tripod_compensator(), fields() | {"mechanism": {"name": "x"}}, forms=())
    with pytest.raises(ModelFileError, match="needs the machine's kinematics"):
        export_model(bare["safetensors"], "linuxcnc", tmp_path / "out")
    with pytest.raises(InputError, match="no dtype"):
        export_model(path, "table", tmp_path / "out", dtype="float16")
