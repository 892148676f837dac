"""From the posterior over sets to a name that can be stood by: outside or not, classes, probabilities."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ccnn_torch.diagnosis._analysis import Analysis
from ccnn_torch.diagnosis._search import Found, scored

__all__ = ["Judgement", "judge"]

# A catch-all beside library effects below this share of their energy is how the form of a real effect differs from the
# textbook, not a cause of its own.
_FORM = 0.06
# Remainder above that of the richest fit, as a share of the gap's energy, beyond which no library name is stood by.
_VETO = 0.02
# Odds up to which one name for another is not told apart by the data.
_ODDS = math.log(20.0)
# What is claimed grows slower than what the evidence says: its models are not the truth.
_TEMPER = 1.0


@dataclass(frozen=True)
class Judgement:
    """What is stood by.

    Attributes:
        found: the set that speaks for the verdict.
        names: library effects, the favourite of each class.
        classes: for each of them the names that cannot be told from it.
        probability: that the verdict, classes taken as one, is right.
        outside: whether something is there that no library effect describes; `driver` says what it follows.
        driver: of the catch-all, or None.
        marginal: probability of each candidate's name.
        leading: name sets by probability, most probable first (library names, driver or None, probability, set).
    """

    found: Found
    names: tuple[str, ...]
    classes: dict[str, tuple[str, ...]]
    probability: float
    outside: bool
    driver: str | None
    marginal: dict[str, float]
    leading: list[tuple[frozenset[str], str | None, float, Found]]


def judge(analysis: Analysis) -> Judgement:
    """Weigh the sets that the search has found."""
    groups: dict[tuple[frozenset[str], str | None], list[Found]] = {}
    for found in analysis.found:
        groups.setdefault(_named(analysis, found), []).append(found)
    top = analysis.found[0].log_posterior
    weights = {key: math.exp(_TEMPER * (max(f.log_posterior for f in fs) - top)) for key, fs in groups.items()}
    total = sum(weights.values())
    leading = sorted(
        ((k[0], k[1], w / total, groups[k][0]) for k, w in weights.items()), key=lambda x: -x[2]
    )
    names, driver, probability, found = leading[0]
    outside = driver is not None
    if not outside and _unexplained(analysis, found):
        outside = True
        driver = _driver_of_remainder(analysis)
    marginal: dict[str, float] = {a.name: 0.0 for a in analysis.library.atoms if not a.catch_all}
    for members, _, p, _ in leading:
        for name in members:
            marginal[name] += p
    classes = {} if outside else _classes(analysis, found, names)
    if not outside:
        same = [
            p for members, drive, p, _ in leading if drive is None and _equals(members, names, classes)
        ]
        probability = sum(same)
    else:
        probability = sum(p for _, drive, p, _ in leading if drive is not None) if leading[0][1] is not None else 0.5
    ordered = tuple(sorted(names, key=lambda n: -_energy(analysis, found, n)))
    return Judgement(found, ordered, classes, min(probability, 1.0), outside, driver, marginal, leading)


def _named(analysis: Analysis, found: Found) -> tuple[frozenset[str], str | None]:
    atoms = analysis.library.atoms
    names = frozenset(atoms[i].name for i in found.members if not atoms[i].catch_all)
    energy = sum(e for i, e in zip(found.members, found.energy, strict=True) if not atoms[i].catch_all)
    for i, e in zip(found.members, found.energy, strict=True):
        if atoms[i].catch_all and not (names and e < _FORM * energy):
            return names, atoms[i].name
    return names, None


def _energy(analysis: Analysis, found: Found, name: str) -> float:
    return sum(
        e for i, e in zip(found.members, found.energy, strict=True) if analysis.library.atoms[i].name == name
    )


def _unexplained(analysis: Analysis, found: Found) -> bool:
    """Whether what a set leaves is clearly more than the noise (given, or of the richest fit)."""
    count = analysis.library.grams.count
    left = found.rss / max(count - found.effective, 1.0)
    floor = analysis.floor
    significant = left > floor * (1 + 5 * math.sqrt(2 / count))
    gap = float(analysis.library.grams.yy) / count
    return significant and left - floor > _VETO * max(gap - floor, 0.0) and left > 1.5 * floor


def _driver_of_remainder(analysis: Analysis) -> str | None:
    """The driver of the most probable set that has one."""
    for found in analysis.found:
        driver = _named(analysis, found)[1]
        if driver is not None:
            return driver
    return None


def _classes(analysis: Analysis, found: Found, names: frozenset[str]) -> dict[str, tuple[str, ...]]:
    """For each name of the set those that can stand in its place, as far as these rows can tell."""
    atoms = analysis.library.atoms
    library = [i for i, a in enumerate(atoms) if not a.catch_all]
    classes: dict[str, tuple[str, ...]] = {}
    for i in found.members:
        if atoms[i].catch_all:
            continue
        others = [j for j in library if atoms[j].name not in names]
        sets = [tuple(sorted(j if m == i else m for m in found.members)) for j in others]
        trials = scored(analysis.library, sets)
        like = {
            atoms[j].name: t.log_posterior
            for j, t in zip(others, trials, strict=True)
            if t.log_posterior > found.log_posterior - _ODDS
        }
        classes[atoms[i].name] = tuple(sorted(like, key=lambda n: -like[n]))
    return classes


def _equals(members: frozenset[str], names: frozenset[str], classes: dict[str, tuple[str, ...]]) -> bool:
    """Whether a set of names is the verdict's, up to its classes."""
    if len(members) != len(names):
        return False
    left = list(names - members)
    new = members - names
    return all(any(n in classes.get(e, ()) for e in left) for n in new)
