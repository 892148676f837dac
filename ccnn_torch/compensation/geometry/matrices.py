"""Small matrices in operators that every export has: no solver, no pivoting."""

from __future__ import annotations

import torch
from torch import Tensor


def skew_vector(turn: Tensor) -> Tensor:
    """Vector of the skew part of `... x 3 x 3`, `... x 3`: sin(angle) times the axis of a rotation; of a rate of
    rotation the rate."""
    half = (turn - turn.mT) / 2
    return torch.stack([half[..., 2, 1], half[..., 0, 2], half[..., 1, 0]], dim=-1)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of `... x 3`, without an operation that a file lacks."""
    next_, last = [1, 2, 0], [2, 0, 1]
    return a[..., next_] * b[..., last] - a[..., last] * b[..., next_]


def gauss_jordan(matrix: Tensor, right: Tensor) -> Tensor:
    """Solution of a positive definite `... x n x n`, right `... x n x c`: without pivoting, unrolled."""
    table = torch.cat([matrix, right], dim=-1)
    count = matrix.shape[-1]
    unit = torch.eye(count, dtype=matrix.dtype)
    for k in range(count):
        row = table[..., k : k + 1, :] / table[..., k : k + 1, k : k + 1]
        table = table - (table[..., :, k : k + 1] - unit[:, k : k + 1]) * row
    return table[..., count:]


def inverse(matrix: Tensor) -> Tensor:
    """Inverse of a positive definite `... x n x n`."""
    return gauss_jordan(matrix, torch.eye(matrix.shape[-1], dtype=matrix.dtype).expand_as(matrix))
