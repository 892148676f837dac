"""The result of a verification, and the arrays of its figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from ccnn_torch.mechanisms import PoseError
from ccnn_torch.report.arrays import RunArrays
from ccnn_torch.report.results.base import Length
from ccnn_torch.report.results.verify import Error, Promised, Size, VerifyResults
from ccnn_torch.verification.prediction import Rows


@dataclass(frozen=True)
class Verified:
    """What was found, and the arrays that its pictures need, all rows held out."""

    results: VerifyResults
    arrays: RunArrays


def error_of(unit: Length, before: Tensor | None, after: Tensor | None, promise: Promised | None) -> Error | None:
    """The errors of all rows before and after, `s` [unit]; None where there are none."""
    if before is None or after is None:
        return None
    first, last = (Size(rms=float(e.square().mean().sqrt()), max=float(e.max())) for e in (before, after))
    return Error(unit=unit, before=first, after=last, promised=promise)


def rms_of(values: Tensor) -> float | None:
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
