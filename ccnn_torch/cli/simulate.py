"""`ccnn simulate`: records of a machine with given effects."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.run_folder.interrupt import NOTHING_WRITTEN, if_stopped


def simulate(
    mechanism: Annotated[
        str,
        typer.Option(
            help="A mechanism's name, a geometry file, or path/to/file.py:Name.", autocompletion=complete_mechanism
        ),
    ],
    rows: Annotated[int, typer.Option(help="Number of rows.")],
    noise: Annotated[
        str, typer.Option(help="Standard deviation of the pose: 1e-5 (SI), 10um, x=1e-5,y=20um or m=10um,rad=30urad.")
    ],
    out: Annotated[Path, typer.Option(help="CSV to write.")],
    effect: Annotated[
        list[str] | None, typer.Option(help="NAME or NAME:parameter=value,…; repeat it for more.")
    ] = None,
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value, over the config.")] = None,
    config: Annotated[Path | None, typer.Option(help="A YAML file with keys as below.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", help="Do not print what was injected.")] = False,
) -> None:
    """Simulate the records of a machine that differs from its model by given effects, and print what was injected.

    OUT.csv has the commanded joints, the measured pose and the conditions (time, temperature, loads, directions of
    approach; speeds along moves). Effects: geometry, joint_offset, joint_gain, transmission, backlash, friction,
    compliance, gravity, thermal, drift, frame, tool, coupling, latency, instrument, outlier (bad rows), or
    your own as path/to/file.py:Name. An effect without parameters is drawn in a plausible size; size=2 makes that
    twice as large. Given parameters are SI numbers or have a unit (q1=0.1mm); blanks in names may be underscores;
    parameters that are not given are 0. Keys: mechanism_keys, covariates, rows, duration, step, move, way, load,
    moment, gravity, max_condition, rotation_weight.

    Examples:

    ccnn simulate --mechanism five_bar --effect backlash --rows 200 --noise 1e-5 --out records.csv

    ccnn simulate --mechanism stewart --effect compliance:q1=2e-7,q4=1e-7 --effect thermal:growth=1.2e-5,lag=30min
    --rows 400 --noise 1e-5 --out records.csv

    ccnn simulate --mechanism tripod --effect outlier:share=0.05 --rows 100 --noise m=10um,rad=30urad --out r.csv

    ccnn simulate --mechanism my_arm.yaml --effect my_effect.py:CableForce --rows 300 --noise 2e-5 --out r.csv

    ccnn simulate --mechanism my_simulator.py:PRESS --effect "parameter spring1:spring1=-6000" --rows 200 --noise 1e-5
    --out r.csv
    """
    from ccnn_torch.config.noise import read_noise
    from ccnn_torch.report.screen import say, say_place, stdout
    from ccnn_torch.report.table import print_table
    from ccnn_torch.simulation.config import SimulateConfig
    from ccnn_torch.simulation.job import simulate_records
    from ccnn_torch.simulation.outputs import injected_table, write_simulated

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
