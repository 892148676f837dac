"""From the posterior over sets to the verdict: names, classes, probability, outside or not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ccnn_torch.diagnosis.discrepancy.smooth import ANY
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.borrowed import borrowed_names
from ccnn_torch.evidence.beside import gain_beside
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet
from ccnn_torch.evidence.form_error import Posterior, is_unexplained, with_form_error
from ccnn_torch.evidence.sets import scored

# Odds up to which the data do not distinguish one name from another.
_ODDS = math.log(20.0)
# Log odds against the most probable set beyond which sets are not considered.
_FAR = 12.0
# Probability from which a member of the most probable set is named, where the set without it is probable, too.
_NAMED = 0.9
BESIDE_UNKNOWN = 0.6
"""Probability of a verdict that names effects beside a cause outside the library, which can look like a part of any
effect, and of one that knows of such a cause only by what is left."""


_Leading = list[tuple[frozenset[str], tuple[str, ...], float, FittedSet]]


@dataclass(frozen=True)
class Judgement:
    """The verdict on the names.

    Attributes:
        found: the set that represents the verdict.
        fullest: the most probable set that has the same members and more, whose coefficients are told; `found` itself
            where there is none.
        names: library effects, the favourite of each class.
        classes: for each of them the names that cannot be distinguished from it.
        probability: that the verdict, classes taken as one, is right.
        outside: whether something is there that no library effect describes; `drivers` says what it follows.
        drivers: of the discrepancy terms, the one that does most first.
        marginal: probability of each candidate's name.
        leading: name sets by probability, most probable first (library names, drivers, probability, set).
    """

    found: FittedSet
    fullest: FittedSet
    names: tuple[str, ...]
    classes: dict[str, tuple[str, ...]]
    probability: float
    outside: bool
    drivers: tuple[str, ...]
    marginal: dict[str, float]
    leading: _Leading


def judge(analysis: Analysis) -> Judgement:
    """Weigh the sets that the search has found."""
    levels = with_form_error(analysis.dictionary, analysis.found[0], analysis.floor, analysis.noise_is_known)
    usual, likeliest = levels[0], max(levels, key=lambda level: level.weight)
    leading = _leading(analysis, levels, frozenset())
    names, drivers, _, chosen = leading[0]
    # Names that rest on what makes other effects what they are are no candidates.
    without: frozenset[str] = frozenset()
    while borrowed := borrowed_names(analysis, usual, chosen):
        without |= borrowed
        leading = _leading(analysis, levels, without)
        names, drivers, _, chosen = leading[0]
    sure, likely = frozenset(n for n in names if _marginal(leading, n) >= _NAMED), names
    names, drivers, chosen = next(
        ((n, d, f) for n, d, _, f in leading if n == sure and bool(d) == bool(drivers)), (names, drivers, chosen)
    )
    # Of the shapes that form errors do not tell apart those that fit best.
    same = (f for f in analysis.found if _named(analysis, f) == (names, drivers))
    found = max([*_refitted(analysis, [chosen]), *same], key=lambda f: f.log_posterior)
    outside = bool(drivers)
    if not outside and is_unexplained(analysis.dictionary, found, analysis.floor):
        outside = True
        # A set with a discrepancy term that does explain the rows goes before one that does not.
        fits = ((one, _refitted(analysis, [one[3]])[0]) for one in leading if one[1])
        other = next(
            ((one, fit) for one, fit in fits if not is_unexplained(analysis.dictionary, fit, analysis.floor)), None
        )
        if other is None:
            drivers = _drivers_of_remainder(analysis, leading, usual)
        else:
            (names, drivers, _, _), found = other
    if drivers:
        drivers += _second_driver(analysis, usual, found)
    classes = {} if outside else _classes(analysis, likeliest, chosen, names)
    if outside:
        told = [p for _, some, p, _ in leading if some] if leading[0][1] else []
    else:
        told = [p for members, some, p, _ in leading if not some and is_same(members, names, classes)]
        if names and names < likely:
            # What was left out for want of a sure name mends the form of what is named, as a rule, and is no cause.
            told += [p for members, some, p, _ in leading if not some and names < members]
            told = [min(sum(told), _NAMED)]
    # Beside its twin an effect would share its coefficients with it.
    twins = {twin for some in classes.values() for twin in some} - names
    more = (
        f
        for f in analysis.found
        if found.members and set(found.members) <= set(f.members) and not twins & _named(analysis, f)[0]
    )
    return Judgement(
        found=found,
        fullest=max(more, key=lambda f: f.log_posterior, default=found),
        names=tuple(sorted(names, key=lambda n: -_energy(analysis, found, n))),
        classes=classes,
        probability=BESIDE_UNKNOWN if outside and (names or not told) else min(sum(told), 1.0),
        outside=outside,
        drivers=drivers,
        marginal={a.name: _marginal(leading, a.name) for a in analysis.atoms if not a.is_discrepancy},
        leading=[
            (*one[:3], fit) for one, fit in zip(leading, _refitted(analysis, [one[3] for one in leading]), strict=True)
        ],
    )


def without_names(analysis: Analysis, judgement: Judgement) -> Judgement:
    """None in the place of names that are not likely and that no row outside the fit shows."""
    empty = _empty(analysis)
    return replace(judgement, found=empty, fullest=empty, names=(), classes={}, probability=0.5)


def _leading(analysis: Analysis, levels: Sequence[Posterior], without: frozenset[str]) -> _Leading:
    """Names and drivers of the sets by probability, the mean over the levels of the form error, each with its most
    probable set; without: names of none of them."""
    shares: dict[tuple[frozenset[str], tuple[str, ...]], list[tuple[float, FittedSet]]] = {}
    for posterior in levels:
        allowed = [f for f in posterior.found if not without & _named(analysis, f)[0]]
        top = allowed[0].log_posterior
        first: dict[tuple[frozenset[str], tuple[str, ...]], FittedSet] = {}
        for found in allowed:
            if found.log_posterior > top - _FAR:
                first.setdefault(_named(analysis, found), found)
        weights = {key: math.exp(found.log_posterior - top) for key, found in first.items()}
        total = sum(weights.values()) / posterior.weight if posterior.weight else math.inf
        for key, found in first.items():
            shares.setdefault(key, []).append((weights[key] / total, found))
    leading = [(*key, sum(p for p, _ in own), max(own, key=lambda o: o[0])[1]) for key, own in shares.items()]
    return sorted(leading, key=lambda one: -one[2])


def _marginal(leading: _Leading, name: str) -> float:
    """Probability that a name is in the set that is right."""
    return min(sum(p for names, _, p, _ in leading if name in names), 1.0)


def _refitted(analysis: Analysis, sets: Sequence[FittedSet]) -> list[FittedSet]:
    """The sets with the coefficients that they have under the noise alone."""
    return _fits(analysis.dictionary, [f.members for f in sets], {f.members: f for f in analysis.found})


def _fits(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: dict[tuple[int, ...], FittedSet]
) -> list[FittedSet]:
    """The sets, those fitted that are not among the tried, where they then are."""
    fresh = [s for s in dict.fromkeys(sets) if s not in tried]
    tried.update(zip(fresh, scored(dictionary, fresh, tried), strict=True))
    return [tried[s] for s in sets]


def _empty(analysis: Analysis) -> FittedSet:
    return next(f for f in analysis.found if not f.members)


def _named(analysis: Analysis, found: FittedSet) -> tuple[frozenset[str], tuple[str, ...]]:
    atoms = analysis.atoms
    names = frozenset(atoms[i].name for i in found.members if not atoms[i].is_discrepancy)
    return names, tuple(_driver(analysis, atoms[i].name) for i in found.members if atoms[i].is_discrepancy)


def _driver(analysis: Analysis, name: str) -> str:
    return _leader(analysis, name.removesuffix(ANY)) if name.endswith(ANY) else name


def _leader(analysis: Analysis, kind: str) -> str:
    """Of drivers of one kind the one that explains most alone."""
    atoms = analysis.atoms
    alone = (f for f in analysis.found if len(f.members) == 1)
    names = (atoms[f.members[0]].name for f in alone)
    return next(n for n in names if n.startswith(kind) and not n.endswith(ANY))


def _energy(analysis: Analysis, found: FittedSet, name: str) -> float:
    return sum(e for i, e in zip(found.members, found.energy, strict=True) if analysis.atoms[i].name == name)


def _second_driver(analysis: Analysis, posterior: Posterior, found: FittedSet) -> tuple[str, ...]:
    """What a part of the remainder follows beside the set, where that is more probable than not."""
    dictionary, atoms, size = posterior.dictionary, analysis.atoms, math.sqrt(posterior.variance)
    first = next((atoms[i].name for i in found.members if atoms[i].is_discrepancy), None)
    if first is None:
        return ()
    # All drivers of one kind are one driver.
    kind = first.removesuffix(ANY) if first.endswith(ANY) else None
    own = [n == first or n.endswith(ANY) or (kind is not None and n.startswith(kind)) for n in (a.name for a in atoms)]
    more = [i for i in analysis.outside if not own[i]]
    if not more:
        return ()
    known = _fits(dictionary, [found.members], {f.members: f for f in posterior.found})[0]
    gains = gain_beside(dictionary, known, [analysis.outside[i] / size for i in more], analysis.y / size)
    odds, best = max((gain + atoms[i].log_prior, i) for gain, i in zip(gains, more, strict=True))
    return (atoms[best].name,) if odds > 0 else ()


def _drivers_of_remainder(analysis: Analysis, leading: _Leading, posterior: Posterior) -> tuple[str, ...]:
    """The most probable drivers; where no probable set has any, those of the most probable set with some."""
    likely = next((drivers for _, drivers, _, _ in leading if drivers), None)
    every = (_named(analysis, found)[1] for found in posterior.found)
    return likely or next((drivers for drivers in every if drivers), ())


def _classes(
    analysis: Analysis, posterior: Posterior, chosen: FittedSet, names: frozenset[str]
) -> dict[str, tuple[str, ...]]:
    """For each name of the set those that these rows cannot distinguish from it."""
    atoms, tried = analysis.atoms, {f.members: f for f in posterior.found}
    library = [i for i in posterior.dictionary.groups if not atoms[i].is_discrepancy]
    classes: dict[str, tuple[str, ...]] = {}
    least = _fits(posterior.dictionary, [chosen.members], tried)[0].log_posterior - _ODDS
    for i in chosen.members:
        if atoms[i].is_discrepancy:
            continue
        others = [j for j in library if atoms[j].name not in names]
        sets = [tuple(sorted(j if m == i else m for m in chosen.members)) for j in others]
        like: dict[str, float] = {}
        for j, fit in zip(others, _fits(posterior.dictionary, sets, tried), strict=True):
            if fit.log_posterior > least:
                like[atoms[j].name] = max(fit.log_posterior, like.get(atoms[j].name, -math.inf))
        classes[atoms[i].name] = tuple(sorted(like, key=lambda n: -like[n]))
    return classes


def is_same(members: frozenset[Any], names: frozenset[Any], classes: Mapping[Any, tuple[Any, ...]]) -> bool:
    """Whether a set of names is the verdict's, up to its classes."""
    if len(members) != len(names):
        return False
    left = list(names - members)
    new = members - names
    return all(any(n in classes.get(e, ()) for e in left) for n in new)
