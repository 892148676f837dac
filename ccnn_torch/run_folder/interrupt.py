"""Ctrl-C: one sentence on what an interrupted command left behind."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

NOTHING_WRITTEN = "interrupted; nothing was written"


class Stopped(Exception):
    """Ctrl-C was pressed; its text is the message to print."""


@contextmanager
def if_stopped(sentence: str) -> Iterator[None]:
    """Within it Ctrl-C ends the command with this sentence and the exit code 130."""
    try:
        yield
    except KeyboardInterrupt:
        raise Stopped(sentence) from None
