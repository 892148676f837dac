"""Blank cells of a pose: a row counts with the coordinates that were measured in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.api import identify
from ccnn_torch.calibration.calibrate import calibrate
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.diagnosis import diagnose
from ccnn_torch.errors import InputError
from ccnn_torch.identification.identify import Identification
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.records import load_records, write_table

Array = NDArray[np.float64]
Cli = Callable[..., tuple[int, str, str]]
NAN = float("nan")


def write(path: Path, machine: Mechanism, joints: Tensor, pose: Tensor) -> Path:
    columns = torch.cat([joints, pose], -1).T
    names = [c.header for c in (*machine.joints, *machine.pose)]
    write_table(path, {name: values.numpy() for name, values in zip(names, columns, strict=True)})
    return path


def printer(seed: int) -> tuple[Mechanism, Tensor, Tensor, Tensor, list[str]]:
    """A linear delta: rows of which 12 have x, y, z and 60 the height alone; and what is held at its nominal value."""
    machine = load_mechanism("delta_linear")
    generator = torch.Generator().manual_seed(seed)
    held = [p.name for p in machine.geometry if not p.name.startswith(("base", "rod", "offset"))]
    free = torch.tensor([p.name not in held for p in machine.geometry])
    truth = machine.nominal + 5e-4 * free * torch.randn(len(machine.geometry), generator=generator, dtype=torch.float64)
    joints = machine.sample_joints(72, generator)
    pose = machine.forward_kinematics(joints, truth)
    pose = pose + 1e-5 * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    pose[12:, :2] = NAN
    return machine, truth, joints, pose, held


def left(machine: Mechanism, found: Identification, truth: Tensor) -> float:
    """RMS error of the identified machine at new joints [m]."""
    joints = machine.sample_joints(200, torch.Generator().manual_seed(99))
    there, real = (machine.forward_kinematics(joints, v) for v in (found.outcomes["lm"].values[0], truth))
    return float((there - real)[:, :3].square().sum(-1).mean().sqrt())


def errors_in_sd(found: Identification, truth: Tensor) -> Tensor:
    """Errors of the parameters that the rows determine, in their stated standard deviations."""
    entries: dict[str, Any] = found.results["parameters"]
    names = [p.name for p in found.measured.mechanism.geometry]
    values = found.outcomes["lm"].values[0]
    sd = {n: e["sd"] for n, e in entries.items() if e.get("sd")}
    return torch.tensor([float(values[names.index(n)] - truth[names.index(n)]) / s for n, s in sd.items()])


def test_heights_beside_few_positions(tmp_path: Path) -> None:
    better, ratios = [], []
    for seed in range(4):
        machine, truth, joints, pose, held = printer(seed)
        keys = {
            "mechanism": "delta_linear",
            "parameters": {"fixed": held},
            "noise": "10 um",
            "split": {"test": 0.2},
            "refit": False,
        }
        mixed = identify(records=str(write(tmp_path / "m.csv", machine, joints, pose)), **keys)
        whole = identify(records=str(write(tmp_path / "w.csv", machine, joints[:12], pose[:12])), **keys)
        assert "x, y are missing in 60 of 72 rows, which count with what was measured" in mixed.results["notes"]
        better.append(left(machine, mixed, truth) / left(machine, whole, truth))
        ratios.append(errors_in_sd(mixed, truth))
    assert np.exp(np.mean(np.log(better))) < 0.8, better
    every = torch.cat(ratios)
    assert len(every) >= 12 and 0.4 < float(every.square().mean().sqrt()) < 1.7, every


def test_what_is_blank_and_what_is_not(tmp_path: Path) -> None:
    machine, _, joints, pose, _ = printer(0)
    file = write(tmp_path / "r.csv", machine, joints, pose)
    records = load_records(file, machine, learns=False)
    assert records.pose.isnan().equal(pose.isnan()) and int(records.whole.sum()) == 12
    lines = file.read_text().splitlines()

    def refused(row: str, *parts: str) -> None:
        file.write_text("\n".join([*lines[:30], row, *lines[31:]]) + "\n")
        with pytest.raises(InputError) as error:
            load_records(file, machine, learns=False)
        assert all(part in str(error.value) for part in parts), error.value

    refused("0.4,0.4,0.4,lost,,0.1", "column 'x' has 'lost' at line 31")
    refused("0.4,0.4,0.4,nan,,0.1", "column 'x' has 'nan' at line 31")
    refused("0.4,,0.4,,,0.1", "column 'q2' is empty at line 31")
    refused("0.4,0.4,0.4,,,", "nothing of the pose was measured at line 31")
    # All at once: the next try would find the next one.
    lines[40:42] = ["0.4,,0.4,,,0.1"] * 2
    refused("0.4,,,,,0.1", "column 'q2' is empty at lines 31, 41, 42", "also empty in q3 at line 31 (row 30); write")
    # Blank in all rows is no column.
    empty = write(tmp_path / "e.csv", machine, joints, torch.cat([pose[:, :2] * NAN, pose[:, 2:]], -1))
    assert [c.name for c in load_records(empty, machine, learns=False).pose_coordinates] == ["z"]


ARM = """
robot: small arm
dof: 6
units: {length: m, angle: rad}
convention: standard Denavit-Hartenberg
a: [0, -0.612, -0.5723, 0, 0, 0]
alpha: [1.5707963267948966, 0, 0, 1.5707963267948966, -1.5707963267948966, 0]
d: [0.1273, 0, 0, 0.163941, 0.1157, 0.0922]
theta: [0, 0, 0, 0, 0, 0]
"""


def arm(folder: Path) -> tuple[Mechanism, Tensor]:
    """Rows of a tracker that lost the orientation in 60 of 120, and 40 new ones; the true parameters."""
    (folder / "arm.yaml").write_text(ARM)
    machine = load_mechanism(str(folder / "arm.yaml"))
    generator = torch.Generator().manual_seed(3)
    size = torch.tensor([5e-4 if p.unit == "m" else 1e-3 for p in machine.geometry], dtype=torch.float64)
    size[:6], size[-6:] = 0.2, 0.05
    truth = machine.nominal + size * torch.randn(len(size), generator=generator, dtype=torch.float64)
    joints = machine.sample_joints(900, generator)
    joints = joints[machine.condition_number(joints) < 60][:160]
    noise = torch.tensor([2e-5] * 3 + [5e-5] * 3, dtype=torch.float64)
    pose = machine.forward_kinematics(joints, truth)
    pose = pose + noise * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    lost = pose.clone()
    lost[40:100, 3:] = NAN
    lost[130:140, 4] = NAN
    write(folder / "mixed.csv", machine, joints[:120], lost[:120])
    whole = torch.arange(120)[~lost[:120].isnan().any(-1)]
    write(folder / "whole.csv", machine, joints[whole], pose[whole])
    write(folder / "new.csv", machine, joints[120:], lost[120:])
    return machine, truth


def test_a_tracker_that_lost_the_orientation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli) -> None:
    monkeypatch.chdir(tmp_path)
    machine, truth = arm(tmp_path)
    left_by = {}
    for name in ("mixed", "whole"):
        made = identify(records=f"{name}.csv", mechanism="arm.yaml", refit=False, save_report=False)
        made.save(tmp_path / name)
        found = made.mechanism()
        joints = machine.sample_joints(200, torch.Generator().manual_seed(9))
        there, real = found.forward_kinematics(joints), machine.forward_kinematics(joints, truth)
        left_by[name] = float((there - real)[:, :3].square().sum(-1).mean().sqrt())
    assert left_by["mixed"] < 0.8 * left_by["whole"] and left_by["mixed"] < 3e-5, left_by
    code, out, err = cli("verify", "mixed/identified.yaml", "new.csv", "--out", "verified")
    # One of rx, ry, rz alone is no orientation.
    assert code == 0 and "rx, ry, rz are missing in 10 of 40 rows" in out, (out, err)


def test_a_diagnosis_weighs_what_was_measured(tmp_path: Path) -> None:
    machine, _ = arm(tmp_path)
    records = load_records(tmp_path / "mixed.csv", machine, learns=False)
    said = diagnose(records, machine, effects=["geometry", "joint_gain", "backlash"])
    assert said.verdict["effects"] == ["geometry"] and said.verdict["probability"] > 0.9
    assert "rx, ry, rz are missing in 60 of 120 rows, which count with what was measured" in said.content["notes"]
    # The gap is that of the rows in which there is one.
    gap = said.content["gap_rotation"]
    there = load_records(tmp_path / "whole.csv", machine, learns=False)
    alone = diagnose(there, machine, effects=["joint_gain"]).content["gap_rotation"]
    assert abs(gap["before"] / alone["before"] - 1) < 0.1


def test_a_run_learns_from_whole_poses_and_identifies_from_all(tmp_path: Path) -> None:
    machine, truth, joints, pose, _ = printer(0)
    write(tmp_path / "r.csv", machine, joints, pose)
    keys = {"records": str(tmp_path / "r.csv"), "mechanism": "delta_linear", "effects": "none", "refit": False}
    found = calibrate(RunConfig.from_keys(**keys, geometry="identify", methods=["constant"], split={"test": 0.2}))
    assert any("60 rows are not trained on: a part of their pose" in note for note in found.results.notes)
    assert found.results.records.why_set_aside["partial"] == 60
    wanted = machine.sample_workspace(100, torch.Generator().manual_seed(1))
    ideal = machine.solve_inverse(wanted)
    commands = found.compensator().solve(ideal).command
    sent = [(machine.forward_kinematics(q, truth) - wanted).norm(dim=-1) for q in (ideal, commands)]
    before, after = (float(e.square().mean().sqrt()) for e in sent)
    assert before > 1e-3 and after < 0.1 * before, (before, after)
    block = found.results.pose.position
    assert block.after.rms.median < 3e-5, block


def test_joints_of_a_part_of_a_pose_are_not_compared(tmp_path: Path) -> None:
    machine, _, joints, pose, held = printer(0)
    file = str(write(tmp_path / "r.csv", machine, joints, pose))
    keys = {"records": file, "mechanism": "delta_linear", "parameters": {"fixed": held}}
    for more, word in (
        ({"residual": "inverse"}, "residual: inverse"),
        ({"methods": ["lm_per_leg"]}, "methods: leg by leg"),
    ):
        with pytest.raises(InputError, match=f"{word} compares joints, which only a whole pose has"):
            identify(**keys, **more)
