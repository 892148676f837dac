"""`ccnn verify`: a model against rows that were measured after it was made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.completion import complete_mechanism
from ccnn_torch.cli.words import config_and_changes, noted
from ccnn_torch.errors import InputError
from ccnn_torch.run_folder.interrupt import NOTHING_WRITTEN, if_stopped


def verify(
    model: Annotated[Path, typer.Argument(help="A .safetensors or .onnx file, an identified.yaml or diagnosis.json.")],
    out: Annotated[Path, typer.Option(help="Folder to write verify.json and verify.html to.")],
    records: Annotated[
        str | None, typer.Argument(metavar="RECORDS.csv", help="New rows: joints and measured poses.")
    ] = None,
    records_option: Annotated[str | None, typer.Option("--records", help="The same as RECORDS.csv.")] = None,
    config: Annotated[
        Path | None, typer.Option(help="A config for ccnn run: how the records are read, and the machine.")
    ] = None,
    mechanism: Annotated[
        str | None,
        typer.Option(
            help="The machine's name or file; by default the model's.",
            autocompletion=complete_mechanism,
        ),
    ] = None,
    compensated: Annotated[
        bool, typer.Option("--compensated", help="The model was in use while the rows were measured.")
    ] = False,
    refit_frames: Annotated[
        bool, typer.Option("--refit-frames", help="The measuring device was moved since the model was made.")
    ] = False,
    public_key: Annotated[
        Path | None, typer.Option("--public-key", metavar="PUBLIC.pem", help="Take only a model signed by this key.")
    ] = None,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Run the Python file that the model names as its mechanism.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
) -> None:
    """Test a model on new measurements, against the error promised by its held-out rows.

    Without --compensated the rows are of the uncompensated machine: joints commanded, pose measured. With --compensated
    the joints are the ideal ones, the machine was commanded by the model, and the pose should be the nominal one.

    Exit code 0: the promise is kept; 1: the RMS of position or rotation is above its limit at 95 %; 2: bad input.

    Examples:

    ccnn verify runs/ur10/model.safetensors next_week.csv --out runs/next_week

    ccnn verify runs/ur10/model.safetensors with_it_on.csv --compensated --out runs/acceptance

    ccnn verify runs/five_bar/identified.yaml other_day.csv --refit-frames --out runs/other_day
    """
    with if_stopped(NOTHING_WRITTEN):
        from ccnn_torch.compensation import load_compensation
        from ccnn_torch.verification.config import load_verify_config
        from ccnn_torch.verification.job import verify_model
        from ccnn_torch.verification.page import write_verify_report

        file, changes = config_and_changes([], config, records=records or records_option, mechanism=mechanism)
        wanted = load_verify_config(file, changes, noted(quiet))
        if wanted.records is None:
            raise InputError("records: are missing; give RECORDS.csv, --records, or the key in a config")
        loaded = load_compensation(model, public_key=public_key, allow_code=allow_code)
        read = {"columns": wanted.columns, "joint_map": wanted.joint_map, "mechanism_keys": wanted.mechanism_keys}
        found = verify_model(loaded, wanted.records, wanted.mechanism, compensated, refit_frames, allow_code, **read)
        write_verify_report(out, found.results, found.arrays)
    results = found.results
    if not quiet:
        typer.echo(results.text)
        for note in results.notes:
            typer.echo(note)
        typer.echo(f"Everything is in {out}; open {out / 'verify.html'}")
    if not results.kept:
        raise typer.Exit(1)
