"""What each of many candidate measurements says of numbers that are known so far with a covariance.

With the covariance V and rows J_i of candidate i, W_ii = J_i V J_iᵀ (c x c): it adds log det(I + W_ii) to the logarithm
of the determinant of the information, and tells two models apart, whose predictions for it differ by d_i in units of
the noise, by d_iᵀ (I + W_ii)⁻¹ d_i. Taking one is an update of rank c, which all others follow at once.

Factors of a great many small matrices are stored entry by entry: `torch.linalg` takes matrices one by one; here a
factor of up to 6 x 6 for each of 1e5 candidates is a few dozen vector operations.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class Candidates:
    """Candidates, and what each would add. Changes in place.

    Attributes:
        rows: `c x k x M` [1], in units of the noise. The candidates come last so that all work on them is on whole
            vectors.
        inverse: V, `k x k`.
        spread: W_ii of all candidates, `c x c x M`.
        difference: d_i, `c x M`; None where no models are compared.
    """

    rows: Tensor
    inverse: Tensor
    spread: Tensor
    difference: Tensor | None = None

    @classmethod
    def of(cls, rows: Tensor, covariance: Tensor, mean: Tensor | None = None) -> Candidates:
        """Candidates of rows `M x c x k` for numbers with a covariance `k x k`; d_i = J_i mean, mean `k`."""
        across = rows.permute(1, 2, 0).contiguous()
        difference = None if mean is None else (across * mean[:, None]).sum(1)
        return cls(across, covariance, spread_of(across, covariance), difference)

    @property
    def factor(self) -> Tensor:
        """Cholesky factors of I + W_ii, `c x c x M`."""
        return small_cholesky(self.spread + unit(self.spread))

    def information(self) -> Tensor:
        """log det(I + W_ii), `M`; -inf where a candidate has rows that are not finite."""
        return log_determinant(self.factor)

    def divergence(self) -> Tensor:
        """d_iᵀ (I + W_ii)⁻¹ d_i, `M`."""
        assert self.difference is not None
        return forward_substitute(self.factor, self.difference[:, None]).square().sum((0, 1))

    def change(self, candidate: int, sign: int) -> None:
        """Add a candidate's information (sign 1) or take it away (-1): an update of rank c."""
        own = self.rows[:, :, candidate]
        carried = own @ self.inverse
        factor = torch.linalg.cholesky(torch.eye(len(own), dtype=own.dtype) + sign * carried @ own.mT)
        step = torch.linalg.solve_triangular(factor, carried, upper=False)
        self.inverse = self.inverse - sign * step.mT @ step
        moved = step @ self.rows
        if self.difference is not None:
            known = torch.linalg.solve_triangular(factor, self.difference[:, candidate, None], upper=False)
            self.difference = self.difference - sign * (moved * known).sum(1)
        for a in range(len(moved)):
            self.spread[a].sub_((moved[a] * moved).sum(1), alpha=sign)


def spread_of(rows: Tensor, covariance: Tensor) -> Tensor:
    """W_ii of rows `c x k x M`, `c x c x M`."""
    return torch.stack([((covariance @ row) * rows).sum(1) for row in rows])


def unit(spread: Tensor) -> Tensor:
    """I of the size of each W_ii, `c x c x 1`."""
    return torch.eye(len(spread), dtype=spread.dtype)[:, :, None]


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
