"""A user's own effect that breaks the protocol: one sentence that names file, class, method and what would be right."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import broken_effects
import pytest
from broken_effects import Good, LaterColumn
from typer.testing import CliRunner

from ccnn_torch import diagnose, load_mechanism, load_records
from ccnn_torch.cli.application import app
from ccnn_torch.diagnosis import diagnose_rows, noise_of, situation_of
from ccnn_torch.diagnosis.checks.identifiable import check_rows
from ccnn_torch.effects import Effect, make_effect, owned
from ccnn_torch.errors import InputError
from ccnn_torch.simulation.job import simulate_records
from ccnn_torch.testing import check_effect

Cli = Callable[..., tuple[int, str, str]]
FILE = str(Path(broken_effects.__file__))
LINE = (
    Path(FILE)
    .read_text(encoding="utf-8")
    .splitlines()
    .index("        return torch.ones(3) @ torch.ones(4)  # the line that a sentence names")
)
BROKEN = {
    "Wide": r"basis\(\) gives shape \(80, 2, 1\), expected \(80, 2, 2\): rows, joints and coefficients",
    "OneSet": r"basis\(\) gives shape \(80, 2, 2\), expected \(3, 80, 2, 2\): sets of shapes, rows, joints .* shape\[",
    "OneTooMany": r"basis\(\) gives shape \(80, 2, 2\), expected \(80, 2, 3\)",
    "Raises": rf"basis\(\) fails at line {LINE + 1}: RuntimeError: inconsistent tensor size",
    "RaisesOwn": r"missing\(\) fails at line \d+: OwnError: no table for this machine",
    "Unsaid": r"basis\(\) fails at line \d+: KeyError: 'pressure' \(if .* direction1, direction2, and missing\(\) must",
    "Numpy": r"basis\(\) returned a numpy.ndarray, expected a torch tensor",
    "NaN": r"basis\(\) is not finite in every row at power = 1 1, expected",
    "SomeNaN": r"basis\(\) is not finite in 1 of 80 rows at power = 2 1, expected",
    "Single": r"basis\(\) gives torch.float32, expected torch.float64",
    "NoGrid": r"shapes\(\): the grid of shape 'power' is empty, expected finite numbers",
    "Falling": r"shapes\(\): the grid of shape 'power' does not ascend",
    "TensorGrid": r"shapes\(\): the grid of shape 'power' is tensor\(.*expected finite numbers",
    "OutOfRange": r"shapes\(\): shape 'power' names coefficient 2 in columns, expected numbers from 0 to 1",
    "NoComma": r"shapes\(\) returned a ccnn_torch.*Shape, expected a tuple of Shape, \(Shape\(…\),\)",
    "ShapesFail": r"shapes\(\) fails at line \d+: TypeError: .*'grid'",
    "Twice": "two of its coefficients or shapes are called 'same'",
    "NoCoefficient": r"coefficients\(\) returned no coefficient; .* missing\(\) must say why",
    "Pairs": r"coefficients\(\) returned a tuple in a tuple, expected a tuple of Coefficient",
    "Silent": r"missing\(\) returned None, expected a sentence",
    "ScaleZero": r"coefficients\(\): coefficient 'q1' has the scale 0.0, expected more than 0",
    "ScaleNegative": r"coefficients\(\): coefficient 'q1' has the scale -0.001, expected more than 0",
    "ScaleNaN": r"coefficients\(\): coefficient 'q1' has the scale nan, expected more than 0",
    "BadUnit": r"coefficients\(\): the unit of 'q1' is none: .*'radd/N/m' is not known",
    "NotSI": r"coefficients\(\): the unit 'mrad' of 'q1' is no SI unit",
    "NoSuchJoint": r"coefficients\(\): coefficient 'q1' is of joint 'q7', expected one of q1, q2, or None",
    "NoSuchLeg": r"coefficients\(\): coefficient 'q1' is of leg 9, expected one of 1, 2, or None",
    "Named": "its name 'backlash' is one of the library's",
    "Outlier": "its name 'outlier' is one of the library's",
    "Nameless": "its name is ' ', expected a word",
}
LATE = {
    "Late": r"basis\(\) fails at line \d+: KeyError: [\d.]+",
    "LateNaN": r"basis\(\) is not finite in every row at power = [\d.]+ 1, expected",
}
BAR = load_mechanism("five_bar")


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of a five-bar with the good effect, at a power between the values of its grid."""
    file = tmp_path_factory.mktemp("own") / "rows.csv"
    words = ["--mechanism", "five_bar", "--effect", f"{FILE}:Good:q1=1e-3,q2=-1e-3,power=1.4", "--rows", "80"]
    made = CliRunner().invoke(app, ["simulate", *words, "--noise", "1e-6", "--seed", "2", "--out", str(file)])
    assert made.exit_code == 0, made.output
    return file


def test_a_good_effect_is_named_and_the_notes_say_what_cannot_hold_it(rows: Path) -> None:
    found = diagnose(load_records(rows, BAR), BAR, effects=[Good(), "backlash"])
    assert found.verdict["effects"] == ["good"]
    assert [a.effect.name for a in found.acting] == ["good"]
    assert float(found.acting[0].shape) == pytest.approx(1.4, abs=0.05)
    assert any(note.startswith("good: no effect of the library") and "effects=from:" in note for note in found.notes)
    library = diagnose(load_records(rows, BAR), BAR, effects=["joint_gain", "joint_offset"])
    assert not any("effects=from:" in note for note in library.notes)


@pytest.mark.parametrize("name", BROKEN)
def test_python_says_it_in_one_sentence(rows: Path, name: str) -> None:
    records = load_records(rows, BAR)
    sentence = f"^{re.escape(FILE)}:{name}: {BROKEN[name]}"
    with pytest.raises(InputError, match=sentence) as told:
        diagnose(records, BAR, effects=["joint_gain", getattr(broken_effects, name)()])
    assert "\n" not in str(told.value)
    situation = situation_of(records, BAR)
    with pytest.raises(InputError, match=sentence):
        check_rows(situation, records.pose, noise_of(1e-6, situation), [f"{FILE}:{name}"])
    with pytest.raises(InputError, match=sentence):
        simulate_records("five_bar", [f"{FILE}:{name}"], rows=80, noise=1e-6, seed=2)


@pytest.mark.parametrize("name", LATE)
def test_what_the_trial_could_not_see_is_a_sentence_too(rows: Path, name: str) -> None:
    with pytest.raises(InputError, match=f"^{re.escape(FILE)}:{name}: {LATE[name]}"):
        diagnose(load_records(rows, BAR), BAR, effects=[getattr(broken_effects, name)()])


def test_one_that_would_fail_on_a_column_not_recorded_costs_no_verdict(rows: Path) -> None:
    records = load_records(rows, BAR)
    there = situation_of(records, BAR)
    columns = {n: v for n, v in there.covariates.items() if n != "temperature"}
    found = diagnose_rows(replace(there, covariates=columns), records.pose, effects=["joint_gain", LaterColumn()])
    assert "later column" in found.not_seen and found.verdict["effects"]


@pytest.mark.parametrize("command", ["diagnose", "check"])
@pytest.mark.parametrize("name", ["Raises", "Wide", "Unsaid", "NoGrid"])
def test_the_command_line_says_it_in_one_line(cli: Cli, rows: Path, tmp_path: Path, command: str, name: str) -> None:
    words = ("--records", rows, "--mechanism", "five_bar", "--effects", f"{FILE}:{name}", "--out", tmp_path / "o")
    code, _, told = cli(command, *words)
    assert code == 2 and len(told.strip().splitlines()) == 1
    assert re.search(f"^{re.escape(FILE)}:{name}: {BROKEN[name]}", told)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("Needs", "making it without arguments fails: TypeError: .*'stiffness'"),
        ("NeedsFile", r"making it without arguments fails at line \d+: FileNotFoundError"),
        ("Late:power=1.3", r"basis\(\) fails at line \d+: KeyError: 1.3"),
    ],
)
def test_a_simulation_says_it_in_one_line(cli: Cli, tmp_path: Path, words: str, sentence: str) -> None:
    given = (
        "--mechanism",
        "five_bar",
        "--effect",
        f"{FILE}:{words}",
        "--rows",
        "30",
        "--noise",
        "1e-6",
        "--out",
        tmp_path / "r.csv",
    )
    code, _, told = cli("simulate", *given)
    assert code == 2 and len(told.strip().splitlines()) == 1
    assert re.search(f"^{re.escape(FILE)}:{words.partition(':')[0]}: {sentence}", told)


def test_a_file_without_a_class_is_told_the_classes(cli: Cli, rows: Path, tmp_path: Path) -> None:
    file = Path(__file__).parents[2] / "experiments" / "my_effect.py"
    hint = f"effects: {file}: names no class; write {file}:HosePull"
    code, _, told = cli("check", "--records", rows, "--mechanism", "five_bar", "--effects", str(file))
    assert code == 2 and told.strip() == hint
    words = ("--mechanism", "five_bar", "--rows", "30", "--noise", "1e-6", "--out", tmp_path / "r.csv")
    code, _, told = cli("simulate", *words, "--effect", str(file))
    assert code == 2 and told.strip() == hint


def test_two_candidates_of_one_name_and_what_is_no_effect(rows: Path) -> None:
    records = load_records(rows, BAR)
    with pytest.raises(InputError, match=r"two candidates are called 'good' \(.*:Good and .*:Good\)"):
        diagnose(records, BAR, effects=[Good(), Good()])
    with pytest.raises(InputError, match=r"effects: Good is a class; give an object of it, Good\(\)"):
        diagnose(records, BAR, effects=[Good])  # type: ignore[list-item]
    with pytest.raises(InputError, match="effects: int is no effect, it lacks missing, coefficients, shapes, basis"):
        diagnose(records, BAR, effects=[3])  # type: ignore[list-item]


def test_the_file_itself_may_fail(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("SIZE = 1\nTABLE = [SIZE][1]\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"mine.py fails at line 2: IndexError: list index out of range$"):
        make_effect(f"{file}:Mine")


def test_the_librarys_effects_are_left_as_they_are() -> None:
    backlash = make_effect("backlash")
    assert owned(backlash) is backlash
    own: Effect = owned(Good())
    assert owned(own) is own


@pytest.mark.parametrize("name", BROKEN)
def test_the_check_of_effects_says_it_too(name: str) -> None:
    # Its rows are others, with more columns.
    sentence = BROKEN[name].replace("80", "8").replace("direction1, direction2", ".*")
    with pytest.raises(AssertionError, match=sentence) as told:
        check_effect(f"{FILE}:{name}")
    assert "\n" not in str(told.value)
