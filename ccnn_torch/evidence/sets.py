"""Fits of many sets of candidates, batched by width, each started from a smaller one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.dictionary import Dictionary, FittedSet, fitted_sets
from ccnn_torch.evidence.marginal_likelihood import (
    JITTER,
    Fits,
    Prior,
    column_indices,
    fit_batched_sets,
    fit_in_axes,
)
from ccnn_torch.evidence.priors import crowd

# Updates of a fit; after the short one no set that came within 12 of the best in the end was 30 below it, in trials.
_UPDATES, _SHORT, _HOPELESS = 4, 1, 40.0
# What is left of a smaller set's noise to begin with. Two groups may explain together what neither nearly does alone:
# the scales that suit a low noise are not reached from a high one, and a noise that is too low is mended by one update.
_LESS_NOISE = 0.1
# Smaller sets that are so near the best (log odds), and so much better than nothing, are begun from as well.
_RIVAL, _THERE = 30.0, 10.0
# Sets of about the same widths are fitted side by side, as many as have their products near the processor.
_NEAR = 50_000
# Sets are evaluated in one batch where their widths differ by less than this.
_ALIKE = 24
# Share of the squares of an atom's largest column below which what is left of one is rounding.
_ROUNDING = 1e-12
# Beside a set that so many atoms are added to, all columns are evaluated once.
_FEW = 5


def scored(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: Mapping[tuple[int, ...], FittedSet]
) -> list[FittedSet]:
    """Fit the sets, those of like widths side by side; tried: sets that were fitted before, to begin from."""
    found = {s: dictionary.alone[s] for s in sets if len(s) < 2}
    found |= _fitted(dictionary, [s for s in sets if len(s) > 1], tried, None)
    return [found[s] for s in sets]


def promising(
    dictionary: Dictionary,
    sets: Sequence[tuple[int, ...]],
    best: float,
    tried: Mapping[tuple[int, ...], FittedSet],
) -> list[FittedSet]:
    """As `scored`, without the sets that a short fit says are far below `best` or the best of them.

    Args:
        dictionary: candidates.
        sets: of two members or more.
        best: log posterior that is known to be reached.
        tried: sets that were fitted before.
    """
    return [*_fitted(dictionary, sets, tried, best).values()]


def subsets_with_one_less(members: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The set without each of its members."""
    return [members[:k] + members[k + 1 :] for k in range(len(members))]


class _Start(NamedTuple):
    """A set by its number, the smaller one that it is begun from, and the place of the member that this one lacks."""

    number: int
    before: FittedSet
    place: int


class _Begun(NamedTuple):
    """Fits of sets of as many members, `b`, on their way.

    Attributes:
        number: of the set, `b`.
        members: the widest first, `b x g`.
        log_scale: log α² of each, `b x g`.
        noise: σ², `b`.
    """

    number: Tensor
    members: Tensor
    log_scale: Tensor
    noise: Tensor

    def some(self, rows: Tensor) -> _Begun:
        return _Begun(*(v[rows] for v in self))


def _fitted(
    dictionary: Dictionary,
    sets: Sequence[tuple[int, ...]],
    tried: Mapping[tuple[int, ...], FittedSet],
    best: float | None,
) -> dict[tuple[int, ...], FittedSet]:
    """Sets by their members; best: as for `promising`, None = all of them."""
    starts = _starts(dictionary, sets, tried)
    sizes = sorted({len(s) for s in sets})
    short = [
        _short(dictionary, _begun(dictionary, sets, [s for s in starts if len(sets[s.number]) == n])) for n in sizes
    ]
    reached = torch.full((len(sets),), -math.inf, dtype=dictionary.grams.yy.dtype)
    for begun, likely in short:
        reached.scatter_reduce_(0, begun.number, likely, "amax")
    least = -math.inf if best is None else max(best, float(reached.max()) if len(sets) else best) - _HOPELESS
    found: dict[tuple[int, ...], FittedSet] = {}
    for begun, likely in short:
        kept = begun.some(torch.nonzero((likely >= least) & (likely == reached[begun.number]))[:, 0])
        for lot in _lots(dictionary, kept.members):
            mine = kept.some(lot)
            fits = _updated(dictionary, mine, _UPDATES - _SHORT)
            own = [sets[k] for k in mine.number.tolist()]
            found |= fitted_sets(own, mine.members.tolist(), fits, dictionary.axes, dictionary.atoms)
    return found


def _short(dictionary: Dictionary, begun: _Begun) -> tuple[_Begun, Tensor]:
    """Where a short fit brings the sets, and their log posteriors there, `b`."""
    log_scale, noise, likely = (torch.empty_like(v) for v in (begun.log_scale, begun.noise, begun.noise))
    for lot in _lots(dictionary, begun.members):
        fits = _updated(dictionary, begun.some(lot), _SHORT)
        log_scale[lot], noise[lot], likely[lot] = fits.log_scale, fits.noise, fits.log_evidence
    likely = torch.nan_to_num(likely, nan=-math.inf) + _log_prior(dictionary, begun.members)
    return begun._replace(log_scale=log_scale, noise=noise), likely


def _lots(dictionary: Dictionary, members: Tensor) -> Iterator[Tensor]:
    """Rows of sets `b x g`, whose members have the widest first, that are fitted side by side."""
    if not len(members):
        return
    widths = dictionary.widths[members]
    first, rest = widths[:, 0], widths[:, 1:].sum(-1)
    order = (rest * (1 + int(first.max())) + first).argsort()
    begin = wide = 0
    for k, (f, r) in enumerate(zip(first[order].tolist(), rest[order].tolist(), strict=True)):
        wide = max(wide, f)
        if k > begin and (k + 1 - begin) * wide * r > _NEAR:
            yield order[begin:k]
            begin, wide = k, f
    yield order[begin:]


def _updated(dictionary: Dictionary, begun: _Begun, updates: int) -> Fits:
    begin, width = dictionary.begins[begun.members], dictionary.widths[begun.members]
    start = begun.log_scale, begun.noise
    return fit_batched_sets(dictionary.turned, begin, width, dictionary.noise_dof, start, updates)


def _starts(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: Mapping[tuple[int, ...], FittedSet]
) -> list[_Start]:
    """Every set from the most probable of those that lack one of its members, and from the rivals of this one: of two
    that explain the same, the one that is there first leaves nothing to the other."""
    alone = dictionary.alone
    # Where none of them was fitted, the one without the member that is least probable alone is fitted now.
    orphans = {
        tuple(m for m in s if m != min(s, key=lambda i: alone[i,].log_posterior))
        for s in sets
        if len(s) > 2 and not any(f in tried for f in subsets_with_one_less(s))
    }
    new = {f.members: f for f in scored(dictionary, sorted(orphans), tried)} if orphans else {}
    something = alone[()].log_posterior + _THERE
    starts = []
    for number, members in enumerate(sets):
        before = (tried.get(f) or alone.get(f) or new.get(f) for f in subsets_with_one_less(members))
        begun = [_Start(number, f, place) for place, f in enumerate(before) if f is not None]
        top = max(begun, key=lambda s: s.before.log_posterior)
        least = max(top.before.log_posterior - _RIVAL, something)
        starts += [s for s in begun if s is top or s.before.log_posterior > least]
    return starts


def _begun(dictionary: Dictionary, sets: Sequence[tuple[int, ...]], starts: Sequence[_Start]) -> _Begun:
    """Sets of as many members each at the scales of the smaller one and that of the member which this one lacks."""
    members = torch.tensor([sets[s.number] for s in starts])
    own = added_scale(dictionary, [s.before for s in starts], [sets[s.number][s.place] for s in starts]).tolist()
    each = [
        (*s.before.log_scale[: s.place], a, *s.before.log_scale[s.place :]) for s, a in zip(starts, own, strict=True)
    ]
    scales = torch.tensor(each, dtype=torch.float64)
    noise = torch.tensor([_LESS_NOISE * s.before.noise for s in starts], dtype=torch.float64)
    order = (-dictionary.widths[members]).argsort(dim=-1, stable=True)
    return _Begun(torch.tensor([s.number for s in starts]), members.gather(1, order), scales.gather(1, order), noise)


def _log_prior(dictionary: Dictionary, members: Tensor) -> Tensor:
    return dictionary.log_prior[members].sum(-1) + crowd(members.shape[1])


def added_scale(dictionary: Dictionary, before: Sequence[FittedSet], more: Sequence[int]) -> Tensor:
    """log α² of each of the atoms `more` beside the set `before` it, of one member at least, `b`.

    The scales of a set count in units of its noise: y ~ N(0, σ² K + α² Z Zᵀ), where K = I + Σ_g (α_g² / σ²) X_g X_gᵀ is
    as the set has it. Of Zᵀ K⁻¹ Z the diagonal is evaluated only, along the principal axes of Z: near enough to begin
    from, and far better than the scale at which the atom explains all alone.
    """
    turned, atoms = dictionary.turned, torch.tensor([*more])[:, None]
    own, _ = column_indices(dictionary.begins[atoms], dictionary.widths[atoms])
    square, along, yy = turned.yy.new_zeros(own.shape), turned.yy.new_zeros(own.shape), turned.yy.new_zeros(len(own))
    for rows, sets, each in _batches(dictionary, before):
        if len(sets[0].members) == 1:
            squares, products, left = _left_by_one(dictionary, sets)
        else:
            squares, products, left = _left_of_columns(dictionary, sets, own[rows] if each is None else None)
        if each is None:
            square[rows], along[rows], yy[rows] = squares, products, left
        else:
            place = torch.tensor(each)[:, None], own[rows]
            square[rows], along[rows], yy[rows] = squares[place], products[place], left[place[0][:, 0]]
    # Directions in which the atom does nothing, or nothing that the set cannot do, are rounding.
    there = square > _ROUNDING * turned.xx.diagonal()[own].amax(-1, keepdim=True)
    square, along = square.where(there, 0.0), along.where(there, 0.0)
    prior = Prior(turned.values, dictionary.noise_dof)
    return fit_in_axes(square, along, dictionary.widths[atoms[:, 0]] > 0, yy.clamp_min(0), prior).log_scale[:, 0]


def _batches(
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
    edge += 1 + JITTER * edge.amax(-1, keepdim=True)
    factor = torch.linalg.cholesky_ex(kernel).L
    right = turned.xx[columns] if wanted is None else turned.xx[columns[:, :, None], wanted[:, None, :]]
    taken = torch.linalg.solve_triangular(factor, right.mul_(size[..., None]), upper=False)
    with_y = torch.linalg.solve_triangular(factor, (turned.xy[columns] * size)[..., None], upper=False)
    every = slice(None) if wanted is None else wanted
    along = turned.xy[every] - (taken.mT @ with_y)[..., 0]
    square = turned.xx.diagonal()[every] - taken.square_().sum(-2)
    return square, along, turned.yy - with_y.square().sum((-2, -1))
