"""The command line: `ccnn COMMAND …` = `python -m ccnn_torch COMMAND …`, one file per command.

Exit codes: 0 done, 2 bad input (one sentence on stderr), 130 interrupted, 1 a bug (with its traceback). `ccnn verify`
also ends with 1 where a promise is not kept.
"""

import gc
import os
import signal
import sys
from contextlib import suppress
from types import FrameType

_IMPORT = "<frozen importlib"
_OBJECTS = 100_000
"""New objects after which cycles are looked for. The 700 of Python make it search the 200,000 of the imports often."""


def main() -> None:
    """Entry point of the console script: Ctrl-C ends it with one line from its first import on."""
    gc.set_threshold(_OBJECTS, 20, 100)
    # An ignored signal (nohup) stays ignored, and only the main thread sets a handler.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        with suppress(ValueError):
            signal.signal(signal.SIGINT, _interrupted)
    try:
        from ccnn_torch.cli.application import main as run_command

        run_command()
    except KeyboardInterrupt:
        _end()


def _interrupted(number: int, frame: FrameType | None) -> None:
    """Within an import end at once: modules turn a KeyboardInterrupt into errors of their own, or load by halves."""
    at = frame
    while at is not None and not at.f_code.co_filename.startswith(_IMPORT):
        at = at.f_back
    if at is not None:
        _end()
    signal.default_int_handler(number, frame)


def _end() -> None:
    with suppress(OSError):
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, b"interrupted; what was written so far is kept\n")
    os._exit(130)
