"""`ccnn blind-check`: how often the diagnosis is right on machines whose cause it is never told."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.run_folder.interrupt import if_stopped

__all__ = ["blind_check"]


def blind_check(
    cases: Annotated[int, typer.Option(help="How many machines.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    seed: Annotated[int, typer.Option(help="Of the machines, their poses and noise.")] = 0,
    mechanism: Annotated[
        str | None, typer.Option(help="Names with commas; when not given all but mujoco_five_bar.")
    ] = None,
    kinds: Annotated[
        str, typer.Option(help="Of single, pair, none, outside, with commas.")
    ] = "single,pair,none,outside",
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
) -> None:
    """Diagnose machines whose cause is sealed, then open the seal and count how often the diagnosis was right.

    The machines are generated in a process of their own, by formulas that are not those of the effects library: one
    cause, two, none, or something that the library does not have, with a gap of 3, 10 and 30 times the noise. After
    that every single cause is diagnosed once more by a library that lacks it. The folder holds blind.json, blind.csv
    and blind.md: right answers by cause, strength and machine, the confusion table, false alarms, how reliable the
    probabilities are, and how often the intervals of the shrink hold the truth, each with a 95 % interval. A second
    call goes on where the first was stopped. Mechanisms: five_bar, tripod, machine_tool, stewart, delta, delta_linear,
    arm, and mujoco_five_bar (a simulator of others, pip install 'ccnn-torch[mujoco]').

    Examples:

    ccnn blind-check --cases 60 --out runs/blind

    ccnn blind-check --cases 500 --out runs/pairs --kinds pair --mechanism five_bar,stewart --seed 7
    """
    from ccnn_validation.blind.check import run_blind_check
    from ccnn_validation.blind.machines import MACHINES

    from ccnn_torch.diagnosis import diagnose

    with if_stopped(f"interrupted; what is done is kept in {out}, and the same command goes on from there"):
        run_blind_check(
            cases,
            out,
            diagnose,
            seed=seed,
            machines=MACHINES if mechanism is None else tuple(mechanism.split(",")),
            kinds=tuple(kinds.split(",")),
            quiet=quiet,
        )
