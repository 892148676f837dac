"""`ccnn new`: a commented config to start from."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.errors import InputError


def new(
    records: Annotated[Path, typer.Argument(metavar="RECORDS.csv", help="Measured rows, with a line of headers.")],
    out: Annotated[Path, typer.Option(metavar="CONFIG.yaml", help="The config to write.")],
    mechanism: Annotated[
        str | None, typer.Option(help="A mechanism's name or file.", autocompletion=complete_mechanism)
    ] = None,
    units: Annotated[
        str | None, typer.Option(metavar="LENGTH,ANGLE", help="Units of columns without one, e.g. mm,deg.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing CONFIG.yaml.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing, and ask nothing.")] = False,
) -> None:
    """Write a config for ccnn run from a table of measurements, with comments on what was guessed.

    Joints may be called q1, J1, A1, joint_1, axis1 …; the position X, Y, Z; the orientation rx, ry, rz, qw to qz, A, B,
    C (KUKA) or W, P, R (Fanuc). What cannot be guessed is asked for on a terminal; elsewhere a message names it.

    Examples:

    ccnn new measured.csv --out robot.yaml

    ccnn new measured.csv --mechanism my_arm.yaml --units mm,deg --out robot.yaml
    """
    if out.exists() and not force:
        raise InputError(f"{out} is there already; name another file, or give --force to overwrite it")
    from ccnn_torch.files.write import write_whole
    from ccnn_torch.starter.job import starter_config

    ask = (lambda question: str(typer.prompt(question, default="", show_default=False))) if _asks(quiet) else None
    text, ready = starter_config(records, out, mechanism, units, ask)
    write_whole(out, text.encode())
    if quiet:
        return
    typer.echo(f"{out} is written. Check it, then:")
    typer.echo(f"ccnn run {out}" if ready else f"ccnn run {out} mechanism=FILL_IN")


def _asks(quiet: bool) -> bool:
    return not quiet and sys.stdin is not None and sys.stdin.isatty()
