"""`ccnn sweep`, and runs that memory does not hold."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ccnn_torch import api
from ccnn_torch.calibration import prepare
from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.job import RUN
from ccnn_torch.errors import InputError
from ccnn_torch.study.sweep import load_sweep

Cli = Callable[..., tuple[int, str, str]]
QUICK = {"hidden": [3], "restarts": 1, "iterations": 4}


def config_file(folder: Path) -> Path:
    path = folder / "c.yaml"
    path.write_text("case: tripod\nmethods: [constant]\nsave_models: false\nsave_report: false\n")
    return path


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def test_every_combination_is_a_run_and_a_row(cli: Cli, tmp_path: Path) -> None:
    path, out = config_file(tmp_path), tmp_path / "out"
    words = ("sweep", path, "seed=0,1", "split.test=0.2,0.4", "repeats=2", "--out", out)
    code, shown, told = cli(*words)
    assert code == 0, told
    assert "seed-0_split.test-0.2" in shown and f"tensorboard --logdir {out}" in shown
    rows = rows_of(out)
    assert [(row["seed"], row["split.test"]) for row in rows] == [
        ("0", "0.2"),
        ("0", "0.4"),
        ("1", "0.2"),
        ("1", "0.4"),
    ]
    for row in rows:
        results = json.loads((out / row["job"] / "results.json").read_text())
        assert results["seed"] == int(row["seed"]) and results["repeats"] == 2 and row["failed"] == ""
        assert float(row["joint_mse"]) == results["methods"]["constant"]["test"]["all"]["mse"]["median"]
        assert float(row["position_after[m]"]) == results["pose"]["position"]["after"]["rms"]["median"]
    # What is finished is kept; a value more is a job more.
    before = {p: p.stat().st_mtime_ns for p in out.rglob("results.json")}
    (out / rows[0]["job"] / "results.json").unlink()
    assert cli(*words[:2], "seed=0,1,5", *words[3:], "--quiet")[0] == 0
    assert len(rows_of(out)) == 6
    kept = {p: p.stat().st_mtime_ns for p in before if p.parent.name != rows[0]["job"]}
    assert kept == {p: before[p] for p in kept}
    code, _, told = cli(*words[:3], "split.test=0.2,0.4", "repeats=3", "--out", out)
    assert code == 2 and "holds a run that differs in repeats" in told


def test_a_job_that_fails_is_a_row_too(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from ccnn_torch.errors import MethodFailedError\nfrom ccnn_torch.learners.constant import Constant\n"
        "class Never(Constant):\n    def start(self, data):\n        raise MethodFailedError('no')\n"
    )
    config = config_file(tmp_path)
    rows = api.sweep(config, f"methods=constant,{tmp_path / 'mine.py'}:Never", out=tmp_path / "out")
    assert rows[0]["failed"] is None and rows[0]["best_method"] == "constant"
    assert rows[1]["failed"] == "Never: no" and rows[1]["joint_mse"] is None
    with pytest.raises(InputError, match="engine: is 'cloud'; write local"):
        api.sweep(config, "seed=0,1", out=tmp_path / "other", engine="cloud")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (["seed=1"], "name a key that varies"),
        (["seed=0,,1"], "a value is empty"),
        (["seed=0,1", "seed=2,3"], "seed is varied twice"),
        (["seed=0,0"], "is there twice"),
        (["seed=0,x"], "job seed=x: "),
        (["split.tst=0.1,0.2"], "split.tst"),
        (
            [f"{key}={','.join(map(str, range(30)))}" for key in ("seed", "repeats", "order")],
            r"a sweep of 27,000 jobs \(30 of seed x 30 of repeats x 30 of order\): up to 2,000 are taken",
        ),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path: Path, changes: list[str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as told:
        load_sweep(config_file(tmp_path), changes, tmp_path / "out")
    assert "\n" not in str(told.value)


def test_lists_are_one_value(tmp_path: Path) -> None:
    sweep = load_sweep(config_file(tmp_path), ["ccnn.hidden=[4],[6,6]", "methods=[gp,ccnn],'constant'"], tmp_path)
    assert [job.ccnn.hidden for job in sweep.runs.values()] == [(4,), (4,), (6, 6), (6, 6)]
    assert [job.methods for job in sweep.runs.values()][:2] == [["gp", "ccnn"], ["constant"]]
    assert list(sweep.runs)[3] == "ccnn.hidden-6-6_methods-constant"


def test_more_than_memory_holds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys: dict[str, Any] = {"case": "tripod", "methods": ["constant", "bp_lm"], "bp_lm": QUICK}
    each = prepare.memory_of_run(RunConfig.from_keys(**keys), 125, 3)
    monkeypatch.setattr(prepare, "free_memory", lambda: 12 * each)
    assert prepare.check_memory(RunConfig.from_keys(**keys, repeats=6), 125, 3) == []
    assert "may stop the run" in prepare.check_memory(RunConfig.from_keys(**keys, repeats=7), 125, 3)[0]
    for given in ({"max_bytes": each - 1}, {"repeats": 13}):
        needed = f"{each * given.get('repeats', 1):,} bytes"
        with pytest.raises(InputError, match=needed):
            RUN.start(RunConfig.from_keys(**keys, **given, out=str(tmp_path / "no")), quiet=True)
        assert not (tmp_path / "no").exists()
