"""Robust losses by reweighting: rows far off, measured against the spread of the others, count less."""

from __future__ import annotations

import dataclasses

import torch
from scipy.special import chdtr
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.linear import WeightedRows
from ccnn_torch.identification.problems.problem import Problem
from ccnn_torch.numerics.outliers import chi_quantile, residual_scale

LOSSES = ("squared", "huber", "cauchy")

# Where the loss bends, in standard deviations of one residual: 95 % efficient with normal noise (Holland and Welsch
# 1977). A row of several channels bends where its length is as rare.
_BEND = {"huber": 1.345, "cauchy": 2.385}


def loss_weights(residual: Tensor, weights: Tensor, loss: str, parameters: int) -> Tensor:
    """Weight of every row under a robust loss, from the length of its residual over the scale of all of them.

    The scale is that of `residual_scale`.

    Args:
        residual: `… x s x c`, decorrelated, its channels of one variance.
        weights: `… x s` [1]; rows with weight 0 do not enter the scale.

    Returns:
        `… x s` in (0, 1].
    """
    if loss == "squared":
        return torch.ones_like(weights).expand(residual.shape[:-1])
    channels = residual.shape[-1]
    used = (weights > 0).expand(residual.shape[:-1])
    length = torch.linalg.vector_norm(residual * weights.sqrt()[..., None], dim=-1)
    scale = residual_scale(length, used, channels, parameters)
    bend = chi_quantile(chdtr(1, _BEND[loss] ** 2), channels)
    ratio = length / (scale * bend).clamp_min(torch.finfo(length.dtype).tiny)
    factor: Tensor = 1 / ratio.clamp_min(1) if loss == "huber" else 1 / (1 + ratio.square())
    return factor


def reweighted(problem: Problem, values: Tensor, loss: str) -> Problem:
    """The problem with the weights that a robust fit ended with, for what is to be known about that fit.

    Args:
        problem: as it was solved.
        values: `r x k` [SI], the fit's.
        loss: the fit's.

    Raises:
        InputError: unknown loss.
    """
    if loss not in LOSSES:
        raise InputError(f"loss is one of {', '.join(LOSSES)}; got '{loss}'")
    rows = WeightedRows(dataclasses.replace(problem, weights=problem.weights.clamp_min(1e-300)))
    everyone = torch.arange(len(values), device=values.device)
    residual = rows.residuals(values[:, None], everyone)[:, 0]
    residual = torch.where((problem.weights > 0)[..., None], residual, 0.0)
    factor = loss_weights(residual, problem.weights, loss, values.shape[-1])
    return dataclasses.replace(problem, weights=problem.weights * factor)
