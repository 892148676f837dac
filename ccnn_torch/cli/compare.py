"""`ccnn compare`: one table of several runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN_DIR…", help="Folders of finished runs.")],
    out: Annotated[Path | None, typer.Option(help="Also write the table: .csv (every method, SI) or .md.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no table.")] = False,
) -> None:
    """Set runs side by side: rows, method, error before and after, ratio to the noise floor, time.

    Runs that were judged on different test rows carry different letters: their figures are not comparable.

    Examples:

    ccnn compare runs/first runs/second

    ccnn compare runs/* --out runs.csv
    """
    from ccnn_torch.report.screen import stdout
    from ccnn_torch.report.table import print_table
    from ccnn_torch.study.compare import read_runs, runs_table, write_runs

    found = read_runs(runs)
    if out is not None:
        write_runs(out, found)
    if not quiet:
        print_table(runs_table(found), stdout)
