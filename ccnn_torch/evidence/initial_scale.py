"""Initial scale of the group that is added to a fitted set."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from ccnn_torch.evidence.batched_sets import column_indices
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet
from ccnn_torch.evidence.single_groups import fit_in_axes

_DIGITS = 1e-13
# Sets are evaluated in one batch where their widths differ by less than this.
_ALIKE = 24
# Beside a set that so many atoms are added to, all columns are evaluated once.
_FEW = 5


def added_scale(dictionary: Dictionary, before: Sequence[FittedSet], more: Sequence[int]) -> Tensor:
    """log α² of each of the atoms `more` beside the set `before` it, of one member at least, `b`.

    The scales of a set count in units of its noise: y ~ N(0, σ² K + α² Z Zᵀ), where K = I + Σ_g (α_g² / σ²) X_g X_gᵀ is
    as the set has it. Of Zᵀ K⁻¹ Z the diagonal is evaluated only, along the principal axes of Z: near enough to begin
    from, and far better than the scale at which the atom explains all alone.
    """
    turned, atoms = dictionary.turned, torch.tensor([*more])[:, None]
    own, _ = column_indices(dictionary.begins[atoms], dictionary.widths[atoms])
    square, along, yy = turned.yy.new_zeros(own.shape), turned.yy.new_zeros(own.shape), turned.yy.new_zeros(len(own))
    for rows, sets, each in _lots(dictionary, before):
        if len(sets[0].members) == 1:
            squares, products, left = _left_by_one(dictionary, sets)
        else:
            squares, products, left = _left_of_columns(dictionary, sets, own[rows] if each is None else None)
        if each is None:
            square[rows], along[rows], yy[rows] = squares, products, left
        else:
            place = torch.tensor(each)[:, None], own[rows]
            square[rows], along[rows], yy[rows] = squares[place], products[place], left[place[0][:, 0]]
    fits = fit_in_axes(square.clamp_min(0), along, own[:, 0] >= 0, yy.clamp_min(0), turned.values, dictionary.noise_dof)
    return fits.log_scale


def _lots(
    dictionary: Dictionary, before: Sequence[FittedSet]
) -> Iterator[tuple[list[int], list[FittedSet], list[int] | None]]:
    """Rows that are evaluated in one batch; sets of as many members; and which of these sets each row is beside, what
    they leave of all columns being asked for. Or None: then each row has a set, and asks for its own columns."""
    beside: dict[tuple[int, ...], list[int]] = {}
    for row, f in enumerate(before):
        beside.setdefault(f.members, []).append(row)
    lots: dict[tuple[int, int, bool], list[tuple[int, ...]]] = {}
    for members, rows in beside.items():
        width = int(dictionary.widths[list(members)].sum()) if len(members) > 1 else 0
        lots.setdefault((len(members), -(-width // _ALIKE), len(members) == 1 or len(rows) > _FEW), []).append(members)
    for (_, _, whole), sets in lots.items():
        rows = [row for members in sets for row in beside[members]]
        if whole:
            each = [k for k, members in enumerate(sets) for _ in beside[members]]
            yield rows, [before[beside[members][0]] for members in sets], each
        else:
            yield rows, [before[row] for row in rows], None


def _left_by_one(dictionary: Dictionary, sets: Sequence[FittedSet]) -> tuple[Tensor, Tensor, Tensor]:
    """As `_left_of_columns` of sets of one member, whose kernel is a diagonal in its principal axes."""
    turned = dictionary.turned
    left = []
    for f in sets:
        begin, width = (int(v[f.members[0]]) for v in (dictionary.begins, dictionary.widths))
        place = slice(begin, begin + width)
        size = math.exp(f.log_scale[0]) / f.noise
        weight = size / (1 + size * turned.xx.diagonal()[place])
        products, with_y = turned.xx[place], weight * turned.xy[place]
        left.append((weight @ products.square(), with_y @ products, with_y @ turned.xy[place]))
    square, along, yy = (torch.stack(each) for each in zip(*left, strict=True))
    return turned.xx.diagonal() - square, turned.xy - along, turned.yy - yy


def _left_of_columns(
    dictionary: Dictionary, sets: Sequence[FittedSet], wanted: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """What each of the sets of as many members leaves of the columns `wanted` of each, `b x w`, or of all: their
    squares and their products with y, `b x w`; and yᵀ K⁻¹ y, `b`."""
    turned = dictionary.turned
    members = torch.tensor([f.members for f in sets])
    columns, slot = column_indices(dictionary.begins[members], dictionary.widths[members])
    scales = torch.tensor([f.log_scale for f in sets], dtype=turned.yy.dtype)
    noise = torch.tensor([f.noise for f in sets], dtype=turned.yy.dtype)
    size = ((scales.gather(1, slot.clamp_min(0)) - noise.log()[:, None]) / 2).exp()
    kernel = (size[:, :, None] * turned.xx[columns[:, :, None], columns[:, None, :]]).mul_(size[:, None, :])
    edge = kernel.diagonal(dim1=-2, dim2=-1)
    edge += 1 + _DIGITS * edge.amax(-1, keepdim=True)
    factor = torch.linalg.cholesky_ex(kernel).L
    right = turned.xx[columns] if wanted is None else turned.xx[columns[:, :, None], wanted[:, None, :]]
    taken = torch.linalg.solve_triangular(factor, right.mul_(size[..., None]), upper=False)
    with_y = torch.linalg.solve_triangular(factor, (turned.xy[columns] * size)[..., None], upper=False)
    every = slice(None) if wanted is None else wanted
    along = turned.xy[every] - (taken.mT @ with_y)[..., 0]
    square = turned.xx.diagonal()[every] - taken.square_().sum(-2)
    return square, along, turned.yy - with_y.square().sum((-2, -1))
