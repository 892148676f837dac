"""The files of a machine whose parameters were found: our own form, and of a serial arm a URDF and a DH file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ccnn_torch.files.write import write_whole
from ccnn_torch.mechanisms.files.mechanism_file import mechanism_text
from ccnn_torch.mechanisms.files.write_arm import dh_text, urdf_text
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism


def write_machine(
    mechanism: Mechanism,
    nominal: Mapping[str, float],
    folder: Path,
    stem: str,
    columns: Mapping[str, str] | None = None,
    joint_map: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write `STEM.yaml`, of a serial arm also `STEM.urdf` and, where it is one of DH parameters, `STEM_dh.yaml`.

    Args:
        mechanism: with the values found.
        nominal: what was there before, by name [SI].
        folder: where to.
        stem: of the files' names.
        columns: the headers that its records mapped.
        joint_map: the joints as sums of its records' columns.
    """
    texts = {f"{stem}.yaml": mechanism_text(mechanism, nominal, columns, joint_map)}
    if isinstance(mechanism, SerialArm):
        texts[f"{stem}.urdf"] = urdf_text(mechanism)
        if mechanism.convention != "urdf":
            texts[f"{stem}_dh.yaml"] = dh_text(mechanism)
    for name, text in texts.items():
        write_whole(folder / name, text)
    return [folder / name for name in texts]
