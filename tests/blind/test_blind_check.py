"""`ccnn blind-check` from plans to figures: what the seal keeps, what is right, and going on where it was stopped."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest
from blind.stand_in import Said, StandIn
from blind.test_blind_machines import planned
from ccnn_validation.blind.check import _generator, run_blind_check
from ccnn_validation.blind.explain import Judge
from ccnn_validation.blind.folder import BlindFolder
from ccnn_validation.blind.generator import judge_cases, open_cases, write_cases
from ccnn_validation.blind.judge import judged
from ccnn_validation.blind.plan import CasePlan
from ccnn_validation.blind.report import share, summary
from ccnn_validation.blind.simulate import simulate
from ccnn_validation.blind.tables import blind_markdown
from frozen import frozen

from ccnn_torch.cli import main
from ccnn_torch.errors import InputError
from ccnn_torch.report.json_files import read_json, write_json

TRUE_SHRINK = (1.0, 0.9, 1.0)


@pytest.fixture
def beside(monkeypatch: pytest.MonkeyPatch) -> None:
    """The generating side without a process of its own, which takes seconds to start."""
    sides = {"write": write_cases, "open": open_cases, "judge": judge_cases}
    monkeypatch.setattr("ccnn_validation.blind.check._generator", lambda what, folder: sides[what](folder))


@pytest.fixture
def fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the library explains of a case is fitted for the first answer and known for the others."""
    known: dict[CasePlan, Judge] = {}
    monkeypatch.setattr("ccnn_validation.blind.judge.Judge", lambda case: known.setdefault(case.plan, Judge(case)))


def check(out: Path, diagnose: StandIn, cases: int = 6) -> Path:
    return run_blind_check(cases, out, diagnose, seed=5, machines=("five_bar",), quiet=True)


@pytest.mark.usefixtures("beside", "fitted_once")
def test_who_knows_the_truth_is_right_and_who_does_not_is_not(tmp_path: Path) -> None:
    ignorant = StandIn(otherwise=Said(("drift",)))
    path = check(tmp_path / "a", ignorant)
    found = read_json(path)
    jsonschema.validate(found, frozen("blind"))
    assert found["targets"]["none, false alarms"]["share"] == 1.0
    truth = read_json(BlindFolder(tmp_path / "a").truth)["cases"]
    lucky = sum("drift" in c["causes"] for c in truth if c["kind"] == "single")
    assert found["targets"]["single, exact"]["count"] == lucky
    assert found["targets"]["claims"]["share"] < 0.5
    # All single causes but bad rows were diagnosed again without their effect, and nothing else was.
    again = {number: names for number, names in ignorant.asked if names is not None}
    assert set(again) == {c["number"] for c in truth if c["kind"] == "single" and c["causes"] != ["outlier"]}
    assert all(truth[number]["causes"][0] not in names and len(names) > 10 for number, names in again.items())

    answers = {
        c["number"]: Said(driver=c["drivers"][0][0]) if c["kind"] == "outside" else Said(tuple(c["causes"]), None, 0.97)
        for c in truth
    }
    known = read_json(check(tmp_path / "b", StandIn(answers)))
    for figure in ("single, right", "single, exact", "pair, right", "pair, found", "outside, right driver", "claims"):
        assert known["targets"][figure]["share"] == 1.0, figure
    assert known["targets"]["none, false alarms"]["count"] == 0
    with (tmp_path / "b" / "blind.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {"all", "by_machine", "by_cause", "withheld", "reliability"} <= {row["group"] for row in rows}
    assert "| single, right |" in (tmp_path / "b" / "blind.md").read_text() == blind_markdown(known)


def test_seconds_are_those_of_the_longest_records() -> None:
    took = [("tripod", 400, 0.5), ("tripod", 400, 0.7), ("tripod", 400, 1.5), ("tripod", 40, 9.0), ("delta", 100, 9.0)]
    said = {"effects": [], "outside": False}
    keys = {"kind": "none", "causes": [], "class": [], "strength": 3.0, "disturbance": "", "noise_told": True}
    cases = [
        {**keys, "withheld": None, "machine": machine, "rows": rows, "answer": {**said, "seconds": seconds}}
        for machine, rows, seconds in took
    ]
    found = summary(cases)["seconds_by_machine"]
    assert found["rows"] == 400 and [*found["machines"]] == ["tripod"]
    tripod = found["machines"]["tripod"]
    assert (tripod["median"], tripod["most"]) == (0.7, 1.5) and tripod["ninth_decile"] == pytest.approx(1.34)
    assert (tripod["below_1_s"]["count"], tripod["below_1_s"]["of"]) == (2, 3)


@pytest.mark.usefixtures("beside")
def test_going_on_and_the_seal(tmp_path: Path) -> None:
    folder = BlindFolder(tmp_path)

    class Stopped(Exception):
        pass

    class Stops(StandIn):
        def __call__(self, *args: object, **keys: object) -> Said:
            if len(self.asked) == 2:
                raise Stopped
            return super().__call__(*args, **keys)  # type: ignore[arg-type]

    with pytest.raises(Stopped):
        check(tmp_path, Stops(), 3)
    assert not folder.truth.exists()
    with pytest.raises(InputError, match="case 2 is not diagnosed yet; the seal stays closed"):
        open_cases(folder)
    # What the diagnosing side can read tells nothing of causes.
    told = json.dumps(read_json(folder.public)) + json.dumps(read_json(folder.seal))
    truth_words = ("causes", "kind", "strength", "offset", "backlash", "single")
    assert not any(word in told for word in truth_words)
    with pytest.raises(InputError, match="differs in cases"):
        check(tmp_path, StandIn(), 4)
    went_on = StandIn()
    path = check(tmp_path, went_on, 3)
    assert [number for number, names in went_on.asked if names is None] == [2]
    before = path.read_text()
    idle = StandIn()
    assert check(tmp_path, idle, 3).read_text() == before and not idle.asked


@pytest.mark.usefixtures("beside")
def test_records_changed_after_sealing_are_refused(tmp_path: Path) -> None:
    class Meddles(StandIn):
        def __call__(self, *args: object, **keys: object) -> Said:
            path = BlindFolder(tmp_path).records(1)
            path.write_text(path.read_text() + "\n")
            return super().__call__(*args, **keys)  # type: ignore[arg-type]

    with pytest.raises(InputError, match="was changed after it was sealed"):
        check(tmp_path, Meddles(), 2)


def test_the_process_of_its_own(tmp_path: Path) -> None:
    """It writes what the same side writes here, bit by bit."""
    folders = [BlindFolder(tmp_path / name) for name in ("here", "there")]
    for folder in folders:
        folder.path.mkdir()
        write_json(folder.settings, {"cases": 1, "seed": 3, "machines": ["five_bar"], "kinds": ["single"]})
    write_cases(folders[0])
    _generator("write", folders[1])
    assert folders[0].seal.read_text() == folders[1].seal.read_text()
    assert folders[0].records(0).read_text() == folders[1].records(0).read_text()


def test_classes_are_what_the_rows_cannot_tell_apart() -> None:
    offset, frame, weak = simulate(
        [
            planned("five_bar", "single", "joint_offset"),
            planned("five_bar", "single", "frame", number=1),
            replace(planned("five_bar", "single", "compliance", number=2), strength=0.1),
        ],
        0,
    )
    # The five-bar's drives have an offset among their dimensions.
    assert {"joint_offset", "geometry"} <= set(Judge(offset).members(["joint_offset"]))
    assert "compliance" not in Judge(offset).members(["joint_offset"])
    assert Judge(frame).explained(["frame"]).left < 1e-3
    assert Judge(frame).explained(["frame"]).shrink() == pytest.approx(1.0, abs=1e-6)
    assert Judge(frame).explained(["compliance"]).shrink([0, 3]) < 0.5
    assert Judge(frame).explained([]).left == pytest.approx(100 * frame.true.numel(), rel=1e-4)
    # A tenth of the noise is explained by anything.
    assert len(Judge(weak).members(["compliance"])) > 8


@pytest.mark.usefixtures("fitted_once")
def test_answers_are_judged() -> None:
    (pair,) = simulate([replace(planned("five_bar", "pair", "backlash", "drift", rows=100), strength=3.0)], 0)

    def said(*effects: str, **keys: object) -> dict[str, object]:
        return judged(pair, Said(effects, **keys).to_json(), None)["answer"]  # type: ignore[arg-type]

    both = said("drift", "backlash", shrink=TRUE_SHRINK)
    assert both["exact"] and both["right"] and both["found"] == 2
    assert both["shrink"]["holds"] and 0.98 < both["shrink"]["true"] <= 1  # type: ignore[index]
    one = said("backlash", shrink=TRUE_SHRINK)
    assert not one["right"] and one["found"] == 1 and not one["shrink"]["holds"]  # type: ignore[index]
    assert not said("drift", "backlash", "frame")["right"]
    assert not said("drift", "backlash", driver="workspace")["right"]
    assert not said(driver="time")["right"]

    (outside,) = simulate([planned("five_bar", "outside", "time")], 0)
    assert judged(outside, Said(driver="time").to_json(), None)["answer"]["right"]
    assert not judged(outside, Said(driver="workspace").to_json(), None)["answer"]["right"]
    assert not judged(outside, Said(("drift",)).to_json(), None)["answer"]["right"]

    (single,) = simulate([planned("five_bar", "single", "drift")], 0)
    for answer, right, wrong, hidden in (
        (Said(driver="time"), True, False, False),
        (Said(("backlash",)), False, True, False),
        (Said(("drift",)), True, False, True),
    ):
        found = judged(single, Said(("drift",)).to_json(), answer.to_json())["withheld"]
        assert (found["right"], found["wrong_name"], found["hidden"]) == (right, wrong, hidden)
    assert judged(single, {"failed": "no."}, None)["answer"] == {"failed": "no."}


def test_the_command_refuses_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, said in (
        (("--cases", "2", "--mechanism", "crane"), "--mechanism: 'crane' is not there"),
        (("--cases", "0"), "--cases: generate at least 1 case"),
        (("--cases", "2", "--kinds", "single,many"), "--kinds: 'many' is not there"),
    ):
        monkeypatch.setattr(sys, "argv", ["ccnn", "blind-check", "--out", str(tmp_path / "x"), *words])
        with pytest.raises(SystemExit) as ended:
            main()
        error = capsys.readouterr().err
        assert ended.value.code == 2 and said in error and error.count("\n") == 1
    assert not (tmp_path / "x").exists()


def test_intervals_of_shares() -> None:
    # Clopper and Pearson: of 0 of 10 the upper end is 1 - 0.025 ** (1 / 10).
    assert share([False] * 10)["high"] == pytest.approx(1 - 0.025**0.1)
    assert share([]) == {"count": 0, "of": 0, "share": None, "low": None, "high": None}
    assert share([True, False])["share"] == 0.5
