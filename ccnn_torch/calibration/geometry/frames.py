"""Frames fitted to measured records."""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.calibration.rows.dataset import Dataset, pad_rows
from ccnn_torch.mechanisms import Mechanism, SerialArm, fit_unknown, judge_frames
from ccnn_torch.records import Records
from ccnn_torch.records.splits import Split


def frames_of_repeats(mechanism: Mechanism, records: Records, splits: list[Split]) -> tuple[Tensor | None, list[str]]:
    """Fit frames that are unknown to the rows of each repeat that are not held out.

    Returns:
        All parameters, nominal but for the frames, `r x 1 x k`, or `r x s x k` where frames are per group; None where
        all frames are known; and notes.
    """
    rows = pad_rows([Dataset.part(split, "fit") for split in splits])
    weights = torch.zeros(len(splits), len(records.joints), dtype=torch.float64)
    weights.scatter_add_(1, rows.index, rows.weights)
    parameters = fit_unknown(mechanism, records.joints, records.pose, weights, records.columns)
    if parameters is None:
        return None, []
    if not mechanism.grouped:
        parameters = parameters.unsqueeze(-2)
    notes = []
    if isinstance(mechanism, SerialArm):
        about = (records.joints, records.pose, parameters, weights, records.path, records.name_rows)
        notes += judge_frames(mechanism, *about)
    unknown = " and ".join(getattr(mechanism, "unknown_frames", ()))
    notes.append(f"Frames fitted first, on the training rows of each repeat: {unknown}.")
    return parameters, notes
