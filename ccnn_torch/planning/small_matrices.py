"""Cholesky factors of a great many small matrices, stored entry by entry.

`torch.linalg` takes matrices one by one; here a factor of up to 6 x 6 for each of 1e5 candidates is a few dozen vector
operations.
"""

from __future__ import annotations

import torch
from torch import Tensor


def small_cholesky(matrix: Tensor) -> Tensor:
    """Lower factors of symmetric matrices `c x c x ...`; NaN where one is not positive definite."""
    c = matrix.shape[0]
    factor = torch.zeros_like(matrix)
    for column in range(c):
        left = factor[column, :column]
        pivot = (matrix[column, column] - left.square().sum(0)).sqrt()
        factor[column, column] = pivot
        for row in range(column + 1, c):
            factor[row, column] = (matrix[row, column] - (factor[row, :column] * left).sum(0)) / pivot
    return factor


def log_determinant(factor: Tensor) -> Tensor:
    """Logarithm of the determinant from lower factors `c x c x ...`; -inf where there is none."""
    total = sum(factor[i, i].log() for i in range(factor.shape[0]))
    return torch.nan_to_num(2 * torch.as_tensor(total), nan=-torch.inf, posinf=-torch.inf)


def forward_substitute(factor: Tensor, right: Tensor) -> Tensor:
    """L⁻¹ right; factor `c x c x ...`, right `c x d x ...`."""
    solved = torch.zeros_like(right)
    for row in range(factor.shape[0]):
        known = (factor[row, :row, None] * solved[:row]).sum(0)
        solved[row] = (right[row] - known) / factor[row, row]
    return solved
