"""Options of `ccnn diagnose` and `ccnn check` as one config."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from ccnn_torch.cli.words import config_and_changes, noted

if TYPE_CHECKING:
    from ccnn_torch.diagnosis.config import DiagnoseConfig


def configured(
    overrides: list[str] | None,
    records: Path | None,
    mechanism: str | None,
    noise: str | None,
    effects: str | None,
    config: Path | None,
    seed: int | None,
    out: Path | None = None,
    network: bool | None = None,
    motion: list[Path] | None = None,
    quiet: bool = False,
) -> DiagnoseConfig:
    """The config file, overridden by the options of the command line; `overrides` may begin with the config."""
    from ccnn_torch.config.noise import read_noise
    from ccnn_torch.config.overrides import listed_files
    from ccnn_torch.diagnosis.config import DiagnoseConfig

    noise_key = [] if noise is None else [f"noise={json.dumps(read_noise(noise))}"]
    file, changes = config_and_changes(overrides or [], config)
    wanted = DiagnoseConfig.from_file(file, [*changes, *noise_key], noted(quiet))
    names = None if effects is None else [e.strip() for e in effects.split(",") if e.strip()]
    given = {
        "records": None if records is None else listed_files(str(records), Path()),
        "motion": [str(log) for log in motion] if motion else None,
        "mechanism": mechanism,
        "effects": names,
        "seed": seed,
        "network": network,
        "out": None if out is None else str(out),
    }
    return wanted.model_copy(update={k: v for k, v in given.items() if v is not None})
