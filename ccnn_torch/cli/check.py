"""`ccnn check`: what records can show, before any verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli._diagnosed import configured

__all__ = ["check"]


def check(
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value or key.sub=value, over the config.")] = None,
    records: Annotated[Path | None, typer.Option(help="CSV of joints, measured poses and covariates.")] = None,
    mechanism: Annotated[str | None, typer.Option(help="A mechanism's name, file, or path/to/file.py:Name.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write check.json to; nothing when left out.")] = None,
    noise: Annotated[
        str | None, typer.Option(help="Standard deviation of the pose: S in m and rad alike, or NAME=S,….")
    ] = None,
    effects: Annotated[str | None, typer.Option(help="Candidates, a,b,…; all when left out.")] = None,
    config: Annotated[Path | None, typer.Option(help="A YAML file with keys as for ccnn diagnose.")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Nothing but the exit code.")] = False,
) -> None:
    """Tell what records can show: rows, noise, covariates, effects that cannot be seen, pairs that look alike.

    Examples:

    ccnn check --records measured.csv --mechanism five_bar

    ccnn check --records measured.csv --mechanism my_simulator.py:PRESS
    """
    from dataclasses import asdict

    from ccnn_torch.report.json_files import write_json
    from ccnn_torch.report.table_form import print_table
    from ccnn_torch.runs.diagnose import check_table, check_text, run_check
    from ccnn_torch.runs.screen import stdout

    wanted = configured(overrides, records, mechanism, noise, effects, config, seed, out)
    found = run_check(wanted)
    if wanted.out is not None:
        folder = Path(wanted.out)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "check.json", asdict(found))
    if quiet:
        return
    for line in check_text(found):
        typer.echo(line)
    if found.confusable:
        print_table(check_table(found), stdout)
