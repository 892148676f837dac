"""`ccnn plan`: which poses to measure."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.cli.words import config_and_changes, noted
from ccnn_torch.errors import InputError


def plan(
    poses: Annotated[int, typer.Option(help="How many poses to plan (per_leg: for each leg).")],
    out: Annotated[Path, typer.Option(help="CSV to write; a page .md and a picture .png, .svg are written beside it.")],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(metavar="[CONFIG] [KEY=VALUE]...", help="A config, and key=value or key.sub=value over it."),
    ] = None,
    mechanism: Annotated[
        str | None,
        typer.Option(
            help="A mechanism's name, a geometry file, or path/to/file.py:Name.", autocompletion=complete_mechanism
        ),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="A YAML file with keys as below, or one for ccnn run.")] = None,
    records: Annotated[
        str | None, typer.Option(help="Taken as other commands take it; a plan needs the machine alone.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
) -> None:
    """Choose the poses that best identify a machine's geometric parameters, and recommend how many to measure.

    OUT.csv has a row for each pose: the joints to command, q1[unit]…, and the pose at which they bring the nominal
    machine, the most informative ones first. The page beside it gives the gain of each further pose. Keys: mechanism,
    mechanism_keys, columns, joint_map, parameters.free, .fixed, .tied, .prior, residual, noise, joint_noise, index,
    candidates, limits, max_condition, rotation_weight, per_leg, repeat, least_gain, margin, seed. Sizes are in SI, or
    texts with a unit.

    Examples:

    ccnn plan --mechanism five_bar --poses 36 --out poses.csv

    ccnn plan --mechanism five_bar --poses 18 --out poses.csv per_leg=true noise='0.1 mm'

    ccnn plan --mechanism my_arm.yaml --poses 40 --out poses.csv 'limits={z: [0.2, 0.8]}' parameters.fixed=[base_*]

    ccnn plan --mechanism my_machine.py:MyMachine --poses 24 --out poses.csv --config plan.yaml
    """
    from ccnn_torch.planning.config import PlanConfig
    from ccnn_torch.planning.job import check_plan_file, make_plan, write_plan
    from ccnn_torch.planning.page import gain_table, left_out_sentence, parameter_table, plan_sentence
    from ccnn_torch.report.screen import progress_bar, say, say_place, stdout
    from ccnn_torch.report.table import print_table

    file, changes = config_and_changes(overrides or [], config, mechanism=mechanism, seed=seed)
    wanted = PlanConfig.from_file(file, changes, noted(quiet))
    if wanted.mechanism is None:
        raise InputError("mechanism: is missing; give --mechanism, or the key in a config")
    if records is not None:
        noted(quiet)(f"--records {records}: a plan needs the machine alone; the records are not read.")
    check_plan_file(out)
    with progress_bar(quiet, transient=True) as bar:
        task = bar.add_task("poses", total=1.0)
        machine, plans = make_plan(wanted.mechanism, poses, wanted, lambda done: bar.update(task, completed=done))
    if not quiet:
        # Before anything is written, so that the result is not lost if the disk is full.
        for part in plans:
            print_table(parameter_table(part), stdout)
            print_table(gain_table(part, short=True), stdout)
            if sentence := left_out_sentence(part):
                say(sentence)
            say(plan_sentence(part, wanted.least_gain))
    files = write_plan(out, machine, plans, wanted.least_gain, wanted)
    if not quiet:
        say_place(f"Written: {', '.join(str(file) for file in files)}")
