"""The two consoles: results on stdout, progress and notes on stderr if it is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from ccnn_torch.report.table import print_text

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


@contextmanager
def step_bar(steps: Mapping[str, float], quiet: bool) -> Iterator[Callable[..., None]]:
    """One bar over several steps, with the time left; silent off a terminal, removed at the end.

    Args:
        steps: names in their order, and about the seconds that each takes.
        quiet: silent on a terminal as well.

    Yields:
        `tell(step, share, note)`: the step that is at work, the share of it that is done, 0 to 1, and a remark on it;
        without a step the one before goes on.
    """
    names, at = list(steps), (next(iter(steps)), 0.0)
    with progress_bar(quiet, transient=True) as bar:
        task = bar.add_task(names[0], total=sum(steps.values()))

        def tell(step: str = "", share: float = 0.0, note: str = "") -> None:
            nonlocal at
            at = (step, share) if step else at
            place = names.index(at[0])
            done = sum(steps[before] for before in names[:place]) + at[1] * steps[at[0]]
            label = f"{place + 1} of {len(names)}: {at[0]}{f' ({note})' if note else ''}"
            bar.update(task, description=label, completed=done)

        tell()
        yield tell


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
