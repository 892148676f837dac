"""Files of `ccnn identify`: figures, tables, pictures, and the identified machine."""

from __future__ import annotations

from pathlib import Path

from ccnn_torch.files.write import write_whole
from ccnn_torch.identification.identify import Identification
from ccnn_torch.identification.page.report import write_identified_report
from ccnn_torch.identification.page.tables import identified_page, write_identified_csv
from ccnn_torch.mechanisms.files.write_arm import write_machine
from ccnn_torch.report.arrays import ARRAYS_FILE, save_tensors
from ccnn_torch.report.json_files import write_json
from ccnn_torch.report.results.identified import IdentifiedResults

RESULTS = "identified.json"


def write_outputs(found: Identification, folder: Path) -> None:
    """Write everything; `identified.json` comes last: a folder that has it is finished."""
    results = found.results
    write_identified_csv(folder / "identified.csv", results)
    write_whole(folder / "identified.md", identified_page(results).markdown())
    save_tensors(folder / ARRAYS_FILE, found.arrays)
    # Of several machines the first.
    config = found.config
    write_machine(found.mechanism(), found.nominal(), folder, "identified", config.columns, config.joint_map)
    if found.config.save_report:
        write_identified_report(folder, results)
    write_json(folder / RESULTS, IdentifiedResults.model_validate(results))
