"""Shapes (periods, lags, rates): looked for over their grids with what else may be there projected out."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis._atoms import default_shape, scaled_signature
from ccnn_torch.effects import Effect, Shape, Situation

__all__ = ["Shaped", "best_shape"]


class Shaped(NamedTuple):
    """Shapes found: `value` `h`; `used`, the coefficients whose shape is worth its charge (None = all); and `charge`,
    what looking for them costs in log odds, the logarithm of how many values were looked at."""

    value: Tensor
    used: tuple[int, ...] | None
    charge: float


def best_shape(
    situation: Situation,
    effect: Effect,
    whiten: Callable[[Tensor], Tensor],
    y: Tensor,
    others: Tensor,
    start: Tensor | None = None,
) -> Shaped:
    """The shapes of an effect that explain most of `y`, `h`; found one after the other, then refined.

    Args:
        situation: the rows.
        effect: with at least one shape.
        whiten: of signatures, `s x c0 x m` -> `s x c x m`.
        y: whitened residual, `s x c`.
        others: whitened columns of what else is there, scaled by their prior, `s x c x P`; may have no columns.
        start: shapes to start from; the middle of each grid when None.
    """
    shapes = effect.shapes(situation)
    value = default_shape(situation, effect) if start is None else start.clone()
    fixed, target = others.flatten(0, 1), y.flatten()
    groups = [_columns_of(shapes, which) for which in _joined(shapes)]
    gains: list[tuple[float, float, list[int] | None]] = []
    # Twice, the second time with what the first found for the other joints beside it.
    for sweep in range(2 if len(groups) > 1 else 1):
        gains = []
        for which, columns in groups:
            nuisance = fixed
            if sweep:
                own = whiten(scaled_signature(situation, effect, value)).flatten(0, 1)
                nuisance = torch.cat([fixed, own[:, [c for c in range(own.shape[1]) if c not in (columns or ())]]], -1)
            left = _Left(target, nuisance)

            def score(candidates: Tensor, columns: list[int] | None = columns, left: _Left = left) -> Tensor:
                basis = scaled_signature(situation, effect, candidates)
                if columns is not None:
                    basis = basis[..., columns]
                return left.gain(torch.stack([whiten(b) for b in basis]).flatten(1, 2))

            for h in which:
                grid = torch.tensor(shapes[h].grid, dtype=y.dtype)
                value = _looked_at(value, h, grid, score)
            charge = sum(math.log(max(len(shapes[h].grid), 1)) for h in which)
            gains.append((float(score(value[None])[0]) / 2 - charge, charge, columns))
    return _worth(value, gains)


def _worth(value: Tensor, gains: list[tuple[float, float, list[int] | None]]) -> Shaped:
    """Only the parts that pay for their search and half a unit of log evidence a coefficient; at least the best one."""
    best = max(range(len(gains)), key=lambda i: gains[i][0])
    kept = [
        g for i, g in enumerate(gains) if i == best or g[2] is None or g[0] > 1.5 * len(g[2])
    ]
    charge = sum(g[1] for g in kept)
    if any(g[2] is None for g in kept) or len(kept) == len(gains):
        return Shaped(value, None, charge)
    return Shaped(value, tuple(sorted({c for g in kept for c in g[2] or ()})), charge)


def _looked_at(value: Tensor, h: int, grid: Tensor, score: Callable[[Tensor], Tensor]) -> Tensor:
    """`value` with shape h at its best: over the grid, then twice between the neighbours of the best."""
    for _ in range(3):
        candidates = value.expand(len(grid), -1).clone()
        candidates[:, h] = grid
        k = int(score(candidates).argmax())
        value = candidates[k]
        if len(grid) < 2:
            break
        low, high = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
        grid = torch.linspace(0, 1, 9, dtype=grid.dtype) * (high - low) + low
    return value


class _Left:
    """What nuisance columns with their prior leave of `y`, and of whatever is put beside them."""

    def __init__(self, y: Tensor, nuisance: Tensor) -> None:
        """y: `N`; nuisance: `N x P`, whitened, in units of their prior scale."""
        self.nuisance = nuisance
        eye = torch.eye(nuisance.shape[1], dtype=y.dtype, device=y.device)
        self.factor = torch.linalg.cholesky(eye + nuisance.mT @ nuisance)
        self.y = y - (nuisance @ torch.cholesky_solve(nuisance.mT @ y[:, None], self.factor))[:, 0]

    def gain(self, z: Tensor) -> Tensor:
        """Squares that each candidate explains, `g`; z: `g x N x m`."""
        inner = z.mT @ z
        if self.nuisance.shape[1]:
            cross = self.nuisance.mT @ z
            inner = inner - cross.mT @ torch.cholesky_solve(cross, self.factor)
        b = (z.mT @ self.y[:, None])[..., 0]
        ridge = 1e-6 * inner.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-300)
        inner = inner + torch.diag_embed(ridge[:, None].expand(-1, inner.shape[-1]))
        solved = torch.linalg.solve(inner, b[..., None])[..., 0]
        return (b * solved).sum(-1)


def _columns_of(shapes: tuple[Shape, ...], which: list[int]) -> tuple[list[int], list[int] | None]:
    """Shapes that are looked for together, and the coefficients that depend on them (None = all)."""
    if any(shapes[h].columns is None for h in which):
        return which, None
    return which, sorted({c for h in which for c in shapes[h].columns or ()})


def _joined(shapes: tuple[Shape, ...]) -> list[list[int]]:
    """Shapes in groups that share a coefficient."""
    groups: list[tuple[set[int] | None, list[int]]] = []
    for h, shape in enumerate(shapes):
        mine = None if shape.columns is None else set(shape.columns)
        for i, (theirs, members) in enumerate(groups):
            if mine is None or theirs is None or mine & theirs:
                groups[i] = (None if mine is None or theirs is None else mine | theirs, [*members, h])
                break
        else:
            groups.append((mine, [h]))
    return [members for _, members in groups]
