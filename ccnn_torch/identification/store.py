"""Checkpoints of an identification: one for each finished method."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ccnn_torch.identification.solve import Outcome
from ccnn_torch.training import load_checkpoint, save_checkpoint


def save_outcome(path: Path, outcome: Outcome, facts: Mapping[str, Any]) -> None:
    """Write an outcome; `facts` say what config and data it is of.

    Raises:
        WriteError: it cannot be written.
    """
    about = {
        "facts": dict(facts),
        "evaluations": outcome.evaluations,
        "seconds": outcome.seconds,
        "message": outcome.message,
    }
    tensors = {"machines": outcome.machines, "values": outcome.values, "converged": outcome.converged}
    save_checkpoint(path, tensors, about)


def load_outcome(path: Path) -> Outcome:
    """The outcome in a file."""
    tensors, about = load_checkpoint(path)
    return Outcome(
        tensors["machines"],
        tensors["values"],
        tensors["converged"].to(torch.bool),
        int(about["evaluations"]),
        float(about["seconds"]),
        str(about["message"]),
    )
