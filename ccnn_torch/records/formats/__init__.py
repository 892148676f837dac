"""Files and folders as other programs write them, each read as one table with our headers.

A form is recognised by the names of files alone; what it needs is imported when it is read.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ccnn_torch.errors import InputError
from ccnn_torch.records.table import Table
from ccnn_torch.spelling import hint

Keys = Mapping[str, Any]
"""What is said of a form beside its path, by key."""


_TEXTS = (".csv", ".txt", ".tsv", ".tab", ".asc", ".dat", ".prn", ".rpt", ".log", "")


class Form(NamedTuple):
    """A form of a file or folder.

    Attributes:
        about: what it is, in the words of a sentence.
        module: file of this folder with its `read(path, keys) -> Table`.
        recognised: whether a path is one, by the names of files.
        keys: what may be said of it.
        motion: whether it is a log of a machine in motion.
        config: lines of a config for its rows, where they are no measured poses.
    """

    about: str
    module: str
    recognised: Callable[[Path], bool]
    keys: Sequence[str] = ()
    motion: bool = False
    config: Sequence[str] = ()


def _has(pattern: str) -> Callable[[Path], bool]:
    return lambda path: path.is_dir() and next(path.glob(pattern), None) is not None


def _is_export(path: Path) -> bool:
    if path.suffix.lower() not in _TEXTS:
        return False
    from ccnn_torch.records.formats.export import recognised

    return recognised(path)


def _is_bag(path: Path) -> bool:
    return any(_has(pattern)(path) for pattern in ("*.mcap", "*.db3", "*.db3.zstd", "*.mcap.zstd"))


FORMS = (
    Form(
        "a LeRobot data set",
        "lerobot",
        lambda path: _has("meta/info.json")(path) or _has("data/*/*.parquet")(path),
        ("episodes", "joints", "units", "calibration", "effort", "velocity"),
        motion=True,
    ),
    Form(
        "a recording of ROS 2",
        "bags",
        lambda path: path.suffix.lower() in (".mcap", ".db3", ".bag") or _is_bag(path),
        ("command", "state", "samples", "joints", "units"),
        motion=True,
    ),
    Form(
        "rows of a ball in sockets (hole_0.csv …)",
        "sockets",
        lambda path: _has("hole_[0-9].csv")(path) or _has("*/hole_[0-9].csv")(path),
        config=(
            "constraint: {kind: sockets, by: [placement]}   # tolerance: how far links may be from the nominal",
            "split: {kind: random, test: 0.3}   # single rows are held out",
        ),
    ),
    Form("a text export with its tables", "export", lambda path: _is_export(path)),
)
"""All forms that are read beside tables."""


def form_of(path: str | Path) -> Form | None:
    """The form of a file or folder; None of a table, or of what is not there."""
    try:
        return next((form for form in FORMS if form.recognised(Path(path))), None)
    except (OSError, ValueError):
        # Who opens it tells what is wrong.
        return None


def read_form(path: str | Path, keys: Keys) -> Table | None:
    """The table of a file or folder in one of the forms; None of another one.

    Raises:
        InputError: it is damaged or lacks something, it is a folder in none of the forms, or a key is not known.
    """
    form = form_of(path)
    if form is None and Path(path).is_dir():
        forms = ", nor ".join(form.about for form in FORMS)
        raise InputError(f"{path}: is a folder and no file, nor {forms}; give a file")
    for key in keys:
        known = form.keys if form else ()
        if key not in known:
            near = hint(key, known) if known else "leave it out"
            raise InputError(
                f"motion_keys: '{key}' says nothing of {path}, {form.about if form else 'a table'}; {near}"
            )
    if form is None:
        return None
    module = importlib.import_module(f"{__name__}.{form.module}")
    table: Table = module.read(Path(path), keys)
    return table
