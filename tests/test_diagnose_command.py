"""`ccnn diagnose` and `ccnn check`: what they write and say, and one sentence for everything that is wrong."""

from __future__ import annotations

import io
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch
from frozen import frozen
from rich.console import Console

from ccnn_torch import diagnose, load_mechanism, load_records
from ccnn_torch.diagnosis.progress import TO_VERDICT, watched
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect, reached
from ccnn_torch.errors import InputError
from ccnn_torch.records import read_table, write_table
from ccnn_torch.report.screen import step_bar
from ccnn_torch.simulation.job import simulate_records, write_simulated

Cli = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulated") / "rows.csv"
    write_simulated(path, simulate_records("five_bar", ["backlash"], 80, 1e-5, seed=4))
    return path


@pytest.fixture
def rows(simulated: Path, tmp_path: Path) -> Path:
    """Records of a five-bar with play, beside a config that names them by a relative path."""
    shutil.copy(simulated, tmp_path / "rows.csv")
    (tmp_path / "config.yaml").write_text("records: rows.csv\nmechanism: five_bar\nnoise: 10um\n", encoding="utf-8")
    return tmp_path / "rows.csv"


def test_a_config_beside_its_records_gives_verdict_and_report(
    cli: Cli, rows: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    # Of an earlier verdict that named a geometry.
    Path("found").mkdir()
    Path("found/corrected.yaml").write_text("mechanism: five_bar\n", encoding="utf-8")
    Path("found/diagnosis.json").write_text("{}", encoding="utf-8")
    code, shown, told = cli("diagnose", "--config", rows.parent / "config.yaml", "--out", "found", "--details")
    assert code == 0 and told == ""
    results = json.loads(Path("found/diagnosis.json").read_text(encoding="utf-8"))
    jsonschema.validate(results, frozen("diagnosis"))
    assert results["verdict"]["effects"] == ["backlash"]
    assert "acklash" in shown and " SI " not in shown
    network = results["network"]
    assert network["reason"] == "what the effects leave is no more than the noise"
    assert [step["name"] for step in results["in_order"]] == ["backlash"] and results["where_ci95"][
        "joints"
    ].keys() == {
        "q1",
        "q2",
    }
    assert set(results["not_seen"]) == {"bending", "error_motion", "latency", "sag", "tool"}
    assert "needs a platform that turns" in shown
    # The verdict comes before all that takes longer.
    assert shown.index("acklash") < shown.index("How large is the gap?") and shown.count("would remove") == 1
    for name in ("report.html", "diagnosis.md", "diagnosis.safetensors", "next_measurements.csv"):
        assert Path("found", name).is_file(), name
    assert not Path("found/corrected.yaml").exists()


@pytest.mark.parametrize("kind", ["--records", "--motion"])
def test_a_folder_of_something_else_is_left_as_it_is(cli: Cli, rows: Path, tmp_path: Path, kind: str) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "report.html").write_text("of a run", encoding="utf-8")
    for folder in (tmp_path / "run", rows, Path("/")):
        code, _, told = cli("diagnose", kind, rows, "--mechanism", "five_bar", "--out", folder)
        assert code == 2 and told == f"{folder} holds files already; give a folder of its own with --out DIR\n"
    assert [file.name for file in (tmp_path / "run").iterdir()] == ["report.html"]


def test_check_says_what_rows_can_show_without_a_verdict(cli: Cli, rows: Path) -> None:
    code, shown, _ = cli("check", "--records", rows, "--mechanism", "five_bar", "--details")
    assert code == 0
    assert "80 rows" in shown and "tool cannot be seen without" in shown
    # One line an effect, with the closest few of those that could take it over.
    assert shown.count("│ joint_offset │") == 1 and "geometry 1.000" in shown and " more " in shown
    assert list(rows.parent.glob("*.json")) == []


def test_rows_set_aside_are_called_by_one_name_everywhere(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    words = ("--mechanism", "five_bar", "--effect", "outlier:share=0.05,size=0.01", "--rows", 60, "--noise", "1e-5")
    code, shown, _ = cli("simulate", *words, "--seed", 2, "--out", path)
    lines, rows = (re.findall(rf"{kind}s? ([\d, ]+)", " ".join(shown.split()))[-1].strip() for kind in ("line", "row"))
    assert code == 0 and len(rows.split(", ")) == 3
    assert [int(line) for line in lines.split(",")] == [int(row) + 1 for row in rows.split(",")]
    # Bad by the file itself: the line that is named there is far off.
    file = path.read_text(encoding="utf-8").splitlines()
    records = load_records(path, load_mechanism("five_bar"))
    gap = (records.pose - load_mechanism("five_bar").forward_kinematics(records.joints)).norm(dim=-1)
    assert set(gap.argsort(descending=True)[:3].tolist()) == {int(row) - 1 for row in rows.split(",")}
    # A blank line below the header: lines go up by one, rows stay.
    path.write_text("\n".join([file[0], "", *file[1:]]) + "\n", encoding="utf-8")
    moved = ", ".join(str(int(line) + 1) for line in lines.split(","))
    name = f"lines {moved} (rows {rows})"
    sentence = f"Far from what any fit to the other rows says: 3, at {name}."
    few = "effects=[geometry,joint_offset]"
    code, shown, _ = cli("check", "--records", path, "--mechanism", "five_bar", "--out", tmp_path, few)
    assert code == 0 and sentence in " ".join(shown.split())
    looked = json.loads((tmp_path / "check.json").read_text(encoding="utf-8"))
    assert {int(row) for row in rows.split(",")} <= {row + 1 for row in looked["aside"]}
    assert looked["lines_aside"] == [row + 3 for row in looked["aside"]]
    assert f"{len(looked['aside'])} rows set aside. " in " ".join(shown.split())
    # Beside the check the diagnosis may be written: both say what the same rows show.
    code, shown, _ = cli(
        "diagnose", "--records", path, "--mechanism", "five_bar", "--out", tmp_path, "--no-network", few
    )
    assert code == 0 and sentence in " ".join(shown.split())
    results = json.loads((tmp_path / "diagnosis.json").read_text(encoding="utf-8"))
    assert results["rows_set_aside"] == looked["aside"] and results["why_set_aside"] == looked["why_aside"]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for line, row in zip(moved.split(", "), rows.split(", "), strict=True):
        assert f"<td>{line}</td><td>{row}</td>" in page


def test_a_direction_that_is_no_sign_is_named(cli: Cli, rows: Path) -> None:
    lines = rows.read_text(encoding="utf-8").splitlines()
    assert lines[0].endswith(",direction2[1]")
    lines[5] = lines[5].rpartition(",")[0] + ",0.5"
    (rows.parent / "odd.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    code, _, told = cli("check", "--records", rows.parent / "odd.csv", "--mechanism", "five_bar")
    assert code == 2 and "column 'direction2', line 6: 0.5 is no direction; write 1 or -1" in told


def test_directions_that_never_change_are_not_to_be_recorded_but_changed(cli: Cli, rows: Path, tmp_path: Path) -> None:
    write_simulated(rows, simulate_records("five_bar", ["joint_offset"], 80, 1e-5, seed=4))
    head, *lines = rows.read_text(encoding="utf-8").splitlines()
    assert head.endswith(",direction1[1],direction2[1]")
    rows.write_text("\n".join([head, *(f"{line.rsplit(',', 2)[0]},1,1" for line in lines)]) + "\n", encoding="utf-8")
    code, shown, told = cli("check", "--config", tmp_path / "config.yaml")
    assert code == 0, told
    assert "direction1[1]…direction2[1], which never change: approach the joints from both sides." in _line(shown)
    code, shown, told = cli("diagnose", "--config", tmp_path / "config.yaml", "--out", tmp_path / "found")
    assert code == 0, told
    measure = _line(shown).partition("Measure next:")[2]
    assert "direction" not in measure.partition("Record as well:")[2].partition("Recorded, but")[0]
    assert "never changing: direction1[1], direction2[1] (would show" in measure
    assert "): approach the joints from both sides." in measure
    still = json.loads((tmp_path / "found/diagnosis.json").read_text(encoding="utf-8"))["missing_covariates"]
    assert {tuple(entry["columns"]) for entry in still if entry["constant"]} == {("direction1[1]", "direction2[1]")}


def _line(text: str) -> str:
    return " ".join(text.split())


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "name the folder to write with --out DIR"),
        (["--out", "x", "--effects", "backlsh"], "did you mean 'backlash'?"),
        (["--out", "x", "--effects", "tool"], "can show none of the candidates: tool needs"),
        (["--out", "x", "--noise", "abc"], "--noise abc: 'abc' is no number with a unit; write e.g. 0.4 mm"),
        (["--out", "x", "--noise", "10"], "10 m for x is more than five_bar moves"),
        (["--out", "x", "--noise", "x=1,2"], "'x=1,2' is neither a size nor NAME=SIZE"),
        (["--out", "x", "--noise", "10 blub"], "--noise 10 blub"),
        (["--out", "x", "--noise", "10 urad"], "noise.x is in 'urad', an angle, but must be a length"),
        (["--out", "x", "--noise", "0"], "noise: must be a standard deviation of the pose, a size above 0 (10um"),
        (["--out", "x", "--noise", "-1"], "noise: must be a standard deviation"),
        (["--out", "x", "--noise", "nan"], "noise: must be a standard deviation"),
        (["--out", "x", "--noise", "x=1e-5,y=0"], "noise: must be a standard deviation"),
        (["--out", "x", "--noise", "=1"], "'=1' is neither a size nor NAME=SIZE"),
        (["--out", "x", "noise=0"], "'noise=0': noise: must be a standard deviation of the pose, a size above"),
        (["--out", "x", "noise={x: wide}"], "noise: must be a standard deviation"),
        (["--out", "x", "--noise", "z=1e-5"], "noise.z: there is no such name; there are x, y"),
        (["--out", "x", "--noise", "x=10um"], "noise: gives nothing for y; the pose is x, y"),
    ],
)
def test_what_is_wrong_is_one_sentence(
    cli: Cli, rows: Path, words: list[str], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(rows.parent)
    code, _, told = cli("diagnose", "--records", rows, "--mechanism", "five_bar", *words)
    assert code == 2 and sentence in told and len(told.strip().splitlines()) == 1


def _first_rows(rows: Path) -> None:
    head = "".join(rows.read_text(encoding="utf-8").splitlines(keepends=True)[:6])
    rows.write_text(head, encoding="utf-8")


def _moved_away(rows: Path) -> None:
    header, *lines = rows.read_text(encoding="utf-8").splitlines()
    x = header.split(",").index("q1[rad]")
    cells = [line.split(",") for line in lines]
    # Cranks that point away from each other: no coupler reaches.
    rows.write_text("\n".join([header, *(",".join([*c[:x], "3.1", "0.0", *c[x + 2 :]]) for c in cells)]) + "\n")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_first_rows, "5 rows are too few for a diagnosis; measure at least 20"),
        (_moved_away, "80 of 80 rows are outside the reach of five_bar"),
        (lambda rows: rows.write_text(""), "the file is empty; line 1 must be the header"),
        (Path.unlink, "there is no such file; give the path of a CSV file"),
        (lambda rows: (rows.unlink(), rows.mkdir()), "is a folder and no file"),
    ],
)
@pytest.mark.parametrize("command", ["diagnose", "check"])
def test_wrong_records_are_named(
    cli: Cli, rows: Path, tmp_path: Path, command: str, change: Callable[[Path], object], sentence: str
) -> None:
    change(rows)
    code, _, told = cli(command, "--records", rows, "--mechanism", "five_bar", "--out", tmp_path / "found")
    assert code == 2 and told.startswith(f"{rows}: {sentence}"), told
    assert len(told.strip().splitlines()) == 1 and not (tmp_path / "found").exists()


def _stop(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_stopped_before_the_verdict_it_says_that_nothing_was_written(
    cli: Cli, rows: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--records", rows, "--mechanism", "five_bar", "--out", tmp_path / "found")
    monkeypatch.setattr("ccnn_torch.diagnosis.job.diagnose", _stop)
    monkeypatch.setattr("ccnn_torch.diagnosis.job.check_rows", _stop)
    assert cli("diagnose", *words) == (130, "", "interrupted before there was a verdict; nothing was written\n")
    assert cli("check", *words) == (130, "", "interrupted; nothing was written\n")
    assert not (tmp_path / "found").exists()


def test_a_stopped_blind_check_says_how_to_go_on(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccnn_validation.blind.check.run_blind_check", _stop)
    sentence = f"interrupted; finished cases are kept in {tmp_path / 'b'}, and the same command resumes from them\n"
    assert cli("blind-check", "--cases", 6, "--out", tmp_path / "b") == (130, "", sentence)


def test_stopped_after_the_verdict_it_says_where_that_is(
    cli: Cli, rows: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ccnn_torch.diagnosis.job.with_network", _stop)
    words = ("--records", rows, "--mechanism", "five_bar", "--effects", "backlash", "--out", tmp_path / "found")
    code, shown, told = cli("diagnose", *words)
    kept = tmp_path / "found" / "diagnosis.json"
    assert code == 130 and "acklash" in shown and f"the verdict, which is kept in {kept};" in told
    assert json.loads(kept.read_text(encoding="utf-8"))["verdict"]["effects"] == ["backlash"]
    assert not (tmp_path / "found" / "report.html").exists()


def test_records_of_another_machine_are_refused_in_python(rows: Path) -> None:
    records = load_records(rows, load_mechanism("five_bar"))
    with pytest.raises(InputError, match="records: they have 2 joints and tripod has 3"):
        diagnose(records, load_mechanism("tripod"))


def test_columns_by_another_name_are_said(cli: Cli, rows: Path, tmp_path: Path) -> None:
    text = rows.read_text(encoding="utf-8")
    rows.write_text(text.replace("load_x[", "force_x[", 1), encoding="utf-8")
    words = ("--records", rows, "--mechanism", "five_bar", "--effects", "backlash", "--no-network")
    code, shown, _ = cli("diagnose", *words, "--details", "--out", tmp_path / "found")
    assert code == 0
    notes = json.loads((tmp_path / "found" / "diagnosis.json").read_text(encoding="utf-8"))["notes"]
    assert any("not evaluated: force_x; effects use time, temperature, load_x" in note for note in notes)
    assert "force_x" in shown and "force_x" in (tmp_path / "found" / "report.html").read_text(encoding="utf-8")
    # One that was asked for is there for effects of one's own.
    code, shown, told = cli("check", *words[:4], "covariates=[time,temperature,load_*,direction*,force_x]")
    assert code == 0 and "not evaluated" not in shown, told


def test_where_the_frame_is_off_a_command_fits_it_first(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("--mechanism", "delta", "--rows", "60", "--noise", "1e-5", "--seed", "1")
    code, _, told = cli("simulate", *words, "--effect", "frame:x=0.003,ry=0.004", "--out", "rows.csv")
    assert code == 0, told
    words = ("--records", "rows.csv", "--mechanism", "delta", "--noise", "1e-5", "--no-network", "--effects", "frame")
    code, shown, told = cli("diagnose", *words, "--out", "found")
    assert code == 0, told
    *_, run = (shlex.split(line) for line in shown.splitlines() if line.startswith("  ccnn run"))
    assert "mechanism=framed" in run and 'mechanism_keys={"mechanism": "delta", "base": true}' in run
    code, shown, told = cli(*run[1:], "methods=[constant]", "save_models=false", "save_report=false")
    assert code == 0, told
    position = json.loads(Path("found_compensator/results.json").read_text("utf-8"))["pose"]["position"]
    assert position["before"]["rms"]["median"] < 1e-4


def test_the_command_on_the_screen_puts_the_effect_in_a_compensator(
    cli: Cli, rows: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (rows.parent / "my data").mkdir()
    rows.rename(rows.parent / "my data" / "rows 1.csv")
    monkeypatch.chdir(rows.parent)
    words = ("--records", "my data/rows 1.csv", "--mechanism", "five_bar", "--noise", "1e-5", "--no-network")
    words += ("--effects", "geometry,joint_offset,joint_gain,backlash")
    code, shown, _ = cli("diagnose", *words, "--out", "found")
    assert code == 0 and "How large is the gap?" not in shown and "--details" in shown
    assert "found/next_measurements.csv" in shown and "where nothing was measured (by block)" in shown
    assert "What is wrong: Backlash of joints 1 and 2: joint" in shown
    correct, run = (shlex.split(line) for line in shown.splitlines() if line.startswith("  ccnn "))
    assert correct == ["ccnn", "compensate", "found/diagnosis.json", "TARGETS.csv", "COMMANDS.csv", "--pose"]
    page = Path("found/report.html").read_text(encoding="utf-8")
    assert "What is wrong" in page and "ccnn compensate found/diagnosis.json" in page
    # Temperature and time act on nothing that was found: targets need not have them.
    machine = json.loads(Path("found/diagnosis.json").read_text(encoding="utf-8"))["machine"]
    assert set(machine["covariates"]) <= {"load_x", "load_y", "direction1", "direction2"}
    table = read_table(Path("my data/rows 1.csv"))
    keep = {f"{n}[{table.units[n]}]": table.column(n) for n in machine["covariates"]}
    nominal = load_mechanism("five_bar")
    joints = torch.from_numpy(np.stack([table.column(f"q{k}") for k in (1, 2)], -1))
    place = nominal.forward_kinematics(joints).numpy()
    write_table(Path("TARGETS.csv"), {c.header: place[:, k] for k, c in enumerate(nominal.pose)} | keep)
    code, _, told = cli(*correct[1:])
    assert code == 0, told
    # The true machine misses less under these commands.
    made = simulate_records("five_bar", ["backlash"], 80, 1e-5, seed=4)
    injected = {name: value for name, (value, _) in made.injected[0].parameters.items()}
    there = Situation(made.mechanism, made.joints, made.covariates, default_gravity(made.mechanism))
    backlash = make_effect("backlash")
    numbers = (backlash.shapes(there), backlash.coefficients(there))
    acting = [
        Acting(
            backlash,
            *(torch.tensor([injected.get(p.name, 0.0) for p in kind], dtype=torch.float64) for kind in numbers),
        )
    ]
    command = np.stack([read_table(Path("COMMANDS.csv")).column(f"command_q{i}") for i in (1, 2)], -1)
    poses = [reached(replace(there, joints=q), acting)[:, :3] for q in (made.joints, torch.from_numpy(command))]
    before, after = (float((pose - there.platform[0]).square().sum(-1).mean()) for pose in poses)
    assert after < 0.02 * before
    assert "records=my data/rows 1.csv" in run and "out=found_compensator" in run
    code, _, told = cli(
        *run[1:], "methods=constant", "geometry=none", "effects=none", "save_models=false", "save_report=false"
    )
    assert code == 0, told


def test_effects_that_a_compensator_cannot_hold_are_left_to_its_network(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = ("--effect", "drift", "--rows", "80", "--noise", "5e-6", "--out", "r.csv", "--quiet")
    assert cli("simulate", "--mechanism", "five_bar", *made)[0] == 0
    words = ("--records", "r.csv", "--mechanism", "five_bar", "--noise", "5e-6", "--no-network", "--out", "found")
    code, shown, _ = cli("diagnose", *words, "--effects", "drift,thermal,backlash")
    assert code == 0 and "What is wrong: Drift of joints 1 and 2" in shown
    assert "No model holds these effects by themselves" in shown
    assert "  ccnn run records=r.csv mechanism=five_bar out=found_compensator\n" in shown


def test_a_terminal_shows_the_steps_and_the_time_left(rows: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    terminal = Console(file=screen, force_terminal=True, width=100)
    monkeypatch.setattr("ccnn_torch.report.screen.stderr", terminal)
    mechanism = load_mechanism("five_bar")
    records = load_records(rows, mechanism)
    told: list[tuple[str, float]] = []

    def look(step: str, share: float) -> None:
        told.append((step, share))
        tell(step, share)

    with step_bar(TO_VERDICT, quiet=False) as tell, watched(look):
        diagnose(records, mechanism, effects=["backlash"])
    drawn = screen.getvalue()
    assert "5 of 5: next measurements" in drawn and "-:--:--" in drawn
    names = [name for name in TO_VERDICT if name != "reading the records"]
    assert list(dict.fromkeys(step for step, _ in told)) == names
    assert [s for n, s in told if n == names[0]] == sorted(s for n, s in told if n == names[0])
    # Off a terminal nothing is drawn.
    quiet = io.StringIO()
    monkeypatch.setattr("ccnn_torch.report.screen.stderr", Console(file=quiet, force_terminal=False))
    with step_bar(TO_VERDICT, quiet=False) as tell:
        tell("by block", 0.5, "half")
    assert quiet.getvalue() == ""


def test_nothing_is_loaded_that_a_command_does_not_need(rows: Path, tmp_path: Path) -> None:
    """To compensate takes neither the diagnosis nor the learners that are evolved, by an export not even torch; a
    diagnosis nothing slow."""
    root = Path(__file__).parent.parent
    arm, wanted = root / "experiments" / "data", tmp_path / "wanted.csv"
    wanted.write_text("q1[m],q2[m],q3[m]\n1,1,1\n")
    some = tmp_path / "some.csv"
    some.write_text("".join((arm / "ur10_b_500.csv").read_text().splitlines(keepends=True)[:26]))
    watched = "{'torch._dynamo', 'sympy', 'scipy', 'pint', 'torch.utils.tensorboard'}"
    program = f"""
import sys
import ccnn_torch.compensation.job
loaded = [m.split(".")[1] for m in sys.modules if m.startswith("ccnn_torch.")]
print(len(loaded) < 120, sorted({{"diagnosis", "motion", "evolution", "report"}} & set(loaded)))
from ccnn_torch.cli.application import app
def run(*words): app(words, standalone_mode=False)
model = {str(root / "checkpoints" / "tripod" / "model.onnx")!r}
run("compensate", model, {str(wanted)!r}, {str(tmp_path / "commands.csv")!r}, "--quiet")
print("torch" in sys.modules)
run("check", "--records", {str(some)!r}, "--mechanism", {str(arm / "ur10.yaml")!r}, "--quiet", "effects=[geometry]")
print("matplotlib" in sys.modules)
of = ("--records", {str(rows)!r}, "--mechanism", "five_bar", "--effects", "backlash", "--quiet")
run("diagnose", *of, "--out", {str(tmp_path / "found")!r})
print(sorted({watched} & set(sys.modules)), "matplotlib" in sys.modules)
"""
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert told.splitlines() == ["True []", "False", "False", "[] True"]


def test_a_length_is_the_noise_of_an_arm_measured_in_position(cli: Cli, tmp_path: Path) -> None:
    """The arm's pose has angles, its records have none: only there a length suits all coordinates."""
    arm = Path(__file__).parent.parent / "experiments" / "data" / "ur10.yaml"
    made = simulate_records(str(arm), ["backlash"], 40, {"m": 1e-5, "rad": 1e-5}, seed=4)
    write_simulated(tmp_path / "whole.csv", made)
    lines = [line.split(",") for line in (tmp_path / "whole.csv").read_text().splitlines()]
    kept = [k for k, header in enumerate(lines[0]) if header[:2] not in ("rx", "ry", "rz")]
    (tmp_path / "rows.csv").write_text("\n".join(",".join(line[k] for k in kept) for line in lines) + "\n")
    for name, expected in (("rows", 0), ("whole", 2)):
        words = (
            "--records",
            tmp_path / f"{name}.csv",
            "--mechanism",
            arm,
            "--noise",
            "10um",
            "--effects",
            "backlash",
            "--quiet",
        )
        code, _, err = cli("check", *words)
        assert code == expected and ("lengths and angles" in err) == bool(expected), err
