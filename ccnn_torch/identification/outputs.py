"""Files of `ccnn identify`: figures, tables, pictures, and the identified machine."""

from __future__ import annotations

from pathlib import Path

from ccnn_torch.files.write import write_whole
from ccnn_torch.identification.identify import Identification
from ccnn_torch.identification.page.report import save_identified_arrays, write_identified_report
from ccnn_torch.identification.page.tables import identified_markdown, write_identified_csv
from ccnn_torch.mechanisms import SerialArm
from ccnn_torch.mechanisms.files.mechanism_file import mechanism_text
from ccnn_torch.mechanisms.files.write_arm import dh_text, urdf_text
from ccnn_torch.report.json_files import write_json

__all__ = ["RESULTS", "write_machine", "write_outputs"]

RESULTS = "identified.json"


def write_outputs(found: Identification, folder: Path) -> None:
    """Write everything; `identified.json` comes last: a folder that has it is finished."""
    results = found.results
    write_identified_csv(folder / "identified.csv", results)
    write_whole(folder / "identified.md", identified_markdown(results))
    save_identified_arrays(folder, found.arrays)
    write_machine(found, folder)
    if found.config.save_report:
        write_identified_report(folder, results)
    write_json(folder / RESULTS, results)


def write_machine(found: Identification, folder: Path) -> list[Path]:
    """Write the identified machine (of several the first): `identified.yaml`, of a serial arm also URDF and DH file."""
    mechanism = found.mechanism()
    texts = {"identified.yaml": mechanism_text(mechanism, found.nominal(), found.config.columns)}
    if isinstance(mechanism, SerialArm):
        texts["identified.urdf"] = urdf_text(mechanism)
        if mechanism.convention != "urdf":
            texts["identified_dh.yaml"] = dh_text(mechanism)
    for name, text in texts.items():
        write_whole(folder / name, text)
    return [folder / name for name in texts]
