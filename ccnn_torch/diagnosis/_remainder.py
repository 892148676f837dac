"""What candidates explain of a residual that others have had their part of; the price of choosing among many."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["Remainder", "search_charge"]

_DIGITS = 1e-13


def search_charge(gain: Tensor) -> float:
    """Log odds that a search over a grid costs, `g` squares explained at each value: nothing where all do as well."""
    return math.log(len(gain)) - float(torch.logsumexp((gain - gain.max()) / 2, 0))


class Remainder:
    """What nuisance columns with their prior leave of `y`, and of whatever is put beside them."""

    def __init__(self, y: Tensor, nuisance: Tensor) -> None:
        """y: `N`; nuisance: `N x P`, whitened, in units of their prior scale."""
        gram = nuisance.mT @ nuisance
        diagonal = gram.diagonal()
        # Columns that are the same, far above the noise, would leave no digit of the 1.
        diagonal += 1 + _DIGITS * diagonal.amax(0, keepdim=True) if len(gram) else 0
        factor = torch.linalg.cholesky(gram)
        # Rows whose Gram matrix is what the nuisance takes out: (I + NᵀN)^-1/2 Nᵀ.
        self.taken = torch.linalg.solve_triangular(factor, nuisance.mT, upper=False)
        self.y = y - self.taken.mT @ (self.taken @ y)

    def gain(self, z: Tensor) -> Tensor:
        """Squares that each candidate explains, `g`; z: `g x N x m`."""
        inner = z.mT @ z
        if len(self.taken):
            count, rows, width = z.shape
            flat = z.transpose(0, 1).reshape(rows, count * width)
            cross = (self.taken @ flat).reshape(-1, count, width).transpose(0, 1)
            inner = inner - cross.mT @ cross
        b = (z.mT @ self.y[:, None])[..., 0]
        ridge = 1e-6 * inner.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-300)
        inner = inner + torch.diag_embed(ridge[:, None].expand(-1, inner.shape[-1]))
        solved = torch.linalg.solve(inner, b[..., None])[..., 0]
        gain: Tensor = (b * solved).sum(-1)
        return gain
