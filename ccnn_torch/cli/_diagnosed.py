"""What `ccnn diagnose` and `ccnn check` share: their options as one config, and a sign of life."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from ccnn_torch.diagnosis.config import DiagnoseConfig

__all__ = ["configured", "watched"]

_Found = TypeVar("_Found")


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
) -> DiagnoseConfig:
    """The config file with what the command line says over it."""
    from ccnn_torch.config.noise import read_noise
    from ccnn_torch.config.overrides import listed_files
    from ccnn_torch.diagnosis.config import load_diagnose_config

    told = [] if noise is None else [f"noise={json.dumps(read_noise(noise))}"]
    wanted = load_diagnose_config(config, [*(overrides or []), *told])
    names = None if effects is None else [e.strip() for e in effects.split(",") if e.strip()]
    given = {
        "records": None if records is None else listed_files(str(records), Path()),
        "mechanism": mechanism,
        "effects": names,
        "seed": seed,
        "network": network,
        "out": None if out is None else str(out),
    }
    return wanted.model_copy(update={k: v for k, v in given.items() if v is not None})


def watched(text: str, work: Callable[[Callable[[str], None]], _Found], quiet: bool) -> _Found:
    """Work that says how far it is, where a person is looking."""
    from ccnn_torch.report.screen import stderr

    if quiet or not stderr.is_terminal:
        return work(lambda how_far: None)
    with stderr.status(text) as status:
        return work(lambda how_far: status.update(f"{text} {how_far}"))
