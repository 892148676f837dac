"""`ccnn compensate` part by part: the same as at once, in bounded memory, whole or not at all."""

from __future__ import annotations

import csv
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from stand_ins import Sigmoids, fields, tripod_joints
from torch import Tensor

from ccnn_torch.compensation import Compensator, LoadedModel, load_compensation, register_network, save_model
from ccnn_torch.compensation.job import sentences, write_compensated
from ccnn_torch.compensation.model_files.identified import load_geometry
from ccnn_torch.compensation.wanted import WantedPoses
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.mechanisms.mechanism_file import write_machine
from ccnn_torch.records import read_table, write_table
from ccnn_torch.records.read_table import read_parts
from ccnn_torch.units import from_si

Cli = Callable[..., tuple[int, str, str]]

ARM = """
dof: 6
convention: standard Denavit-Hartenberg
units: {length: m, angle: rad}
a: [0.05, 0.5, 0.05, 0.0, 0.0, 0.0]
alpha: [1.5707963267948966, 0.0, 1.5707963267948966, -1.5707963267948966, 1.5707963267948966, 0.0]
d: [0.3, 0.0, 0.0, 0.4, 0.0, 0.1]
theta: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
base_frame: identity
tool_frame: identity
"""


class Hungry(Sigmoids):
    """Asks for a petabyte where it gets more than one row, as a model does that gets too many."""

    def forward(self, features: Tensor) -> Tensor:
        torch.empty(1 if features.shape[0] == 1 else 1 << 50, dtype=torch.uint8)
        return super().forward(features)

    def describe(self) -> dict[str, object]:
        return {"kind": "hungry", "sizes": self.sizes}


register_network("hungry", Hungry)


def numbers(path: Path) -> dict[str, np.ndarray]:
    table = read_table(path)
    return {table.header(name): table.raw(name) for name in table.names}


def assert_same(one: Path, other: Path) -> None:
    a, b = numbers(one), numbers(other)
    assert list(a) == list(b)
    for name in a:
        np.testing.assert_allclose(a[name], b[name], rtol=1e-13, atol=1e-15, err_msg=name)


@pytest.mark.parametrize("form", ["safetensors", "onnx"])
def test_parts_give_what_the_whole_gives(folder: Path, tmp_path: Path, form: str) -> None:
    joints = tripod_joints(23).numpy()
    joints[-1] += 3
    write_table(tmp_path / "in.csv", {f"q{k + 1}[m]": joints[:, k] for k in range(3)})
    loaded = load_compensation(folder / f"model.{form}")
    found = [
        write_compensated(loaded, tmp_path / "in.csv", tmp_path / f"{rows}.csv", sd=True, rows=rows)
        for rows in (1, 5, 100)
    ]
    assert found[0] == found[1] == found[2] and found[0].rows == 23 and found[0].outside == 1
    assert_same(tmp_path / "1.csv", tmp_path / "100.csv")
    assert_same(tmp_path / "5.csv", tmp_path / "100.csv")


def test_an_arm_keeps_its_branch_from_part_to_part(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(ARM)
    arm = load_mechanism(str(tmp_path / "arm.yaml"))
    write_machine(arm, arm.describe()["parameters"], tmp_path, "identified", {})
    # A wrist that turns away from the first guess, which is nearer to the other branch in the end.
    joints = arm.home_joints + torch.zeros(9, 6, dtype=torch.float64)
    joints[:, [3, 5]] += torch.linspace(0.0, 2.6, 9, dtype=torch.float64)[:, None]
    joints[:, 4] += 0.8
    poses = arm.forward_kinematics(joints).numpy()
    write_table(tmp_path / "in.csv", dict(zip([c.header for c in arm.pose], poses.T, strict=True)))
    loaded = load_compensation(tmp_path / "identified.yaml")
    for rows in (2, 100):
        write_compensated(loaded, tmp_path / "in.csv", tmp_path / f"{rows}.csv", WantedPoses(loaded), rows=rows)
    assert_same(tmp_path / "2.csv", tmp_path / "100.csv")
    np.testing.assert_allclose(read_table(tmp_path / "2.csv").column("command_q4"), joints[:, 3], atol=1e-6)


def test_a_part_names_rows_as_the_file_does(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text("# a comment\n\nq1[m],q2[m],q3[m]\n1,1,1\n\n1,1,1\n1,,1\n")
    loaded = load_compensation(folder / "model.onnx")
    for rows in (1, 2, 9):
        with pytest.raises(InputError, match=r"column 'q2' is empty at line 7 \(row 3\)"):
            write_compensated(loaded, tmp_path / "in.csv", tmp_path / "out.csv", rows=rows)
    (tmp_path / "in.csv").write_text("q1[m],q2[m],q3[m]\n1,1,1\n1,1,1\n1,1\n")
    with pytest.raises(InputError, match=r"line 4 \(row 3\) has 2 cells"):
        write_compensated(loaded, tmp_path / "in.csv", tmp_path / "out.csv", rows=2)
    # The rows before the wrong one were computed, and are nowhere.
    assert [file.name for file in tmp_path.iterdir()] == ["in.csv"]


@pytest.mark.parametrize("kind", ["csv", "xlsx"])
def test_parts_of_a_file_are_its_rows_in_order(tmp_path: Path, kind: str) -> None:
    rows = [["q1[deg]", "remark"], *([str(k) if kind == "csv" else k, f"row {k}"] for k in range(7))]
    path = tmp_path / f"in.{kind}"
    if kind == "csv":
        path.write_bytes("\r\n".join(";".join(row) for row in rows).replace("0", "0,5").encode("utf-16"))
    else:
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append(row)
        book.save(path)
    whole, parts = read_table(path), list(read_parts(path, 3))
    assert [len(part) for part in parts] == [3, 3, 1] and [part.start for part in parts] == [0, 3, 6]
    np.testing.assert_array_equal(np.concatenate([part.values for part in parts]), whole.values)
    np.testing.assert_array_equal(np.concatenate([part.lines for part in parts]), whole.lines)
    assert [cell for part in parts for cell in part.cells("remark")] == whole.cells("remark")


def test_memory_that_runs_out_is_no_fault_of_the_model(tmp_path: Path, tripod: Compensator, cli: Cli) -> None:
    network = Hungry([3, 5, 3], seed=3, gain=0.5)
    hungry = Compensator(
        network, tripod.scaling, tripod.domain, tripod.limit, tripod.safe, tripod.joints, [], 0.1, 3
    )  # fmt: skip
    save_model(tmp_path, hungry, fields(), forms=("safetensors",))
    (tmp_path / "in.csv").write_text("q1[m],q2[m],q3[m]\n1,1,1\n1,1,1\n")
    code, _, said = cli("compensate", tmp_path / "model.safetensors", tmp_path / "in.csv", tmp_path / "out.csv")
    assert code == 2 and said.count("\n") == 1 and "not enough memory" in said and "model" not in said
    assert not (tmp_path / "out.csv").exists()


class Interrupting(Sigmoids):
    """Presses Ctrl-C where it gets more than one row."""

    def forward(self, features: Tensor) -> Tensor:
        if features.shape[0] > 1:
            signal.raise_signal(signal.SIGINT)
        return super().forward(features)

    def describe(self) -> dict[str, object]:
        return {"kind": "interrupting", "sizes": self.sizes}


register_network("interrupting", Interrupting)


def test_ctrl_c_leaves_the_old_file(tmp_path: Path, tripod: Compensator, cli: Cli) -> None:
    network = Interrupting([3, 5, 3], seed=3, gain=0.5)
    model = Compensator(
        network, tripod.scaling, tripod.domain, tripod.limit, tripod.safe, tripod.joints, [], 0.1, 3
    )  # fmt: skip
    save_model(tmp_path, model, fields(), forms=("safetensors",))
    (tmp_path / "in.csv").write_text("q1[m],q2[m],q3[m]\n1,1,1\n1,1,1\n")
    (tmp_path / "out.csv").write_text("old")
    files = sorted(tmp_path.iterdir())
    # A background job has the signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code, _, said = cli("compensate", tmp_path / "model.safetensors", tmp_path / "in.csv", tmp_path / "out.csv")
    finally:
        signal.signal(signal.SIGINT, before)
    assert code == 130 and said == "interrupted; nothing was written\n"
    assert (tmp_path / "out.csv").read_text() == "old" and sorted(tmp_path.iterdir()) == files


def test_texts_are_repeated_and_run_in_no_spreadsheet(folder: Path, tmp_path: Path, cli: Cli) -> None:
    cells = ["weld start", "=1+1", "@SUM(A1)", "+5", "-", '"a, b"', '"say ""on"""', "\t=2", ""]
    written = ["weld start", "'=1+1", "'@SUM(A1)", "5", "'-", "a, b", 'say "on"', "'=2", ""]
    lines = [f"1.12,1.13,1.12,{cell}" for cell in cells]
    (tmp_path / "in.csv").write_text("\n".join(["q1[m],q2[m],q3[m],remark", *lines]))
    assert cli("compensate", folder / "model.onnx", tmp_path / "in.csv", tmp_path / "out.csv")[0] == 0
    with (tmp_path / "out.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["remark"] for row in rows] == written
    assert all(float(row["q1[m]"]) == 1.12 for row in rows)


class Statuses(LoadedModel):
    """Says of every row how it was found: exact, outside, no number, damped, damped, …"""

    def __call__(self, joints: ArrayLike, covariates: ArrayLike | None = None, ways: Any = ()) -> dict[str, Any]:
        found = super().__call__(joints, covariates)
        states = np.minimum(np.arange(len(found["command"])), 3)
        return found | {"status": states, "ideal_status": states[::-1]}


def test_the_status_stands_after_inside_domain(tmp_path: Path) -> None:
    machine = load_mechanism("five_bar")
    write_machine(machine, {p.name: p.nominal for p in machine.geometry}, tmp_path, "identified")
    loaded = load_geometry(tmp_path / "identified.yaml")
    loaded.__class__ = Statuses
    joints = machine.sample_joints(5, torch.Generator().manual_seed(0)).numpy()
    write_table(tmp_path / "in.csv", {"q1[rad]": joints[:, 0], "q2[rad]": joints[:, 1]})
    found = write_compensated(loaded, tmp_path / "in.csv", tmp_path / "out.csv")
    names = read_table(tmp_path / "out.csv").names
    assert names[-2:] == ("inside_domain", "status") and found.damped == 2
    np.testing.assert_array_equal(read_table(tmp_path / "out.csv").column("status"), [0, 1, 2, 3, 3])
    told = sentences(tmp_path, found, loaded)[-1]
    assert "2 of them are near a singular pose or at a limit of the joints (key limits of the machine's file; " in told
    # The way back has one of its own.
    write_compensated(loaded, tmp_path / "in.csv", tmp_path / "out.csv", back=True)
    np.testing.assert_array_equal(read_table(tmp_path / "out.csv").column("status"), [3, 3, 2, 1, 0])


@pytest.mark.parametrize("guided", [True, False])
def test_joints_of_poses_are_in_the_units_of_the_file(tmp_path: Path, guided: bool) -> None:
    (tmp_path / "arm.yaml").write_text(ARM)
    arm = load_mechanism(str(tmp_path / "arm.yaml"))
    write_machine(arm, arm.describe()["parameters"], tmp_path, "identified", {})
    pose = arm.forward_kinematics(arm.home_joints).numpy()
    usual = {"m": "mm", "rad": "deg"}
    table = {
        f"{c.name}[{usual[c.unit]}]": [from_si(v, c.unit, usual[c.unit])] for c, v in zip(arm.pose, pose, strict=True)
    }
    if guided:
        table = {name.replace("deg", "rad"): np.radians(v) if "deg" in name else v for name, v in table.items()}
        table |= {
            f"guess_{c.name}[deg]": [np.degrees(v)] for c, v in zip(arm.joints, arm.home_joints.numpy(), strict=True)
        }
    write_table(tmp_path / "in.csv", table)
    loaded = load_compensation(tmp_path / "identified.yaml")
    write_compensated(loaded, tmp_path / "in.csv", tmp_path / "out.csv", WantedPoses(loaded))
    out = read_table(tmp_path / "out.csv")
    assert {out.units[f"command_q{k}"] for k in range(1, 7)} == {"deg"}
    command = [out.column(f"command_q{k}")[0] for k in range(1, 7)]
    np.testing.assert_allclose(command, arm.home_joints, atol=1e-7)


@pytest.fixture
def identified(tmp_path: Path) -> Path:
    """An arm whose links and tool differ from the nominal ones."""
    (tmp_path / "arm.yaml").write_text(ARM)
    arm = load_mechanism(str(tmp_path / "arm.yaml"))
    nominal = arm.describe()["parameters"]
    draw = torch.Generator().manual_seed(0)
    real = arm.with_nominal(arm.nominal + 1e-3 * torch.randn(len(arm.nominal), generator=draw, dtype=torch.float64))
    write_machine(real, nominal, tmp_path, "identified", {})
    return tmp_path / "identified.yaml"


def test_another_tool_in_another_frame_reaches_the_pose(identified: Path, tmp_path: Path, cli: Cli) -> None:
    loaded = load_compensation(identified)
    assert loaded.machine is not None
    real = loaded.machine.identified
    assert isinstance(real, SerialArm)
    tool, base = [0.01, 0.0, 0.12, 0.0, np.pi / 2, 0.0], [1.0, -0.5, 0.2, 0.0, 0.0, 0.3]
    joints = real.home_joints + 0.3 * torch.rand(9, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    joints[:, 4] += 0.6
    with_tool = real.with_nominal(torch.cat([real.nominal[:-6], torch.tensor(tool, dtype=torch.float64)]))
    # Poses of the tool in the workpiece's frame.
    there = Rotation.from_rotvec(base[3:]).inv()
    pose = with_tool.forward_kinematics(joints).numpy()
    wanted = np.concatenate(
        [there.apply(pose[:, :3] - base[:3]), (there * Rotation.from_rotvec(pose[:, 3:])).as_rotvec()], -1
    )
    guess = {f"guess_{c.header}": joints[:, k].numpy() for k, c in enumerate(real.joints)}
    write_table(tmp_path / "in.csv", dict(zip([c.header for c in real.pose], wanted.T, strict=True)) | guess)
    options = ("--pose", "--tool", "10mm,0,120mm,0,90deg,0", "--base", "1,-50cm,0.2,0,0,0.3")
    code, _, said = cli("compensate", identified, tmp_path / "in.csv", tmp_path / "out.csv", *options)
    assert code == 0, said
    out = read_table(tmp_path / "out.csv")
    command = np.stack([out.column(f"command_q{k}") for k in range(1, 7)], -1)
    reached = with_tool.forward_kinematics(torch.from_numpy(command)).numpy()
    np.testing.assert_allclose(reached, pose, atol=1e-7)


def test_a_tool_or_a_frame_that_cannot_be_taken(identified: Path, folder: Path, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "in.csv").write_text("y[m],z[m],phi[rad]\n0,1,0\n")
    for model, words, sentence in (
        (identified, ("--tool", "0,0,0,0,0,0"), "--tool: needs --pose"),
        (identified, ("--pose", "--tool", "0,0,0"), 'give x,y,z,rx,ry,rz with units, e.g. "10mm,0,120mm,0,90deg,0"'),
        (identified, ("--pose", "--base", "10deg,0,0,0,0,0"), "--base"),
        (identified, ("--pose", "--base", "inf,0,0,0,0,0"), "has a number that is not finite"),
        (
            folder / "model.onnx",
            ("--pose", "--base", "0,0,0,0,0,0"),
            "only an arm whose orientation was measured takes another",
        ),
    ):
        code, _, said = cli("compensate", model, tmp_path / "in.csv", tmp_path / "out.csv", *words)
        assert code == 2 and sentence in said and said.count("\n") == 1
