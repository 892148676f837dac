"""The two consoles: results on stdout, progress and notes on stderr if it is a terminal."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from ccnn_torch.report.table import print_text

__all__ = ["note", "progress_bar", "say", "say_place", "stderr", "stdout", "with_status"]

_Result = TypeVar("_Result")

# Without rich's markup: a name or a path may have [brackets] in it.
stdout = Console(markup=False, emoji=False)
stderr = Console(stderr=True, markup=False, emoji=False)


def note(text: str, quiet: bool = False) -> None:
    """Print a line on stderr if it is a terminal."""
    if stderr.is_terminal and not quiet:
        print_text(text, stderr, "dim")


def progress_bar(quiet: bool, steps: bool = False, transient: bool = False) -> Progress:
    """Bars on stderr, each with its label and the time left; silent off a terminal.

    Args:
        quiet: silent on a terminal as well.
        steps: show `done/total` instead of percent, and the field `note` of each bar.
        transient: remove the bars at the end.
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn() if steps else TaskProgressColumn(),
        TimeRemainingColumn(),
        *([TextColumn("{task.fields[note]}", markup=False)] if steps else []),
    )
    return Progress(*columns, console=stderr, disable=quiet or not stderr.is_terminal, transient=transient)


def with_status(text: str, work: Callable[[Callable[[str], None]], _Result], quiet: bool) -> _Result:
    """Do work of unknown length; a terminal shows `text` and the progress that the work reports."""
    if quiet or not stderr.is_terminal:
        return work(lambda progress: None)
    with stderr.status(text) as status:
        return work(lambda progress: status.update(f"{text} {progress}"))


def say(text: str) -> None:
    """Print a result on stdout, wrapped between words at the width of the terminal."""
    print_text(text, stdout)


def say_place(text: str) -> None:
    """Print a line with a path on stdout, without wrapping."""
    print_text(text, stdout, wrap=False)
