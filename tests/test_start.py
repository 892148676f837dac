"""`ccnn start`: from a table to a verified model by one command, with a gate before each step."""

from __future__ import annotations

import io
import json
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_new_command import QUICK, delta, write

Cli = Callable[..., tuple[int, str, str]]
HEADERS = ["J1", "J2", "J3", "X", "Y", "Z"]
RUN = tuple(key for key in QUICK if key != "save_models=false")


def rows(path: Path, seed: int) -> Path:
    """Rows of a delta robot whose joints are off by 1 mrad, with 5 um of noise."""
    values = delta(60)
    values[:, 3:] += np.random.default_rng(seed).normal(0, 5e-3, (60, 3))
    return write(path, HEADERS, values)


def test_one_command_goes_from_a_table_to_a_verified_model(tmp_path: Path, cli: Cli) -> None:
    records, out = rows(tmp_path / "r.csv", 0), tmp_path / "all"
    code, _, said = cli("start", records, "--out", out)
    assert code == 2 and "--units mm,deg" in said
    code, _, said = cli("start", "--out", out)
    assert code == 2 and "name RECORDS.csv" in said
    flags = ("--mechanism", "delta", "--units", "mm,deg", "--out", out)
    code, shown, said = cli("start", records, *RUN, *flags)
    assert code == 0, said
    assert [f"{step} of 5: " in shown for step in (1, 2, 3, 4, 5)] == [True] * 5
    assert "--new NEW.csv" in shown and (out / "check.json").is_file() and (out / "run" / "model.onnx").is_file()
    # What is there is not made again; new rows judge the model.
    before = (out / "run" / "results.json").stat().st_mtime_ns
    code, shown, said = cli("start", "--out", out, "--new", rows(tmp_path / "n.csv", 1))
    assert code == 0 and shown.count("done before") == 4 and "The promise is kept" in shown, said
    assert (out / "run" / "results.json").stat().st_mtime_ns == before
    # A model that makes held-out rows no better is not judged on others, unless it is wanted.
    results = out / "run" / "results.json"
    content = json.loads(results.read_text())
    content["pose"]["position"]["after"] = content["pose"]["position"]["before"]
    results.write_text(json.dumps(content))
    code, shown, said = cli("start", "--out", out, "--new", tmp_path / "n.csv")
    assert code == 0 and "no better" in shown and "The promise" not in shown, said
    # Nothing found: no model is trained of noise, unless it is wanted.
    found = out / "diagnosis" / "diagnosis.json"
    content = json.loads(found.read_text())
    found.write_text(json.dumps(content | {"verdict": content["verdict"] | {"none": True}}))
    (out / "run" / "results.json").unlink()
    code, shown, _ = cli("start", "--out", out)
    assert code == 0 and "Stopped here" in shown and not (out / "run" / "results.json").exists()
    code, shown, said = cli("start", "--out", out, "--yes")
    assert code == 0 and (out / "run" / "results.json").is_file(), said


def test_on_a_terminal_it_asks(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    answers = io.StringIO("y\ndelta\nmm,deg\nn\n")
    monkeypatch.setattr(answers, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdin", answers)
    code, shown, said = cli("start", rows(tmp_path / "r.csv", 0), "--out", tmp_path / "all")
    assert code == 0 and "Go on?" in shown and "goes on." in shown, said
    text = (tmp_path / "all" / "robot.yaml").read_text(encoding="utf-8")
    assert 'mechanism: "delta"' in text and not (tmp_path / "all" / "check.json").exists()


def test_the_page_of_a_folder_is_opened_or_named(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    page = tmp_path / "report.html"
    code, _, said = cli("report", tmp_path)
    assert code == 2 and "has no report.html" in said
    page.write_text("<p>", encoding="utf-8")
    assert cli("report", tmp_path)[:2] == (0, f"{page}\n") and opened == []
    monkeypatch.setenv("DISPLAY", ":0")
    assert cli("report", tmp_path)[0] == 0 and opened == [page.resolve().as_uri()]
