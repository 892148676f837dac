"""The config of a diagnosis: its keys, defaults and checks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from ccnn_torch.config.sizes import Noise, Size, size
from ccnn_torch.config.tree import Columns, Files, JobConfig, JointMap, Names
from ccnn_torch.errors import InputError
from ccnn_torch.run_folder.folder import check_own_folder

_WRONG_NOISE = (
    "must be a standard deviation of the pose, a size above 0 (10um, or 1e-5 in SI) or one for each coordinate; leave "
    "it out to have it estimated"
)


def _deviation(value: Any) -> Any:
    """Noise as in a config: None, a size above 0, or sizes above 0 by name."""
    sizes = list(value.values()) if isinstance(value, dict) else [value]
    try:
        fine = value is None or (sizes and all(0 < size(one, None, "noise") < math.inf for one in sizes))
    except (TypeError, InputError):
        fine = False
    if not fine or (isinstance(value, dict) and not all(isinstance(name, str) for name in value)):
        raise ValueError(f"{_WRONG_NOISE} (it is {value})")
    return value


class DiagnoseConfig(JobConfig):
    """Options of `ccnn diagnose` and `ccnn check`."""

    of_a_run = ("records", "columns", "joint_map", "mechanism", "mechanism_keys", "covariates", "seed")

    records: Files | None = Field(
        default=None,
        description="CSV (or .xlsx) of the records, or a list of such files; the same as --records",
    )
    motion: Files | None = Field(
        default=None,
        description="logs of a machine in motion: CSV files (each a run), LeRobot data sets, recordings of ROS 2; the "
        "same as --motion; in the place of records",
    )
    motion_keys: dict[str, Any] = Field(
        default={},
        description="of logs that are no tables: joints, units; of a LeRobot data set episodes, calibration; of a "
        "recording of ROS 2 the topics command and state, and samples",
    )
    columns: Columns
    joint_map: JointMap
    mechanism: str | None = Field(default=None, description="the nominal machine; the same as --mechanism")
    out: str | None = Field(default=None, description="folder to write; the same as --out")
    mechanism_keys: dict[str, Any] = Field(
        default={},
        description="keys of the mechanism's constructor; of a servo its gain, inertia, mass, length, viscous, …",
    )
    covariates: Names | None = Field(
        default=None,
        description="covariate columns by name or pattern; null = time, temperature, load_*, torque_*, direction*, …",
    )
    noise: Annotated[Noise | None, BeforeValidator(_deviation)] = Field(
        default=None,
        description="standard deviation of the measured pose, in SI or with a unit (10um), one size for every "
        "coordinate or by coordinate or unit; null = estimated from the records; one number is metres for lengths and "
        "radians for angles alike",
    )
    exact: Names | None = Field(
        default=None,
        description="of a motion: values of the model that are exact, e.g. gain, inertia, and time for the time stamps",
    )
    known: dict[str, Size] = Field(
        default={},
        description="of a motion: shares to which others are known (standard deviation), e.g. {mass: 2 %}; 3 % each "
        "where nothing is said, time stamps to 10 % of a sampling step",
    )
    effects: Names | None = Field(
        default=None, description="candidates, by name or path/to/file.py:Name, all for the library; null = all"
    )
    gravity: tuple[float, float, float] | None = Field(
        default=None,
        description="gravity in m/s² in the frame of the poses, of an arm with an unknown base frame in its own base; "
        "null = down along -z (planar machines: -y; an arm on a track: against its first axis that turns)",
    )
    network: bool = Field(
        default=True, description="whether to say what a network on the remainder would still gain; takes seconds"
    )
    seed: int = Field(default=0, ge=0, lt=2**63, description="seed of folds and resampling")


def folder_of(config: DiagnoseConfig, *more: str) -> Path:
    """The folder that a diagnosis writes; one with an earlier diagnosis, a check or a file of `more` is written over.

    Raises:
        InputError: none is named, or it holds other files.
    """
    if config.out is None:
        raise InputError("name the folder to write with --out DIR")
    folder = Path(config.out)
    check_own_folder(folder, ("diagnosis.json", "check.json", *more))
    return folder
