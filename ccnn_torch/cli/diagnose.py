"""`ccnn diagnose`: which effect makes the gap between model and machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ccnn_torch.cli._complete import complete_mechanism
from ccnn_torch.cli._diagnosed import configured, watched
from ccnn_torch.cli._stopped import if_stopped
from ccnn_torch.errors import InputError

if TYPE_CHECKING:
    from ccnn_torch.diagnosis import Diagnosis
    from ccnn_torch.diagnosis.config import DiagnoseConfig

__all__ = ["diagnose"]


def diagnose(
    overrides: Annotated[list[str] | None, typer.Argument(help="key=value or key.sub=value, over the config.")] = None,
    records: Annotated[Path | None, typer.Option(help="CSV of joints, measured poses and covariates.")] = None,
    mechanism: Annotated[
        str | None,
        typer.Option(help="A mechanism's name, file, or path/to/file.py:Name.", autocompletion=complete_mechanism),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write diagnosis.json to.")] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            help="Standard deviation of the pose: 1e-5 (m and rad alike), 10um, NAME=S,…, or m=10um,rad=30urad."
        ),
    ] = None,
    effects: Annotated[
        str | None, typer.Option(help="Candidates, a,b,…; all for the whole library, as when left out.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="A YAML file with keys as below.")] = None,
    seed: Annotated[int | None, typer.Option(help="The same as seed=….")] = None,
    network: Annotated[
        bool | None, typer.Option(help="What a network would still gain; the same as network=….")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No verdict, no table.")] = False,
) -> None:
    """Name the physical effect that makes the gap between a model and measurements, and how far the gap shrinks.

    The verdict comes first; then a network is trained on what the effects leave, to say what it would still gain
    (seconds; --no-network leaves that out). The folder gets diagnosis.json, report.html and next_measurements.csv, the
    rows that would tell most. Keys: records, columns, mechanism, out, mechanism_keys, covariates, noise, effects,
    gravity, network, seed.

    Examples:

    ccnn diagnose --records measured.csv --mechanism five_bar --out runs/diagnosis

    ccnn diagnose --records measured.csv --mechanism arm.yaml --out runs/arm --noise x=1e-5,y=1e-5,z=2e-5

    ccnn diagnose --records measured.csv --mechanism stewart --out runs/s --effects all,my_effect.py:Mine

    ccnn diagnose --records measured.csv --mechanism my_simulator.py:PRESS --out runs/press
    """
    with if_stopped("interrupted before there was a verdict; nothing was written"):
        wanted = configured(overrides, records, mechanism, noise, effects, config, seed, out, network)
        if wanted.out is None:
            raise InputError("name the folder to write with --out DIR")
        found = _search(wanted, quiet)
    from ccnn_torch.diagnosis.job import write_result
    from ccnn_torch.diagnosis.page.report import print_diagnosis
    from ccnn_torch.files.write import sweep
    from ccnn_torch.report.screen import stdout
    from ccnn_torch.run_folder.lock import locked

    folder = Path(wanted.out)
    try:
        with locked(folder):
            sweep(folder)
            kept = write_result(folder, found)
            stopped = f"interrupted after the verdict, which is kept in {kept}; what comes after it is not complete"
            with if_stopped(stopped):
                _tell(wanted, folder, found, quiet)
    except InputError:
        # A full disk, or another process that writes there: what was found is told, if it cannot be kept.
        print_diagnosis(found.to_json(), stdout)
        raise


def _search(wanted: DiagnoseConfig, quiet: bool) -> Diagnosis:
    """The verdict."""
    from ccnn_torch.diagnosis.job import run_diagnosis
    from ccnn_torch.mechanisms import simulated_rows

    def search(tell: Callable[[str], None]) -> Diagnosis:
        with simulated_rows(lambda n: tell(f"{n:,} rows simulated")):
            return run_diagnosis(wanted)

    # Thousands of rows of an arm take half a minute, a slow simulator more; how much is left nobody knows.
    return watched("looking for the effects that make the gap …", search, quiet)


def _tell(wanted: DiagnoseConfig, folder: Path, found: Diagnosis, quiet: bool) -> None:
    """The verdict at once, then all that takes longer."""
    from ccnn_torch.diagnosis import with_network
    from ccnn_torch.diagnosis.job import write_diagnosis
    from ccnn_torch.diagnosis.page.data import about_of, load_labels
    from ccnn_torch.diagnosis.page.report import print_diagnosis
    from ccnn_torch.display import short_path
    from ccnn_torch.report.screen import say_place, stdout
    from ccnn_torch.report.table import print_text

    if not quiet:
        print_text(found.verdict["text"], stdout, "bold")
    if wanted.network:

        def train(tell: Callable[[str], None]) -> Diagnosis:
            return with_network(found, wanted.seed, lambda share: tell(f"{100 * share:.0f} %"))

        found = watched("training a network on what the effects leave …", train, quiet)
    records = wanted.records if isinstance(wanted.records, list) else [wanted.records]
    rows = ", ".join(short_path(str(file)) for file in records)
    about = {"name": folder.name, "mechanism": short_path(str(wanted.mechanism)), "records": rows}
    path = write_diagnosis(folder, found, about, wanted.seed)
    if quiet:
        return
    print_diagnosis(found.to_json(), stdout, about_of(load_labels(folder)), verdict=False)
    say_place(f"Written: {path} and report.html beside it")
