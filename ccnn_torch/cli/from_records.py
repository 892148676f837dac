"""Commands that make something of measured records: new, run, identify, diagnose, check."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ccnn_torch.cli.options import (
    Config,
    ConfigOption,
    Details,
    Effects,
    Mechanism,
    Noise,
    Out,
    Overrides,
    Quiet,
    Records,
    Resume,
    Seed,
    Words,
    config_and_changes,
    loading,
    noted,
)
from ccnn_torch.errors import InputError
from ccnn_torch.files.yaml_file import read_yaml
from ccnn_torch.run_folder.folder import NOTHING_WRITTEN, if_stopped

# A first word that ends so is no config but RECORDS.
_TABLES = (".csv", ".tsv", ".txt", ".xlsx", ".xlsm")

if TYPE_CHECKING:
    from ccnn_torch.diagnosis.config import DiagnoseConfig
    from ccnn_torch.run_folder.resume import FolderJob


def new(
    records: Annotated[
        Path | None, typer.Argument(metavar="RECORDS", help="Measured rows with a line of headers, or a log.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE.yaml", help="The config or machine file to write.")] = None,
    mechanism: Mechanism = None,
    units: Annotated[
        str | None, typer.Option(metavar="LENGTH,ANGLE", help="Units of columns without one, e.g. mm,deg.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing FILE.yaml.")] = False,
    quiet: Quiet = False,
) -> None:
    """Write a config from a table of measurements or a log, or without one a machine file of a kind of machine.

    Joints may be called q1, J1, A1, joint_1, axis1 …; the position X, Y, Z; the orientation rx, ry, rz, qw to qz, A, B,
    C (KUKA) or W, P, R (Fanuc). What cannot be guessed is asked for on a terminal; elsewhere, and with
    --quiet, a message names it.

    A machine file asks for the numbers that people know of a machine; the kinds are gantry, linear_axis, scara,
    five_axis_table_table, five_axis_table_head, five_axis_head_head, delta_printer, hexapod, alt_azimuth, pan_tilt.

    Examples:

    ccnn new measured.csv --out robot.yaml

    ccnn new measured.csv --mechanism my_arm.yaml --units mm,deg --out robot.yaml

    ccnn new lerobot_dataset --units deg --out arm.yaml      then ccnn diagnose --config arm.yaml

    ccnn new printer.cfg --out printer.yaml      a delta printer of Klipper's, then ccnn identify printer.yaml

    ccnn new --mechanism delta_printer --out printer.yaml
    """
    if records is None:
        if mechanism is None:
            raise InputError("give RECORDS.csv, or --mechanism KIND for a machine file, e.g. --mechanism gantry")
        out = Path(f"{mechanism}.yaml") if out is None else out
    if out is None:
        raise InputError("--out: name the config to write, e.g. --out robot.yaml")
    from ccnn_torch.files.write import write_whole
    from ccnn_torch.mechanisms.registry import machine_text
    from ccnn_torch.records.formats.klipper import printer_files, read_printer
    from ccnn_torch.starter import command_of, starter_config

    printer = None if records is None else read_printer(records)
    files = {out: ""} if records is None or printer is None else printer_files(printer, records, out)
    there = [] if force else [file for file in files if file.exists()]
    if there:
        raise InputError(f"{there[0]} is there already; name another file, or give --force to overwrite it")
    if records is None:
        write_whole(out, machine_text(str(mechanism)).encode())
        if not quiet:
            typer.echo(f"{out} is written. Write your machine's numbers into it, then use it as mechanism={out}")
        return
    asks = not quiet and sys.stdin is not None and sys.stdin.isatty()
    ask = (lambda question: str(typer.prompt(question, default="", show_default=False))) if asks else None
    text, ready = (files[out], True) if printer else starter_config(records, out, mechanism, units, ask)
    for file, content in {**files, out: text}.items():
        write_whole(file, content.encode())
    if quiet:
        return
    one = len(files) == 1
    typer.echo(f"{', '.join(map(str, files))} {'is' if one else 'are'} written. Check {'it' if one else 'them'}, then:")
    typer.echo(f"{command_of(text, out)}{'' if ready else ' mechanism=FILL_IN'}")


def run(
    config: Config = None,
    overrides: Overrides = None,
    config_option: ConfigOption = None,
    records: Records = None,
    mechanism: Mechanism = None,
    resume: Resume = None,
    out: Out = None,
    seed: Seed = None,
    details: Details = False,
    quiet: Quiet = False,
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
    words = [config, *(overrides or [])]
    file, changes = config_and_changes(words, config_option, records=records, mechanism=mechanism, out=out, seed=seed)
    if file is not None:
        # Before torch is loaded: a file that is not there need not wait for it.
        read_yaml(file)
    from ccnn_torch.calibration.job import RUN

    _start_or_resume(RUN, "tripod", file, changes, resume, quiet, details)


def identify(
    config: Config = None,
    overrides: Overrides = None,
    config_option: ConfigOption = None,
    records: Records = None,
    mechanism: Mechanism = None,
    resume: Resume = None,
    out: Out = None,
    seed: Seed = None,
    keys: Annotated[bool, typer.Option("--keys", help="List every key with its default, and exit.")] = False,
    details: Details = False,
    quiet: Quiet = False,
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
    from ccnn_torch.identification.identify import IDENTIFY

    if keys:
        from ccnn_torch.config.keys import list_keys

        for key, default, description in list_keys(IDENTIFY.model):
            typer.echo(f"{key}={default}\n    {description}")
        return
    words = [config, *(overrides or [])]
    file, changes = config_and_changes(words, config_option, records=records, mechanism=mechanism, out=out, seed=seed)
    _start_or_resume(IDENTIFY, "five_bar", file, changes, resume, quiet, details)


def _start_or_resume(
    job: FolderJob[Any, Any],
    example: str,
    file: Path | None,
    changes: list[str],
    resume: Path | None,
    quiet: bool,
    details: bool,
) -> None:
    if resume is not None:
        if changes or file is not None:
            raise InputError("--resume takes the folder alone, without CONFIG, overrides and other options")
        job.resume(resume, quiet, details)
        return
    if file is None and not changes:
        example = f"{job.command} experiments/{example}.yaml"
        raise InputError(f"name a config, for example: {example} (or --resume DIR)")
    job.start(job.model.from_file(file, changes, noted(quiet)), quiet, details)


def diagnose(
    overrides: Words = None,
    records: Records = None,
    mechanism: Mechanism = None,
    motion: Annotated[
        list[Path] | None,
        typer.Option(help="Log of a machine in motion: CSV, LeRobot data set, recording of ROS 2; may be repeated."),
    ] = None,
    out: Out = None,
    noise: Noise = None,
    effects: Effects = None,
    config: ConfigOption = None,
    seed: Seed = None,
    network: Annotated[
        bool | None, typer.Option(help="Estimate the further gain by a network; the same as network=….")
    ] = None,
    since: Annotated[
        Path | None,
        typer.Option(metavar="MODEL", help="Tell what changed since this model was made, from a few new rows."),
    ] = None,
    details: Details = False,
    quiet: Quiet = False,
) -> None:
    """Find the physical effect that explains the error of a model, and how much of the error it removes.

    The diagnosis comes first; then a network is trained on the residual of the effects, to estimate its further gain
    (seconds; --no-network omits that). The folder gets diagnosis.json, report.html and next_measurements.csv, the most
    informative poses to measure next. With --motion it is of time series: delay, gains, friction, play,
    weights, limits. With --since MODEL it is of a machine that has a model: ten new rows tell what changed, such as
    the zero of one joint; the folder gets since.json and since.html. Keys: records, motion, columns, mechanism, out,
    mechanism_keys, covariates, noise, exact, known, effects, gravity, network, seed.

    Examples:

    ccnn diagnose --records measured.csv --mechanism five_bar --out runs/diagnosis

    ccnn diagnose --records measured.csv --mechanism arm.yaml --out runs/arm --noise x=1e-5,y=1e-5,z=2e-5

    ccnn diagnose --records measured.csv --mechanism stewart --out runs/s --effects all,my_effect.py:Mine

    ccnn diagnose --records measured.csv --mechanism my_simulator.py:PRESS --out runs/press

    ccnn diagnose --motion sine.csv --motion steps.csv --mechanism servo --out runs/axis

    ccnn diagnose --motion sine.csv --mechanism servo --out runs/axis exact=gain,time 'known={mass: 2 %}'

    ccnn diagnose --since runs/ur10/model.safetensors new.csv --out runs/ur10_now
    """
    first = Path(overrides[0]) if overrides else None
    if overrides and first and records is None and (first.suffix.lower() in _TABLES or os.path.isdir(first)):
        records, overrides = overrides[0], overrides[1:]
    with loading():
        from ccnn_torch.diagnosis.job import run_diagnosis

    logs = [str(log) for log in motion or []] or None
    given = {"records": records, "mechanism": mechanism, "seed": seed, "out": out, "network": network, "motion": logs}
    wanted = _diagnose_config(overrides, config, noise, effects, quiet, **given)
    if not wanted.motion and (wanted.exact or wanted.known):
        raise InputError("exact and known: tell how well the values of a motion's model are known; give --motion")
    if since is not None:
        _diagnose_since(since, wanted, details, quiet)
        return
    if not wanted.motion:
        run_diagnosis(wanted, quiet, details)
        return
    with loading():
        from ccnn_torch.motion.job import run_motion

    run_motion(wanted, quiet, details)


def _diagnose_since(model: Path, wanted: DiagnoseConfig, details: bool, quiet: bool) -> None:
    with loading():
        from ccnn_torch.compensation import load_compensation
        from ccnn_torch.diagnosis.config import folder_of
        from ccnn_torch.report.screen import say, say_place, stdout
        from ccnn_torch.report.table import print_table
        from ccnn_torch.verification.page import since_tables, write_since
        from ccnn_torch.verification.since import what_changed

    if wanted.records is None or wanted.motion:
        raise InputError("--since MODEL: needs new rows of poses; give NEW.csv, or --records NEW.csv")
    with if_stopped(NOTHING_WRITTEN):
        folder, loaded = folder_of(wanted, "since.json"), load_compensation(model)
        keys = {name: getattr(wanted, name) for name in ("columns", "joint_map", "mechanism_keys", "seed")}
        results, picture = what_changed(loaded, wanted.records, wanted.mechanism, **keys)
        write_since(folder, results, loaded.joints, picture)
    if quiet:
        return
    say(results.text)
    for told in results.changed:
        say(told.look)
    if results.next_measurements:
        say(f"Measure next: {len(results.next_measurements)} poses, {folder / 'next_measurements.csv'}.")
    for table in since_tables(results, loaded.joints):
        if details and table is not None:
            print_table(table, stdout)
    say_place(f"Everything is in {folder}; open {folder / 'since.html'}")


def check(
    overrides: Words = None,
    records: Records = None,
    mechanism: Mechanism = None,
    out: Out = None,
    noise: Noise = None,
    effects: Effects = None,
    config: ConfigOption = None,
    seed: Seed = None,
    details: Details = False,
    quiet: Quiet = False,
) -> None:
    """Report which effects records can identify: rows, noise, covariates, unidentifiable effects, confusable pairs.

    With --out the folder gets check.json.

    Examples:

    ccnn check --records measured.csv --mechanism five_bar

    ccnn check --records measured.csv --mechanism my_simulator.py:PRESS
    """
    with loading():
        from ccnn_torch.diagnosis.job import run_check
        from ccnn_torch.diagnosis.page.outputs import write_check
        from ccnn_torch.diagnosis.page.report import check_table, check_text
        from ccnn_torch.report.screen import say, stdout, with_status
        from ccnn_torch.report.table import print_table

    with if_stopped(NOTHING_WRITTEN):
        given = {"records": records, "mechanism": mechanism, "seed": seed, "out": out}
        wanted = _diagnose_config(overrides, config, noise, effects, quiet, **given)
        found = with_status("checking what the rows can identify …", lambda _: run_check(wanted), quiet)
    if not quiet:
        for line in check_text(found):
            say(line)
        if details and found.confusable:
            print_table(check_table(found), stdout)
    if wanted.out is not None:
        write_check(Path(wanted.out), found)


def _diagnose_config(
    words: list[str] | None, config: Path | None, noise: str | None, effects: str | None, quiet: bool, **given: object
) -> DiagnoseConfig:
    """The config, under the options of the command line; `words` may begin with the config."""
    from ccnn_torch.config.sizes import read_noise
    from ccnn_torch.diagnosis.config import DiagnoseConfig

    names = None if effects is None else [e.strip() for e in effects.split(",") if e.strip()]
    sizes = None if noise is None else read_noise(noise)
    file, changes = config_and_changes(words or [], config, **given, noise=sizes, effects=names)
    return DiagnoseConfig.from_file(file, changes, noted(quiet))
