"""Whether rows share their noise: the correlation under which the best explanations found so far are most probable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.correlation import INDEPENDENT, Correlation, targets_of
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.marginal_likelihood import fit_sets, grams_of

# Correlations from row to row, and shares of the variance that readings of a target have in common.
_FROM_ROW, _IN_TARGET = (0.3, 0.6, 0.8, 0.9, 0.95, 0.98), (0.2, 0.5, 0.8, 0.9, 0.95, 0.99)
# The same of a device that drifts and scatters, with the share of the variance that is of each row alone; and the rows
# up to which that is tried, as its cost grows with their square.
_DRIFTS, _SCATTERS, _MOST_ROWS = (0.9, 0.97, 0.99), (0.3, 0.6, 0.85), 1000
_LOG_PRIOR = math.log(0.1)
# Directions of what was fitted before with less than this share of the largest one are rounding.
_DIGITS = 1e-9


class Explanation(NamedTuple):
    """A set of candidates: whitened columns of each, `s x c x m`, and the log prior of all."""

    columns: list[Tensor]
    log_prior: float


def possible_correlations(situation: Situation, keep: Tensor) -> list[Correlation]:
    """What may be: independent rows first.

    Args:
        situation: all rows.
        keep: those that count, in the order measured.
    """
    target = targets_of(situation.joints[keep])
    found = [INDEPENDENT, *(Correlation(value) for value in _FROM_ROW)]
    if len(keep) <= _MOST_ROWS:
        found += [Correlation(value, alone=alone) for value in _DRIFTS for alone in _SCATTERS]
    if target is not None:
        found += [Correlation(value, target) for value in _IN_TARGET]
    return found


def likeliest_correlation(
    y: Tensor, fitted: Tensor, sets: Sequence[Explanation], possible: Sequence[Correlation], noise_dof: float
) -> Correlation:
    """The correlation with the most probable of the sets.

    Args:
        y: whitened residual, `s x c`; rows that count.
        fitted: whitened columns of what was fitted before, `s x c x r`.
        sets: explanations to compare.
        possible: correlations, independent rows first.
        noise_dof: as for `fit_sets`.
    """
    scores = []
    for correlation in possible:
        score = correlation.log_determinant(*y.shape) + (_LOG_PRIOR if correlation.value else 0.0)
        frames = correlation(fitted)
        if fitted.shape[-1]:
            # What any size of the frames is as probable for.
            values = torch.linalg.svdvals(frames.flatten(0, 1))
            score -= float(values[values > _DIGITS * values[0]].log().sum())
        best = -math.inf
        for one in sets:
            target, *columns = without_fitted(frames, [correlation(c) for c in (y[..., None], *one.columns)])
            x = torch.cat([target[..., :0], *columns], -1)
            widths = [c.shape[-1] for c in columns]
            groups = torch.split(torch.arange(sum(widths)), widths) if widths else []
            fit = fit_sets(grams_of(x, target[..., 0]), [list(groups)], noise_dof)
            best = max(best, float(fit.log_evidence[0]) + one.log_prior)
        scores.append(score + best)
    return possible[max(range(len(scores)), key=scores.__getitem__)]


def without_fitted(fitted: Tensor, columns: list[Tensor]) -> list[Tensor]:
    """What was fitted before, `s x c x r`, takes its part out of everything, `s x c x m` each."""
    if not fitted.shape[-1]:
        return columns
    u, s, _ = torch.linalg.svd(fitted.flatten(0, 1), full_matrices=False)
    q = u[:, s > _DIGITS * s[0]]
    return [(c.flatten(0, 1) - q @ (q.mT @ c.flatten(0, 1))).reshape(c.shape) for c in columns]
