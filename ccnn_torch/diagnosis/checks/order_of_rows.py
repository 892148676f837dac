"""Directions of approach that were not recorded, from the order of the rows: backlash and friction show by them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import default_shape, scaled_signature
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.effects import Situation
from ccnn_torch.effects.backlash import Backlash
from ccnn_torch.evidence.dictionary import gain_beside

# Log odds that the directions must gain beside the verdict, and beyond twice what those of as many random orders gain:
# in any order a row far out was reached from further in, so that directions follow the place a little.
_CLEARLY, _ORDERS = 10.0, 4
_EFFECT = Backlash()


def directions_of_order(situation: Situation) -> dict[str, Tensor]:
    """Sign of each joint's way from the row before, `s` each, by the names of their columns; {} where one is recorded.

    Rows are in the order of their time where that was recorded, else in that of the file. A joint that stands still
    keeps its sign; before its first motion it is 0.

    Args:
        situation: all rows of the file.
    """
    time = situation.covariates.get("time")
    order = torch.arange(len(situation.joints)) if time is None else time.argsort(stable=True)
    return {} if situation.directed else _by_name(_signs(situation.joints, order))


def order_shows(analysis: Analysis, judgement: Judgement, directions: Mapping[str, Tensor]) -> bool:
    """Whether what a verdict leaves follows these directions.

    Args:
        analysis: of the rows.
        judgement: the verdict without them.
        directions: of the same rows, `s` each; {} = none.
    """
    if not directions:
        return False
    drawn = torch.Generator().manual_seed(0)
    orders = [torch.randperm(len(analysis.residual), generator=drawn) for _ in range(_ORDERS)]
    every = []
    for signs in (directions, *(_by_name(_signs(analysis.situation.joints, order)) for order in orders)):
        there = replace(analysis.situation, covariates={**analysis.situation.covariates, **signs})
        every.append(scaled_signature(there, _EFFECT, default_shape(there, _EFFECT)))
    gain, *by_chance = gain_beside(analysis.dictionary, judgement.found, analysis.whitened(every))
    return gain > _CLEARLY + 2 * max(0.0, *by_chance)


def _signs(joints: Tensor, order: Tensor) -> Tensor:
    """Sign of each joint's way from the row before in an order of the rows, `s x n`."""
    way = joints[order].diff(dim=0, prepend=joints[order[:1]]).sign()
    rows = torch.arange(len(way))[:, None].expand_as(way)
    last = torch.where(way != 0, rows, 0).cummax(0).values
    signs = torch.empty_like(joints)
    signs[order] = way.gather(0, last)
    return signs


def _by_name(signs: Tensor) -> dict[str, Tensor]:
    return {f"direction{i + 1}": way for i, way in enumerate(signs.unbind(-1))}
