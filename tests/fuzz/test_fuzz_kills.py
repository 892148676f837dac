"""SIGKILL at a random moment, two at once, and a full disk: the same result at last, or one sentence."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

pytestmark = pytest.mark.fuzz
CASES = 1
ROOT = Path(__file__).parent.parent.parent
_TINY = ["ccnn.generations=6", "ccnn.population=8", "ccnn.hidden=[4]", "ccnn.members=1", "ccnn.refinement_iterations=3"]
_TINY += ["training.checkpoint_every=1", "save_report=false", "--quiet"]
IDENTIFY = "mechanism: tripod\nsimulate: {machines: 2, poses: 12}\nmethods: [lm, tikhonov]\nsave_report: false\n"
SUITE = """\
base: {case: tripod, methods: [constant, grnn], save_report: false, save_models: false}
cases: [{name: a}, {name: b, seed: 3}]
"""
TIMES = ("seconds_by_machine", "seconds", "reach", "stamp", "date", "time", "created")


def command(kind: str, folder: Path, out: str) -> list[str]:
    """What is killed; `out` is in the folder."""
    words = {
        "run": ["run", str(ROOT / "experiments" / "tripod.yaml"), *_TINY],
        "identify": ["identify", "i.yaml", "--quiet"],
        "suite": ["suite", "s.yaml", "--quiet"],
        "blind-check": ["blind-check", "--cases", "1", "--mechanism", "five_bar", "--kinds", "single", "--quiet"],
    }[kind]
    (folder / "i.yaml").write_text(IDENTIFY)
    (folder / "s.yaml").write_text(SUITE)
    return [sys.executable, "-m", "ccnn_torch", *words, *(["--out", out] if kind != "run" else [f"out={out}"])]


def resumed(kind: str, words: list[str], folder: Path, out: str) -> list[str]:
    """What goes on where the kill left it."""
    there = (folder / out / "config.yaml").is_file()
    return [*words[:3], words[3], "--resume", out] if kind in ("run", "identify") and there else words


def content(folder: Path) -> dict[str, object]:
    """Figures and model files of a folder; times differ."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items() if k not in TIMES}
        return [plain(v) for v in value] if isinstance(value, list) else value

    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.name in ("results.json", "identified.json", "suite.json", "blind.json"):
            found[name] = plain(json.loads(path.read_text()))
        elif path.name == "model.safetensors":
            found[name] = path.read_bytes()
    assert found, folder
    return found


def finished(words: list[str], folder: Path) -> None:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0 and "Traceback" not in done.stderr, (words, done.stderr)


_whole: dict[str, tuple[dict[str, object], float]] = {}


@given(kind=st.sampled_from(["run", "run", "run", "identify", "suite", "blind-check"]), share=st.floats(0.0, 1.0))
def test_a_kill_at_any_moment(tmp_path_factory, kind, share) -> None:
    folder = tmp_path_factory.mktemp("kill")
    if kind not in _whole:
        began = time.monotonic()
        finished(command(kind, folder, "whole"), folder)
        _whole[kind] = content(folder / "whole"), time.monotonic() - began
    wanted, seconds = _whole[kind]
    words = command(kind, folder, "out")
    process = subprocess.Popen(
        words, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    time.sleep(share * seconds)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.returncode != 0:
        finished(resumed(kind, words, folder, "out"), folder)
    assert content(folder / "out") == wanted


@given(limit=st.sampled_from([0, 500, 5_000, 50_000]))
def test_a_full_disk(tmp_path_factory, limit) -> None:
    """Of a file that may not grow further the old one stays, and one sentence says so."""
    folder = tmp_path_factory.mktemp("full")
    joints = "\n".join("0.9,0.9,0.9" for _ in range(2000))
    (folder / "IN.csv").write_text(f"q1[m],q2[m],q3[m]\n{joints}\n")
    (folder / "OUT.csv").write_text("old")
    model = ROOT / "checkpoints" / "tripod" / "model.onnx"

    def full() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    words = [sys.executable, "-m", "ccnn_torch", "compensate", str(model), "IN.csv", "OUT.csv"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, preexec_fn=full, timeout=120)
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert (folder / "OUT.csv").read_text() == "old" and sorted(p.name for p in folder.iterdir()) == [
        "IN.csv",
        "OUT.csv",
    ]
