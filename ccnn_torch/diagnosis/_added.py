"""Where the fit of a set begins that was fitted with one group less: the scale of the one that was added."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis._alone import fit_in_axes
from ccnn_torch.diagnosis._dictionary import Dictionary, Found
from ccnn_torch.diagnosis._joined import side_by_side

__all__ = ["added_scale"]

_DIGITS = 1e-13
# Sets are looked at side by side where their widths differ by less than this.
_ALIKE = 24


def added_scale(dictionary: Dictionary, before: Sequence[Found], more: Sequence[int]) -> Tensor:
    """log α² of each of the atoms `more` beside the set `before` it, of one member at least, `b`.

    The scales of a set count in units of its noise: y ~ N(0, σ² K + α² Z Zᵀ), where K = I + Σ_g (α_g² / σ²) X_g X_gᵀ is
    as the set has it. Of Zᵀ K⁻¹ Z the diagonal is looked at only, along the principal axes of Z: near enough to begin
    from, and far better than the scale at which the atom explains all by itself.
    """
    turned = dictionary.turned
    singles = {f.members: f for f in before if len(f.members) == 1}
    others = {f.members: f for f in before if len(f.members) > 1}
    parts = [_left_by_one(dictionary, [*singles.values()])] if singles else []
    lots: dict[tuple[int, int], list[Found]] = {}
    for f in others.values():
        width = int(dictionary.widths[list(f.members)].sum())
        lots.setdefault((len(f.members), -(-width // _ALIKE)), []).append(f)
    parts += [_left_of_columns(dictionary, lot) for lot in lots.values()]
    rows = {members: k for k, members in enumerate((*singles, *(f.members for lot in lots.values() for f in lot)))}
    square, along, yy = (torch.cat(each) for each in zip(*parts, strict=True))
    row, atom = torch.tensor([rows[f.members] for f in before]), torch.tensor([*more])[:, None]
    own, _ = side_by_side(dictionary.begins[atom], dictionary.widths[atom])
    place = row[:, None], own
    fits = fit_in_axes(
        square[place].clamp_min(0),
        along[place],
        own[:, 0] >= 0,
        yy.clamp_min(0)[row],
        turned.values,
        dictionary.noise_dof,
    )
    return fits.log_scale


def _left_by_one(dictionary: Dictionary, sets: Sequence[Found]) -> tuple[Tensor, Tensor, Tensor]:
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


def _left_of_columns(dictionary: Dictionary, sets: Sequence[Found]) -> tuple[Tensor, Tensor, Tensor]:
    """What each of the sets of as many members leaves of every column: its squares and its products with y, `b x P`;
    and yᵀ K⁻¹ y, `b`."""
    turned = dictionary.turned
    members = torch.tensor([f.members for f in sets])
    columns, slot = side_by_side(dictionary.begins[members], dictionary.widths[members])
    scales = torch.tensor([f.log_scale for f in sets], dtype=turned.yy.dtype)
    noise = torch.tensor([f.noise for f in sets], dtype=turned.yy.dtype)
    size = ((scales.gather(1, slot.clamp_min(0)) - noise.log()[:, None]) / 2).exp()
    kernel = (size[:, :, None] * turned.xx[columns[:, :, None], columns[:, None, :]]).mul_(size[:, None, :])
    edge = kernel.diagonal(dim1=-2, dim2=-1)
    edge += 1 + _DIGITS * edge.amax(-1, keepdim=True)
    factor = torch.linalg.cholesky_ex(kernel).L
    right = turned.xx[columns].mul_(size[..., None])
    taken = torch.linalg.solve_triangular(factor, right, upper=False)
    with_y = torch.linalg.solve_triangular(factor, (turned.xy[columns] * size)[..., None], upper=False)
    along = turned.xy - (taken.mT @ with_y)[..., 0]
    square = turned.xx.diagonal() - taken.square_().sum(-2)
    return square, along, turned.yy - with_y.square().sum((-2, -1))
