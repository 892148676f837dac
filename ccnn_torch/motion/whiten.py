"""The autoregressive model of a residual: its order is the one with the most evidence."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

_HIGHEST = 8
# A residual that is a constant or a ramp would give a root outside the unit circle: so much is added to the diagonal.
_RIDGE = 1e-9
# Poles are drawn in by this factor (bandwidth expansion of linear prediction): what a model leaves is no stationary
# noise, and a pole at the unit circle would leave the slow half of every effect without weight.
_WIDER = 0.9


class Whitening(NamedTuple):
    """An autoregressive model of each axis' residual: e_t = r_t - sum_k a_k r_(t-k), `n x order`."""

    coefficients: Tensor

    def __call__(self, residual: Tensor, axis: Tensor) -> Tensor:
        """Of residuals `p x b x s` of the axes `p`; the first samples, which lack some before them, are as they are."""
        white = residual.clone()
        factors = self.coefficients[axis, :, None, None]
        for k in range(1, self.coefficients.shape[1] + 1):
            white[..., k:].addcmul_(factors[:, k - 1], residual[..., :-k], value=-1)
        return white


def white_noise(axes: int) -> Whitening:
    """No correlation."""
    return Whitening(torch.zeros(axes, 0, dtype=torch.float64))


def fitted_whitening(residual: Tensor, judged: Tensor) -> Whitening:
    """Fit orders 0 to 8 and take, for each axis, the one with the most evidence (Schwarz 1978).

    Args:
        residual: `n x b x s`.
        judged: samples that count, `b x s`; those before them may be looked back at.
    """
    n, high = len(residual), _HIGHEST
    now = judged.clone()
    now[:, :high] = False
    # Every stretch's lead is longer than the highest order, so that hardly a judged sample is lost.
    past = torch.stack([torch.roll(residual, k, -1)[:, now] for k in range(1, high + 1)], -1)
    target = residual[:, now]
    found = torch.zeros(n, high, dtype=residual.dtype)
    count = target.shape[1]
    for i in range(n):
        # Nothing is left of a joint that never moves.
        if not bool(target[i].any()):
            continue
        gram, along = past[i].mT @ past[i], past[i].mT @ target[i]
        costs, tried = [], found.new_zeros(high + 1, high)
        for order, a in enumerate(tried):
            inner = gram[:order, :order]
            inner = inner + _RIDGE * inner.diagonal().sum() / max(order, 1) * torch.eye(order, dtype=inner.dtype)
            a[:order] = torch.linalg.solve(inner, along[:order])
            left = float((target[i] - past[i] @ a).square().mean())
            costs.append(count * math.log(max(left, 1e-300)) + order * math.log(max(count, 2)))
        found[i] = tried[costs.index(min(costs))]
    found = found * _WIDER ** torch.arange(1, high + 1, dtype=found.dtype)
    used = int((found != 0).any(0).sum())
    return Whitening(found[:, :used])
