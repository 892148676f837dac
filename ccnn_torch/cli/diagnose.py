"""`ccnn diagnose`: which effect makes the gap between model and machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli._diagnosed import configured
from ccnn_torch.errors import InputError

__all__ = ["diagnose"]


def diagnose(
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value or key.sub=value, over the config.")] = None,
    records: Annotated[Path | None, typer.Option(help="CSV of joints, measured poses and covariates.")] = None,
    mechanism: Annotated[str | None, typer.Option(help="A mechanism's name, file, or path/to/file.py:Name.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write diagnosis.json to.")] = None,
    noise: Annotated[str | None, typer.Option(help="Standard deviation of the pose in SI: S, or NAME=S,….")] = None,
    effects: Annotated[str | None, typer.Option(help="Candidates, a,b,…; all when left out.")] = None,
    config: Annotated[Path | None, typer.Option(help="A YAML file with keys as below.")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No verdict, no table.")] = False,
) -> None:
    """Name the physical effect that makes the gap between a model and measurements, and how far the gap shrinks.

    The folder gets diagnosis.json and report.html. Keys: records, mechanism, out, mechanism_keys, covariates, noise,
    effects, gravity, seed.

    Examples:

    ccnn diagnose --records measured.csv --mechanism five_bar --out runs/diagnosis

    ccnn diagnose --records measured.csv --mechanism arm.yaml --out runs/arm --noise x=1e-5,y=1e-5,z=2e-5

    ccnn diagnose --records measured.csv --mechanism stewart --out runs/s --effects backlash,friction,my_effect.py:Mine

    ccnn diagnose --records measured.csv --mechanism my_simulator.py:PRESS --out runs/press
    """
    from ccnn_torch.mechanisms import simulated_rows
    from ccnn_torch.report.diagnosis_data import about_of, load_labels
    from ccnn_torch.report.diagnosis_report import print_diagnosis
    from ccnn_torch.runs.diagnose import run_diagnosis, write_diagnosis
    from ccnn_torch.runs.screen import stderr, stdout

    wanted = configured(overrides, records, mechanism, noise, effects, config, seed, out)
    if wanted.out is None:
        raise InputError("name the folder to write with --out DIR")
    if stderr.is_terminal and not quiet:
        # Thousands of rows of an arm take half a minute, a slow simulator more; how much is left nobody knows.
        doing = "looking for the effects that make the gap …"
        with stderr.status(doing) as shown, simulated_rows(lambda n: shown.update(f"{doing} {n:,} rows simulated")):
            found = run_diagnosis(wanted)
    else:
        found = run_diagnosis(wanted)
    about = {"name": Path(wanted.out).name, "mechanism": str(wanted.mechanism), "records": str(wanted.records)}
    path = write_diagnosis(Path(wanted.out), found, about, wanted.seed)
    if quiet:
        return
    print_diagnosis(found.to_json(), stdout, about_of(load_labels(path.parent)))
    typer.echo(f"Written: {path} and report.html beside it")
