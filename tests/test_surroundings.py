"""Surroundings that are not as usual: code pages, variables of other programs, Ctrl-C in an import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TRIPOD = Path(__file__).parent.parent / "experiments" / "tripod.yaml"
MAIN = "from ccnn_torch.cli import main; main()"
# Raises SIGINT in the import of a module, as Ctrl-C there does; what catches it makes an ImportError of it.
STOPPED = """
import signal, sys
# A background job has it ignored, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
class Finder:
    def find_spec(self, name, *_):
        if name == {name!r}:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                raise ImportError("half of a module")
sys.meta_path.insert(0, Finder())
"""


def run(code: str, *words: str | Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-c", f"{code}\n{MAIN}", *map(str, words)],
        env=os.environ | environment,
        capture_output=True,
        check=False,
    )


def test_a_run_does_not_depend_on_them(tmp_path: Path) -> None:
    environment = {"PYTHONIOENCODING": "ascii", "MPLBACKEND": "none such", "SOURCE_DATE_EPOCH": "yesterday"}
    keys = ("methods=[constant]", "repeats=1", "save_models=false", f"out={tmp_path / 'r'}")
    done = run("", "run", TRIPOD, *keys, **environment)
    assert done.returncode == 0 and done.stderr == b"", done.stderr
    assert b" ? " in done.stdout and b"removes" in done.stdout
    assert (tmp_path / "r" / "report.html").is_file()


@pytest.mark.parametrize(("module", "words"), [("typer", ["--help"]), ("torch", ["keys"]), ("numpy", ["keys"])])
def test_an_import_is_interrupted_in_one_line(module: str, words: list[str]) -> None:
    done = run(STOPPED.format(name=module), *words)
    assert done.returncode == 130
    assert done.stderr == b"interrupted; what was written so far is kept\n"
