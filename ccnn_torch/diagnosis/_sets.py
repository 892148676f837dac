"""Fits of many sets of candidates: those of like widths side by side, each from where a smaller one ended."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis._added import added_scale
from ccnn_torch.diagnosis._dictionary import Dictionary, Found
from ccnn_torch.diagnosis._joined import Joined, fit_joined

__all__ = ["promising", "scored"]

# Updates of a fit; after the short one no set that came within 12 of the best in the end was 30 below it, in trials.
_UPDATES, _SHORT, _HOPELESS = 4, 1, 60.0
# What is left of a smaller set's noise to begin with. Two groups may explain together what neither nearly does alone:
# the scales that suit a low noise are not reached from a high one, and a noise that is too low is mended by one update.
_LESS_NOISE = 0.1
# Smaller sets that are so near the best (log odds), and so much better than nothing, are begun from as well.
_RIVAL, _THERE = 30.0, 10.0
# Sets are fitted side by side where their widths differ by less than this.
_ALIKE = 24
# A third cause at once is rarer still than a second one.
_CROWD = math.log(0.1)


def scored(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: Mapping[tuple[int, ...], Found]
) -> list[Found]:
    """Fit the sets, those of like widths side by side; tried: sets that were fitted before, to begin from."""
    found = {s: dictionary.alone[s] for s in sets if len(s) < 2}
    found |= _fitted(dictionary, [s for s in sets if len(s) > 1], tried, None)
    return [found[s] for s in sets]


def promising(
    dictionary: Dictionary,
    sets: Sequence[tuple[int, ...]],
    best: float,
    tried: Mapping[tuple[int, ...], Found],
) -> list[Found]:
    """As `scored`, without the sets that a short fit says are far below `best` or the best of them.

    Args:
        dictionary: candidates.
        sets: of two members or more.
        best: log posterior that is known to be reached.
        tried: sets that were fitted before.
    """
    return [*_fitted(dictionary, sets, tried, best).values()]


class _Start(NamedTuple):
    """A set, the smaller one that it is begun from, and the member that this one lacks."""

    members: tuple[int, ...]
    before: Found
    more: int


def _fitted(
    dictionary: Dictionary,
    sets: Sequence[tuple[int, ...]],
    tried: Mapping[tuple[int, ...], Found],
    best: float | None,
) -> dict[tuple[int, ...], Found]:
    """Sets by their members; best: as for `promising`, None = all of them."""
    lots = _lots(dictionary, _starts(dictionary, sets, tried))
    fits, likely = [], []
    for starts, begin in lots:
        fits.append(_updated(dictionary, [s.members for s in starts], begin, _SHORT))
        prior = torch.tensor([_log_prior(dictionary, s.members) for s in starts], dtype=torch.float64)
        likely.append((torch.nan_to_num(fits[-1].log_evidence, nan=-math.inf) + prior).tolist())
    reached: dict[tuple[int, ...], float] = {}
    for (starts, _), mine in zip(lots, likely, strict=True):
        for start, value in zip(starts, mine, strict=True):
            reached[start.members] = max(value, reached.get(start.members, -math.inf))
    least = -math.inf if best is None else max([best, *reached.values()]) - _HOPELESS
    found: dict[tuple[int, ...], Found] = {}
    for (starts, _), first, mine in zip(lots, fits, likely, strict=True):
        rows = [k for k, (s, v) in enumerate(zip(starts, mine, strict=True)) if least <= v == reached[s.members]]
        if not rows:
            continue
        kept = [starts[k].members for k in rows]
        begin = first.log_scale[rows], first.noise[rows]
        found |= _read(dictionary, kept, _updated(dictionary, kept, begin, _UPDATES - _SHORT))
    return found


def _updated(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], begin: tuple[Tensor, Tensor], updates: int
) -> Joined:
    groups = [[dictionary.groups[i] for i in _widest_first(dictionary, members)] for members in sets]
    return fit_joined(dictionary.turned, groups, dictionary.noise_dof, begin, updates)


def _starts(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: Mapping[tuple[int, ...], Found]
) -> list[_Start]:
    """Every set from the most probable of those that lack one of its members, and from the rivals of this one: of two
    that explain the same, the one that is there first leaves nothing to the other."""
    known = {**dictionary.alone, **tried}
    # Where none of them was fitted, the one without the member that is least probable by itself is fitted now.
    orphans = {
        tuple(m for m in s if m != min(s, key=lambda i: dictionary.alone[i,].log_posterior))
        for s in sets
        if not any(f in known for f in _fewer(s))
    }
    known |= {f.members: f for f in scored(dictionary, sorted(orphans), tried)} if orphans else {}
    something = dictionary.alone[()].log_posterior + _THERE
    starts = []
    for members in sets:
        begun = [_Start(members, known[f], i) for f, i in zip(_fewer(members), members, strict=True) if f in known]
        top = max(begun, key=lambda s: s.before.log_posterior)
        least = max(top.before.log_posterior - _RIVAL, something)
        starts += [s for s in begun if s is top or s.before.log_posterior > least]
    return starts


def _lots(dictionary: Dictionary, starts: Sequence[_Start]) -> list[tuple[list[_Start], tuple[Tensor, Tensor]]]:
    """Sets of as many members whose widest groups are about as wide, and the others together as well; and log α² of
    each group, the widest first, and σ² to begin with."""
    own = added_scale(dictionary, [s.before for s in starts], [s.more for s in starts]).tolist() if starts else []
    lots: dict[tuple[int, int, int], list[tuple[_Start, list[float]]]] = {}
    for start, scale in zip(starts, own, strict=True):
        each = {**dict(zip(start.before.members, start.before.log_scale, strict=True)), start.more: scale}
        ordered = _widest_first(dictionary, start.members)
        first, *rest = (dictionary.widths[i] for i in ordered)
        lot = len(ordered), -(-first // _ALIKE), -(-sum(rest) // _ALIKE)
        lots.setdefault(lot, []).append((start, [each[i] for i in ordered]))
    begun = []
    for alike in lots.values():
        scales = torch.tensor([scale for _, scale in alike], dtype=torch.float64)
        noise = torch.tensor([_LESS_NOISE * start.before.noise for start, _ in alike], dtype=torch.float64)
        begun.append(([start for start, _ in alike], (scales, noise)))
    return begun


def _fewer(members: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The set without each of its members."""
    return [tuple(m for m in members if m != i) for i in members]


def _widest_first(dictionary: Dictionary, members: tuple[int, ...]) -> list[int]:
    return sorted(members, key=lambda i: (-dictionary.widths[i], i))


def _log_prior(dictionary: Dictionary, members: tuple[int, ...]) -> float:
    return sum(dictionary.atoms[i].log_prior for i in members) + _CROWD * max(len(members) - 2, 0)


def _read(dictionary: Dictionary, sets: Sequence[tuple[int, ...]], fits: Joined) -> dict[tuple[int, ...], Found]:
    found = {}
    numbers = zip(*(v.tolist() for v in (fits.log_evidence, fits.rss, fits.noise, fits.effective)), strict=True)
    energy, log_scale = fits.energy.tolist(), fits.log_scale.tolist()
    for row, (members, (evidence, rss, noise, effective)) in enumerate(zip(sets, numbers, strict=True)):
        ordered = _widest_first(dictionary, members)
        widths = [dictionary.widths[i] for i in ordered]
        means = fits.first[row, : widths[0]], *torch.split(fits.rest[row, : sum(widths[1:])], widths[1:])
        place = [ordered.index(i) for i in members]
        evidence = evidence if math.isfinite(evidence) else -math.inf
        found[members] = Found(
            members=members,
            log_posterior=evidence + _log_prior(dictionary, members),
            log_evidence=evidence,
            mean=tuple(dictionary.axes[i] @ means[k] for i, k in zip(members, place, strict=True)),
            log_scale=tuple(log_scale[row][k] for k in place),
            energy=tuple(energy[row][k] for k in place),
            rss=rss,
            noise=noise,
            effective=effective,
        )
    return found
