"""Rows that this machine can have reached."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.checks.mistakes import late_rows, mistake, what_is_wrong
from ccnn_torch.diagnosis.residual.distance import USUAL, distance, size_of
from ccnn_torch.diagnosis.residual.rows import picked
from ccnn_torch.effects import Situation
from ccnn_torch.errors import RowsError

# Sizes of the machine: a row farther off is of other joints.
_ROW = 1.0
# Rows astray among which a mistake in common is searched.
_MANY = 5


class PlausibleRows(NamedTuple):
    """Which rows are of the machine.

    Attributes:
        fine: those that are, `s` bool.
        astray: those that are not because their pose is elsewhere, `s` bool.
        mistake: the one that many of these have in common, in words; empty where there is none.
    """

    fine: Tensor
    astray: Tensor
    mistake: str

    @property
    def lost(self) -> float:
        """Share of the rows that are not."""
        return 1 - float(self.fine.double().mean())


def plausible_rows(situation: Situation, measured: Tensor) -> PlausibleRows:
    """Whether the pose of each row is near where its joints put it.

    Raises:
        RowsError: most of them do not, are out of reach, or belong to the row before or after.
    """
    size = size_of(situation)
    far = distance(situation, measured, size)
    late = late_rows(situation, measured, size)
    if late:
        raise RowsError(late)
    reached = torch.isfinite(far)
    if 2 * int(reached.sum()) < len(far):
        raise RowsError(
            f"{int((~reached).sum())} of {len(far)} rows are outside the reach of {situation.mechanism.name}; "
            + (
                what_is_wrong(situation, measured, size)
                or "check the units, the order of the joints, and that this is the machine"
            )
        )
    usual = float(far[reached].median())
    if usual > USUAL:
        raise RowsError(
            f"the usual pose lies {usual:.3g} times as far from where {situation.mechanism.name} puts it as its poses "
            "are spread over the workspace, so that these rows are not of this model; "
            + (
                what_is_wrong(situation, measured, size)
                or "check the units, the order and signs of joints and pose, the frame that the pose is given in, and "
                "that joints and pose of a row belong together"
            )
        )
    astray = reached & (far >= _ROW)
    many = int(astray.sum()) >= _MANY
    common = mistake(picked(situation, torch.nonzero(astray)[:, 0]), measured[astray], size) if many else ""
    return PlausibleRows(reached & ~astray, astray, common)
