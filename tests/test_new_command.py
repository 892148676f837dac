"""`ccnn new`: from a stranger's table to a config that runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.cli.options import MECHANISMS, complete_mechanism
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.mechanisms.registry import REGISTRY
from ccnn_torch.starter import starter_config

Cli = Callable[..., tuple[int, str, str]]
QUICK = ("methods=[constant]", "geometry=none", "effects=none", "save_models=false", "save_report=false")
ARM = Path(__file__).parent.parent / "experiments" / "data" / "ur10.yaml"


def write(path: Path, headers: list[str], values: np.ndarray, separator: str = ",") -> Path:
    lines = [separator.join(headers), *(separator.join(f"{v:.9g}" for v in row) for row in values)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def delta(rows: int = 40) -> np.ndarray:
    """Joints in degrees and poses in mm of a delta robot whose joints are off by 1 mrad."""
    machine = load_mechanism("delta")
    joints = machine.solve_inverse(machine.sample_workspace(rows, torch.Generator().manual_seed(0)))
    pose = machine.forward_kinematics(joints + 1e-3)
    return np.concatenate([np.rad2deg(joints.numpy()), 1e3 * pose.numpy()], axis=1)


def arm(rows: int, places: int | None = None) -> np.ndarray:
    """Six joints in degrees, position in mm and KUKA angles in degrees, of an arm; at so many places only."""
    machine = load_mechanism(str(ARM))
    joints = machine.sample_joints(places or rows, torch.Generator().manual_seed(1)) / 4
    joints = joints.repeat(-(-rows // len(joints)), 1)[:rows]
    pose = machine.forward_kinematics(joints).numpy()
    return np.concatenate([np.rad2deg(joints.numpy()), 1e3 * pose[:, :3], np.zeros((rows, 3))], axis=1)


def test_from_strange_headers_to_a_finished_run(tmp_path: Path, cli: Cli) -> None:
    headers = ["No", "Axis_1", "Axis_2", "Axis_3", "X", "Y", "Z"]
    values = np.concatenate([np.arange(40)[:, None], delta()], axis=1)
    records, config = write(tmp_path / "mätning.csv", headers, values), tmp_path / "delta.yaml"
    # Without units, and with nobody to ask, nothing is guessed.
    code, _, err = cli("new", records, "--out", config)
    assert code == 2 and "--units mm,deg" in err and "Axis_1" in err and not config.exists()
    code, _, err = cli("new", records, "--units", "deg,mm", "--out", config)
    assert code == 2 and "--units" in err
    code, out, err = cli("new", records, "--units", "mm,deg", "--mechanism", "delta", "--out", config)
    assert code == 0, err
    assert f"ccnn diagnose --config {config}" in out
    text = config.read_text(encoding="utf-8")
    assert '"Axis_1": "q1[deg]"' in text and '"X": "x[mm]"' in text and "Not used: No" in text
    assert "# mechanism_keys: {base: " in text
    code, _, err = cli("run", config, *QUICK, "--out", tmp_path / "run", "--quiet")  # fmt: skip
    assert code == 0, err
    assert (tmp_path / "run" / "results.json").is_file()
    # The same config shows what the rows can show; a direction has no unit but 1.
    config.write_text(text.replace("columns:", 'columns:\n  "No": "direction1"'), encoding="utf-8")
    values[:, 0] = np.sign(np.arange(40) % 3 - 0.5)
    write(records, headers, values)
    code, out, err = cli("check", "--config", config)
    assert code == 0 and "direction1" in out, (out, err)
    # What is there is not lost.
    code, _, err = cli("new", records, "--units", "mm,deg", "--mechanism", "delta", "--out", config)
    assert code == 2 and "--force" in err
    assert cli("new", records, "--units", "mm,deg", "--mechanism", "delta", "--out", config, "--force")[0] == 0


def test_a_mechanism_that_is_built_in_needs_no_file(tmp_path: Path, cli: Cli) -> None:
    code, _, told = cli("new", "--mechanism", "five_bar", "--out", tmp_path / "a.yaml")
    assert code == 2 and "write mechanism: five_bar and mechanism_keys: {l: 0.75, L: 1.1, a: 0.5} into the" in told
    code, _, told = cli("new", "--mechanism", "framed", "--out", tmp_path / "a.yaml")
    assert code == 2 and "mechanism_keys: {mechanism: five_bar, keys: {l: 220 mm, " in told
    code, _, told = cli("new", "--mechanism", "serial", "--out", tmp_path / "a.yaml")
    assert code == 2 and "the kind of machine 'serial' is not known" in told and not list(tmp_path.iterdir())


def test_a_mechanism_is_guessed_only_where_one_fits(tmp_path: Path, cli: Cli) -> None:
    headers = ["q1[deg]", "q2[deg]", "q3[deg]", "x[mm]", "y[mm]", "z[mm]"]
    text, ready = starter_config(write(tmp_path / "a.csv", headers, delta()), tmp_path / "a.yaml")
    assert ready and 'mechanism: "delta"' in text and "columns:" not in text
    # Without units of the joints two built-in deltas fit.
    bare = write(tmp_path / "b.csv", ["q1", "q2", "q3", "x", "y", "z"], delta())
    text, ready = starter_config(bare, tmp_path / "b.yaml", units="mm,deg")
    assert not ready and "delta, delta_linear would fit" in text and "# mechanism:" in text
    (tmp_path / "b.yaml").write_text(text, encoding="utf-8")
    code, _, err = cli("run", tmp_path / "b.yaml", "--out", tmp_path / "run")
    assert code == 2 and "mechanism: records need it" in err
    asked: list[str] = []

    def answer(question: str) -> str:
        asked.append(question)
        return "delta" if "Mechanism" in question else "mm,deg"

    text, ready = starter_config(bare, tmp_path / "b.yaml", ask=answer)
    assert ready and len(asked) == 2 and '"q1": "q1[deg]"' in text
    with pytest.raises(InputError, match="it has 2 joints"):
        starter_config(bare, tmp_path / "b.yaml", mechanism="five_bar", units="mm,deg")


def test_a_german_export_runs_without_a_word(tmp_path: Path, cli: Cli) -> None:
    headers = ["Achse 1 [Grad]", "Achse 2 [Grad]", "Achse 3 [Grad]", "X [MM]", "Y [MM]", "Z [MM]", "Zeit [Min]"]
    headers += ["Hallentemp. [°C]", *(f"Anfahrt A{k}" for k in (1, 2, 3)), "Richtung 1"]
    generator = np.random.default_rng(0)
    beside = [np.arange(40), generator.normal(22, 1, 40), *generator.choice([-1, 1], (3, 40)), np.arange(40)]
    records = write(tmp_path / "messung.csv", headers, np.column_stack([delta(), *beside]), ";")
    assert cli("new", records, "--mechanism", "delta", "--out", tmp_path / "c.yaml")[0] == 0
    columns = RunConfig.from_file(tmp_path / "c.yaml").columns
    assert columns["Zeit[Min]"] == "time[Min]" and columns["Anfahrt A3"] == "direction3[1]"
    assert columns["Hallentemp.[°C]"] == "temperature[°C]" and "Richtung 1" not in columns
    code, _, err = cli("run", tmp_path / "c.yaml", *QUICK, "--out", tmp_path / "run", "--quiet")  # fmt: skip
    assert code == 0, err
    # A unit that is not read is as good as none: it is asked for, not copied.
    records.write_text(records.read_text(encoding="utf-8").replace("Grad", "grad"), encoding="utf-8")
    with pytest.raises(InputError, match="Achse 1, Achse 2, Achse 3 have no unit that is known"):
        starter_config(records, tmp_path / "d.yaml", mechanism="delta")
    assert '"q1[deg]"' in starter_config(records, tmp_path / "d.yaml", mechanism="delta", units="mm,deg")[0]


def test_an_arms_controller_names_and_repeated_targets(tmp_path: Path) -> None:
    headers = [*(f"A{k}[deg]" for k in range(1, 7)), "X[mm]", "Y[mm]", "Z[mm]", "A[deg]", "B[deg]", "C[deg]"]
    records = write(tmp_path / "kuka.csv", headers, arm(60, places=15), separator=";")
    text, ready = starter_config(records, tmp_path / "kuka.yaml", mechanism=str(ARM))
    (tmp_path / "kuka.yaml").write_text(text, encoding="utf-8")
    config = RunConfig.from_file(tmp_path / "kuka.yaml")
    assert ready and config.columns["A1[deg]"] == "q1[deg]" and config.columns["C[deg]"] == "kuka_c[deg]"
    assert config.split.kind == "group" and config.split.by == ["position:5mm"] and "KUKA" in text
    once = write(tmp_path / "once.csv", headers, arm(60))
    assert "kind: random" in starter_config(once, tmp_path / "once.yaml", mechanism=str(ARM))[0]
    assert "# FILL IN" in starter_config(once, tmp_path / "once.yaml")[0]


def test_joints_as_a_urdf_and_as_drivers_name_them(tmp_path: Path) -> None:
    chain = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/></joint>'
        for k, name in enumerate(("pan", "lift", "elbow"))
    )
    links = "".join(f'<link name="l{k}"/>' for k in range(4))
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{links}{chain}</robot>')
    for theirs in (
        ["pan.pos", "lift.pos", "elbow.pos"],
        ["actual_q_0", "actual_q_1", "actual_q_2"],
        ["Leg 1", "Leg 2", "Leg 3"],
        ["arm_1_joint"],
    ):
        names = [f"arm_{k}_joint" for k in (1, 2, 3)] if len(theirs) == 1 else theirs
        path = write(tmp_path / "r.csv", [*names, "speed_q_0", "x", "y", "z"], np.ones((9, 7)))
        text, _ = starter_config(path, tmp_path / "c.yaml", str(tmp_path / "r.urdf"), "mm,deg")
        assert all(f'"{name}": "q{k}[deg]"' in text for k, name in enumerate(names, 1)), text


def test_tables_without_joints_or_with_strange_text(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'looks like a joint .* columns: \{"x\[mm\]": "q1\[mm\]", …\}'):
        starter_config(write(tmp_path / "a.csv", ["x[mm]", "y[mm]"], np.zeros((3, 2))), tmp_path / "a.yaml")
    with pytest.raises(InputError, match="measured pose"):
        starter_config(write(tmp_path / "b.csv", ["q1[deg]", "q2[deg]"], np.zeros((3, 2))), tmp_path / "b.yaml")
    log = write(tmp_path / "log.csv", ["time", "command", "measured position", "current"], np.zeros((3, 4)))
    with pytest.raises(InputError, match=r"command1\[rad\].*ccnn diagnose --motion .*log.csv"):
        starter_config(log, tmp_path / "log.yaml")
    # A header cannot write keys of its own into the config.
    headers = ["q1[deg]", "q2[deg]", "x[mm]", "y[mm]", "a: 1 # out: /tmp/x", 'Time: "s" # out']
    values = np.random.default_rng(0).uniform(0.1, 1, (30, 6))
    text, _ = starter_config(write(tmp_path / "c.csv", headers, values), tmp_path / "c.yaml")
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    config = RunConfig.from_file(tmp_path / "c.yaml")
    assert config.out is None and config.mechanism == "five_bar"


def test_a_machine_file_is_written_without_records(tmp_path: Path, cli: Callable[..., tuple[int, str, str]]) -> None:
    out = tmp_path / "printer.yaml"
    code, said, _ = cli("new", "--mechanism", "delta_printer", "--out", out)
    assert code == 0 and f"mechanism={out}" in said
    assert load_mechanism(str(out)).name == "delta_printer"
    for words, wanted in (
        (("--mechanism", "delta_printer", "--out", out), "is there already"),
        (("--mechanism", "delta_printr", "--out", tmp_path / "other.yaml"), "did you mean 'delta_printer'"),
        (("--out", tmp_path / "other.yaml"), "give RECORDS.csv, or --mechanism KIND"),
        ((tmp_path / "rows.csv",), "--out: name the config"),
    ):
        code, _, told = cli("new", *words)
        assert code == 2 and wanted in told


def test_completion_knows_the_mechanisms() -> None:
    assert set(MECHANISMS) == set(REGISTRY) - {"serial", "framed", "partial", "instrument", "pair", "machine"}
    assert complete_mechanism("del") == ["delta", "delta_linear"]


def test_a_thermometer_of_a_strange_name_is_told_how_to_be_used(tmp_path: Path, cli: Cli) -> None:
    headers = ["q1[deg]", "q2[deg]", "q3[deg]", "x[mm]", "y[mm]", "z[mm]", "Fühler am Bett [degC]"]
    warm = np.linspace(20, 30, 40)[:, None]
    records = write(tmp_path / "rows.csv", headers, np.concatenate([delta(), warm], axis=1))
    config = tmp_path / "delta.yaml"
    made = cli("new", records, "--mechanism", "delta", "--out", config)
    assert made[0] == 0, made
    text = config.read_text(encoding="utf-8")
    line = next(one for one in text.splitlines() if "growth follows" in one)
    # What it says is what works.
    config.write_text(f"{text}\n{line.removeprefix('# ').partition(' makes')[0]}\n", encoding="utf-8")
    code, out, err = cli("check", "--config", config)
    assert code == 0 and "temperature" in out, (out, err)
