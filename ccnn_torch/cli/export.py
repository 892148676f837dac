"""`ccnn export`: a model for a controller or a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.run_folder.interrupt import NOTHING_WRITTEN, if_stopped


def export(
    model: Annotated[
        Path, typer.Argument(help="A .safetensors file with its card, an identified.yaml or diagnosis.json.")
    ],
    to: Annotated[str, typer.Option(help="c99, st (IEC 61131-3 Structured Text), linuxcnc, onnx, urdf or table.")],
    out: Annotated[Path, typer.Option(help="Folder to write to.")],
    dtype: Annotated[str, typer.Option(help="float64 or float32, in which the controller computes.")] = "float64",
    sd: Annotated[bool, typer.Option("--sd", help="Add a function for the deviation's standard deviation.")] = False,
    public_key: Annotated[
        Path | None, typer.Option("--public-key", metavar="PUBLIC.pem", help="Take only a model signed by this key.")
    ] = None,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Run the Python file that the model names as its mechanism.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
) -> None:
    """Write a model for a controller: both directions, with domain, limit and fallback inside; or for a simulator.

    c99 writes compensator.h, compensator.c, selftest.c and a Makefile: make test builds them without warnings and
    compares more than a thousand golden vectors. The code has no heap, no recursion and no global state, and does
    the same operations in each call. st writes compensator.st, selftest.st and a README.md for TwinCAT and CODESYS.
    linuxcnc writes ccnnkins.comp, the machine's kinematics with the compensation around them, for halcompile; of an
    identified.yaml the kinematics with the identified parameters. onnx writes model.onnx with master and card, and
    controller.onnx with the command alone. urdf writes an arm with its identified links as URDF, MuJoCo model and DH
    table. table writes the deviation over a grid, tables of single axes and a mesh where they suffice, and how far off
    each of them is.

    Source code returns the same codes: 0 exact; 1 outside the domain, or where the model broke its limit; 2 where an
    input is not finite: then command = joints, with the middle of the domain for what is no number and its edge for
    infinity; 3 damped near a singular pose, at a limit or not settled. Before a file is written its operations are
    compared with the model: in float64 to 1e-12 of the limit (1e-9 with a Gaussian process, an identified machine or
    physical effects), in float32 to 1e-5.

    Examples:

    ccnn export checkpoints/tripod/model.safetensors --to c99 --out controller && make -C controller test

    ccnn export runs/ur10/model.safetensors --to st --out plc

    ccnn export checkpoints/tripod/model.safetensors --to c99 --dtype float32 --sd --out microcontroller

    ccnn export checkpoints/tripod/model.safetensors --to linuxcnc --out kins

    ccnn export runs/arm/identified.yaml --to urdf --out robot
    """
    with if_stopped(NOTHING_WRITTEN):
        from ccnn_torch.compensation import export_model

        files = export_model(model, to, out, dtype, sd, public_key, allow_code)
    if not quiet:
        proven = "; their operations give the model's numbers" if to in ("c99", "st", "linuxcnc", "onnx") else ""
        typer.echo(f"{out}: {', '.join(files)} written{proven}.")
        if to == "c99":
            typer.echo(f"Compile them and compare golden vectors: make -C {out} test")
