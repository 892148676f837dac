"""Fits of many sets of candidates, batched by width, each started from a smaller one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.evidence.batched_sets import BatchedFits, fit_batched_sets
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet
from ccnn_torch.evidence.initial_scale import added_scale

# Updates of a fit; after the short one no set that came within 12 of the best in the end was 30 below it, in trials.
_UPDATES, _SHORT, _HOPELESS = 4, 1, 40.0
# What is left of a smaller set's noise to begin with. Two groups may explain together what neither nearly does alone:
# the scales that suit a low noise are not reached from a high one, and a noise that is too low is mended by one update.
_LESS_NOISE = 0.1
# Smaller sets that are so near the best (log odds), and so much better than nothing, are begun from as well.
_RIVAL, _THERE = 30.0, 10.0
# Sets of about the same widths are fitted side by side, as many as have their products near the processor.
_NEAR = 50_000
# A third cause at once is rarer still than a second one.
_CROWD = math.log(0.1)


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
            found |= _read(dictionary, [sets[k] for k in mine.number.tolist()], mine.members, fits)
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


def _updated(dictionary: Dictionary, begun: _Begun, updates: int) -> BatchedFits:
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
    return dictionary.log_prior[members].sum(-1) + _CROWD * max(members.shape[1] - 2, 0)


def _read(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], members: Tensor, fits: BatchedFits
) -> dict[tuple[int, ...], FittedSet]:
    """members: of the sets, the widest first, `b x g`."""
    found = {}
    evidence = torch.where(torch.isfinite(fits.log_evidence), fits.log_evidence, -torch.inf)
    posterior = evidence + _log_prior(dictionary, members)
    numbers = zip(*(v.tolist() for v in (posterior, evidence, fits.rss, fits.noise, fits.effective)), strict=True)
    tables = (members, dictionary.widths[members], fits.energy, fits.log_scale)
    rows = zip(sets, *(v.tolist() for v in tables), numbers, strict=True)
    for row, (
        own,
        ordered,
        widths,
        energy,
        log_scale,
        (log_posterior, log_evidence, rss, noise, effective),
    ) in enumerate(rows):
        along = fits.first[row, : widths[0]], *torch.split(fits.rest[row, : sum(widths[1:])], widths[1:])
        place = [ordered.index(i) for i in own]
        found[own] = FittedSet(
            members=own,
            log_posterior=log_posterior,
            log_evidence=log_evidence,
            along=tuple(along[k] for k in place),
            axes=tuple(dictionary.axes[i] for i in own),
            log_scale=tuple(log_scale[k] for k in place),
            energy=tuple(energy[k] for k in place),
            rss=rss,
            noise=noise,
            effective=effective,
        )
    return found
