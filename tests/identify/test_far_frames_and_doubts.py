"""A measuring frame far away, a search that does not end, and rows that contradict the noise they are said to have."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import ccnn_torch
from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import IDENTIFY, Identification
from ccnn_torch.mechanisms import Framed, load_mechanism
from ccnn_torch.records import write_table

Cli = Callable[..., tuple[int, str, str]]
FAR = {"base_x": 2.0, "base_y": -1.0, "base_z": 0.5, "base_rx": 0.3, "base_ry": -0.2, "base_rz": 2.5}
FIVE_BAR_FREE = {"fixed": ["A*", "gamma*"]}


def records(path: Path, name: str, tool: bool = False, noise: float = 1e-5, count: int = 40) -> Path:
    """Rows of a machine with errors of about 1 mm, measured in a frame far away; `path`."""
    generator = torch.Generator().manual_seed(3)
    framed = Framed(load_mechanism(name), base=True, tool=tool)
    errors = 1e-3 * torch.randn(len(framed.geometry), generator=generator, dtype=torch.float64)
    values = framed.nominal + errors
    for i, parameter in enumerate(framed.geometry):
        fixed = parameter.name.startswith(("A", "gamma")) and name == "five_bar"
        values[i] = FAR.get(parameter.name, framed.nominal[i] if fixed else values[i])
    joints = framed.mechanism.sample_joints(count, generator)
    pose = framed.forward_kinematics(joints, values)
    pose = pose + noise * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    columns = dict(zip([c.header for c in (*framed.joints, *framed.pose)], [*joints.T, *pose.T], strict=True))
    write_table(path, {name: column.numpy() for name, column in columns.items()})
    return path


def identified(path: Path, **keys: object) -> Identification:
    return ccnn_torch.identify(records=str(path), noise="0.01 mm", save_report=False, **keys)


@pytest.mark.parametrize("name", ["five_bar", "stewart"])
def test_a_frame_two_metres_away_and_turned_is_found(name: str, tmp_path: Path) -> None:
    """LM from the nominal frame ended 400 mm off, for a machine without orientation."""
    path = records(tmp_path / "far.csv", name)
    fixed = FIVE_BAR_FREE if name == "five_bar" else {}
    found = identified(path, mechanism=name, frame={"base": True}, parameters=fixed)
    results = found.results
    assert results["methods"]["lm"]["converged"] == 1
    assert results["test"]["position"]["before"] < 0.02, "before the search the frame alone is fitted"
    assert results["test"]["position"]["after"] < 5e-5
    if name == "five_bar":
        for parameter, true in FAR.items():
            block = results["parameters"][parameter]
            assert abs(block["value"] - true) < 5 * block["sd"] + 1e-9, parameter
    assert results["doubts"] == []


def test_base_and_tool_far_away_are_found(tmp_path: Path) -> None:
    path = records(tmp_path / "far.csv", "stewart", tool=True, noise=1e-6)
    found = identified(path, mechanism="stewart", frame={"base": True, "tool": True}, parameters={"free": ["leg1.*"]})
    assert found.results["test"]["position"]["before"] < 0.02


@pytest.mark.parametrize("frames", [(True, False), (False, True), (True, True)])
def test_the_closed_form_is_exact_for_exact_poses(frames: tuple[bool, bool]) -> None:
    """For several machines at once, one of which has rows without a pose."""
    framed = Framed(load_mechanism("stewart"), *frames)
    generator = torch.Generator().manual_seed(0)
    values = framed.nominal.expand(2, -1).clone()
    free = [i for i, p in enumerate(framed.geometry) if p.name.startswith(("base_", "tool_"))]
    values[:, free] = torch.rand(2, len(free), generator=generator, dtype=torch.float64) * 2 - 1
    joints = framed.mechanism.sample_joints(20, generator).expand(2, -1, -1).clone()
    pose = framed.forward_kinematics(joints, values[:, None])
    joints[1, :3] = 0.0
    torch.testing.assert_close(framed.fitted_frames(joints, framed.frame(pose)), values, rtol=0, atol=1e-8)


def test_points_in_a_plane_keep_the_side_of_its_normal() -> None:
    framed = Framed(load_mechanism("five_bar"))
    values = framed.nominal.clone()
    values[:6] = torch.tensor([0.1, 0.2, 0.3, 2.0, 1.0, -1.0], dtype=torch.float64)
    joints = framed.mechanism.sample_joints(12, torch.Generator().manual_seed(0))
    pose = framed.forward_kinematics(joints, values)
    torch.testing.assert_close(framed.fitted_frames(joints, framed.frame(pose)), values, rtol=0, atol=1e-8)
    few = framed.fitted_frames(joints[:2], framed.frame(pose[:2]))
    assert torch.equal(few, framed.nominal), "two points tell no frame"


def test_a_search_that_did_not_converge_identifies_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = IdentifyConfig.from_keys(
        mechanism="five_bar",
        records=str(records(tmp_path / "far.csv", "five_bar")),
        frame={"base": True},
        parameters=FIVE_BAR_FREE,
        settings={"lm": {"max_iterations": 1}},
        save_report=False,
        out=str(tmp_path / "out"),
    )
    with pytest.raises(MethodFailedError, match=r"lm did not converge, so nothing is identified.*starts=10"):
        IDENTIFY.start(config)
    results = json.loads((tmp_path / "out" / "identified.json").read_text())
    free = [p for p in results["parameters"].values() if p["free"]]
    assert free and all(not p["identifiable"] and p["sd"] is None for p in free)
    text = (tmp_path / "out" / "identified.md").read_text()
    assert text.split("\n\n")[1].startswith("lm did not converge, so nothing is identified")
    assert "brings" not in text and "95 %" not in text
    assert "lm did not converge" in capsys.readouterr().out.replace("\n", " ")
    assert not (tmp_path / "out" / "identified.yaml").exists(), "commands could come from it"


def test_some_machines_that_did_not_converge_are_named_first() -> None:
    from ccnn_torch.identification.page import identified_verdict

    found = ccnn_torch.identify(mechanism="five_bar", simulate={"machines": 4, "noise": 1e-6}, save_report=False)
    results = found.results
    assert identified_verdict(results).startswith("On 400 held-out") or identified_verdict(results).startswith("On ")
    results["methods"]["lm"]["converged"] = 0.75
    assert identified_verdict(results).startswith("lm did not converge on 1 of 4 machines, which the standard")


def test_an_error_that_grew_is_not_called_nearer(tmp_path: Path) -> None:
    from ccnn_torch.identification.page import identified_verdict

    block = {"before": 1e-3, "after": 2e-3, "unit": "m"}
    results = {"test": {"position": block, "rotation": None}, "method": "lm", "machines": 1, "rows": {"test": 9}}
    results["methods"] = {"lm": {"converged": 1, "machines": 1}}
    assert "the predicted pose is not nearer to the measured one" in identified_verdict(results)


def test_a_noise_that_does_not_fit_the_rows_is_doubted(tmp_path: Path) -> None:
    path = records(tmp_path / "rows.csv", "five_bar", noise=1e-4)
    keys = {"mechanism": "five_bar", "records": str(path), "frame": {"base": True}, "parameters": FIVE_BAR_FREE}
    right, small, large, unknown = (
        ccnn_torch.identify(noise=noise, refit=False, save_report=False, **keys).results["doubts"]
        for noise in ("0.1 mm", "0.005 mm", "1 mm", None)
    )
    assert right == [] and unknown == []
    assert "noise given does not fit" in small[0] and "too small" in small[0] and "17.7 times" in small[0]
    assert "times the noise" in small[1] and "something else is wrong" in small[1]
    assert len(large) == 1 and "too large" in large[0]


def test_an_error_that_stays_is_doubted_and_the_interval_sentence_goes(tmp_path: Path) -> None:
    path = records(tmp_path / "rows.csv", "five_bar")
    config = IdentifyConfig.from_keys(
        mechanism="five_bar",
        records=str(path),
        frame={"base": True},
        parameters={"free": ["base_z", "l1"]},
        save_report=False,
        out=str(tmp_path / "out"),
    )
    IDENTIFY.start(config, quiet=True)
    text = (tmp_path / "out" / "identified.md").read_text()
    assert "% of what it was: what was identified explains little of it." in text.split("\n\n")[2]
    assert "which these do not" in text and "95 %" not in text


def test_a_table_has_one_unit_for_each_kind(tmp_path: Path) -> None:
    path = records(tmp_path / "rows.csv", "five_bar")
    keys = {"mechanism": "five_bar", "frame": {"base": True}, "parameters": FIVE_BAR_FREE}
    identified(path, **keys).save(tmp_path / "out")
    text = (tmp_path / "out" / "identified.md").read_text().partition("Held-out")[0]
    assert "base_x [mm]" in text and "l1 [mm]" in text and "µm]" not in text
    assert "e+0" not in text


def test_too_few_rows_speak_of_parameters_and_not_of_a_linear_fit(tmp_path: Path) -> None:
    path = records(tmp_path / "few.csv", "five_bar", count=5)
    with pytest.raises(InputError, match=r"cannot determine 12 free parameters; measure at least") as said:
        identified(path, mechanism="five_bar", frame={"base": True}, parameters=FIVE_BAR_FREE)
    assert "linear" not in str(said.value)


def test_the_lean_of_parallel_axes_is_found(tmp_path: Path, cli: Cli) -> None:
    """A SCARA's second axis leans by 0.5 mrad, which a Denavit-Hartenberg table alone cannot follow."""
    rng = np.random.default_rng(2)
    joints = rng.uniform([-2, -2, -0.15], [2, 2, 0], (60, 3))
    lean = np.array([[1, 0, -3e-4], [0, 1, -4e-4], [3e-4, 4e-4, 1]])
    a, b = joints[:, 0], joints[:, 1]
    elbow = 0.3 * np.stack([np.cos(a), np.sin(a), 0 * a], -1)
    fore = np.stack([0.25 * np.cos(b), 0.25 * np.sin(b), joints[:, 2]], -1) @ lean.T
    turn = np.array([[np.cos(a), -np.sin(a), 0 * a], [np.sin(a), np.cos(a), 0 * a], [0 * a, 0 * a, 1 + 0 * a]])
    place = elbow + np.einsum("ijk,kj->ki", turn, fore) + rng.normal(0, 8e-6, (60, 3))
    columns = {"q1[rad]": a, "q2[rad]": b, "q3[m]": joints[:, 2]}
    write_table(tmp_path / "rows.csv", columns | {f"{c}[m]": place[:, k] for k, c in enumerate("xyz")})
    (tmp_path / "arm.yaml").write_text(
        "dof: 3\nconvention: standard Denavit-Hartenberg\nunits: {length: m, angle: deg}\n"
        "joint_types: [revolute, revolute, prismatic]\na: [0.3, 0.25, 0]\nalpha: [0, 0, 0]\nd: [0, 0, 0]\n"
        "theta: [0, 0, 0]\nbase_frame: unknown\ntool_offset: [0, 0, 0]\n"
    )
    words = (f"records={tmp_path / 'rows.csv'}", f"mechanism={tmp_path / 'arm.yaml'}", "save_report=false")
    code, *_ = cli("identify", *words, "links=given", "--out", tmp_path / "given")
    assert code != 0
    code, *_ = cli("identify", *words, "--out", tmp_path / "lean")
    found = json.loads((tmp_path / "lean" / "identified.json").read_text())
    assert code == 0 and found["test"]["position"]["after"] < 2e-5
    lean = found["parameters"]["beta1"]
    assert abs(lean["value"] + 3e-4) < 4 * lean["sd"] < 1e-4
