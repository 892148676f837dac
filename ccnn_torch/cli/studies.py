"""Commands that simulate, plan, or set many runs side by side; and the keys of every config."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.options import (
    MECHANISM,
    ConfigOption,
    Mechanism,
    Out,
    OutFolder,
    Overrides,
    Quiet,
    Seed,
    Words,
    config_and_changes,
    noted,
)
from ccnn_torch.errors import InputError
from ccnn_torch.run_folder.folder import NOTHING_WRITTEN, if_stopped


def suite(
    config: Annotated[Path, typer.Argument(help="A YAML file with base and cases, e.g. experiments/realistic.yaml.")],
    overrides: Overrides = None,
    out: Out = None,
    seed: Seed = None,
    quiet: Quiet = False,
) -> None:
    """Run a list of cases and compare the methods over all of them; each case is a run folder of its own.

    A second call keeps the finished cases and resumes the others. The folder then also holds
    suite.json, suite.csv and suite.md: per case the error of each method as a multiple of the noise floor,
    the best method, and whether the others are tied with it.

    Examples:

    ccnn suite experiments/realistic.yaml

    ccnn suite experiments/realistic.yaml methods=[constant,gp,ccnn] repeats=3 --out runs/short

    ccnn suite experiments/realistic.yaml realistic.noise=1e-6 --out runs/quiet_tracker --seed 100
    """
    from ccnn_torch.study.suite import load_suite, run_suite

    _, changes = config_and_changes([], None, out=out, seed=seed)
    run_suite(load_suite(config, [*(overrides or []), *changes]), quiet=quiet)


def sweep(
    config: Annotated[Path, typer.Argument(help="A YAML config of a run, e.g. experiments/tripod.yaml.")],
    out: OutFolder,
    changes: Annotated[
        list[str] | None, typer.Argument(help="key=a,b,c for a key that varies, key=value for all jobs.")
    ] = None,
    engine: Annotated[
        str | None, typer.Option(help="local, processes, dask, or a scheduler as tcp://HOST:8786.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Run a config with every combination of some keys' values; each job is a run folder of its own.

    A second call keeps the finished jobs and runs the others. The folder then holds sweep.csv, with one row a job:
    its keys, the best method and its held-out errors. With seed=0,10,20 repeats=10 a job has ten seeds.

    Examples:

    ccnn sweep experiments/tripod.yaml methods=gp,bp_lm split.test=0.2,0.5,0.8 --out runs/shares

    ccnn sweep experiments/ur10.yaml ccnn.hidden=[24],[48],[24,24] seed=0,1,2 --out runs/hidden --engine processes

    ccnn sweep experiments/tripod.yaml seed=0,10,20 repeats=10 --out runs/seeds --engine tcp://10.0.0.5:8786
    """
    from ccnn_torch.study.sweep import load_sweep, run_sweep

    words = [*(changes or []), *([] if engine is None else [f"engine={engine}"])]
    run_sweep(load_sweep(config, words, out), quiet=quiet)


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN_DIR…", help="Folders of finished runs.")],
    out: Annotated[Path | None, typer.Option(help="Also write the table: .csv (every method, SI) or .md.")] = None,
    quiet: Quiet = False,
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


def plan(
    poses: Annotated[int, typer.Option(help="How many poses to plan (per_leg: for each leg).")],
    out: Annotated[
        Path, typer.Option(help="CSV to write; a page .html, .md and a picture .png, .svg are written beside it.")
    ],
    overrides: Words = None,
    mechanism: Mechanism = None,
    records: Annotated[
        str | None, typer.Option(help="Taken as other commands take it; a plan needs the machine alone.")
    ] = None,
    config: ConfigOption = None,
    seed: Seed = None,
    quiet: Quiet = False,
) -> None:
    """Choose the poses that best identify a machine's geometric parameters, and recommend how many to measure.

    OUT.csv has a row for each pose: the joints to command, q1[unit]…, and the pose at which they bring the nominal
    machine, the most informative ones first. The page beside it gives the gain of each further pose. Keys: mechanism,
    mechanism_keys, columns, joint_map, parameters.free, .fixed, .tied, .prior, residual, noise, joint_noise,
    candidates, limits, max_condition, rotation_weight, per_leg, repeat, least_gain, margin, program, seed. Sizes are in
    SI, or texts with a unit. program=krl, rapid, urscript or gcode writes the moves as a robot program's skeleton, too.

    Examples:

    ccnn plan --mechanism five_bar --poses 36 --out poses.csv

    ccnn plan --mechanism five_bar --poses 18 --out poses.csv per_leg=true noise='0.1 mm'

    ccnn plan --mechanism my_arm.yaml --poses 40 --out poses.csv 'limits={z: [0.2, 0.8]}' parameters.fixed=[base_*]

    ccnn plan --mechanism my_machine.py:MyMachine --poses 24 --out poses.csv --config plan.yaml
    """
    from ccnn_torch.planning.config import PlanConfig
    from ccnn_torch.planning.job import check_plan_file, make_plan, write_plan
    from ccnn_torch.planning.page import plan_page
    from ccnn_torch.report.screen import progress_bar, say_place, stdout

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
        plan_page(machine.name, plans, wanted.least_gain, short=True).show(stdout)
    files = write_plan(out, machine, plans, wanted.least_gain, wanted)
    if not quiet:
        say_place(f"Written: {', '.join(str(file) for file in files)}")


def simulate(
    mechanism: Annotated[str, MECHANISM],
    rows: Annotated[int, typer.Option(help="Number of rows.")],
    noise: Annotated[
        str, typer.Option(help="Standard deviation of the pose: 1e-5 (SI), 10um, x=1e-5,y=20um or m=10um,rad=30urad.")
    ],
    out: Annotated[Path, typer.Option(help="CSV to write.")],
    effect: Annotated[
        list[str] | None, typer.Option(help="NAME or NAME:parameter=value,…; repeat it for more.")
    ] = None,
    overrides: Overrides = None,
    config: ConfigOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Simulate the records of a machine that differs from its model by given effects, and print what was injected.

    OUT.csv has the commanded joints, the measured pose and the conditions (time, temperature, loads,
    directions of approach; speeds along moves). Effects: geometry, joint_offset, joint_gain, transmission,
    backlash, friction, compliance, thermal_compliance, sag (with columns of torques), gravity, bending (an
    arm), thermal, drift, homing (on four days), frame, frame_drift, tool, coupling, error_motion (joints that
    slide), latency, flexure (of directions: key orientation=direction of an arm), instrument, outlier (bad
    rows), or your own as path/to/file.py:Name. An effect without parameters is drawn in a plausible size;
    size=2 makes that twice as large. Given parameters are SI numbers or have a unit (q1=0.1mm); blanks in
    names may be underscores; parameters that are not given are 0. Keys: mechanism_keys, covariates, rows,
    duration, step, move, way, load, moment, gravity, max_condition, rotation_weight.

    Examples:

    ccnn simulate --mechanism five_bar --effect backlash --rows 200 --noise 1e-5 --out records.csv

    ccnn simulate --mechanism stewart --effect compliance:q1=2e-7,q4=1e-7 --effect thermal:growth=1.2e-5,lag=30min
    --rows 400 --noise 1e-5 --out records.csv

    ccnn simulate --mechanism tripod --effect outlier:share=0.05 --rows 100 --noise m=10um,rad=30urad --out r.csv

    ccnn simulate --mechanism my_arm.yaml --effect my_effect.py:CableForce --rows 300 --noise 2e-5 --out r.csv

    ccnn simulate --mechanism my_simulator.py:PRESS --effect "parameter spring1:spring1=-6000" --rows 200 --noise 1e-5
    --out r.csv
    """
    from ccnn_torch.config.sizes import read_noise
    from ccnn_torch.report.screen import say, say_place, stdout
    from ccnn_torch.report.table import print_table
    from ccnn_torch.simulation.config import SimulateConfig
    from ccnn_torch.simulation.job import injected_table, simulate_records, write_simulated

    with if_stopped(NOTHING_WRITTEN):
        wanted = SimulateConfig.from_file(config, overrides or [])
        made = simulate_records(mechanism, effect or [], rows, read_noise(noise), wanted, seed)
    write_simulated(out, made)
    if quiet:
        return
    if made.injected:
        print_table(injected_table(made), stdout)
    else:
        say("Nothing was injected: the machine equals its model.")
    say_place(f"Written: {out}")


def blind_check(
    cases: Annotated[int, typer.Option(help="Number of machines.")],
    out: OutFolder,
    seed: Annotated[int, typer.Option(help="Seed of the machines, their poses and noise.")] = 0,
    mechanism: Annotated[
        str | None, typer.Option(help="Names, separated by commas; by default all but mujoco_five_bar.")
    ] = None,
    kinds: Annotated[
        str, typer.Option(help="Any of single, pair, none, outside, separated by commas.")
    ] = "single,pair,none,outside",
    source: Annotated[
        str, typer.Option(help="Who made the cases: blind, semi_real, multibody, adversarial, motion, shop, since.")
    ] = "blind",
    engine: Annotated[
        str | None,
        typer.Option(
            help="Where cases are diagnosed: local, processes, dask, or a scheduler as tcp://HOST:8786; "
            "by default local, and processes with --source."
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Diagnose simulated machines of undisclosed cause, then count how often the diagnosis was right.

    A separate process simulates the machines, by formulas that are not those of the effects library. They have one
    cause, two, none, or one that the library lacks, with a gap of 3, 10 and 30 times the noise. Then every single cause
    is diagnosed again by a library without it. The folder holds blind.json, blind.csv and blind.md: right answers by
    cause, strength and machine, the confusion table, false alarms, the calibration of the probabilities, and the
    coverage of the intervals of the error reduction. Each figure has a 95 % interval. A second call resumes an
    interrupted one. Mechanisms: five_bar, tripod, machine_tool, stewart, delta, delta_linear, arm, and mujoco_five_bar
    (an independent simulator, pip install 'ccnn-torch[mujoco]').

    Five more sources share no formula with the library or each other. They were written without a look at its code:
    semi_real adds a known error to measured rows of real arms (folder CCNN_MEASURED; without it the UR10 of
    experiments/data), multibody changes MuJoCo models, adversarial has noise, plans and causes that are not of the
    textbook's form, shop has machines of a workshop by somebody who had read the documentation only (seeds 1 to 3 were
    looked at during repairs: take others), and motion has logs of axes in motion, simulated in MuJoCo (by the author of
    its effects, but before they were tuned). For these --seed is the seed of the first case of each family, and the
    folder holds source.json, source.csv and source.md.

    Examples:

    ccnn blind-check --cases 60 --out runs/blind

    ccnn blind-check --source adversarial --cases 200 --out runs/adversarial --seed 1000

    ccnn blind-check --cases 500 --out runs/pairs --kinds pair --mechanism five_bar,stewart --seed 7
    """
    from ccnn_validation.blind.check import run_blind_check
    from ccnn_validation.blind.machines import MACHINES

    from ccnn_torch.diagnosis import diagnose
    from ccnn_torch.engine import check_engine

    try:
        check_engine(engine or "local")
    except ValueError as problem:
        raise InputError(f"--engine: {problem}") from None
    with if_stopped(f"interrupted; finished cases are kept in {out}, and the same command resumes from them"):
        if source != "blind":
            from ccnn_validation.sources.run import run_source

            run_source(source, cases, out, seed, engine or "processes", quiet=quiet)
            return
        machines = MACHINES if mechanism is None else tuple(mechanism.split(","))
        where, which = engine or "local", tuple(kinds.split(","))
        run_blind_check(cases, out, diagnose, seed=seed, machines=machines, kinds=which, engine=where, quiet=quiet)


class Command(StrEnum):
    """The commands that take a config."""

    run = "run"
    identify = "identify"
    suite = "suite"
    plan = "plan"
    diagnose = "diagnose"


def keys(
    command: Annotated[Command, typer.Argument(help="The command whose config it is.")] = Command.run,
    schema: Annotated[bool, typer.Option("--schema", help="A JSON Schema for editors instead of a list.")] = False,
) -> None:
    """List every config key with its default and what it means, section by section; or write a JSON Schema of them.

    An editor that knows YAML completes and checks keys by the schema: put the line
    "# yaml-language-server: $schema=ccnn.schema.json" on top of a config.

    Examples:

    ccnn keys

    ccnn keys identify

    ccnn keys --schema > ccnn.schema.json
    """
    from ccnn_torch.config.keys import config_schema, keys_by_section

    if schema:
        typer.echo(json.dumps(config_schema(command.value), indent=2, ensure_ascii=False))
        return
    for section, entries in keys_by_section(command.value).items():
        typer.echo(f"\n# {section}" if section else "# top level")
        for key, default, description in entries:
            typer.echo(f"{key}={default}\n    {description}")
