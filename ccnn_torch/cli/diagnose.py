"""`ccnn diagnose`: which physical effects explain the error of a model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.cli.diagnose_options import configured
from ccnn_torch.cli.loading import loading


def diagnose(
    overrides: Annotated[
        list[str] | None,
        typer.Argument(metavar="[CONFIG] [KEY=VALUE]...", help="A config, and key=value or key.sub=value over it."),
    ] = None,
    records: Annotated[Path | None, typer.Option(help="CSV of joints, measured poses and covariates.")] = None,
    mechanism: Annotated[
        str | None,
        typer.Option(help="A mechanism's name, file, or path/to/file.py:Name.", autocompletion=complete_mechanism),
    ] = None,
    motion: Annotated[
        list[Path] | None,
        typer.Option(help="CSV of time, commands and positions of a machine in motion; a run, may be repeated."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write diagnosis.json to.")] = None,
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
    config: Annotated[Path | None, typer.Option(help="A YAML file with keys as below, or one for ccnn run.")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    network: Annotated[
        bool | None, typer.Option(help="Estimate the further gain by a network; the same as network=….")
    ] = None,
    details: Annotated[bool, typer.Option("--details", help="Show all tables as well.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No verdict, no table.")] = False,
) -> None:
    """Find the physical effect that explains the error of a model, and how much of the error it removes.

    The diagnosis comes first; then a network is trained on the residual of the effects, to estimate its further gain
    (seconds; --no-network omits that). The folder gets diagnosis.json, report.html and next_measurements.csv, the most
    informative poses to measure next. With --motion it is of time series: delay, gains, friction, play,
    weights, limits. Keys: records, motion, columns, mechanism, out, mechanism_keys, covariates, noise,
    effects, gravity, network, seed.

    Examples:

    ccnn diagnose --records measured.csv --mechanism five_bar --out runs/diagnosis

    ccnn diagnose --records measured.csv --mechanism arm.yaml --out runs/arm --noise x=1e-5,y=1e-5,z=2e-5

    ccnn diagnose --records measured.csv --mechanism stewart --out runs/s --effects all,my_effect.py:Mine

    ccnn diagnose --records measured.csv --mechanism my_simulator.py:PRESS --out runs/press

    ccnn diagnose --motion sine.csv --motion steps.csv --mechanism servo --out runs/axis
    """
    with loading():
        from ccnn_torch.diagnosis.job import run_diagnosis
        from ccnn_torch.motion.job import run_motion

    wanted = configured(overrides, records, mechanism, noise, effects, config, seed, out, network, motion, quiet)
    (run_motion if wanted.motion else run_diagnosis)(wanted, quiet, details)
