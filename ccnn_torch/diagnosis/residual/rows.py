"""Selected rows of a situation."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from ccnn_torch.effects import Situation

__all__ = ["picked"]


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
