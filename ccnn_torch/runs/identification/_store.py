"""What a method found, in a file: an interrupted identification goes on behind the last finished method."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from ccnn_torch.errors import InputError
from ccnn_torch.runs.identification._solve import Outcome
from ccnn_torch.training import write_whole

__all__ = ["load_outcome", "save_outcome"]

_KEY = "outcome"


def save_outcome(path: Path, outcome: Outcome, fingerprint: str) -> None:
    """Write an outcome; `fingerprint` says what data it is of."""
    about = {
        "fingerprint": fingerprint,
        "evaluations": outcome.evaluations,
        "seconds": outcome.seconds,
        "message": outcome.message,
    }
    tensors = {"machines": outcome.machines, "values": outcome.values, "converged": outcome.converged}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, save({k: v.contiguous() for k, v in tensors.items()}, {_KEY: json.dumps(about, sort_keys=True)}))


def load_outcome(path: Path, fingerprint: str) -> Outcome | None:
    """The outcome in a file; None where there is none.

    Raises:
        InputError: the file is damaged, or of other data.
    """
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads(file.metadata()[_KEY])
            tensors = {name: file.get_tensor(name) for name in ("machines", "values", "converged")}
    except (SafetensorError, KeyError, TypeError, json.JSONDecodeError):
        raise InputError(f"{path}: is damaged; remove it, and its method is run again") from None
    if about["fingerprint"] != fingerprint:
        raise InputError(f"{path}: is of other data than the config's; the records were changed: start a new folder")
    return Outcome(
        tensors["machines"],
        tensors["values"],
        tensors["converged"].to(torch.bool),
        int(about["evaluations"]),
        float(about["seconds"]),
        str(about["message"]),
    )
