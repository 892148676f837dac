"""Fits of many sets of candidates: those of like widths side by side, each from where a smaller one ended."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ccnn_torch.diagnosis._dictionary import Dictionary, Found
from ccnn_torch.diagnosis._joined import Joined, fit_joined

__all__ = ["promising", "scored"]

# Updates of a fit; after the short one no set that came within 12 of the best in the end was 85 below it, in trials.
_UPDATES, _SHORT, _HOPELESS = 8, 1, 100.0
# Sets are fitted side by side where their widths differ by less than this.
_ALIKE = 24
# A third cause at once is rarer still than a second one.
_CROWD = math.log(0.1)


def scored(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: Mapping[tuple[int, ...], Found]
) -> list[Found]:
    """Fit the sets, those of like widths side by side; tried: sets that were fitted before, to begin from."""
    found: dict[tuple[int, ...], Found] = {}
    for lot in _lots(dictionary, sets):
        found |= _read(dictionary, lot, _fitted(dictionary, lot, _started(dictionary, lot, tried), _UPDATES))
    return [found[s] for s in sets]


def promising(
    dictionary: Dictionary,
    sets: Sequence[tuple[int, ...]],
    best: float,
    tried: Mapping[tuple[int, ...], Found],
) -> list[Found]:
    """As `scored`, without the sets that a short fit says are far below `best` or the best of them.

    tried: sets that were fitted before.
    """
    lots = _lots(dictionary, sets)
    short = [_fitted(dictionary, lot, _started(dictionary, lot, tried), _SHORT) for lot in lots]
    prior = [torch.tensor([_log_prior(dictionary, s) for s in lot], dtype=torch.float64) for lot in lots]
    posterior = [torch.nan_to_num(f.log_evidence, -math.inf) + p for f, p in zip(short, prior, strict=True)]
    least = max([best, *(float(p.max()) for p in posterior)]) - _HOPELESS
    found: list[Found] = []
    for lot, first, likely in zip(lots, short, posterior, strict=True):
        rows = torch.nonzero(likely >= least).squeeze(-1)
        kept = [lot[k] for k in rows.tolist()]
        if kept:
            start = first.log_scale[rows], first.noise[rows]
            found += _read(dictionary, kept, _fitted(dictionary, kept, start, _UPDATES - _SHORT)).values()
    return found


def _fitted(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], start: tuple[Tensor, Tensor], updates: int
) -> Joined:
    groups = [[dictionary.groups[i] for i in _widest_first(dictionary, s)] for s in sets]
    return fit_joined(dictionary.turned, groups, dictionary.noise_dof, start, updates)


def _started(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: Mapping[tuple[int, ...], Found]
) -> tuple[Tensor, Tensor]:
    """log α² and σ² to begin with: of the most probable set that lacks one of the members, and of that one alone."""
    longest = max(max(map(len, sets)), 1)
    scales, noises = [], []
    for members in sets:
        fewer = (tried.get(tuple(m for m in members if m != i)) for i in members)
        known = [f for f in fewer if f is not None] or [dictionary.alone[i,] for i in members]
        base = max(known, key=lambda f: f.log_posterior, default=dictionary.alone[()])
        scale = dict(zip(base.members, base.log_scale, strict=True))
        ordered = _widest_first(dictionary, members)
        own = [scale[i] if i in scale else dictionary.alone[i,].log_scale[0] for i in ordered]
        scales.append(own + [0.0] * (longest - len(members)))
        noises.append(base.noise)
    return torch.tensor(scales, dtype=torch.float64), torch.tensor(noises, dtype=torch.float64)


def _widest_first(dictionary: Dictionary, members: tuple[int, ...]) -> list[int]:
    return sorted(members, key=lambda i: (-dictionary.widths[i], i))


def _lots(dictionary: Dictionary, sets: Sequence[tuple[int, ...]]) -> list[list[tuple[int, ...]]]:
    """Sets whose widest groups are about as wide, and the others together as well."""
    lots: dict[tuple[int, int], list[tuple[int, ...]]] = {}
    for members in sets:
        widths = [dictionary.widths[i] for i in members]
        first = max(widths, default=0)
        lots.setdefault((-(-first // _ALIKE), -(-(sum(widths) - first) // _ALIKE)), []).append(members)
    return list(lots.values())


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
