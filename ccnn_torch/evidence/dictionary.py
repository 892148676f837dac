"""Candidates with the inner products of their columns: all that fits of sets of them ask for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate, chain
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ccnn_torch.evidence.marginal_likelihood import (
    NARROW,
    NO_COLUMNS,
    Fits,
    Grams,
    GroupProducts,
    Prior,
    column_indices,
    fit_in_axes,
    fit_single_groups,
    groups_of,
    own_products,
    real_squares,
    scaled,
)
from ccnn_torch.evidence.priors import crowd

CERTAIN = 100.0
"""Weight of a noise that is certain, in multiples of the values."""


class Candidate(Protocol):
    """A candidate cause.

    Attributes:
        name: no set holds two of one name.
        log_prior: log prior odds.
        is_discrepancy: whether it stands for something outside the library; no set holds two of these.
        plain: whether a discrepancy term has straight lines, planes or gentle curves only.
        form_error: share φ of its squares by which its form may be wrong in every direction.
    """

    @property
    def name(self) -> str: ...
    @property
    def log_prior(self) -> float: ...
    @property
    def is_discrepancy(self) -> bool: ...
    @property
    def plain(self) -> bool: ...
    @property
    def form_error(self) -> float: ...


@dataclass(frozen=True)
class FittedSet:
    """A set of atoms with its log posterior (up to a constant), log evidence, and fit.

    `along` are the coefficients along the principal `axes` of each atom, `log_scale` is log α² of each, `energy` the
    squares that each atom's own part makes, and `rss` what the set leaves.
    """

    members: tuple[int, ...]
    log_posterior: float
    log_evidence: float
    along: tuple[Tensor, ...]
    axes: tuple[Tensor, ...]
    log_scale: tuple[float, ...]
    energy: tuple[float, ...]
    rss: float
    noise: float
    effective: float

    @cached_property
    def mean(self) -> tuple[Tensor, ...]:
        """The coefficients, atom by atom, in units of their plausible sizes."""
        return tuple(axes @ along for axes, along in zip(self.axes, self.along, strict=True))


@dataclass(frozen=True)
class Dictionary:
    """Candidates, and the inner products of those that sets are made of.

    Attributes:
        atoms: all candidates.
        y: what they explain, whitened, `s x c`; rows that count.
        columns: whitened, of the library effects, name by name, and then of the discrepancy terms that are put beside
            them, side by side, `s x c x P`.
        groups: which of the columns are those of an atom, for the atoms that have such.
        grams: of the columns; NaN is possible between discrepancy terms and between atoms of one name, which are in no
            set together.
        axes: principal axes of the columns of each of these atoms, `m x m`.
        turned: `grams` with every group in its axes, and with a last column of zeros.
        alone: no atom, and each alone.
        noise_dof: as for `fit_sets`.
    """

    atoms: tuple[Candidate, ...]
    y: Tensor
    columns: Tensor
    groups: Mapping[int, Tensor]
    grams: Grams
    axes: Mapping[int, Tensor]
    turned: Grams
    alone: Mapping[tuple[int, ...], FittedSet]
    noise_dof: float

    @cached_property
    def widths(self) -> Tensor:
        """How many columns each of the atoms has, `a`; 0 for those that no sets are made of."""
        return torch.tensor([len(self.groups[i]) if i in self.groups else 0 for i in range(len(self.atoms))])

    @cached_property
    def begins(self) -> Tensor:
        """The first of them, `a`: they are contiguous."""
        return torch.tensor([int(self.groups[i][0]) if i in self.groups else 0 for i in range(len(self.atoms))])

    @cached_property
    def log_prior(self) -> Tensor:
        """Log prior odds of each of the atoms, `a`."""
        return torch.tensor([a.log_prior for a in self.atoms], dtype=self.grams.yy.dtype)


def covariance(dictionary: Dictionary, found: FittedSet) -> Tensor:
    """Posterior covariance of the coefficients of a set, atom by atom, in units of their plausible sizes, `m x m`."""
    index = torch.cat([torch.arange(0), *(dictionary.groups[i] for i in found.members)])
    own = [m.new_full((len(m),), s / 2).exp() for m, s in zip(found.mean, found.log_scale, strict=True)]
    scale = torch.cat([dictionary.grams.xy[:0], *own])
    inner = scale[:, None] * dictionary.grams.xx[index][:, index] * scale / found.noise
    inverse: Tensor = torch.linalg.inv(inner + torch.eye(len(inner), dtype=inner.dtype))
    return scale[:, None] * inverse * scale


class Singles(NamedTuple):
    """Fits of no atom, and of each alone; principal axes and inner products of each; how many values there are."""

    found: dict[tuple[int, ...], FittedSet]
    axes: list[Tensor]
    products: list[GroupProducts]
    values: float


def singles_of(
    atoms: Sequence[Candidate], x: Sequence[Tensor], y: Tensor, noise_dof: float, values: float | None = None
) -> Singles:
    """Fit no atom, and each alone.

    Args:
        atoms: candidates.
        x: whitened columns of each, `s x c x m`.
        y: what they explain, whitened, `s x c`.
        noise_dof: weight of the prior of the noise, in values; 0 = it is not known.
        values: how many of y were measured, the others being 0; all when None.
    """
    values = float(y.numel()) if values is None else values
    products = [own_products(columns, y) for columns in x]
    fits, axes = fit_single_groups([NO_COLUMNS, *products], y.square().sum(), Prior(values, noise_dof))
    sets = [(), *((i,) for i in range(len(products)))]
    return Singles(fitted_sets(sets, sets, fits, dict(enumerate(axes[1:])), atoms), axes[1:], products, values)


def fitted_sets(
    sets: Sequence[tuple[int, ...]],
    ordered: Sequence[Sequence[int]],
    fits: Fits,
    axes: Mapping[int, Tensor],
    atoms: Sequence[Candidate],
) -> dict[tuple[int, ...], FittedSet]:
    """Sets by their members.

    Args:
        sets: members of each, ascending.
        ordered: the same in the order of the fits, which have the first in their `first`.
        fits: of the sets.
        axes: principal axes of each atom.
        atoms: candidates.
    """
    evidence = torch.where(torch.isfinite(fits.log_evidence), fits.log_evidence, -torch.inf)
    tables = (evidence, fits.log_scale, fits.energy, fits.rss, fits.noise, fits.effective)
    rows = zip(sets, ordered, fits.first, fits.mean, *(v.tolist() for v in tables), strict=True)
    found, wide = {}, {i: len(axes[i]) for i in {*chain(*ordered)}}
    for own, order, first, rest, log_evidence, log_scale, energy, rss, noise, effective in rows:
        widths = [wide[i] for i in order]
        others = zip(widths[1:], accumulate(widths[1:]), strict=True)
        along = [*(first[:w] for w in widths[:1]), *(rest[end - w : end] for w, end in others)]
        place = [order.index(i) for i in own]
        found[own] = FittedSet(
            members=own,
            log_posterior=log_evidence + sum(atoms[i].log_prior for i in own) + crowd(len(own)),
            log_evidence=log_evidence,
            along=tuple(along[k] for k in place),
            axes=tuple(axes[i] for i in own),
            log_scale=tuple(log_scale[k] for k in place),
            energy=tuple(energy[k] for k in place),
            rss=rss,
            noise=noise,
            effective=effective,
        )
    return found


def with_noise(dictionary: Dictionary, variance: float) -> Dictionary:
    """The same candidates under noise of a variance that is known, in units of which all squares then are.

    Args:
        dictionary: candidates.
        variance: of the noise, in units of the noise so far.
    """
    grams, turned = scaled(dictionary.grams, variance), scaled(dictionary.turned, variance)
    size, known = math.sqrt(variance), CERTAIN * grams.values
    sets = [(), *((i,) for i in dictionary.groups)]
    held = torch.tensor([*dictionary.groups], dtype=torch.int64)[:, None]
    index, _ = column_indices(dictionary.begins[held], dictionary.widths[held])
    # The last column is of zeros.
    index = torch.nn.functional.pad(index, (0, 1, 1, 0), value=-1)
    square, along = real_squares(turned.xx.diagonal()[index], turned.xy[index])
    fits = fit_in_axes(square, along, torch.arange(len(sets)) > 0, grams.yy, Prior(grams.values, known))
    return replace(
        dictionary,
        y=dictionary.y / size,
        columns=dictionary.columns / size,
        grams=grams,
        turned=turned,
        alone=fitted_sets(sets, sets, fits, dictionary.axes, dictionary.atoms),
        noise_dof=known,
    )


def dictionary_of(
    atoms: Sequence[Candidate],
    x: Sequence[Tensor],
    y: Tensor,
    others: Sequence[int],
    singles: Singles,
    noise_dof: float,
    firsts: Sequence[int] | None = None,
) -> Dictionary:
    """Of the library effects and the discrepancy terms `others`.

    Args:
        atoms, x, y, noise_dof: as for `singles_of`.
        others: discrepancy terms.
        singles: what that says of them.
        firsts: atoms of which one is in every set that will be asked for; None = any.
    """
    library = [i for i, a in enumerate(atoms) if not a.is_discrepancy]
    names = list(dict.fromkeys(atoms[i].name for i in library))
    # Atoms that are never in one set are contiguous.
    kinds = [*([i for i in library if atoms[i].name == name] for name in names), [*others]]
    chosen = [i for kind in kinds for i in kind]
    columns = torch.cat([y[..., None][..., :0], *(x[i] for i in chosen)], -1)
    groups = dict(zip(chosen, groups_of(x[i] for i in chosen), strict=True))
    grams = _grams(columns, y, kinds, groups, singles, firsts)
    own = {i: singles.axes[i] for i in groups}
    return Dictionary(
        tuple(atoms), y, columns, groups, grams, own, _turned(grams, groups, own), singles.found, noise_dof
    )


def _grams(
    columns: Tensor,
    y: Tensor,
    kinds: Sequence[Sequence[int]],
    groups: Mapping[int, Tensor],
    singles: Singles,
    firsts: Sequence[int] | None,
) -> Grams:
    """Inner products of what may be in one set: atoms of two kinds, one of them among the firsts; others may be NaN."""
    flat = columns.flatten(0, 1)
    width = flat.shape[-1]
    xx = flat.new_full((width, width), torch.nan)
    ends = [int(groups[kind[-1]][-1]) + 1 for kind in kinds if kind]
    if firsts is None:
        begin = 0
        for k, end in enumerate(ends):
            # Thin products take as long as wide ones: narrow kinds go together, for all that they have among them.
            if end - begin < NARROW and end < width and ends[k + 1] - end < NARROW:
                continue
            after = end if begin == (0, *ends)[k] else begin
            xx[begin:end, after:] = flat[:, begin:end].mT @ flat[:, after:]
            xx[end:, begin:end] = xx[begin:end, end:].mT
            begin = end
    else:
        mine = torch.cat([torch.arange(0), *(groups[i] for i in firsts)])
        xx[mine] = flat[:, mine].mT @ flat
        xx[:, mine] = xx[mine].mT
    for i, group in groups.items():
        xx[_run(group), _run(group)] = singles.products[i].xx
    xy = torch.cat([y.reshape(-1)[:0], *(singles.products[i].xy for kind in kinds for i in kind)])
    return Grams(xx, xy, y.square().sum(), singles.values)


def _run(group: Tensor) -> slice:
    """Of contiguous columns."""
    return slice(int(group[0]), int(group[-1]) + 1)


def _turned(grams: Grams, groups: Mapping[int, Tensor], axes: Mapping[int, Tensor]) -> Grams:
    """Every group in its principal axes, and one more column, of zeros, in the place of those that are not there."""
    width = len(grams.xy)
    xx, xy = grams.xx.new_zeros(width + 1, width + 1), grams.xy.new_zeros(width + 1)
    for i, group in groups.items():
        place = _run(group)
        xx[place, :width], xy[place] = axes[i].mT @ grams.xx[place], axes[i].mT @ grams.xy[place]
    for i, group in groups.items():
        place = _run(group)
        xx[:width, place] = xx[:width, place] @ axes[i]
    return grams._replace(xx=xx, xy=xy)


def gain_beside(dictionary: Dictionary, found: FittedSet, groups: Sequence[Tensor]) -> list[float]:
    """Log evidence that each group of columns adds to a set.

    At the scales of the set, y ~ N(0, σ² K + α² Z Zᵀ) with K = I + Σ_g (α_g² / σ²) X_g X_gᵀ, so that Zᵀ K⁻¹ Z and
    Zᵀ K⁻¹ y take the place of the inner products.

    Args:
        dictionary: of the set's atoms.
        found: the set.
        groups: whitened columns, `s x c x m` each.
    """
    x = [
        dictionary.columns[..., dictionary.groups[i]] * math.exp(scale / 2) / math.sqrt(found.noise)
        for i, scale in zip(found.members, found.log_scale, strict=True)
    ]
    own = torch.cat([dictionary.columns[..., :0], *x], -1).flatten(0, -2)
    factor = torch.linalg.cholesky(own.mT @ own + torch.eye(own.shape[-1], dtype=own.dtype))

    def project(columns: Tensor) -> Tensor:
        solved: Tensor = torch.linalg.solve_triangular(factor, own.mT @ columns, upper=False)
        return solved

    flat = dictionary.y.reshape(-1, 1)
    with_y = project(flat)
    left = []
    for group in groups:
        columns = group.flatten(0, -2)
        with_own = project(columns)
        inner, along = columns.mT @ columns - with_own.mT @ with_own, columns.mT @ flat - with_own.mT @ with_y
        left.append(GroupProducts(inner, along[:, 0]))
    yy = flat.square().sum() - with_y.square().sum()
    prior = Prior(dictionary.grams.values, dictionary.noise_dof)
    evidence = fit_single_groups([NO_COLUMNS, *left], yy, prior)[0].log_evidence
    return [float(v) for v in evidence[1:] - evidence[0]]
