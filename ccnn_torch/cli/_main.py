"""Puts the commands together and turns what went wrong into one sentence and an exit code."""

from __future__ import annotations

import sys
from typing import Annotated

import click
import typer

from ccnn_torch import __version__
from ccnn_torch.cli.compensate import compensate
from ccnn_torch.cli.keys import keys
from ccnn_torch.cli.picture import picture
from ccnn_torch.cli.run import run
from ccnn_torch.errors import InputError

__all__ = ["main"]

app = typer.Typer(
    name="ccnn",
    help="Neural compensation of robot kinematics: measured records in, corrected commands and a model file out.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ccnn_torch {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show it.")] = False,
) -> None:
    pass


for _command in (run, compensate, picture, keys):
    app.command(epilog=(_command.__doc__ or "").partition("\n\n")[2])(_command)


def main() -> None:
    """Entry point of the console script."""
    try:
        code = app(standalone_mode=False)
    except InputError as problem:
        code = _say(str(problem))
    except click.exceptions.NoArgsIsHelpError as help_wanted:
        typer.echo(help_wanted.format_message())
        code = 2
    except click.ClickException as problem:
        code = _say(f"{problem.format_message()} (ccnn --help, or ccnn COMMAND --help, tells what there is)")
    except (KeyboardInterrupt, click.Abort):
        _say("interrupted; what was computed is kept")
        code = 130
    sys.exit(code)


def _say(sentence: str) -> int:
    typer.echo(" ".join(sentence.split()), err=True)
    return 2
