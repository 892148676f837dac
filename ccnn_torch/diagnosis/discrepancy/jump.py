"""Discrepancy terms of a jump: from one row on something has moved, by a collision, a new clamping or a new zero."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.candidates.nuisance import NuisanceFit, SharedColumns, TrialColumns, search_charge
from ccnn_torch.evidence.priors import OUTSIDE

# Rows before the first possible jump and after the last, and places that are tried, at most.
_FEWEST_ROWS, _PLACES = 5, 120


def jump_discrepancies(
    moved: Mapping[str, Tensor], whitened: Mapping[str, Tensor], few: Tensor, plain: NuisanceFit, loose: float
) -> list[Atom]:
    """The likeliest jump of everything that may have moved, its search charged; `note` says what moved.

    Args:
        moved: what may have moved -> columns of a shift of it, `s x c0 x k` [m, rad]; rows in the order measured.
        whitened: the same, `s x c x k`.
        few: rows evaluated, `t`.
        plain: what is to be explained there.
        loose: size of what else is there, in plausible sizes.
    """
    rows = len(next(iter(moved.values())))
    if rows < 4 * _FEWEST_ROWS:
        return []
    step = max(1, -(-(rows - 2 * _FEWEST_ROWS) // _PLACES))
    number = torch.arange(rows)
    found = []
    for what, columns in moved.items():
        lead = whitened[what][few]
        shared, left = SharedColumns(lead), plain.beside(loose * lead)

        def gain(places: Tensor, shared: SharedColumns = shared, left: NuisanceFit = left) -> Tensor:
            return left.gain(TrialColumns(_steps(number[few], places)[..., None, None], shared))

        places = torch.arange(_FEWEST_ROWS, rows - _FEWEST_ROWS, step)
        score = gain(places)
        best = int(places[score.argmax()])
        close = torch.arange(max(best - step + 1, _FEWEST_ROWS), min(best + step, rows - _FEWEST_ROWS))
        best = int(close[gain(close).argmax()])
        charge = search_charge(rows / len(few) * score)
        acting = columns * _steps(number, torch.tensor([best]))[0][:, None, None]
        prior = OUTSIDE - charge
        found.append(Atom("time", None, lead.new_zeros(0), acting, prior, note=f"a jump of {what}", begins=best))
    return found


def _steps(number: Tensor, places: Tensor) -> Tensor:
    """0 before each place and 1 from it on, `g x s`."""
    return (number >= places[:, None]).to(torch.float64)
