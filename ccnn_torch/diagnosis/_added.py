"""Where the fit of a set begins that was fitted with one group less: the scale of the one that was added."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis._alone import fit_in_axes
from ccnn_torch.diagnosis._dictionary import Dictionary, Found
from ccnn_torch.diagnosis._evidence import padded

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
    sets = {f.members: f for f in before}
    lots: dict[int, list[Found]] = {}
    for f in sets.values():
        lots.setdefault(-(-sum(dictionary.widths[i] for i in f.members) // _ALIKE), []).append(f)
    rows = {f.members: k for k, f in enumerate(f for lot in lots.values() for f in lot)}
    parts = [_left_of_columns(dictionary, lot) for lot in lots.values()]
    square, along, yy = (torch.cat(each) for each in zip(*parts, strict=True))
    row = torch.tensor([rows[f.members] for f in before])
    own, _ = padded([[dictionary.groups[i]] for i in more])
    real, place = own >= 0, (row[:, None], own.clamp_min(0))
    square, along = (torch.where(real, v[place], 0.0) for v in (square.clamp_min(0), along))
    fits = fit_in_axes(square, along, real.any(-1), yy.clamp_min(0)[row], turned.values, dictionary.noise_dof)
    return fits.log_scale


def _left_of_columns(dictionary: Dictionary, sets: Sequence[Found]) -> tuple[Tensor, Tensor, Tensor]:
    """What each of the sets leaves of every column: its squares and its products with y, `b x P`; and yᵀ K⁻¹ y, `b`."""
    turned = dictionary.turned
    columns, slot = padded([[dictionary.groups[i] for i in f.members] for f in sets])
    longest = max(len(f.members) for f in sets)
    known = [[*f.log_scale, *[0.0] * (longest - len(f.members))] for f in sets]
    scales = torch.tensor(known, dtype=turned.yy.dtype)
    noise = torch.tensor([f.noise for f in sets], dtype=turned.yy.dtype)
    there, safe = columns >= 0, columns.clamp_min(0)
    size = torch.where(there, ((scales.gather(1, slot.clamp_min(0)) - noise.log()[:, None]) / 2).exp(), 0.0)
    # Products with columns that are not there are NaN, and no factor 0 makes a number of that.
    among = torch.where(there[:, :, None] & there[:, None, :], turned.xx[safe[:, :, None], safe[:, None, :]], 0.0)
    kernel = (size[:, :, None] * among).mul_(size[:, None, :])
    edge = kernel.diagonal(dim1=-2, dim2=-1)
    edge += 1 + _DIGITS * edge.amax(-1, keepdim=True)
    factor = torch.linalg.cholesky_ex(kernel).L
    right = torch.where(there[..., None], turned.xx[safe], 0.0).mul_(size[..., None])
    taken = torch.linalg.solve_triangular(factor, right, upper=False)
    with_y = torch.linalg.solve_triangular(factor, (turned.xy[safe] * size)[..., None], upper=False)
    along = turned.xy - (taken.mT @ with_y)[..., 0]
    square = turned.xx.diagonal() - taken.square_().sum(-2)
    return square, along, turned.yy - with_y.square().sum((-2, -1))
