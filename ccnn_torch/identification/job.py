"""`ccnn identify`: a config to a finished folder, and an unfinished folder to a finished one."""

from __future__ import annotations

from ccnn_torch.errors import MethodFailedError
from ccnn_torch.identification import Progress
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.identify import RESULTS, identify, write_outputs
from ccnn_torch.identification.page import identified_page, not_settled
from ccnn_torch.report.screen import note, progress_bar, say_place, stdout
from ccnn_torch.run_folder.folder import RunFolder, resume_hint
from ccnn_torch.run_folder.resume import FolderJob


def _run(config: IdentifyConfig, _data: None, folder: RunFolder, quiet: bool, tables: bool) -> None:
    path = folder.path
    with progress_bar(quiet) as bar:

        def watch(label: str) -> Progress:
            task = bar.add_task(label, total=1.0)
            return lambda done: bar.update(task, completed=done)

        found = identify(config, path / "methods", watch)
    if tables and not quiet:
        # Before anything is written: what was found is not lost where the disk is full.
        identified_page(found.results).show(stdout)
    note("writing tables, plots and files …", quiet)
    with resume_hint(f"ccnn identify --resume {path}"):
        write_outputs(found, path)
    if not quiet:
        say_place(f"Everything is in {path}" + (f"; open {path / 'report.html'}" if config.save_report else ""))
    if found.results["methods"][found.results["method"]]["converged"] == 0:
        raise MethodFailedError(
            f"{not_settled(found.results)} What was written to {path} is there to look into it, not to use; more rows, "
            "more starts (starts=10) or fewer free parameters may help"
        )


IDENTIFY = FolderJob("ccnn identify", IdentifyConfig, RESULTS, "methods/*.safetensors", lambda c: (c, None), _run)
"""A config to a finished folder; `MethodFailedError` where all is written, but the first method did not converge."""
