"""Selected rows of a situation, and rows that are copies of others."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.effects import Situation

__all__ = ["copies_of", "picked"]


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
