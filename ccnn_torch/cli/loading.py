"""Quick loading of the heavy modules of a command of seconds."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager


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
