"""`ccnn blind-check`: how often the diagnosis is right on simulated machines of undisclosed cause."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.run_folder.interrupt import if_stopped


def blind_check(
    cases: Annotated[int, typer.Option(help="Number of machines.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    seed: Annotated[int, typer.Option(help="Seed of the machines, their poses and noise.")] = 0,
    mechanism: Annotated[
        str | None, typer.Option(help="Names, separated by commas; by default all but mujoco_five_bar.")
    ] = None,
    kinds: Annotated[
        str, typer.Option(help="Any of single, pair, none, outside, separated by commas.")
    ] = "single,pair,none,outside",
    source: Annotated[
        str, typer.Option(help="Who made the cases: blind, semi_real, multibody, adversarial, motion or shop.")
    ] = "blind",
    engine: Annotated[
        str | None,
        typer.Option(
            help="Where cases are diagnosed: local, processes, dask, or a scheduler as tcp://HOST:8786; "
            "by default local, and processes with --source."
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
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
    from ccnn_torch.errors import InputError

    try:
        check_engine(engine or "local")
    except ValueError as problem:
        raise InputError(f"--engine: {problem}") from None
    if source != "blind":
        from ccnn_validation.sources.run import run_source

        with if_stopped(f"interrupted; finished cases are kept in {out}, and the same command resumes from them"):
            run_source(source, cases, out, seed, engine or "processes", quiet=quiet)
        return
    with if_stopped(f"interrupted; finished cases are kept in {out}, and the same command resumes from them"):
        run_blind_check(
            cases,
            out,
            diagnose,
            seed=seed,
            machines=MACHINES if mechanism is None else tuple(mechanism.split(",")),
            kinds=tuple(kinds.split(",")),
            engine=engine or "local",
            quiet=quiet,
        )
