"""The result of a verification: the content of verify.json, and the arrays of its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from ccnn_torch.mechanisms import PoseError
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.verification.prediction import Rows


@dataclass(frozen=True)
class Verified:
    """`results`: the content of verify.json; `arrays`: what its pictures need, all rows held out."""

    results: dict[str, Any]
    arrays: RunArrays


def error_block(
    unit: str, before: Tensor | None, after: Tensor | None, promise: Mapping[str, float] | None
) -> dict[str, Any] | None:
    if before is None or after is None:
        return None
    figures = {
        when: {"rms": rms(error), "max": float(error.max())} for when, error in (("before", before), ("after", after))
    }
    return {"unit": unit, **figures, "promised": promise}


def rms(values: Tensor) -> float | None:
    return float(values.square().mean().sqrt()) if values.numel() else None


def figure_arrays(rows: Rows, measured: Tensor, left: Tensor, before: PoseError, after: PoseError) -> RunArrays:
    return RunArrays(
        joints=rows.mechanism.joints,
        commanded=rows.joints.numpy(),
        measured=measured.detach().numpy(),
        predicted=(measured - left).detach().numpy(),
        test=np.ones(len(rows.joints), dtype=np.bool_),
        place=rows.mechanism.frame(rows.pose)[0].numpy(),
        position_before=before.position.detach().numpy(),
        position_after=after.position.detach().numpy(),
        rotation_before=None if before.rotation is None else before.rotation.detach().numpy(),
        rotation_after=None if after.rotation is None else after.rotation.detach().numpy(),
        labels={"mechanism": rows.mechanism.name},
    )
