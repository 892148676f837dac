"""What every case of a fuzzer must keep to, whatever it feeds the command line."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import signal
import sys
import traceback
import unicodedata
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType

from ccnn_torch.cli import main

__all__ = ["Outcome", "finite_files", "judged", "limited"]

LONGEST_SECONDS = 60
LONGEST_SENTENCE = 2100


class TooLongError(Exception):
    """A case went on for more than a minute."""


class Outcome(tuple[int, str, str]):
    """Exit code, stdout, stderr."""

    @property
    def code(self) -> int:
        return self[0]


def judged(words: Sequence[object], folder: Path) -> Outcome:
    """Run `ccnn WORDS…` in this process, and hold it to the contract.

    Exit code 0, or 2 with one sentence on stderr; no exception, no traceback, no control character, within a minute;
    after exit 0 every number that was written under the folder is finite.
    """
    out, err = io.StringIO(), io.StringIO()
    code, trace = 0, ""
    before = sys.argv, os.getcwd()
    sys.argv = ["ccnn", *map(str, words)]
    os.chdir(folder)
    told = warnings.catch_warnings(record=True)
    with limited(), told as warned, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        warnings.simplefilter("default")
        try:
            main()
        except SystemExit as ended:
            code = int(ended.code or 0)
        except BaseException:
            trace = traceback.format_exc()
    sys.argv = before[0]
    os.chdir(before[1])
    # On a command line a warning goes to stderr, where only the one sentence may be.
    said = err.getvalue() + "".join(f"{w.category.__name__}: {w.message}\n" for w in warned if code == 2)
    about = f"ccnn {' '.join(map(str, words))}\nexit {code}\n{said}{trace}"
    assert not trace and "Traceback" not in said + out.getvalue(), about
    assert code in (0, 2), about
    assert len(said) < LONGEST_SENTENCE, about
    assert all(c == "\n" or unicodedata.category(c) not in ("Cc", "Cf") for c in said), about
    if code == 2:
        assert len(said.strip().splitlines()) == 1, about
    else:
        assert list(finite_files(folder)) == [], about
    return Outcome((code, out.getvalue(), said))


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Within it no more than a minute."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLongError

    old = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LONGEST_SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)


def finite_files(folder: Path) -> Iterator[str]:
    """Files that the package wrote and that hold NaN or infinity; JSON has no such word, CSV may not."""
    for path in folder.rglob("*"):
        if path.suffix == ".json" and path.name != "card.json":
            text = path.read_text()
            if any(word in text for word in ("NaN", "Infinity")):
                yield str(path)
            json.loads(text)
        elif path.name == "results.csv":
            with path.open(newline="") as file:
                yield from (
                    f"{path}: {row}" for row in csv.reader(file) if {"nan", "inf", "-inf"} & {*map(str.lower, row)}
                )


def columns(path: Path) -> dict[str, list[float]]:
    """Numbers of a CSV file by name without unit; NaN where a cell is none."""
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    names = [cell.partition("[")[0] for cell in header]

    def number(cell: str) -> float:
        try:
            return float(cell)
        except ValueError:
            return math.nan

    return {name: [number(row[k]) for row in rows] for k, name in enumerate(names)}
