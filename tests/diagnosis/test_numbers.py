"""The numbers to enter mean what their words say: they are entered, and the machine's error goes."""

from __future__ import annotations

import math
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen

from ccnn_torch import diagnose, load_mechanism, load_records
from ccnn_torch.diagnosis import Diagnosis
from ccnn_torch.diagnosis.page.data import About
from ccnn_torch.diagnosis.page.first_screen import first_screen, numbers_table, where_words
from ccnn_torch.diagnosis.verdict.findings import findings
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.kinds.machine_file import template
from ccnn_torch.records import write_table
from ccnn_torch.report.json_files import plain

NOISE = 1e-5


def _gantry(*unknown_frames: str) -> SerialArm:
    """Slides along x, y and z; their travels are nowhere stated."""
    turn = math.pi / 2
    links = [[0.0, -turn, 0.0, 0.0], [0.0, turn, 0.0, turn], [0.0, 0.0, 0.0, 0.0]]
    return SerialArm(
        name="gantry",
        convention="standard",
        links=links,
        joint_types=["prismatic"] * 3,
        orientation="none",
        unknown_frames=unknown_frames,
    )


def _found(machine: SerialArm, folder: Path, error: np.ndarray, commands: np.ndarray) -> Diagnosis:
    with torch.no_grad():
        pose = machine.forward_kinematics(torch.from_numpy(commands + error)).numpy()
    pose = pose + NOISE * np.random.default_rng(1).standard_normal(pose.shape)
    columns = {f"q{i + 1}[m]": commands[:, i] for i in range(3)} | {f"{c}[m]": pose[:, i] for i, c in enumerate("xyz")}
    write_table(folder / "r.csv", columns)
    return diagnose(load_records(folder / "r.csv", machine), machine, noise=dict.fromkeys("xyz", NOISE))


def test_a_gain_says_from_where_it_counts(tmp_path: Path) -> None:
    commands = np.random.default_rng(0).uniform([0.0, 0.0, -0.4], [1.2, 0.8, 0.0], (150, 3))
    error = np.zeros_like(commands)
    error[:, 2] = 2e-3 * (commands[:, 2] + 0.2)
    found = plain(_found(_gantry(), tmp_path, error, commands).to_json())
    jsonschema.validate(found, frozen("diagnosis"))
    assert found["verdict"]["effects"] == ["joint_gain"]
    numbers = next(e for e in found["effects"] if e["name"] == "joint_gain")["parameters"]
    about = numbers["q3"]["about"]
    assert about["joint"] == "q3" and about["unit"] == "m"
    told = numbers["q3"]["value"] * (commands[:, 2] - about["value"]) + numbers["q3 zero"]["value"]
    np.testing.assert_allclose(told, error[:, 2], rtol=0, atol=5 * NOISE)
    table = numbers_table(found, 6)
    assert table is not None and f"joint 3, about q3 = {1e3 * about['value']:.3f} mm" in {r[0] for r in table.rows}
    assert "joint 3: 0.2" in first_screen(found, About())[0].text


def test_axes_out_of_square_are_told_before_a_device_that_does_the_same(tmp_path: Path) -> None:
    commands = np.random.default_rng(0).uniform([0.0, 0.0, -0.4], [1.2, 0.8, 0.0], (80, 3))
    # Row by row: what each joint's motion adds along the axes.
    matrix = 1e-6 * np.array([[120.0, -400.0, 250.0], [0.0, -80.0, -300.0], [0.0, 0.0, 60.0]])
    found = plain(_found(_gantry("base"), tmp_path, commands @ matrix.T, commands).to_json())
    effects = {e["name"]: e for e in found["effects"]}
    assert {*found["verdict"]["effects"]} == {"geometry", "joint_gain"} and found["verdict"]["probability"] > 0.95
    assert all("instrument" in effects[name]["indistinguishable_from"] for name in ("geometry", "joint_gain"))
    angles, leads = (effects[name]["parameters"] for name in ("geometry", "joint_gain"))
    np.testing.assert_allclose([leads[f"q{k}"]["value"] for k in (1, 2, 3)], matrix.diagonal(), rtol=0, atol=2e-5)
    told = [abs(angles[name]["value"]) for name in ("alpha1", "theta2", "alpha2")]
    np.testing.assert_allclose(told, np.abs(matrix[[0, 0, 1], [1, 2, 2]]), rtol=0, atol=3e-5)


def test_a_period_has_the_digits_that_its_waves_need(tmp_path: Path) -> None:
    commands = np.random.default_rng(0).uniform([0.0, 0.0, -0.4], [1.2, 0.8, 0.0], (200, 3))
    error = np.zeros_like(commands)
    error[:, 0] = 3e-4 * np.sin(2 * np.pi * commands[:, 0] / 0.03137 + 0.7)
    found = plain(_found(_gantry(), tmp_path, error, commands).to_json())
    table = numbers_table(found, 6)
    assert table is not None
    # As a reader enters them: from the text alone.
    told = np.zeros(len(commands))
    for name, value, *_ in table.rows:
        words = name.split()
        assert words[:2] == ["joint", "1"] and words[3] == "every" and words[5] == "mm" and value.endswith("µm")
        wave = {"sin,": np.sin, "cos,": np.cos}[words[2]]
        told += 1e-6 * float(value.split()[0]) * wave(2 * np.pi * commands[:, 0] / (1e-3 * float(words[4])))
    assert np.abs(told - error[:, 0]).max() < 1e-5


def test_the_second_crank_of_a_five_bar_counts_clockwise() -> None:
    machine = load_mechanism("five_bar")
    joints = machine.sample_joints(3, torch.Generator().manual_seed(0))
    names = [p.name for p in machine.geometry]
    for crank, way in ((1, 1.0), (2, -1.0)):
        parameter = machine.geometry[names.index(f"gamma{crank}")]
        turned = machine.nominal.clone()
        turned[names.index(parameter.name)] = 1e-3
        moved = machine.solve_inverse(machine.forward_kinematics(joints, turned)) - joints
        torch.testing.assert_close(moved[:, crank - 1], torch.full((3,), way * 1e-3).double(), rtol=0, atol=1e-9)
        assert parameter.sense == ("clockwise" if way < 0 else "")
    numbers = {"gamma2": {"value": -5e-4, "sd": 1e-5, "unit": "rad", "part": "leg 2", "nominal": 0.0}}
    results = {"effects": [{"name": "geometry", "parameters": numbers}], "verdict": {"effects": ["geometry"]}}
    numbers["gamma2"]["sense"] = "clockwise"
    table = numbers_table(results, 6)
    assert table is not None and table.rows[0][0] == "leg 2 gamma2, clockwise"


def test_a_wrong_theta_is_the_zero_of_a_joint() -> None:
    arm = load_mechanism("serial", name="arm", links=[[0.3, 0.0, 0.1, 0.0]] * 3, convention="standard")
    (sense,) = (p.sense for p in arm.geometry if p.name == "theta3")
    theta = {"value": -5e-4, "sd": 1e-5, "unit": "rad", "part": "link 3", "nominal": 0.0, "sense": sense}
    results = {
        "effects": [{"name": "geometry", "parameters": {"theta3": theta}}],
        "verdict": {"effects": ["geometry"]},
        "rows_set_aside": [],
    }
    (found,) = findings(results)
    assert "theta3 -500 µrad (zero of joint 3)" in found.text
    assert found.look.startswith("Zero of joint 3: master the axis again.")


@pytest.mark.parametrize(("rows", "said"), [([10, 90], ""), ([80, 20], "85 % of it in 20 % of the rows: load_y 0")])
def test_a_share_of_the_gap_is_compared_with_that_of_the_rows(rows: list[int], said: str) -> None:
    regimes = [
        {"from": low, "to": high, "share": share, "rows": count}
        for (low, high), share, count in zip([(-70.0, 0.0), (0.0, 70.0)], (0.15, 0.85), rows, strict=True)
    ]
    where = {"outputs": {}, "joints": {"q1": 1.0}, "legs": {}, "regions": [], "covariates": {"load_y": regimes}}
    results = {
        "where": where,
        "where_ci95": {"covariates": {"load_y": [[0.1, 0.2], [0.8, 0.9]]}},
        "verdict": {"none": False, "effects": ["geometry"], "probability": 0.9, "outside_library": False},
        "effects": [{"name": "geometry", "parameters": {}, "indistinguishable_from": []}],
    }
    assert "; ".join(where_words(results, About()))[: len(said)] == said
    assert bool(where_words(results, About())) == bool(said)


@pytest.mark.parametrize("base", ["identity", "unknown"])
def test_axes_of_a_gantry_that_are_not_square_are_no_coupling(tmp_path, base):
    (tmp_path / "gantry.yaml").write_text(template("gantry").replace("base_frame: unknown", f"base_frame: {base}"))
    draw = np.random.default_rng(4)
    commands = draw.uniform([0.05, 0.05, 0.02], [0.95, 0.75, 0.28], (70, 3))
    # y leans towards x by 300 um/m; formulas of this test.
    place = commands + np.outer(commands[:, 1], [3e-4, 0, 0]) + draw.normal(0, 5e-6, (70, 3))
    columns = {f"q{k + 1}[m]": commands[:, k] for k in range(3)}
    write_table(tmp_path / "r.csv", columns | {f"{axis}[m]": place[:, k] for k, axis in enumerate("xyz")})
    machine = load_mechanism(str(tmp_path / "gantry.yaml"))
    said = diagnose(load_records(tmp_path / "r.csv", machine), machine)
    assert said.verdict["effects"] == ["geometry"], said.verdict["text"]
    (entry,) = (e for e in said.to_json()["effects"] if e["name"] == "geometry")
    assert entry["parameters"]["squareness_xy"]["value"] == pytest.approx(3e-4, abs=4e-5)
