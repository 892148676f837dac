"""The words that commands with a config have in common: CONFIG or --config, key=value, --records, --mechanism, …"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import typer

from ccnn_torch.errors import InputError


def config_and_changes(words: Sequence[object], option: Path | None, **given: object) -> tuple[Path | None, list[str]]:
    """The config file, None without one, and what is put over it as ``key=value``.

    Args:
        words: arguments of the command line: a config, then overrides; None = not given.
        option: the value of --config.
        given: options that are keys, such as `seed`; None = not given.

    Raises:
        InputError: several configs are named.
    """
    texts = [str(word) for word in words if word is not None]
    # A file may have an = in its name; only the first word can be one.
    first = [Path(text) for text in texts[:1] if "=" not in text or Path(text).is_file()]
    if first and option is not None:
        raise InputError(f"two configs are given, {first[0]} and --config {option}; name one")
    changes = [f"{key}={value}" for key, value in given.items() if value is not None]
    return option or next(iter(first), None), [*texts[len(first) :], *changes]


def noted(quiet: bool) -> Callable[[str], None]:
    """What prints a remark on a config, unless nothing is to be printed."""
    return lambda sentence: None if quiet else typer.echo(sentence)
