"""`ccnn suite` from its file to the comparison of methods, and going on where it was stopped."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from frozen import frozen
from rich.console import Console

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.statistics import spread
from ccnn_torch.errors import InputError
from ccnn_torch.report.json_files import plain
from ccnn_torch.report.results.run import RunResults
from ccnn_torch.study.suite import compare, load_suite, run_suite, suite_page, write_suite

# Its figures are looked at.
DRAWN = True

ROOT = Path(__file__).parent.parent
TINY = """
base:
  case: realistic
  methods: [constant, ccnn]
  repeats: 2
  training: {early_stop: false}
  ccnn: {hidden: [3], population: 8, generations: 3, members: 1, refinement_iterations: 2}
cases:
  - {name: platform, realistic: {cause: geometry, rows: 40}}
  - {name: reach, realistic: {machine: arm, cause: backlash, rows: 40}, split: {kind: block}}
"""


def written(folder: Path, text: str = TINY) -> Path:
    path = folder / "tiny.yaml"
    path.write_text(text)
    return path


def stamps(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_a_suite_runs_its_cases_and_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    keys = [f"out={tmp_path / 'out'}", "seed=2"]
    suite = load_suite(written(tmp_path), keys)
    kept, stopped = tmp_path / "out" / "platform", tmp_path / "out" / "reach"
    run_suite(replace(suite, runs={"platform": suite.runs["platform"]}), quiet=True)
    before = stamps(kept)
    # As a run that was killed before its first checkpoint leaves it.
    stopped.mkdir()
    (stopped / "config.yaml").write_text(suite.runs["reach"].to_yaml())
    path = run_suite(suite, quiet=True)
    assert stamps(kept) == before
    comparison = json.loads(path.read_text())
    jsonschema.validate(comparison, frozen("suite"))
    assert [case["name"] for case in comparison["cases"]] == ["platform", "reach"]
    assert [case["split"] for case in comparison["cases"]] == ["random", "block"]
    for case in comparison["cases"]:
        results = json.loads((tmp_path / "out" / case["name"] / "results.json").read_text())
        jsonschema.validate(results, frozen("results"))
        assert results["case"].startswith("realistic:") and results["seed"] == 2
        # The machine under the compensated command is solved again: less is left of its error.
        position = results["pose"]["position"]
        assert 1e-5 < position["after"]["rms"]["median"] < position["before"]["rms"]["median"]
        mine, its = case["methods"]["ccnn"], results["methods"]["ccnn"]
        assert mine["mse"] == its["test"]["all"]["mse"]
        assert mine["ratio_to_floor"]["values"] == pytest.approx(its["ratio_to_floor"]["values"])
        assert not list((tmp_path / "out" / case["name"]).glob("*.onnx"))
    for name in ("suite.csv", "suite.md"):
        assert (tmp_path / "out" / name).is_file()
    with pytest.raises(InputError, match="platform holds a run that differs in seed"):
        run_suite(load_suite(written(tmp_path), [*keys, "seed=3"]), quiet=True)


def test_overrides_reach_every_case_and_sections_are_merged(tmp_path: Path) -> None:
    suite = load_suite(written(tmp_path), ["realistic.noise=1e-6", "repeats=4", "name=short"])
    assert suite.name == "short" and suite.out == Path("runs/short")
    assert [c.realistic.noise for c in suite.runs.values()] == [1e-6, 1e-6]
    assert [c.realistic.rows for c in suite.runs.values()] == [40, 40]
    assert [c.realistic.machine for c in suite.runs.values()] == ["tripod", "arm"]
    assert all(c.repeats == 4 and not c.save_models for c in suite.runs.values())
    assert suite.runs["reach"].split.kind == "block" and suite.runs["reach"].split.test == 0.3


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("base: {}\n", "cases"),
        ("cases: []\n", "cases: must have at least 1 item"),
        ("cases: [{case: tripod}]\n", "case 1: name: must be letters"),
        ("cases: [{name: a/b, case: tripod}]\n", "not 'a/b'"),
        ("cases: [{name: a, case: tripod}, {name: a, case: tripod}]\n", "'a' is given twice"),
        (
            "cases: [{name: a, case: tripod, repeat: 3}]\n",
            "'a': there is no key 'repeat'; did you mean 'repeats'?",
        ),
        ("case: tripod\n", "there is no key 'case'; did you mean 'cases'?"),
    ],
)
def test_a_bad_suite_is_refused_in_one_sentence(tmp_path: Path, text: str, part: str) -> None:
    with pytest.raises(InputError) as refused:
        load_suite(written(tmp_path, text))
    assert part in str(refused.value) and "\n" not in str(refused.value)


def test_the_shipped_suite_is_broad() -> None:
    suite = load_suite(ROOT / "experiments" / "realistic.yaml")
    cases = list(suite.runs.values())
    assert len(cases) >= 24
    assert len({(c.realistic.machine, c.realistic.cause) for c in cases}) == 18
    assert {c.realistic.rows for c in cases} >= {60, 100, 200, 400, 1000, 2000}
    assert {c.realistic.noise for c in cases} == {1e-6, 5e-6, 1e-5}
    assert {c.realistic.strength for c in cases} == {0.5, 1.0, 3.0}
    blocks = sum(c.split.kind == "block" for c in cases)
    assert len(cases) / 4 < blocks < len(cases) / 2


def results(floor: list[float] | None, **errors: list[float] | None) -> RunResults:
    """What `compare` reads of a run; None = the method failed."""

    def block(values: list[float]) -> dict[str, Any]:
        return {"all": {measure: spread(values) for measure in ("mse", "mae", "sse")}}

    def mse(values: list[float]) -> dict[str, Any]:
        return {"all": {"mse": spread(values)}}

    methods = {
        name: {"test": None, "failed": "singular"} if values is None else {"test": block(values), "seconds": None}
        for name, values in errors.items()
    }
    one = spread([1.0])
    position = {"unit": "m", "before": {"rms": one, "max": one}, "after": {"rms": one, "max": one}}
    return RunResults.model_validate(
        {
            "name": "made up",
            "seed": 0,
            "repeats": 3,
            "joints": [{"name": "q1", "unit": "m"}],
            "rows": {"train": 10, "validation": 2, "test": 4},
            "before": {},
            "floor": None if floor is None else {"realised": mse(floor), "expected": mse(floor)},
            "constant": {"test": block([9.0, 9.0, 9.0])},
            "methods": methods,
            "pose": {"position": position, "rotation": None},
        }
    )


def split(kind: str) -> RunConfig:
    return RunConfig.from_keys(case="tripod", split={"kind": kind})


def test_best_tied_and_close_are_what_their_definitions_say(tmp_path: Path) -> None:
    first = results([1.0, 2.0, 4.0], gp=[2.0, 4.0, 8.0], ccnn=[1.9, 4.1, 8.4], grnn=[2.1, 4.2, 8.2])
    second = results([1.0, 1.0, 1.0], gp=None, ccnn=[2.0, 2.0, 2.0], grnn=[3.0, 3.0, 3.0])
    about = dict.fromkeys(("a", "b"), split("random"))
    found = compare("two", {"a": first, "b": second}, about, {"c": "nothing was measured"})
    jsonschema.validate(plain(found), frozen("suite"))
    a, b = found["cases"]
    assert a["best"] == "gp" and b["best"] == "ccnn"
    # Ratios by repeat: 0.95, 1.025, 1.05 hold 1; 1.05, 1.05, 1.025 do not, but are close.
    flags = {name: (block["best"], block["tied"], block["close"]) for name, block in a["methods"].items()}
    assert flags == {
        "gp": (True, True, True),
        "ccnn": (False, True, True),
        "grnn": (False, False, True),
        "constant": (False, False, False),
    }
    assert a["methods"]["gp"]["ratio_to_floor"]["values"] == [2.0, 2.0, 2.0]
    assert b["failed_methods"] == {"gp": "singular"}
    gp, ccnn = found["methods"]["gp"], found["methods"]["ccnn"]
    assert (gp["cases"], gp["failed"], gp["best_or_tied"], gp["share"]["best_or_tied"]) == (2, 1, 1, 0.5)
    assert (ccnn["best"], ccnn["best_or_tied"], ccnn["close"]) == (1, 2, 2)
    assert ccnn["typical_ratio_to_best"] == pytest.approx(1.025**0.5)
    write_suite(tmp_path, found)
    with (tmp_path / "suite.csv").open() as file:
        rows = list(csv.DictReader(file))
    ratio = [r for r in rows if (r["case"], r["method"], r["quantity"]) == ("a", "ccnn", "ratio_to_best")]
    assert [float(v) for v in ratio[0]["values"].split()] == pytest.approx([0.95, 1.025, 1.05])
    text = suite_page(found).markdown()
    assert "ccnn is the best method or tied with it in 2 of 2 cases (100 %)" in text
    assert "gp; ccnn tied and close (1.02)" in text
    assert "gp failed in 1 case ('b'): singular" in text and "case 'c' failed: nothing was measured" in text
    console = Console(record=True, width=80)
    suite_page(found).show(console)
    assert "How often a method is the best" in console.export_text()


def test_cases_without_a_floor_are_compared_with_the_best() -> None:
    found = compare("one", {"a": results(None, gp=[1.0, 1.0, 1.0])}, {"a": split("block")}, {})
    assert found["cases"][0]["methods"]["constant"]["ratio_to_floor"] is None
    assert "ratio to that of the best method" in suite_page(found).markdown()
