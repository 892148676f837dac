"""Evidence of columns beside a set that is fitted: what they add to it, and not what they explain alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.evidence.dictionary import Dictionary, FittedSet
from ccnn_torch.evidence.single_groups import NO_COLUMNS, GroupProducts, fit_single_groups


def gain_beside(dictionary: Dictionary, found: FittedSet, groups: Sequence[Tensor], y: Tensor) -> list[float]:
    """Log evidence that each group of columns adds to a set.

    At the scales of the set, y ~ N(0, σ² K + α² Z Zᵀ) with K = I + Σ_g (α_g² / σ²) X_g X_gᵀ, so that Zᵀ K⁻¹ Z and
    Zᵀ K⁻¹ y take the place of the inner products.

    Args:
        dictionary: of the set's atoms.
        found: the set.
        groups: whitened columns, `s x c x m` each.
        y: what they explain, whitened, `s x c`.
    """
    x = [
        dictionary.columns[..., dictionary.groups[i]] * math.exp(scale / 2) / math.sqrt(found.noise)
        for i, scale in zip(found.members, found.log_scale, strict=True)
    ]
    own = torch.cat([dictionary.columns[..., :0], *x], -1).flatten(0, -2)
    factor = torch.linalg.cholesky(own.mT @ own + torch.eye(own.shape[-1], dtype=own.dtype))

    def taken(columns: Tensor) -> Tensor:
        solved: Tensor = torch.linalg.solve_triangular(factor, own.mT @ columns, upper=False)
        return solved

    flat = y.reshape(-1, 1)
    with_y = taken(flat)
    left = []
    for group in groups:
        columns = group.flatten(0, -2)
        with_own = taken(columns)
        inner, along = columns.mT @ columns - with_own.mT @ with_own, columns.mT @ flat - with_own.mT @ with_y
        left.append(GroupProducts(inner, along[:, 0]))
    yy = flat.square().sum() - with_y.square().sum()
    fits = fit_single_groups([NO_COLUMNS, *left], yy, float(y.numel()), dictionary.noise_dof)
    return [float(v) for v in fits.log_evidence[1:] - fits.log_evidence[0]]
