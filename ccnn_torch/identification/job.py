"""`ccnn identify`: a config to a finished folder, and an unfinished folder to a finished one."""

from __future__ import annotations

from pathlib import Path

from ccnn_torch.errors import InputError, MethodFailedError
from ccnn_torch.identification import Progress
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import Identification, identify
from ccnn_torch.identification.outputs import RESULTS, write_outputs
from ccnn_torch.identification.page.tables import identified_page, not_settled
from ccnn_torch.report.screen import note, progress_bar, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, kept_for
from ccnn_torch.run_folder.resume import facts_of, refuse_changes


def start_identification(config: IdentifyConfig, quiet: bool = False) -> Path:
    """Identify into a fresh folder.

    Raises:
        InputError: the config or its data cannot be used, or the folder is taken.
        MethodFailedError: everything is written, but the first method did not converge.
    """
    with RunFolder.fresh(config.out, config.name, "ccnn identify --resume") as folder:
        try:
            folder.write("config.yaml", config.to_yaml(folder.path))
            _run(config, folder.path, quiet)
        except InputError:
            # Nothing was computed: the next try may take the same name.
            if not any(folder.path.glob("methods/*")):
                folder.config.unlink(missing_ok=True)
            raise
    return folder.path


def resume_identification(path: Path, quiet: bool = False) -> Path:
    """Finish the identification in a folder; methods that are finished are kept.

    Raises:
        InputError: there is none in the folder, it is in use, or its config or records were changed.
        MethodFailedError: as `start_identification`.
    """
    if (path / RESULTS).is_file():
        note(f"{path} is finished; nothing to do", quiet)
        return path
    with RunFolder.existing(path, "ccnn identify") as folder:
        config = IdentifyConfig.from_file(folder.config)
        refuse_changes(sorted(path.glob("methods/*.safetensors")), facts_of(config), folder.config)
        _run(config, path, quiet)
    return path


def _run(config: IdentifyConfig, path: Path, quiet: bool) -> Identification:
    with progress_bar(quiet) as bar:

        def watch(label: str) -> Progress:
            task = bar.add_task(label, total=1.0)
            return lambda done: bar.update(task, completed=done)

        found = identify(config, path / "methods", watch)
    if not quiet:
        # Before anything is written: what was found is not lost where the disk is full.
        identified_page(found.results).show(stdout)
    note("writing tables, plots and files …", quiet)
    with kept_for(f"ccnn identify --resume {path}"):
        write_outputs(found, path)
    if not quiet:
        say_place(f"Everything is in {path}" + (f"; open {path / 'report.html'}" if config.save_report else ""))
    if found.results["methods"][found.results["method"]]["converged"] == 0:
        raise MethodFailedError(
            f"{not_settled(found.results)} What was written to {path} is there to look into it, not to use; more rows, "
            "more starts (starts=10) or fewer free parameters may help"
        )
    return found
