"""What all tests share: one thread, blank figures, and the command line in this process.

One thread: the tensors are small, and threads of two processes would wait for each other.
"""

from __future__ import annotations

import functools
import gc
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

# Before numpy is loaded, which reads it once; processes that tests start inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch
import typer.main
from matplotlib.figure import Figure

from ccnn_torch.cli import main

torch.set_num_threads(1)
# Rewriting the tests' asserts is 10 s of each worker, compiling the package half a second of each process that tests
# start: both are kept for the next, whatever the environment says.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# 700 new objects, Python's own threshold, are made by one operation on tensors, and by a line of a test that is read.
gc.set_threshold(50_000, 10, 10)
# A process runs one command, and the tests a thousand: typer reads the signatures of all commands for each.
typer.main.get_command = functools.cache(typer.main.get_command)


def pytest_collection_finish() -> None:
    """What the imports left is there to stay: the garbage collector need not look at it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def _blank_figures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Figures are made and written, but blank and of a few pixels: drawing them is a third of a run with a page.

    Not in tests/report, nor in a module that says `DRAWN = True`.
    """
    with pytest.MonkeyPatch.context() as patch:
        if "report" not in request.path.parts and not hasattr(request.module, "DRAWN"):
            patch.setattr(Figure, "draw", lambda figure, renderer: None)
            patch.setattr(Figure, "get_layout_engine", lambda figure: None)
            patch.setattr("ccnn_torch.report.figures._PNG_DPI", 5)
        yield


@pytest.fixture
def cli(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run `ccnn WORDS…` in this process; returns exit code, stdout and stderr."""

    def call(*words: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["ccnn", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err

    return call


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fuzz-cases",
        type=int,
        default=None,
        metavar="N",
        help="cases of every fuzzer (tests/fuzz), drawn anew each time",
    )
