"""`ccnn check`: which effects records can identify, before a diagnosis."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.cli.diagnose_options import configured
from ccnn_torch.cli.loading import loading
from ccnn_torch.run_folder.interrupt import NOTHING_WRITTEN, if_stopped


def check(
    overrides: Annotated[
        list[str] | None,
        typer.Argument(metavar="[CONFIG] [KEY=VALUE]...", help="A config, and key=value or key.sub=value over it."),
    ] = None,
    records: Annotated[Path | None, typer.Option(help="CSV of joints, measured poses and covariates.")] = None,
    mechanism: Annotated[
        str | None,
        typer.Option(help="A mechanism's name, file, or path/to/file.py:Name.", autocompletion=complete_mechanism),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write check.json to; nothing by default.")] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            help="Standard deviation of the pose: 1e-5 (m and rad alike), NAME=S,…, or m=10um,rad=30urad; 10um "
            "where the records have positions alone."
        ),
    ] = None,
    effects: Annotated[
        str | None, typer.Option(help="Candidates, a,b,…; all = the whole library, which is the default.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="A YAML file with keys as for ccnn diagnose, or one for ccnn run.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing; set the exit code alone.")] = False,
) -> None:
    """Report which effects records can identify: rows, noise, covariates, unidentifiable effects, confusable pairs.

    Examples:

    ccnn check --records measured.csv --mechanism five_bar

    ccnn check --records measured.csv --mechanism my_simulator.py:PRESS
    """
    with loading():
        from ccnn_torch.diagnosis.job import run_check
        from ccnn_torch.diagnosis.outputs import write_check
        from ccnn_torch.diagnosis.page.check import check_table, check_text
        from ccnn_torch.report.screen import say, stdout, with_status
        from ccnn_torch.report.table import print_table

    with if_stopped(NOTHING_WRITTEN):
        wanted = configured(overrides, records, mechanism, noise, effects, config, seed, out, quiet=quiet)
        found = with_status("checking what the rows can identify …", lambda _: run_check(wanted), quiet)
    if not quiet:
        for line in check_text(found):
            say(line)
        if found.confusable:
            print_table(check_table(found), stdout)
    if wanted.out is not None:
        write_check(Path(wanted.out), found)
