"""Observability indices O1 to O5 of a set of poses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.errors import InputError

INDICES = ("O1", "O2", "O3", "O4", "O5")


@dataclass(frozen=True)
class Observability:
    """Indices of an identification matrix with singular values σ1 ≥ … ≥ σk; each `...`, larger is better.

    They are 0 where a direction is unobservable. The ranking of poses by O1, with any divisor, does not depend on the
    parameters' units; that by the others does. Sun and Hollerbach (2008) compare all five.

    Attributes:
        o1: (σ1 ⋯ σk)^(1/k) / √poses (Borm and Menq 1991).
        o1_by_parameters: (σ1 ⋯ σk)^(1/k) / k, the divisor of paper 004.
        o2: σk / σ1, the reciprocal condition number (Driels and Pathre 1990).
        o3: σk (Nahvi, Hollerbach and Hayward 1994).
        o4: σk² / σ1, the noise amplification index (Nahvi and Hollerbach 1996).
        o5: 1 / (1/σ1 + … + 1/σk) (Sun and Hollerbach 2008).
    """

    o1: Tensor
    o1_by_parameters: Tensor
    o2: Tensor
    o3: Tensor
    o4: Tensor
    o5: Tensor


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
    mean = _geometric_mean(values)
    others = [index_of(name, values) for name in INDICES[1:]]
    return Observability(mean / count.sqrt(), mean / k, *others)


def index_of(name: str, values: Tensor) -> Tensor:
    """One index, by its name, of singular values `... x k`, largest first; O1 without its divisor."""
    if name == "O1":
        return _geometric_mean(values)
    first, last = values[..., 0], values[..., -1]
    some = torch.where(first > 0, first, 1.0)
    if name == "O2":
        return last / some
    if name == "O3":
        return last
    if name == "O4":
        return last.square() / some
    seen = last > 0
    return torch.where(seen, 1 / torch.where(seen[..., None], values, 1.0).reciprocal().sum(-1), 0.0)


def _geometric_mean(values: Tensor) -> Tensor:
    return values.log().mean(-1).exp()
