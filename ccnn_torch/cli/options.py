"""What commands have in common: their options, CONFIG and key=value, and how heavy modules are loaded."""

from __future__ import annotations

import gc
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.errors import InputError

MECHANISMS = ("tripod", "machine_tool", "five_bar", "overconstrained_2dof", "stewart", "delta", "delta_linear")
"""The registry's names, so that completion need not load torch; a test compares the two."""


def complete_mechanism(incomplete: str) -> list[str]:
    """Built-in mechanisms whose names begin with `incomplete`."""
    return [name for name in MECHANISMS if name.startswith(incomplete)]


MECHANISM = typer.Option(
    help="A mechanism's name, its file, or path/to/file.py:Name.", autocompletion=complete_mechanism
)
Config = Annotated[Path | None, typer.Argument(help="A YAML config, for example one of experiments/.")]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="A YAML config, of this command or of ccnn run.")]
Overrides = Annotated[list[str] | None, typer.Argument(help="key=value or key.sub=value, over the config.")]
Words = Annotated[
    list[str] | None,
    typer.Argument(metavar="[CONFIG] [KEY=VALUE]...", help="A config, and key=value or key.sub=value over it."),
]
Records = Annotated[str | None, typer.Option("--records", help="CSV of joints, measured poses and covariates.")]
Mechanism = Annotated[str | None, MECHANISM]
Out = Annotated[str | None, typer.Option(help="Folder to write; the same as out=….")]
OutFolder = Annotated[Path, typer.Option(help="Folder to write.")]
Seed = Annotated[int | None, typer.Option(help="Random seed; the same as seed=….")]
Resume = Annotated[Path | None, typer.Option(help="Resume the work in this folder.")]
Details = Annotated[bool, typer.Option("--details", help="Show all tables as well.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
Noise = Annotated[
    str | None,
    typer.Option(
        help="Standard deviation of the pose: 1e-5 (m and rad alike), NAME=S,…, or m=10um,rad=30urad; 10um "
        "where the records have positions alone."
    ),
]
Effects = Annotated[str | None, typer.Option(help="Candidates, a,b,…; all = the whole library, which is the default.")]
PublicKey = Annotated[
    Path | None, typer.Option("--public-key", metavar="PUBLIC.pem", help="Take only a model signed by this key.")
]
AllowCode = Annotated[
    bool, typer.Option("--allow-code", help="Run the Python file that the model names as its mechanism.")
]


def config_and_changes(words: Sequence[object], option: Path | None, **given: object) -> tuple[Path | None, list[str]]:
    """The config file, None without one, and what is put over it as ``key=value``.

    Args:
        words: arguments of the command line: a config, then overrides; None = not given.
        option: the value of --config.
        given: options that are keys, such as `seed`; None = not given. Others than texts are written as JSON.

    Raises:
        InputError: several configs are named.
    """
    texts = [str(word) for word in words if word is not None]
    # A file may have an = in its name; only the first word can be one. os.path: a change may be too long for a name.
    first = [Path(text) for text in texts[:1] if "=" not in text or os.path.isfile(text)]
    if first and option is not None:
        raise InputError(f"two configs are given, {first[0]} and --config {option}; name one")
    written = {key: value if isinstance(value, str) else json.dumps(value) for key, value in given.items()}
    changes = [f"{key}={text}" for key, text in written.items() if given[key] is not None]
    return option or next(iter(first), None), [*texts[len(first) :], *changes]


def noted(quiet: bool) -> Callable[[str], None]:
    """What prints a remark on a config, unless nothing is to be printed."""
    return lambda sentence: None if quiet else typer.echo(sentence)


@contextmanager
def loading() -> Iterator[None]:
    """Import without garbage collection, leave what was imported out of later ones, and let torch have one thread.

    Modules are no garbage, but make so many objects that looking for it takes a sixth of the time of the imports. The
    matrices of a diagnosis are small: with two threads 400 rows and 5000 rows took a tenth more time by the clock.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
