"""The noise as the records themselves show it, without any model: readings of one target, or columns of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.coordinates import is_temperature
from ccnn_torch.diagnosis.residual.correlation import FEWEST_TARGETS
from ccnn_torch.effects import Situation, measured_channels, pose_residual
from ccnn_torch.records import Records
from ccnn_torch.records.splits import number_targets
from ccnn_torch.units import si_unit_of

# Readings beyond the first of their target that make an estimate.
_FEWEST = 20
# What a column of standard deviations may be called, `{}` being the coordinate.
_NAMES = ("s{}", "sd_{}", "std_{}", "sigma_{}")
_ANGLES = {"rx": "seuler_x", "ry": "seuler_y", "rz": "seuler_z"}


class Noise(NamedTuple):
    """Standard deviation of each channel of position and rotation vector, `c` [m, rad], and where it is from: `given`,
    `columns`, `repeats`."""

    sd: Tensor
    source: str


def column_names(coordinate: str) -> list[str]:
    """What a column of the standard deviation of a pose coordinate may be called."""
    angles = [_ANGLES[coordinate]] if coordinate in _ANGLES else []
    return [*(name.format(coordinate) for name in _NAMES), *angles]


def noise_of_repeats(situation: Situation, measured: Tensor) -> Noise | None:
    """From readings of one target under the same conditions; None where there are too few.

    Args:
        situation: `s` rows.
        measured: poses, `s x p` [SI].
    """
    # Time and temperatures may differ between readings under the same conditions.
    held = [v[:, None] for name, v in situation.covariates.items() if name != "time" and not is_temperature(name)]
    # Readings of different corners or anchors are none of one target.
    held.append(measured[:, situation.mechanism.compared :].nan_to_num())
    residual, seen = pose_residual(situation, measured), measured_channels(situation, measured)
    fine = torch.isfinite(residual).all(-1)
    target = number_targets(torch.cat([situation.joints, *held], -1)[fine], FEWEST_TARGETS)
    if target is None:
        return None
    values = residual[fine]
    there = torch.ones_like(values) if seen is None else seen[fine].to(values.dtype)
    count, total = (
        torch.zeros(int(target.max()) + 1, values.shape[-1], dtype=values.dtype).index_add_(0, target, each)
        for each in (there, values)
    )
    free = (count - 1).clamp_min(0).sum(0)
    if int(free.min()) < _FEWEST:
        return None
    apart = (values - (total / count.clamp_min(1))[target]) * there
    sd = (apart.square().sum(0) / free).sqrt()
    return Noise(sd, "repeats") if bool((sd > 0).any()) else None


def noise_of_columns(records: Records, names: Sequence[str], channels: Mapping[str, int], count: int) -> Noise | None:
    """From columns of the standard deviation of each reading; None where a coordinate has none.

    Args:
        records: with all their columns.
        names: of the pose coordinates, which are channels themselves.
        channels: channel of each of these names.
        count: of the channels.
    """
    sd = torch.full((count,), torch.nan, dtype=torch.float64)
    for name in names:
        column = next((c for c in column_names(name) if c in records.columns), None)
        if column is None or name not in channels:
            return None
        values, unit = records.columns[column], records.units[column]
        if not unit or si_unit_of(unit) != ("rad" if name in _ANGLES else "m"):
            return None
        if not bool(np.isfinite(values).all()) or not bool((values >= 0).all()) or not bool((values > 0).any()):
            return None
        sd[channels[name]] = float(np.sqrt(np.square(values).mean()))
    # A channel that is no coordinate shows nothing of its own.
    return Noise(torch.nan_to_num(sd, nan=float(np.nanmax(sd.numpy()))), "columns")
