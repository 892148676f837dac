"""`ccnn sweep`: a run for every combination of values of some keys."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def sweep(
    config: Annotated[Path, typer.Argument(help="A YAML config of a run, e.g. experiments/tripod.yaml.")],
    out: Annotated[Path, typer.Option(help="Folder to write, with one run folder a job.")],
    changes: Annotated[
        list[str] | None, typer.Argument(help="key=a,b,c for a key that varies, key=value for all jobs.")
    ] = None,
    engine: Annotated[
        str | None, typer.Option(help="local, processes, dask, or a scheduler as tcp://HOST:8786.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
) -> None:
    """Run a config with every combination of some keys' values; each job is a run folder of its own.

    A second call keeps the finished jobs and runs the others. The folder then holds sweep.csv, with one row a job:
    its keys, the best method and its held-out errors. With seed=0,10,20 repeats=10 a job is a block of ten seeds.

    Examples:

    ccnn sweep experiments/tripod.yaml methods=gp,bp_lm split.test=0.2,0.5,0.8 --out runs/shares

    ccnn sweep experiments/ur10.yaml ccnn.hidden=[24],[48],[24,24] seed=0,1,2 --out runs/hidden --engine processes

    ccnn sweep experiments/tripod.yaml seed=0,10,20 repeats=10 --out runs/seeds --engine tcp://10.0.0.5:8786
    """
    from ccnn_torch.study.sweep import run_sweep
    from ccnn_torch.study.sweep_config import load_sweep

    words = [*(changes or []), *([] if engine is None else [f"engine={engine}"])]
    run_sweep(load_sweep(config, words, out), quiet=quiet)
