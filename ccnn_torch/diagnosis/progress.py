"""Which step a diagnosis is at, for whoever watches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Told = Callable[[str, float], None]
"""Called with the name of a step and the share of it that is done, 0 to 1."""

TO_VERDICT = {
    "reading the records": 1.0,
    "searching the effects": 8.0,
    "judging on held-out rows": 2.0,
    "by block": 1.0,
    "next measurements": 1.0,
}
"""Steps to the verdict, with the seconds that each takes for some hundred rows: the time left is told by them."""

TO_REPORT = {"network on the remainder": 8.0, "figures and report": 4.0}
"""Steps from the verdict to the report."""

_WATCHER: ContextVar[Told | None] = ContextVar("watcher", default=None)


@contextmanager
def watched(tell: Told) -> Iterator[None]:
    """Within it, `tell` is called at every step of a diagnosis."""
    token = _WATCHER.set(tell)
    try:
        yield
    finally:
        _WATCHER.reset(token)


def at_step(step: str, share: float = 0.0) -> None:
    """Say that a step has come so far."""
    watcher = _WATCHER.get()
    if watcher is not None:
        watcher(step, share)
