"""Frames fitted to measured records, and with `geometry: identify` all parameters."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.calibration.rows.dataset import Dataset, pad_rows
from ccnn_torch.errors import InputError
from ccnn_torch.identification import fit_geometry
from ccnn_torch.mechanisms import Framed, Mechanism, SerialArm, fit_frames, judge_frames
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split


@dataclass(frozen=True)
class Fitted:
    """What was fitted to the training rows of each repeat.

    Attributes:
        parameters: with fitted frames, `r x 1 x k`, or `r x s x k` where frames are per group; None = nominal.
        geometry: all parameters identified, `r x 1 x k`, for comparison or to be learned beside; None = not fitted.
    """

    parameters: Tensor | None
    geometry: Tensor | None
    notes: list[str]


def fit_machine(mechanism: Mechanism, records: Records, splits: list[Split], identify: bool) -> Fitted:
    """Fit frames that are unknown, and the geometry where it is asked for or costs nothing (a serial arm).

    Args:
        splits: one a repeat; only rows that are not held out are used.
        identify: whether the geometry is to be a part of the compensator.
    """
    rows = pad_rows([Dataset.part(split, "fit") for split in splits])
    weights = torch.zeros(len(splits), len(records.joints), dtype=torch.float64)
    weights.scatter_add_(1, rows.index, rows.weights)
    arm = mechanism if isinstance(mechanism, SerialArm) else None
    grouped = arm is not None and bool(arm.frame_per or arm.tool_per)
    if identify and grouped:
        raise InputError(
            f"geometry: {mechanism.name} has frames per group of rows (frame_per, tool_per), and one compensator needs "
            "one frame; take the rows of one group, or write geometry=none"
        )
    notes = []
    parameters = geometry = None
    if arm is not None and arm.unknown_frames:
        parameters = fit_frames(arm, records.joints, records.pose, weights, columns=records.columns)
        if not grouped:
            parameters = parameters.unsqueeze(-2)
        about = (records.joints, records.pose, parameters, weights, records.path, records.name_rows)
        notes += judge_frames(arm, *about)
        frames = " and ".join(arm.unknown_frames)
        notes.append(f"Frames fitted first, on the training rows of each repeat: {frames}.")
    elif isinstance(mechanism, Framed) and mechanism.unknown_frames:
        parameters = mechanism.inlying_frames(records.joints, records.pose, weights).unsqueeze(-2)
        frames = " and ".join(mechanism.unknown_frames)
        notes.append(f"Frames fitted first, on the training rows of each repeat: {frames}.")
    if identify or (arm is not None and parameters is not None and not grouped):
        start = mechanism.nominal.expand(len(splits), -1) if parameters is None else parameters.squeeze(-2)
        geometry = fit_geometry(mechanism, records.joints, records.pose, start, weights).unsqueeze(-2)
    if identify:
        notes.append(
            f"Geometry identified on the training rows of each repeat: {len(mechanism.geometry)} parameters, each "
            "drawn to its nominal value by a plausible error; the network learns only what they leave."
        )
    return Fitted(parameters, geometry, notes)
