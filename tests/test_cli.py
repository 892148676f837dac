"""The command line: bad input is one sentence on stderr and exit code 2, and a run on real records works."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import read_table, write_table

ROOT = Path(__file__).parent.parent
EXPERIMENTS = ROOT / "experiments"
FAST = ["ccnn.generations=3", "ccnn.population=8", "ccnn.hidden=[3]", "ccnn.members=1", "ccnn.refinement_iterations=2"]
# Pages and pictures take seconds, and have tests of their own.
NO_REPORT = "save_report=false"
# Nor are causes looked for, and models compared, as in test_geometry_choice.py.
QUICK = [*FAST, NO_REPORT, "geometry=none", "effects=none"]
Cli = Callable[..., tuple[int, str, str]]


def tripod_records(path: Path, rows: int = 60, **changes: np.ndarray) -> Path:
    """Records of a tripod whose joints are off by 0.1 mm, in mm and degrees."""
    mechanism = load_mechanism("tripod")
    pose = mechanism.sample_workspace(rows, torch.Generator().manual_seed(0))
    joints = mechanism.solve_inverse(pose)
    reached = mechanism.forward_kinematics(joints + 1e-4, guess=pose)
    columns = {f"q{k + 1}[mm]": 1e3 * joints[:, k].numpy() for k in range(3)}
    columns |= {"y[mm]": 1e3 * reached[:, 0].numpy(), "z[mm]": 1e3 * reached[:, 1].numpy()}
    columns["phi[deg]"] = np.rad2deg(reached[:, 2].numpy())
    write_table(path, columns | changes)
    return path


def refused(outcome: tuple[int, str, str], *words: str) -> None:
    code, _, err = outcome
    assert code == 2, err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1, err
    for word in words:
        assert word in err, err


def test_help_has_examples_and_names_every_command(cli: Cli) -> None:
    code, out, _ = cli("--help")
    assert code == 0
    for command in ("run", "compensate", "keys"):
        assert command in out
        code, text, _ = cli(command, "--help")
        assert code == 0
        assert text.count("xample") and f"ccnn {command}" in text, command
        # typer shows the whole docstring by itself.
        lines = [line for line in text.splitlines() if line.strip().startswith(f"ccnn {command} ")]
        assert len(lines) == len(set(lines)) and text.count("Examples:") <= 1, command


def test_module_and_version() -> None:
    told = subprocess.run([sys.executable, "-m", "ccnn_torch", "--version"], capture_output=True, text=True, check=True)
    assert told.stdout.startswith("ccnn_torch 0.")


def test_every_key_is_listed_with_a_meaning(cli: Cli) -> None:
    code, out, _ = cli("keys")
    assert code == 0
    for key in ("seed", "split.kind", "ccnn.generations", "ccnn.members", "compensation.margin"):
        assert f"{key}=" in out


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("sede=1", ("sede", "seed")),
        ("ccnn.generation=4", ("ccnn.generation", "generations")),
        ("split.kind=grp", ("split.kind", "group")),
        ("ccnn.population=two", ("ccnn.population",)),
        ("seed", ("key=value",)),
        ("methods=[ccn]", ("methods", "ccnn")),
        ("variant=printed", ("variant", "machine_tool")),
        ("covariates=[temperature]", ("temperature",)),
    ],
)
def test_a_wrong_key_is_named_with_the_nearest_right_one(
    cli: Cli, tmp_path: Path, override: str, words: tuple[str, ...]
) -> None:
    out = tmp_path / "run"
    refused(cli("run", EXPERIMENTS / "tripod.yaml", f"out={out}", override), *words)
    assert not out.exists()


def test_two_wrong_keys_are_named_at_once(cli: Cli) -> None:
    refused(cli("run", EXPERIMENTS / "tripod.yaml", "sede=1", "ccnn.generation=4"), "sede", "ccnn.generation")


def test_missing_words_and_files_are_said_in_one_sentence(cli: Cli, tmp_path: Path) -> None:
    refused(cli("run"), "experiments/tripod.yaml")
    refused(cli("run", tmp_path / "no.yaml"), "no.yaml")
    refused(cli("rum"), "rum")
    refused(cli("run", "--resume", tmp_path), "config.yaml")
    refused(cli("run", EXPERIMENTS / "tripod.yaml", "--resume", tmp_path), "--resume")
    refused(cli("run", EXPERIMENTS / "records.yaml", "records=none.csv", "mechanism=tripod"), "none.csv")
    refused(cli("run", EXPERIMENTS / "records.yaml", "records=none.csv", "mechanism=tripd"), "tripd", "tripod")


def test_a_change_may_be_longer_than_the_name_of_a_file(cli: Cli) -> None:
    keys = f"mechanism_keys={{{', '.join(f'key_{i}: 0.1' for i in range(40))}}}"
    refused(cli("diagnose", keys), "--out DIR")
    refused(cli("run", keys), "no data is named")
    refused(cli("start", keys), "RECORDS.csv")
    files = ",".join(f"none_{i}.csv" for i in range(40))
    for words in ((f"records={files}",), ("--records", files)):
        refused(cli("diagnose", *words, "--mechanism", "tripod", "--out", "out"), "none_0.csv: there is no such file")


def test_bad_records_are_refused_by_file_row_and_column(cli: Cli, tmp_path: Path) -> None:
    def run(path: Path, *words: str) -> tuple[int, str, str]:
        out = tmp_path / "run"
        outcome = cli("run", EXPERIMENTS / "records.yaml", f"records={path}", "mechanism=tripod", f"out={out}", *words)
        assert not out.exists()
        return outcome

    good = tripod_records(tmp_path / "good.csv").read_text()

    def edited(old: str, new: str) -> Path:
        assert old in good
        path = tmp_path / "bad.csv"
        path.write_text(good.replace(old, new, 1))
        return path

    refused(run(edited("q2[mm]", "p2[mm]")), "bad.csv", "q2")
    refused(run(edited("q2[mm]", "q1[mm]")), "bad.csv", "q1")
    refused(run(edited("z[mm]", "zz[mm]")), "bad.csv", "z")
    refused(run(edited("z[mm]", "z")), "bad.csv", "z", "z[mm]")
    refused(run(edited("z[mm]", "z[deg]")), "bad.csv", "z")
    refused(run(edited("phi[deg]", "phi[rad]")), "phi", "deg")
    lines = good.splitlines()
    cells = lines[7].split(",")
    path = tmp_path / "nan.csv"
    path.write_text("\n".join([*lines[:7], ",".join(["nan", *cells[1:]]), *lines[8:]]))
    refused(run(path), "nan.csv", "line 8", "q1")
    path.write_text("\n".join(lines[:5]))
    refused(run(path), "nan.csv", "too few")
    refused(run(tripod_records(tmp_path / "far.csv", **{"z[mm]": np.full(60, 2000.0)})), "far.csv", "workspace")
    still = {f"q{k}[mm]": np.full(60, 900.0) for k in (1, 2, 3)}
    refused(run(tripod_records(tmp_path / "still.csv", **still)), "still.csv", "varies")


def test_own_records_train_compensate_and_come_back(cli: Cli, tmp_path: Path) -> None:
    records = tripod_records(tmp_path / "mine.csv")
    out = tmp_path / "run"
    code, shown, err = cli(
        "run", EXPERIMENTS / "records.yaml", f"records={records}", "mechanism=tripod", f"out={out}", *QUICK
    )
    assert code == 0, err
    assert "position" in shown and "are in results.json; --details shows them here." in " ".join(shown.split())
    results = json.loads((out / "results.json").read_text())
    position = results["pose"]["position"]
    # The same 0.1 mm everywhere: whatever learns at all takes nearly all of it away.
    assert position["after"]["rms"]["median"] < 0.05 * position["before"]["rms"]["median"]
    assert results["floor"] is None
    program, commands, again = (tmp_path / name for name in ("in.csv", "out.csv", "back.csv"))
    write_table(program, {f"q{k}[m]": np.linspace(0.95, 1.0, 5) for k in (1, 2, 3)})
    for model in ("model.onnx", "model.safetensors"):
        code, _, err = cli("compensate", out / model, program, commands)
        assert code == 0, err
        table = read_table(commands)
        assert table.names == (
            *("q1", "q2", "q3"),
            *("command_q1", "command_q2", "command_q3"),
            *("deviation_q1", "deviation_q2", "deviation_q3"),
            *("inside_domain", "status"),
        )
    code, _, err = cli("compensate", out / "model.pt2", program, commands)
    assert code == 2 and "never read back" in err and len(err.splitlines()) == 1
    write_table(again, {f"q{k}[m]": read_table(commands).column(f"command_q{k}", "m") for k in (1, 2, 3)})
    code, _, err = cli("compensate", out / "model.onnx", again, commands, "--back")
    assert code == 0, err
    assert np.allclose(read_table(commands).column("ideal_q1", "m"), np.linspace(0.95, 1.0, 5), atol=1e-15)


def test_the_real_robot_runs_from_the_shipped_records(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = [
        f"out={out}",
        "--quiet",
        *FAST,
        "ccnn.refinement_iterations=8",
        "save_models=false",
        NO_REPORT,
        "effects=none",
    ]
    code, _, err = cli("run", EXPERIMENTS / "ur10.yaml", *words)
    assert code == 0, err
    results = json.loads((out / "results.json").read_text())
    assert results["rows"]["train"] + results["rows"]["validation"] == 350
    # Damped by default, so that rows near a singularity are learned from like all others.
    assert results["records"]["rows_set_aside"] == []
    position = results["pose"]["position"]
    # Frames alone leave about 1.0 mm on this robot; a few refinement steps of three nodes already help.
    assert 0.9e-3 < position["before"]["rms"]["median"] < 1.2e-3
    assert position["after"]["rms"]["median"] < 0.85e-3
    assert position["not_compensable"]["rms"]["median"] < 1e-5
    # 0.42 to 0.43 mm is what geometric calibration leaves on this robot.
    assert 0.35e-3 < position["geometry"]["rms"]["median"] < 0.5e-3


def test_rows_near_a_singularity_are_set_aside_where_asked_for(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["damping=0", "rotation_weight=0.3", "methods=[constant]", "save_models=false", *QUICK]
    code, _, err = cli("run", EXPERIMENTS / "ur10.yaml", *words, f"out={out}", "--quiet")
    assert code == 0, err
    results = json.loads((out / "results.json").read_text())
    aside = results["records"]["rows_set_aside"]
    assert 0 < len(aside) < 50
    assert results["records"]["why_set_aside"]["condition"] == len(aside) == results["rows"]["not_trained_on"]
    assert any("near a singularity" in note for note in results["notes"])


@pytest.mark.parametrize("orientation", ["quaternion", "none"])
def test_orientation_as_a_quaternion_or_not_at_all(cli: Cli, tmp_path: Path, orientation: str) -> None:
    from scipy.spatial.transform import Rotation

    table = read_table(EXPERIMENTS / "data" / "ur10_b_500.csv")
    columns = {f"q{k}[rad]": table.column(f"q{k}", "rad") for k in range(1, 7)}
    columns |= {f"{name}[m]": table.column(name, "m") for name in "xyz"}
    if orientation == "quaternion":
        vector = np.stack([table.column(name, "rad") for name in ("rx", "ry", "rz")], -1)
        values = Rotation.from_rotvec(vector).as_quat()
        columns |= {f"q{name}[1]": values[:, k] for k, name in enumerate("xyzw")}
    records, out = tmp_path / "records.csv", tmp_path / "run"
    write_table(records, {name: column[:150] for name, column in columns.items()})
    words = [f"records={records}", f"out={out}", "save_models=false", "--quiet", *FAST, "geometry=none", "effects=none"]
    # A page without orientation is like no other one.
    words += [] if orientation == "none" else [NO_REPORT]
    code, _, err = cli("run", EXPERIMENTS / "ur10.yaml", *words)
    assert code == 0, err
    pose = json.loads((out / "results.json").read_text())["pose"]
    assert (pose["rotation"] is None) == (orientation == "none")


def test_a_users_own_learner_takes_part(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "run"
    learner = Path(__file__).parent / "toy.py"
    words = [f"out={out}", f"methods=[constant,{learner}:Descent]", "save_models=false", NO_REPORT]
    code, _, err = cli("run", EXPERIMENTS / "tripod.yaml", *words)
    assert code == 0, err
    assert set(json.loads((out / "results.json").read_text())["methods"]) == {"constant", "Descent"}
    refused(cli("run", EXPERIMENTS / "tripod.yaml", f"methods=[{learner}:linear_data]"), "toy.py", "learner")


@pytest.mark.parametrize(
    ("command", "text", "other"),
    [
        ("run", "mechanism: five_bar\nrecords: rows.csv\nnoise: 1e-4\n", "identify"),
        ("identify", "case: tripod\ntraining: {folds: 3}\n", "run"),
        ("suite", "mechanism: five_bar\nsimulate: {poses: 20}\n", "identify"),
        ("identify", "base: {case: tripod}\ncases: [{name: a}]\n", "suite"),
        ("run", "candidates: 200\nlimits: {x: [0, 1]}\n", "plan --config"),
    ],
)
def test_a_config_of_another_command_is_known(cli: Cli, tmp_path: Path, command: str, text: str, other: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    code, _, err = cli(command, path)
    assert code == 2 and err.strip() == f"{path}: this looks like a config for `ccnn {other}`"


def test_a_python_file_without_a_class_is_told_its_classes(cli: Cli, tmp_path: Path) -> None:
    path, none, broken = (tmp_path / name for name in ("arm.py", "none.py", "broken.py"))
    path.write_text("raise SystemExit\nclass Arm: ...\nclass Other: ...\n")
    none.write_text("x = 1\n")
    broken.write_text("def f(:\n")
    out = ("--poses", "8", "--out", tmp_path / "p.csv")
    for file, sentence in (
        (path, f"{path}: names no class; write {path}:Arm or {path}:Other"),
        (none, f"{none}: names no class, and has none; write path/to/file.py:Name"),
        (broken, f"{broken} line 1 is no valid Python: "),
        (tmp_path / "lost.py", f"{tmp_path / 'lost.py'}: there is no such file"),
    ):
        code, _, err = cli("plan", "--mechanism", file, *out)
        assert code == 2 and err.startswith(sentence)
    code, _, err = cli("plan", "--mechanism", "xyzzy", *out)
    assert code == 2 and "machine. Otherwise give" in err


def test_an_arm_in_the_place_of_a_config_and_many_wrong_keys_are_said_shortly(cli, tmp_path: Path) -> None:
    arm = tmp_path / "arm.yaml"
    arm.write_text("convention: standard\nalpha: [0]\na: [0]\n")
    code, _, err = cli("run", arm)
    assert code == 2 and "the file of a machine" in err and f"mechanism={arm}" in err
    strange = tmp_path / "strange.yaml"
    strange.write_text("".join(f"odd{k}: {k}\n" for k in range(50)))
    code, _, err = cli("run", strange)
    assert code == 2 and "and 42 more" in err and len(err) < 2000
