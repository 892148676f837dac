"""The truth of a case as JSON, and the seal on it.

The truth is on no disk while the cases are diagnosed. It is drawn from the seed in a process of its own, and drawn
again when the seal is opened; in between there are only digests. A digest covers the noise-free poses bit by bit, so
that it cannot be tried against a list of likely truths. Opening checks that every diagnosis is there, and that truth
and records are those that were sealed. The diagnosing side gets the records, the nominal machine, and the noise where
it is disclosed; it could only cheat by running the generator itself.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from ccnn_validation.blind.case import BlindCase

__all__ = ["digest", "file_digest", "truth_of"]


def truth_of(case: BlindCase) -> dict[str, Any]:
    """What is sealed of a case."""
    plan = case.plan
    return {
        "number": plan.number,
        "kind": plan.kind,
        "machine": plan.machine,
        "causes": list(plan.causes),
        "shares": list(plan.shares),
        "strength": plan.strength,
        "rows": plan.rows,
        "noise": plan.noise,
        "noise_told": plan.noise_told,
        "moving": plan.moving,
        "disturbance": plan.disturbance,
        "drivers": [list(d) for d in case.drivers],
        "bad_rows": list(case.bad),
        "poses": hashlib.sha256(case.true.contiguous().numpy().tobytes()).hexdigest(),
    }


def digest(truth: dict[str, Any]) -> str:
    """SHA-256 of a truth."""
    return hashlib.sha256(json.dumps(truth, sort_keys=True, allow_nan=False).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
