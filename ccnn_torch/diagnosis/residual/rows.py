"""Rows of a situation: selected ones, copies of others, those near a singularity, and what fitted frames do in them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.whitening import moving_channels
from ccnn_torch.effects import Situation
from ccnn_torch.mechanisms import sees_directions

# Rows are left out where the Jacobian is worse conditioned than this and than ten times the usual.
_CONDITION = 50.0
_TIMES_USUAL = 10.0
# Length that is worth a radian in that number [m].
_LEVER = 0.3
# Or where the joints move the platform so many times as far as usual.
_GAIN = 3.0
# Directions of fitted frames that move the rows less than this share of what the largest does are not known from them.
_HARDLY = 1e-3


def picked(situation: Situation, rows: Tensor) -> Situation:
    """The rows of these numbers, `t`, of a situation with `s` rows; parameters go along where they are by row."""
    count = len(situation.joints)

    def pick(value: Tensor | None) -> Tensor | None:
        return value[rows] if value is not None and value.dim() > 1 and len(value) == count else value

    return replace(
        situation,
        joints=situation.joints[rows],
        covariates={n: v[rows] for n, v in situation.covariates.items()},
        parameters=pick(situation.parameters),
        guess=pick(situation.guess),
    )


def copies_of(situation: Situation, measured: Tensor) -> Tensor:
    """Rows that repeat an earlier one in joints, pose and every covariate, `s` bool; measured: poses, `s x p`."""
    columns = [situation.joints, measured, *(v[:, None] for v in situation.covariates.values())]
    # NaN is equal to nothing: a row without a pose is no copy.
    number = torch.unique(torch.cat(columns, -1), dim=0, return_inverse=True)[1]
    first = torch.full((int(number.max()) + 1,), len(number)).scatter_reduce_(
        0, number, torch.arange(len(number)), "amin"
    )
    return first[number] < torch.arange(len(number))


def near_singular(situation: Situation) -> Tensor:
    """Rows whose Jacobian is far worse conditioned than the others', `s`; a direction at the pole is as good as any."""
    channels = moving_channels(situation)
    if sees_directions(situation.mechanism):
        return torch.zeros(len(situation.joints), dtype=torch.bool)
    jacobian = torch.nan_to_num(situation.jacobian[:, channels]).clone()
    jacobian *= situation.mechanism.channel_weights(_LEVER)[channels][:, None]
    values = torch.linalg.svdvals(jacobian)
    condition = values[:, 0] / values[:, -1].clamp_min(1e-300)
    far: Tensor = (condition > _CONDITION) & (condition > _TIMES_USUAL * condition.median())
    # First order does not hold where the joints move the platform much more, and a few such rows have the whole gap.
    far = far | (values[:, 0] > _GAIN * values[:, 0].median())
    return far


def only_usable(values: Tensor, usable: Tensor) -> Tensor:
    """Values by row, `s x ...`, 0 in rows that are left out; usable: `s`."""
    return values.where(usable.reshape(-1, *[1] * (values.dim() - 1)), 0.0)


def frame_columns(situation: Situation, usable: Tensor) -> Tensor:
    """What frames that were fitted to these rows can do, `s x c0 x r`, in sizes that no evidence holds back.

    A frame that a group of rows has for itself acts in these alone. What rows hardly show of frames stays as it is: a
    tool that were metres longer would be a forearm that is a millimetre longer, where two axes are all but parallel.
    """
    index = [k for frame in fitted_frames(situation) for k in frame]
    if not index:
        return situation.jacobian[..., :0]
    columns = only_usable(situation.parameter_jacobian[..., index] @ in_groups(situation), usable)
    _, sizes, directions = torch.linalg.svd(torch.nan_to_num(columns).flatten(0, 1), full_matrices=False)
    shown: Tensor = directions[sizes > _HARDLY * sizes[0]]
    return columns @ (shown.mT @ shown)


def in_groups(situation: Situation) -> Tensor:
    """Which of the columns of fitted frames, `r`, is each of their `f` parameters in every row, `s x f x r` of 0, 1.

    Rows of one group have the same frame among their parameters.
    """
    values = situation.mechanism.resolve(situation.parameters).expand(len(situation.joints), -1)
    columns, count = [], 0
    for frame in fitted_frames(situation):
        number = torch.unique(values[:, frame], dim=0, return_inverse=True)[1]
        columns.append(count + number[:, None] * len(frame) + torch.arange(len(frame)))
        count += (int(number.max()) + 1) * len(frame)
    return torch.nn.functional.one_hot(torch.cat(columns, -1), count).to(values.dtype)


def fitted_frames(situation: Situation) -> list[list[int]]:
    """Numbers of the parameters of each frame that is fitted."""
    names = [g.name.partition("_")[0] for g in situation.mechanism.geometry]
    unknown = getattr(situation.mechanism, "unknown_frames", ())
    return [[k for k, name in enumerate(names) if name == frame] for frame in unknown]
