"""The application `ccnn`: register the commands; turn errors into one sentence and an exit code."""

from __future__ import annotations

import gc
import io
import os
import sys
from typing import Annotated

import typer

from ccnn_torch.cli.from_records import check, diagnose, identify, new, run
from ccnn_torch.cli.start import start
from ccnn_torch.cli.studies import blind_check, compare, keys, plan, simulate, suite, sweep
from ccnn_torch.cli.with_model import compensate, export, report, sign, verify
from ccnn_torch.display import visible
from ccnn_torch.errors import InputError, MethodFailedError, out_of_memory
from ccnn_torch.run_folder.folder import Stopped
from ccnn_torch.version import __version__

# Maximum characters of a message. The longest of this package, which lists wrong keys, has some hundreds.
_LONGEST = 2000

app = typer.Typer(
    name="ccnn",
    help="Neural compensation of robot kinematics: measured records in, corrected commands and a model file out.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ccnn_torch {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _common(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


for _command in (
    start,
    new,
    run,
    suite,
    sweep,
    identify,
    compensate,
    export,
    verify,
    compare,
    plan,
    simulate,
    diagnose,
    check,
    blind_check,
    report,
    sign,
    keys,
):
    app.command()(_command)


def main() -> None:
    """Run the command of `sys.argv`, and end the process with its exit code."""
    # Set before torch is loaded. With busy-waiting threads, two runs at once on two cores took tens of times as long;
    # a single run showed no clear difference.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Libraries refuse to load where these are no such thing. Figures need no window, and no file has a date.
    os.environ["MPLBACKEND"] = "agg"
    os.environ.pop("SOURCE_DATE_EPOCH", None)
    for stream in (sys.stdout, sys.stderr):
        # A code page may lack µ or →.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        # 130: Ctrl-C in a command that has no message of its own for it.
        code = app(standalone_mode=False) or 0
    except (InputError, MethodFailedError) as problem:
        code = _say(str(problem))
    except typer.TyperException as problem:
        code = _say(f"{problem.format_message()} (see ccnn --help or ccnn COMMAND --help)")
    except OSError as problem:
        # Errors without a message of their own: stdout on a full disk, a folder that was deleted meanwhile.
        code = _say(f"{problem.filename or 'the output'}: {problem.strerror or problem}")
    except Stopped as stopped:
        _say(str(stopped))
        sys.exit(130)
    except typer.Abort:
        code = 130
    except (MemoryError, RuntimeError) as problem:
        if not out_of_memory(problem):
            raise
        code = _say("there is not enough memory for this: end other programs, or give less at once")
    if code == 130:
        _say("interrupted; what was written so far is kept")
    # The interpreter looks for garbage once more before it ends: a fifth of a second over torch's objects.
    gc.freeze()
    sys.exit(code)


def _say(sentence: str) -> int:
    """Print one line on stderr, with control characters escaped; return the exit code of bad input."""
    typer.echo(visible(" ".join(sentence.split()), _LONGEST), err=True)
    return 2
