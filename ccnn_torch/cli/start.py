"""`ccnn start`: the usual way from a file of measurements to a verified model, one command after another."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from ccnn_torch.cli.from_records import check, diagnose, new, run
from ccnn_torch.cli.options import Mechanism, Overrides, Quiet
from ccnn_torch.cli.with_model import verify
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import make_folder
from ccnn_torch.files.yaml_file import read_yaml

_STEPS = 5


def _check_config(config: Path, records: Path) -> None:
    """Raise InputError where the config that was written is of a log, or has no mechanism."""
    keys = read_yaml(config)
    if "motion" in keys:
        raise InputError(
            f"{records}: is a log of a motion, and the steps here are of poses; ccnn diagnose --config {config} reads "
            "the log"
        )
    if "mechanism" not in keys:
        config.unlink()
        raise InputError(
            f"--mechanism: is missing, and the columns of {records} do not tell it; give its name or file ({config} "
            "was taken away again)"
        )


def start(
    records: Annotated[Path | None, typer.Argument(metavar="RECORDS.csv", help="Measured rows, with headers.")] = None,
    overrides: Overrides = None,
    out: Annotated[Path | None, typer.Option(help="Folder of all steps; runs/RECORDS without it.")] = None,
    mechanism: Mechanism = None,
    units: Annotated[
        str | None, typer.Option(metavar="LENGTH,ANGLE", help="Units of columns without one, e.g. mm,deg.")
    ] = None,
    new_rows: Annotated[
        str | None, typer.Option("--new", metavar="NEW.csv", help="Rows measured since, which judge the model.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Go on at every gate.")] = False,
    quiet: Quiet = False,
) -> None:
    """Go from measured rows to a verified model, step by step: new, check, diagnose, run, verify.

    Before each step it says what comes, and on a terminal asks whether to go on. It trains no model where the diagnosis
    finds nothing beyond the noise, and judges none that makes held-out rows no better, but with --yes. What is finished
    is not done again: ccnn start --out DIR goes on where it was stopped. key=value is for ccnn run. Exit codes are
    those of the commands.

    Examples:

    ccnn start measured.csv

    ccnn start measured.csv --mechanism my_arm.yaml --units mm,deg --out runs/arm --yes

    ccnn start --out runs/arm --new next_week.csv
    """
    if records is not None and "=" in str(records) and not os.path.isfile(records):
        records, overrides = None, [str(records), *(overrides or [])]
    out = out or _folder_of(records)
    asks = not yes and not quiet and sys.stdin is not None and sys.stdin.isatty()
    config, diagnosis, folder = out / "robot.yaml", out / "diagnosis", out / "run"

    say: Callable[[str], None] = (lambda text: None) if quiet else typer.echo

    def due(step: int, result: Path, what: str, wanted: bool = True) -> bool:
        """Whether a step is still to be done; leaves the command where the user, or a gate, does not want it."""
        if result.is_file():
            say(f"{step} of {_STEPS}: done before, {result}")
            return False
        say(f"{step} of {_STEPS}: {what}")
        if not (typer.confirm("Go on?", default=wanted) if asks else yes or wanted):
            typer.echo(f"Stopped here; ccnn start --out {out} goes on{'' if asks else ', with --yes'}.")
            raise typer.Exit
        return True

    if due(1, config, "write a config for the records (ccnn new)"):
        if records is None:
            raise InputError(f"{config} is not there yet; name RECORDS.csv to begin")
        make_folder(out)
        new(records, config, mechanism, units, quiet=quiet)
        _check_config(config, records)
    if due(2, out / "check.json", "see what these rows can show (ccnn check)"):
        check(config=config, out=str(out), quiet=quiet)
    if due(3, diagnosis / "report.html", "find the cause of the error (ccnn diagnose)"):
        diagnose(config=config, out=str(diagnosis), quiet=quiet)
    nothing = _found_nothing(diagnosis)
    what = "nothing beyond the noise was found, so a model would learn noise" if nothing else "train a model"
    if due(4, folder / "results.json", f"{what} (ccnn run)", wanted=not nothing):
        if (folder / "config.yaml").is_file():
            run(resume=folder, quiet=quiet)
        else:
            run(config, overrides, out=str(folder), quiet=quiet)
    if not yes and not _pays(folder):
        say(f"Stopped here: the model makes held-out rows no better. Mend what the diagnosis names, or add rows; {out} "
            "holds what was done, --yes goes on.")  # fmt: skip
        return
    if new_rows is None and asks:
        new_rows = typer.prompt("File of rows measured since, which judge the model (empty: later)", default="") or None
    if new_rows is None:
        say(f"5 of {_STEPS}: measure 20 poses or more again, then: ccnn start --out {out} --new NEW.csv")
        return
    say(f"5 of {_STEPS}: judge the model on {new_rows} (ccnn verify)")
    verify(folder / "model.safetensors", out / "verified", new_rows, quiet=quiet)


def _folder_of(records: Path | None) -> Path:
    if records is None:
        raise InputError("name RECORDS.csv to begin, or --out DIR to go on")
    return Path("runs") / records.stem


def _found_nothing(folder: Path) -> bool:
    from ccnn_torch.report.json_files import read_json

    return bool(read_json(folder / "diagnosis.json")["verdict"]["none"])


def _pays(folder: Path) -> bool:
    from ccnn_torch.calibration.page import pays
    from ccnn_torch.report.json_files import read_json
    from ccnn_torch.report.results.run import RunResults

    return pays(RunResults.model_validate(read_json(folder / "results.json")))
