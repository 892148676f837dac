"""The two consoles: results on stdout, progress and notes on stderr, the latter only where a person is looking."""

from __future__ import annotations

from rich.console import Console

__all__ = ["note", "stderr", "stdout"]

stdout = Console()
stderr = Console(stderr=True)


def note(text: str, quiet: bool = False) -> None:
    """A line for the person at the terminal; nothing where stderr is a file or a pipe."""
    if stderr.is_terminal and not quiet:
        stderr.print(text, style="dim", highlight=False)
