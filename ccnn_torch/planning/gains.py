"""Observability of a set of poses, gain of each further pose, and the recommended number."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.errors import InputError

# Successive poses of small gain before the search for more ends: single gains scatter.
_WINDOW = 3


@dataclass(frozen=True)
class Observability:
    """Indices of an identification matrix with singular values σ1 ≥ … ≥ σk; each `...`, larger is better.

    They are 0 where a direction is unobservable. The ranking of poses by O1, with any divisor, does not depend on the
    parameters' units (Sun and Hollerbach 2008).

    Attributes:
        o1: (σ1 ⋯ σk)^(1/k) / √poses (Borm and Menq 1991).
        o1_by_parameters: (σ1 ⋯ σk)^(1/k) / k, the divisor of paper 004.
        o2: σk / σ1, the reciprocal condition number (Driels and Pathre 1990).
    """

    o1: Tensor
    o1_by_parameters: Tensor
    o2: Tensor


def observability(jacobian: Tensor, poses: int | Tensor | None = None) -> Observability:
    """Indices of identification matrices.

    Args:
        jacobian: derivatives of all measured channels by the parameters, `... x m x k`; rows of 0 count for nothing.
        poses: number of poses that the rows come from, an integer or `...`; m when None (one channel a pose).

    Raises:
        InputError: no parameter.
    """
    m, k = jacobian.shape[-2:]
    if k == 0:
        raise InputError("observability needs an identification matrix with at least one column")
    if m < k:
        jacobian = torch.cat([jacobian, jacobian.new_zeros(*jacobian.shape[:-2], k - m, k)], dim=-2)
    values = torch.linalg.svdvals(jacobian)
    count = torch.as_tensor(m if poses is None else poses, dtype=jacobian.dtype)
    mean = values.log().mean(-1).exp()
    largest = torch.where(values[..., 0] > 0, values[..., 0], 1.0)
    return Observability(mean / count.sqrt(), mean / k, values[..., -1] / largest)


@dataclass(frozen=True)
class Gains:
    """Figures of the first n poses of a plan, for `t` values of n.

    Attributes:
        count: number of poses, `t`, int64.
        observability: of these poses, `t` each; parameters in plausible errors, measurements in noise.
        information: det^(1/2k) of the information, `t`: the mean accuracy of the parameters, growing like √poses where
            a pose only averages the noise.
        sd: standard deviation of each parameter, `t x k` [SI].
        largest: the largest of them in plausible errors, `t` [1].
        information_gain: share by which the last pose made `information` larger, `t` [1]; NaN for the first.
        sd_gain: share by which it made `largest` smaller, `t` [1]; NaN for the first.
    """

    count: Tensor
    observability: Observability
    information: Tensor
    sd: Tensor
    largest: Tensor
    information_gain: Tensor
    sd_gain: Tensor


def gains_of(rows: Tensor, first: int, scale: Tensor, prior_sd: Tensor) -> Gains:
    """The figures of the first n poses for all n from `first` on.

    Args:
        rows: of the poses in order, `N x c x k` [1], in plausible errors.
        first: the least number of poses that make every direction observable.
        scale: plausible errors, `k` [SI].
        prior_sd: standard deviations of the prior, `k` [SI], inf where there is none.
    """
    count = torch.arange(first, len(rows) + 1)
    there = torch.arange(len(rows)) < count[:, None]
    matrices = torch.where(there[:, :, None, None], rows, 0.0).flatten(1, 2)
    return gains_of_sets(matrices, count, scale, prior_sd)


def gains_of_sets(matrices: Tensor, count: Tensor, scale: Tensor, prior_sd: Tensor) -> Gains:
    """The figures of several sets of poses, one after the other.

    Args:
        matrices: identification matrices, `t x m x k` [1], in plausible errors.
        count: poses in each, `t` or one for all.
        scale, prior_sd: as `gains_of`.
    """
    k = matrices.shape[-1]
    seen = observability(matrices, count)
    held = torch.diag(torch.where(torch.isfinite(prior_sd), scale / prior_sd, 0.0)).expand(len(matrices), k, k)
    whole = torch.cat([matrices, held], dim=1)
    # The triangular factor of the rows, and not their square, so that no digits are lost.
    factor = torch.linalg.qr(whole).R
    information = factor.diagonal(dim1=-2, dim2=-1).abs().log().mean(-1).exp()
    unit = torch.eye(k, dtype=matrices.dtype).expand_as(factor)
    inverse = torch.linalg.solve_triangular(factor, unit, upper=True)
    relative = torch.linalg.vector_norm(inverse, dim=-1)
    largest = relative.amax(-1)
    nan = torch.full((1,), math.nan, dtype=matrices.dtype)
    return Gains(
        count.expand(len(matrices)),
        seen,
        information,
        relative * scale,
        largest,
        torch.cat([nan, information[1:] / information[:-1] - 1]),
        torch.cat([nan, 1 - largest[1:] / largest[:-1]]),
    )


def recommended_count(gains: Gains, least_gain: float) -> int | None:
    """The smallest number of poses after which a further one gives less than `least_gain` (a share).

    Gives: makes the information det^(1/2k) larger and the largest standard deviation smaller, each on average over the
    next three poses. None where even the last poses give more.
    """
    for gain in range(len(gains.count) - _WINDOW):
        ahead = slice(gain + 1, gain + 1 + _WINDOW)
        if max(float(gains.information_gain[ahead].mean()), float(gains.sd_gain[ahead].mean())) < least_gain:
            return int(gains.count[gain])
    return None
