"""The command that diagnoses and judges cases of independent sources."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ccnn_validation.ablation import ablate, scaled
from ccnn_validation.sources.case import SourceCase, Truth
from ccnn_validation.sources.judge import judged
from ccnn_validation.sources.report import figures
from ccnn_validation.sources.run import diagnosed, source_of

from ccnn_torch.errors import InputError
from ccnn_torch.evidence import form_error

Cli = Callable[..., tuple[int, str, str]]


def answer(*names: str, outside: bool = False, drivers: tuple[str, ...] = (), p: float = 0.97) -> dict[str, object]:
    verdict = {"effects": [*names], "outside_library": outside, "driver": None, "drivers": [*drivers], "text": "A gap."}
    return {"verdict": verdict | {"probability": p}, "cautions": ["check the signs"], "notes": [], "rows_set_aside": []}


def test_an_answer_is_right_by_what_the_source_said() -> None:
    single = Truth("single", ("backlash",), (frozenset({"backlash"}),))
    assert judged(single, answer("backlash"), None)["right"]
    assert not judged(single, answer("backlash", outside=True, drivers=("time",)), None)["right"]
    wrong = judged(single, answer("friction"), None)
    assert not wrong["right"] and wrong["wrong_name"]
    assert judged(single, answer("backlash", "geometry"), answer("geometry"))["right"]
    assert not judged(single, answer("geometry"), answer("geometry"))["right"]
    outside = Truth("outside", ("cable",), (frozenset(),), True, ("q1", "load_x", "position"))
    for driver in ("joint q1", "load x", "workspace"):
        assert judged(outside, answer(outside=True, drivers=(driver,)), None)["right"]
    assert judged(outside, answer(outside=True, drivers=("temperature", "joint q1")), None)["right"]
    assert not judged(outside, answer(outside=True, drivers=("joint q2",)), None)["right"]
    assert not judged(outside, answer(), None)["right"]
    data = Truth("data", ("sign",), (frozenset(),), None, (), ("sign",))
    assert (
        judged(data, answer("backlash"), None)["right"] and judged(data, {"failed": "look at the sign"}, None)["right"]
    )
    assert not judged(data, {"failed": "no"}, None)["right"]


def test_figures_count_claims_and_alarms() -> None:
    truth = Truth("none", (), (frozenset(),))
    about = {"kind": "none", "noise_kind": "white", "family": "none", "shrink": None}
    cases = [about | judged(truth, answer(), None), about | judged(truth, answer("drift"), None)]
    found = figures(cases)
    assert found["none, false alarms, white noise"]["share"] == 0.5
    assert found["claims of 0.95 and more, right"]["of"] == 2 and found["wrong name above 0.9"]["count"] == 1


def test_a_case_is_diagnosed_from_files() -> None:
    case = source_of("adversarial").make("rows_35", 3)
    assert isinstance(case, SourceCase)
    found = diagnosed(case, case.columns)
    assert found["verdict"]["effects"] and found["true_shrink"]["true"] > 0.5
    cut = {name: np.asarray(values)[:10] for name, values in case.columns.items()}
    assert "10 rows are too few" in diagnosed(case, cut)["failed"]


def test_the_command(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccnn_validation.sources.adversarial.FAMILIES", ("rows_35",))
    out = tmp_path / "out"
    # Processes would take longer to start than the cases take.
    words = ("blind-check", "--source", "adversarial", "--cases", "1", "--engine", "local", "--out", str(out))
    code, said, errors = cli(*words)
    assert code == 0, errors
    assert "Source adversarial" in said and "Right answers by family" in said
    found = json.loads((out / "source.json").read_text())
    assert [c["family"] for c in found["cases"]] == ["rows_35"]
    assert (out / "source.csv").is_file() and (out / "source.md").is_file()
    code, _, errors = cli("blind-check", "--source", "nowhere", "--cases", "2", "--out", str(out))
    assert code == 2 and "known: blind, semi_real, multibody, adversarial" in errors
    with pytest.raises(InputError, match="is not there"):
        source_of("nowhere")


def test_a_constant_halved_and_doubled_is_set_back(tmp_path: Path) -> None:
    assert scaled((0.9, 4, 0.2), 2.0) == (pytest.approx(0.95), 8, 0.4) and scaled(1, 0.5) == 1
    before = form_error.OF_FORM
    table = ablate(["adversarial"], 1, tmp_path, 3, "a factor of 4", "local")
    assert [row[0] for row in table.rows] == ["evidence/form_error OF_EXACT, OF_FORM, OF_SMOOTH"]
    assert before == form_error.OF_FORM and len(list(tmp_path.glob("*.json"))) == 3
    with pytest.raises(InputError, match="no constant"):
        ablate(["adversarial"], 1, tmp_path, 3, "nobody", "local")
