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
    nuisance = others.flatten(0, 1)
    factor = torch.linalg.cholesky(torch.eye(nuisance.shape[1], dtype=y.dtype) + nuisance.mT @ nuisance)

    def score(candidates: Tensor, columns: list[int] | None) -> Tensor:
        basis = scaled_signature(situation, effect, candidates)
        if columns is not None:
            basis = basis[..., columns]
        z = torch.stack([whiten(b) for b in basis]).flatten(1, 2)
        return _gain(z, y.flatten(), nuisance, factor)

    joined = _joined(shapes)
    gains: list[tuple[float, float, list[int] | None]] = []
    for which in joined:
        columns = None if shapes[which[0]].columns is None else sorted({c for h in which for c in shapes[h].columns or ()})
        for h in which:
            grid = torch.tensor(shapes[h].grid, dtype=y.dtype)
            value = _looked_at(value, h, grid, lambda v, columns=columns: score(v, columns))
        charge = sum(math.log(max(len(shapes[h].grid), 1)) for h in which)
        gains.append((float(score(value[None], columns)[0]) / 2 - charge, charge, columns))
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


def _gain(z: Tensor, y: Tensor, nuisance: Tensor, factor: Tensor) -> Tensor:
    """Squares that each candidate explains beyond the nuisance, `g`; z: `g x N x m`, y: `N`, nuisance: `N x P`."""
    if nuisance.shape[1]:
        project = torch.cholesky_solve(nuisance.mT @ y[:, None], factor)
        y = y - (nuisance @ project)[:, 0]
        cross = nuisance.mT @ z
        inner = z.mT @ z - cross.mT @ torch.cholesky_solve(cross, factor)
    else:
        inner = z.mT @ z
    b = (z.mT @ y[:, None])[..., 0]
    ridge = 1e-6 * inner.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(1e-300)
    inner = inner + torch.diag_embed(ridge[:, None].expand(-1, inner.shape[-1]))
    solved = torch.linalg.solve(inner, b[..., None])[..., 0]
    return (b * solved).sum(-1)


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
