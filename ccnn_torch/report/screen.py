"""The two consoles: results on stdout, progress and notes on stderr, the latter only where a person is looking."""

from __future__ import annotations

from rich.console import Console

from ccnn_torch.report.table import print_text

__all__ = ["note", "say", "say_place", "stderr", "stdout"]

# Nothing that is shown is markup of rich's: a name or a path may have [brackets] in it.
stdout = Console(markup=False, emoji=False)
stderr = Console(stderr=True, markup=False, emoji=False)


def note(text: str, quiet: bool = False) -> None:
    """A line for the person at the terminal; nothing where stderr is a file or a pipe."""
    if stderr.is_terminal and not quiet:
        print_text(text, stderr, "dim")


def say(text: str) -> None:
    """A result in words on stdout, broken between words where a terminal is narrow."""
    print_text(text, stdout)


def say_place(text: str) -> None:
    """A line on stdout with a path, which stays in one piece to be copied."""
    print_text(text, stdout, wrap=False)
