"""`ccnn run`: train on a case study or on measured records, and write the run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.cli.words import config_and_changes
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import read_yaml


def run(
    config: Annotated[
        Path | None,
        typer.Argument(help="A YAML config, for example experiments/tripod.yaml; defaults where there is none."),
    ] = None,
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value or key.sub=value, over the config.")] = None,
    config_option: Annotated[Path | None, typer.Option("--config", help="The same as CONFIG.")] = None,
    records: Annotated[str | None, typer.Option(help="The same as records=….")] = None,
    mechanism: Annotated[
        str | None, typer.Option(help="The same as mechanism=….", autocompletion=complete_mechanism)
    ] = None,
    resume: Annotated[Path | None, typer.Option(help="Resume the run in this folder.")] = None,
    out: Annotated[str | None, typer.Option(help="Folder to write; the same as out=….")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
) -> None:
    """Train on a case study or on measured records; write tables, curves, plots and model files into a run folder.

    On records cross-validation chooses first what the model holds: identified geometry, effects that a diagnosis of
    the training rows names, a learner (keys geometry and effects).

    Examples:

    ccnn run experiments/tripod.yaml

    ccnn run experiments/tripod.yaml repeats=30 out=runs/tripod30

    ccnn run experiments/machine_tool.yaml variant=tabulated ccnn.generations=240

    ccnn run experiments/records.yaml records=my_robot.csv mechanism=my_robot.yaml

    ccnn run records=my_robot.csv mechanism=my_robot.yaml effects=from:runs/diagnosis/diagnosis.json

    ccnn run --resume runs/tripod30
    """
    file, changes = config_and_changes(
        [config, *(overrides or [])], config_option, records=records, mechanism=mechanism, out=out, seed=seed
    )
    if file is not None:
        # Before torch is loaded: a file that is not there need not wait for it.
        read_yaml(file)
    from ccnn_torch.calibration.config import RunConfig
    from ccnn_torch.calibration.job import resume_run, start_run

    if resume is not None:
        if changes or file is not None:
            raise InputError("--resume takes the run's folder alone, without CONFIG, overrides and other options")
        resume_run(resume, quiet=quiet)
        return
    if file is None and not changes:
        raise InputError("name a config, for example: ccnn run experiments/tripod.yaml (or --resume RUN_DIR)")
    start_run(RunConfig.from_file(file, changes), quiet=quiet)
