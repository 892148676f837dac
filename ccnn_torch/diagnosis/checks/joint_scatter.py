"""Scatter of one joint in what a verdict leaves: what backlash and friction do whose direction was not recorded."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement

# Variances of a joint that are tried, in units of what would be as much as the noise of the usual row.
_VARIANCES = torch.logspace(-2, 3, 41, dtype=torch.float64)
# Log likelihood that the scatter of one joint adds, from which it is no chance: noise alone adds up to 2 in trials.
# And its share of the mean square that is left, below which it is the scatter of a sound joint.
_CLEARLY, _SHARE = 5.0, 0.1


class Scatter(NamedTuple):
    """A joint's number, from 1, its standard deviation, and the unit of that."""

    joint: int
    size: float
    unit: str


def joint_scatter(analysis: Analysis, judgement: Judgement) -> Scatter | None:
    """The joint whose scatter explains what is left better than noise alike in all directions; None where none does.

    What is left of a row, whitened, is N(0, σ²(I + ρ a aᵀ)), a being what the joint does there: 1 + ρ|a|² is the
    determinant, and ρ(a·r)² / (1 + ρ|a|²) the square that the joint takes (Sherman and Morrison); σ² is profiled out.
    Before that the channels are made alike and independent on average: noise of which one has more than another is no
    scatter of a joint, which changes with the pose. Only joints whose direction of approach was not recorded are asked,
    and verdicts that say that nothing is left.
    """
    situation, white = analysis.situation, analysis.whitening
    joints = [i for i in range(len(situation.mechanism.joints)) if f"direction{i + 1}" not in situation.covariates]
    columns, y = analysis.plain
    if not joints or y.shape[-1] < 2 or judgement.outside:
        return None
    found = judgement.found
    used = torch.cat([torch.arange(0), *(analysis.dictionary.groups[i] for i in found.members)])
    left = y - columns[..., used] @ torch.cat([y.new_zeros(0), *found.mean])
    alike = torch.linalg.cholesky_ex(left.mT @ left / len(left)).L
    left = torch.linalg.solve_triangular(alike, left.mT, upper=False).mT
    moved = torch.linalg.solve_triangular(alike, white(situation.jacobian)[white.keep()][..., joints], upper=False)
    along, square = torch.einsum("scj,sc->sj", moved, left), moved.square().sum(1)
    usual = square.median(0).values.clamp_min(1e-300)
    rho = _VARIANCES[:, None] / usual
    spread = 1 + rho[:, None] * square
    whole, count = left.square().sum(), left.numel()
    noise = (whole - (rho[:, None] * along.square() / spread).sum(1)) / count
    gain = -0.5 * (count * torch.log(noise * count / whole) + spread.log().sum(1))
    best = int(gain.argmax())
    k, j = divmod(best, len(joints))
    share = float(rho[k, j] * noise[k, j] * square[:, j].sum() / whole)
    if float(gain[k, j]) < _CLEARLY or share < _SHARE:
        return None
    size = math.sqrt(float(rho[k, j] * noise[k, j]))
    return Scatter(joints[j] + 1, size, situation.mechanism.joints[joints[j]].unit)
