"""Defer Ctrl-C while something is written that must not be cut."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Within it an interrupt (SIGINT) waits; it acts once the block is left, as if it had come then.

    A KeyboardInterrupt inside TensorBoard's queue leaves its lock taken, and closing the writer then waits for ever
    (about one interrupt in a hundred that falls into a write); one inside a finalizer is dropped by Python. Only the
    main thread gets signals, so that elsewhere, or where a program has a handler of its own, nothing is changed.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if came:
            raise KeyboardInterrupt
