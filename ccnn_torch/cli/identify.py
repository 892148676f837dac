"""`ccnn identify`: geometric parameters from measured poses, or from simulated machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.cli.words import config_and_changes, noted
from ccnn_torch.errors import InputError


def identify(
    config: Annotated[Path | None, typer.Argument(help="A YAML config, e.g. experiments/five_bar.yaml.")] = None,
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value or key.sub=value, over the config.")] = None,
    config_option: Annotated[Path | None, typer.Option("--config", help="The same as CONFIG.")] = None,
    records: Annotated[str | None, typer.Option(help="The same as records=….")] = None,
    mechanism: Annotated[
        str | None, typer.Option(help="The same as mechanism=….", autocompletion=complete_mechanism)
    ] = None,
    resume: Annotated[Path | None, typer.Option(help="Resume the identification in this folder.")] = None,
    out: Annotated[str | None, typer.Option(help="Folder to write; the same as out=….")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    keys: Annotated[bool, typer.Option("--keys", help="List every key with its default, and exit.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
) -> None:
    """Identify a machine's geometry: parameters with intervals, unidentifiable parameters, held-out pose error.

    The folder gets identified.json, .csv, .md, plots and report.html, and the machine itself: identified.yaml, which
    every command takes as a mechanism and ccnn compensate as a model; of a serial arm also identified.urdf and
    identified_dh.yaml for other tools.

    Examples:

    ccnn identify experiments/five_bar.yaml

    ccnn identify experiments/overconstrained_2dof.yaml methods=[lm,tikhonov] simulate.machines=20

    ccnn identify mechanism=ur10.yaml records=measured.csv out=runs/arm

    ccnn identify experiments/sockets.yaml      without a measuring device: a ball in sockets

    ccnn identify --resume runs/arm

    ccnn compensate runs/arm/identified.yaml poses.csv commands.csv --pose
    """
    from ccnn_torch.config.keys import list_keys
    from ccnn_torch.identification.config import IdentifyConfig
    from ccnn_torch.identification.job import resume_identification, start_identification

    if keys:
        for key, default, description in list_keys(IdentifyConfig):
            typer.echo(f"{key}={default}\n    {description}")
        return
    file, changes = config_and_changes(
        [config, *(overrides or [])], config_option, records=records, mechanism=mechanism, out=out, seed=seed
    )
    if resume is not None:
        if changes or file is not None:
            raise InputError("--resume takes the folder alone, without CONFIG, overrides and other options")
        resume_identification(resume, quiet=quiet)
        return
    if file is None and not changes:
        raise InputError("name a config, for example: ccnn identify experiments/five_bar.yaml (or --resume DIR)")
    start_identification(IdentifyConfig.from_file(file, changes, noted(quiet)), quiet=quiet)
