"""Members of a set that matter: those that only correct the form of others are left out; and what a set leaves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ccnn_torch.diagnosis.evidence.dictionary import FittedSet
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.search.convergence import FORM
from ccnn_torch.diagnosis.search.sets import scored, subsets_with_one_less
from ccnn_torch.effects import EXACT

__all__ = [
    "FORM_DISCREPANCY",
    "FORM_EXACT",
    "above_noise",
    "essential",
    "fits",
    "is_exact",
    "is_known",
    "smallest",
    "unexplained",
]

# As `FORM`, of a discrepancy term beside library effects; of effects whose form is exact, which leave no more than the
# second order; and of library effects beside a discrepancy term, which stands for whatever was not thought of.
FORM_DISCREPANCY, FORM_EXACT, _BESIDE_CATCH_ALL = 0.006, 1e-4, 0.1
# Beside such a term the library is known to lack something, which can look like 4 % of the gap's RMS of anything.
_SLIGHT = 0.0016
# A library effect whose own part is more than this share of the gap is no form of other ones, however well these could
# do without it.
_CARRIES = 0.5
# Remainder above that of the richest fit, as a share of the gap's energy, beyond which no library name is accepted.
_VETO, _MUCH = 0.005, 1.5
# Or times the noise's energy, for any gap.
_VETO_NOISE = 25.0
# In any case by so many standard deviations of the noise's mean square.
_CLEARLY = 5.0
# Log odds by which a small effect must improve a set that leaves no more than a known noise.
_NEEDED = 20.0


def _net(
    analysis: Analysis, found: FittedSet, tried: dict[tuple[int, ...], FittedSet]
) -> dict[int, tuple[float, tuple[int, ...]]]:
    """Of each member the share of the gap's energy that goes with it and not without it, and the set without it."""
    gap = analysis.gap
    without = fits(analysis, subsets_with_one_less(found.members), tried)
    return {i: ((f.rss - found.rss) / gap, f.members) for i, f in zip(found.members, without, strict=True)}


def fits(
    analysis: Analysis, sets: Sequence[tuple[int, ...]], tried: dict[tuple[int, ...], FittedSet]
) -> list[FittedSet]:
    """The sets, those fitted that are not among the tried, where they then are."""
    fresh = [s for s in dict.fromkeys(sets) if s not in tried]
    tried.update(zip(fresh, scored(analysis.dictionary, fresh, tried), strict=True))
    return [tried[s] for s in sets]


def smallest(analysis: Analysis, found: FittedSet, tried: dict[tuple[int, ...], FittedSet]) -> float:
    """Share of the gap that the least member of a set carries."""
    return min(share for share, _ in _net(analysis, found, tried).values())


def essential(
    analysis: Analysis, sets: Sequence[FittedSet], tried: dict[tuple[int, ...], FittedSet]
) -> list[FittedSet]:
    """Each of the sets without members that only correct the form of the others."""
    found = [*sets]
    going = list(range(len(found)))
    while going:
        # What is asked for one by one below is fitted side by side first.
        fits(
            analysis,
            [s for k in going if len(found[k].members) > 1 for s in subsets_with_one_less(found[k].members)],
            tried,
        )
        less = {k: _with_less(analysis, found[k], tried) for k in going}
        going = [k for k in going if less[k].members != found[k].members]
        for k in going:
            found[k] = less[k]
    return found


def _with_less(analysis: Analysis, found: FittedSet, tried: dict[tuple[int, ...], FittedSet]) -> FittedSet:
    """The set without the first of its members that only correct the form of the others; itself where there is none."""
    atoms = analysis.dictionary.atoms
    if len(found.members) < 2:
        return found
    shares = _net(analysis, found, tried)
    limits = {i: _form(analysis, found, i, shares) for i in found.members}
    alone = not any(atoms[i].is_discrepancy for i in found.members)
    large = _CARRIES * analysis.gap
    carries = {i for i, e in zip(found.members, found.energy, strict=True) if alone and e > large}
    # What leaves more than the noise when it goes is missed, however small it is.
    missed = unexplained(analysis, found)
    # A small effect that takes a set to a known noise is no form of the others: theirs would leave more.
    exact = alone and is_known(analysis) and not above_noise(analysis, found)
    needed = {
        i
        for i, (_, without) in shares.items()
        if exact
        and above_noise(analysis, tried[without])
        and found.log_posterior - tried[without].log_posterior > _NEEDED
    }
    idle = [
        i
        for i, (share, without) in shares.items()
        if i not in carries | needed and share < limits[i] and (missed or not unexplained(analysis, tried[without]))
    ]
    if not idle:
        return found
    # A discrepancy term can replace much of the library, so it is the first to go; else what is missed least.
    least = max(idle, key=lambda i: (atoms[i].is_discrepancy, tried[shares[i][1]].log_posterior))
    return tried[shares[least][1]]


def _form(
    analysis: Analysis, found: FittedSet, member: int, shares: Mapping[int, tuple[float, tuple[int, ...]]]
) -> float:
    """Share of the gap's energy up to which a member may be no more than the form of the others: each of these leaves
    a share of what it does itself, and a discrepancy term one of what nothing else does."""
    atoms = analysis.dictionary.atoms
    wide = FORM_DISCREPANCY if atoms[member].is_discrepancy else FORM
    form, wild = 0.0, 0.0
    for i, energy in zip(found.members, found.energy, strict=True):
        if i == member:
            continue
        if atoms[i].is_discrepancy:
            wild = max(_BESIDE_CATCH_ALL * shares[i][0], _SLIGHT)
        else:
            form += (FORM_EXACT if is_exact(analysis, [i]) else wide) * min(energy / analysis.gap, 1.0)
    return min(form, wide) + wild


def is_known(analysis: Analysis) -> bool:
    """Whether the noise was given or the records show it."""
    return analysis.whitening.known > 0 or analysis.instrument is not None


def above_noise(analysis: Analysis, found: FittedSet) -> bool:
    """Whether a set leaves more than the noise by three standard deviations."""
    count = analysis.dictionary.grams.values
    return found.rss / max(count - found.effective, 1.0) > analysis.floor * (1 + 3 * math.sqrt(2 / count))


def unexplained(analysis: Analysis, found: FittedSet) -> bool:
    """Whether what a set leaves is clearly more than the noise (given, or of the richest fit)."""
    count = analysis.dictionary.grams.values
    left = found.rss / max(count - found.effective, 1.0)
    floor = analysis.floor
    significant = left > floor * (1 + _CLEARLY * math.sqrt(2 / count))
    gap = float(analysis.dictionary.grams.yy) / count
    much = left - floor > _VETO * max(gap - floor, 0.0) and left > _MUCH * floor
    return significant and (much or left > _VETO_NOISE * floor or is_exact(analysis, found.members))


def is_exact(analysis: Analysis, members: Sequence[int]) -> bool:
    """Whether there are library effects among these, and none could have another form than it was fitted with."""
    atoms = (analysis.dictionary.atoms[i] for i in members)
    names = {a.name for a in atoms if not a.is_discrepancy}
    return bool(names) and names <= EXACT
