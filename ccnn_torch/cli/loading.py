"""Quick loading of the heavy modules of a command."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["loading"]


@contextmanager
def loading() -> Iterator[None]:
    """Import without garbage collection, and leave what was imported out of later ones.

    Modules are no garbage, but make so many objects that looking for it takes a sixth of the time of the imports.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
