"""`ccnn suite`: many cases from one file, and the methods compared over all of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def suite(
    config: Annotated[Path, typer.Argument(help="A YAML file with base and cases, e.g. experiments/realistic.yaml.")],
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value or key.sub=value, over every case.")] = None,
    out: Annotated[str | None, typer.Option(help="Folder to write; the same as out=….")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
) -> None:
    """Run a list of cases and compare the methods over all of them; each case is a run folder of its own.

    A second call keeps the finished cases and resumes the others. The folder then also holds
    suite.json, suite.csv, suite.md and a picture: per case the error of each method as a multiple of the noise floor,
    the best method, and whether the others are tied with it.

    Examples:

    ccnn suite experiments/realistic.yaml

    ccnn suite experiments/realistic.yaml methods=[constant,gp,ccnn] repeats=3 --out runs/short

    ccnn suite experiments/realistic.yaml realistic.noise=1e-6 --out runs/quiet_tracker --seed 100
    """
    from ccnn_torch.study.suite import run_suite
    from ccnn_torch.study.suite_config import load_suite

    changes = list(overrides or [])
    changes += [f"out={out}"] if out is not None else []
    changes += [f"seed={seed}"] if seed is not None else []
    run_suite(load_suite(config, changes), quiet=quiet)
