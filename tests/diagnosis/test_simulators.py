"""Diagnosis with a simulator as the nominal machine; causes are put in by its own formulas, not by effects."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ccnn_torch.diagnosis import Diagnosis, diagnose, situation_of
from ccnn_torch.diagnosis.checks.identifiable import check_rows
from ccnn_torch.diagnosis.page.report import check_text
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records, write_table

Cli = Callable[..., tuple[int, str, str]]
FILE = Path(__file__).parents[2] / "experiments" / "my_simulator.py"
PRESS = f"{FILE}:PRESS"
NOISE = 1e-5


def _example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("my_simulator", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _measured(
    path: Path,
    parameters: tuple[float, ...] = (0.75, 1.1, 0.5, 4e4, 4e4),
    play: tuple[float, float] = (0.0, 0.0),
    payload: float | None = None,
    rows: int = 200,
    seed: int = 0,
) -> Path:
    """Records of a press with these parameters, whose cranks rest half their play short of the command."""
    g = np.random.default_rng(seed)
    commands = np.stack([g.uniform(1.7, 2.3, rows), g.uniform(0.8, 1.4, rows)], -1)
    side = np.sign(g.standard_normal((rows, 2)))
    covariates = {f"load_{c}": 60 * g.standard_normal(rows) for c in "xy"}
    covariates["payload"] = 2 * g.random(rows) if payload is None else np.full(rows, payload)
    pose = _example().simulate(commands - side * np.array(play) / 2, covariates, np.tile(parameters, (rows, 1)))
    pose = pose + NOISE * g.standard_normal(pose.shape)
    columns = {f"q{i + 1}[rad]": commands[:, i] for i in (0, 1)} | {f"{c}[m]": pose[:, i] for i, c in enumerate("xy")}
    columns |= {f"load_{c}[N]": covariates[f"load_{c}"] for c in "xy"} | {"payload[g]": 1e3 * covariates["payload"]}
    columns |= {f"direction{i + 1}[1]": side[:, i] for i in (0, 1)}
    write_table(path, columns)
    return path


def _diagnosed(path: Path) -> Diagnosis:
    mechanism = load_mechanism(PRESS)
    effects = ["geometry", "joint_offset", "backlash", "compliance", "parameter spring1", "parameter spring2"]
    return diagnose(load_records(path, mechanism, learns=False), mechanism, noise=NOISE, effects=effects)


def test_a_wrong_spring_is_found_under_load_by_its_name(tmp_path: Path) -> None:
    said = _diagnosed(_measured(tmp_path / "r.csv", (0.75, 1.1, 0.5, 4e4, 3.6e4)))
    assert said.verdict["effects"] == ["parameter spring2"] and not said.verdict["outside_library"]
    assert said.verdict["probability"] > 0.9 and said.verdict["shrink"] > 0.99
    found = said.effects[0]["parameters"]["spring2"]
    assert found["unit"] == "N*m/rad" and 0 < found["sd"] < 100
    assert abs(found["value"] + 4e3) < 4 * found["sd"]
    assert "a wrong value of the parameter spring2 explains it" in said.verdict["text"].lower()


def test_play_is_told_from_the_simulators_own_parameters(tmp_path: Path) -> None:
    said = _diagnosed(_measured(tmp_path / "r.csv", play=(2e-4, 1e-4)))
    assert said.verdict["effects"] == ["backlash"] and not said.verdict["outside_library"]
    found = {name: said.effects[0]["parameters"][name]["value"] for name in ("q1", "q2")}
    assert found == pytest.approx({"q1": 2e-4, "q2": 1e-4}, rel=0.25)


def test_wrong_lengths_are_geometry(tmp_path: Path) -> None:
    said = _diagnosed(_measured(tmp_path / "r.csv", (0.7505, 1.1003, 0.4996, 4e4, 4e4)))
    assert said.verdict["effects"] == ["geometry"]
    assert list(said.effects[0]["parameters"]) == ["crank", "coupler", "foot"]


@pytest.mark.parametrize("payload", [None, 3.0])
def test_what_the_simulator_says_of_its_conditions_is_no_gap(tmp_path: Path, payload: float | None) -> None:
    """Loads and a payload bend it by some tenths of a millimetre; one that is the same in all rows is told it, too."""
    path = _measured(tmp_path / "r.csv", payload=payload)
    said = _diagnosed(path)
    assert said.verdict["none"] and said.gap["before"] == pytest.approx(said.gap["noise_floor"], rel=0.15)
    assert not any("payload" in note for note in said.notes)
    if payload is not None:
        return
    without = path.read_text(encoding="utf-8").replace("payload[g]", "unknown[g]")
    path.write_text(without, encoding="utf-8")
    blind = _diagnosed(path)
    assert any("press takes payload, which the records do not have" in note for note in blind.notes)
    assert not blind.verdict["none"] and blind.gap["before"] > 5 * NOISE
    mechanism = load_mechanism(PRESS)
    looked = check_rows(situation_of(load_records(path, mechanism, learns=False), mechanism), blind.analysis.measured)
    assert "press takes payload" in " ".join(check_text(looked))


def test_the_commands_take_it_and_simulate_its_parameters(cli: Cli, tmp_path: Path) -> None:
    words = ("--mechanism", PRESS, "--rows", "100", "--noise", "1e-5", "--seed", "2", "--out", tmp_path / "r.csv")
    code, shown, told = cli("simulate", *words, "--effect", "parameter spring1:spring1=-6000N*m/rad")
    assert code == 0, told
    assert "parameter spring1" in shown and "payload[kg]" in (tmp_path / "r.csv").read_text(encoding="utf-8")
    of = ("--records", tmp_path / "r.csv", "--mechanism", PRESS)
    code, shown, told = cli(
        "diagnose", *of, "--no-network", "--out", tmp_path / "d", "--effects", "parameter_spring1,compliance"
    )
    assert code == 0, told
    verdict = json.loads((tmp_path / "d" / "diagnosis.json").read_text(encoding="utf-8"))["verdict"]
    assert verdict["effects"] == ["parameter spring1"] and "Wrong value of spring1" in shown
    code, shown, told = cli("check", *of)
    assert code == 0 and "payload" in shown, told
    code, _, told = cli("diagnose", *of, "--out", tmp_path / "d", "--effects", "parameter sprng1")
    assert code == 2 and "did you mean 'parameter spring1'?" in told


def test_a_row_without_an_answer_is_named_and_ends_with_2(cli: Cli, tmp_path: Path) -> None:
    path = _measured(tmp_path / "r.csv", rows=40)
    lines = path.read_text(encoding="utf-8").splitlines()
    # Cranks so far apart that the couplers do not meet.
    lines[8] = ",".join(["3.1", "0.0", *lines[8].split(",")[2:]])
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    code, _, told = cli("diagnose", "--records", path, "--mechanism", PRESS, "--out", tmp_path / "d")
    assert code == 2 and len(told.strip().splitlines()) == 1
    assert "simulator 'press' returns NaN at line 9 (row 8), with q1 = 3.1 rad, q2 = 0 rad, load_x = " in told
    assert "or remove the row" in told


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("payload[g]", "payload[N]", "column 'payload' is in 'N', and the simulator takes it in kg"),
        (",500,", ",,", "column 'payload' is empty at line 2"),
    ],
)
def test_a_condition_in_another_unit_or_an_empty_one_is_refused(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    path = _measured(tmp_path / "r.csv", payload=0.5, rows=40)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError) as told:
        _diagnosed(path)
    told.match(sentence)


def test_a_simulator_without_parameters_has_effects_of_its_joints(tmp_path: Path) -> None:
    (tmp_path / "axis.py").write_text(
        "from ccnn_torch.mechanisms import Joint, Simulator\n"
        'AXIS = Simulator(name="axis", joints=[Joint("q1", "m", 0.0, 0.6)], pose=("x",),\n'
        "    simulate=lambda q, c, p: q[:, :1], parameters=[])\n",
        encoding="utf-8",
    )
    g = np.random.default_rng(0)
    joints = g.uniform(0, 0.6, 60)
    write_table(tmp_path / "rows.csv", {"q1[m]": joints, "x[m]": 1.002 * joints + NOISE * g.standard_normal(60)})
    mechanism = load_mechanism(f"{tmp_path / 'axis.py'}:AXIS")
    records = load_records(tmp_path / "rows.csv", mechanism)
    assert diagnose(records, mechanism, noise={"x": NOISE}).verdict["effects"] == ["joint_gain"]
    assert mechanism.parameter_jacobian(records.joints).shape == (60, 3, 0)
