"""The verdict on a posterior over sets of causes: names, classes, probability, outside the library or not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

S = TypeVar("S")

ODDS = 20.0
"""Odds up to which the data do not distinguish one name from another."""
NAMED = 0.9
"""Probability from which a member of the most probable set is named, where the set without it was found, too."""
OUTSIDE = 0.5
"""Probability above which something is said to be outside the library."""
BESIDE_UNKNOWN = 0.6
"""Probability of a verdict that names effects beside a cause outside the library, which can look like a part of any
effect, and of one that knows of such a cause only by what is left: at most."""


@dataclass(frozen=True)
class Explanation(Generic[S]):
    """Sets that say the same.

    Attributes:
        names: library effects.
        drivers: what a discrepancy term of theirs follows; () = they have none.
        probability: of all of them.
        best: the most probable one.
    """

    names: frozenset[Any]
    drivers: tuple[str, ...]
    probability: float
    best: S


@dataclass(frozen=True)
class Verdict(Generic[S]):
    """What a posterior says.

    Attributes:
        chosen: the explanation whose names are the verdict's.
        classes: for each name those that cannot be distinguished from it, the most probable first.
        probability: that the verdict, classes taken as one, is right.
        outside: whether something is there that no library effect describes.
        drivers: what that follows; () where no probable set tells.
    """

    chosen: Explanation[S]
    classes: Mapping[Any, tuple[Any, ...]]
    probability: float
    outside: bool
    drivers: tuple[str, ...]


def posterior(
    levels: Iterable[tuple[float, Sequence[tuple[frozenset[Any], tuple[str, ...], float, S]]]],
) -> list[Explanation[S]]:
    """Explanations, most probable first.

    Args:
        levels: the probability of each level of the form error, and its sets: names, drivers, log posterior up to a
            constant of the level, and the set itself.
    """
    shares: dict[tuple[frozenset[Any], tuple[str, ...]], list[tuple[float, S]]] = {}
    for weight, sets in levels:
        top = max(log_posterior for *_, log_posterior, _ in sets)
        total = math.fsum(math.exp(log_posterior - top) for *_, log_posterior, _ in sets)
        for names, drivers, log_posterior, own in sets:
            shares.setdefault((names, drivers), []).append((weight * math.exp(log_posterior - top) / total, own))
    explanations = [
        Explanation(*key, sum(share for share, _ in own), max(own, key=lambda one: one[0])[1])
        for key, own in shares.items()
    ]
    return sorted(explanations, key=lambda e: -e.probability)


def judge(
    explanations: Sequence[Explanation[S]],
    every: Sequence[Explanation[S]],
    rest_of: Callable[[Explanation[S]], tuple[str, ...] | None] = lambda _: None,
    of_classes: bool = False,
) -> Verdict[S]:
    """The verdict.

    Args:
        explanations: of `posterior`; one of them has no driver.
        every: the same with those that are no candidates for a verdict, but can be mistaken for one.
        rest_of: what the remainder of an explanation's set follows, () = nothing known; None = it is noise.
        of_classes: whether a name stays that is only sure as one of its class, unless the set without it is probable:
            where names have few forms. Where they have many, the class holds what corrects the form of another name.
    """
    unknown = sum(e.probability for e in explanations if e.drivers)
    outside = unknown > OUTSIDE
    chosen = next(e for e in explanations if bool(e.drivers) == outside)
    likely, classes = chosen, {} if outside else classes_of(every, chosen.names)
    like = classes if of_classes else {}
    sure = frozenset(n for n in likely.names if marginal(explanations, n, *like.get(n, ())) >= NAMED)
    fewer = next((e for e in explanations if e.names == sure and bool(e.drivers) == outside), chosen)
    if (sure or outside) and (not of_classes or fewer.probability * ODDS > chosen.probability):
        chosen, classes = fewer, {} if outside else classes_of(every, fewer.names)
    drivers = chosen.drivers
    if outside:
        most = BESIDE_UNKNOWN if chosen.names else 1.0
        return Verdict(chosen, classes, min(unknown, most), outside, drivers)
    # What names that are likely but not sure take away is no rest that the library lacks.
    if (rest := rest_of(chosen)) is not None and (likely is chosen or rest_of(likely) is not None):
        # A set with a discrepancy term that leaves noise goes before one that does not. What is not sure beside such a
        # term, or only sure as one of a class, is not named: the unknown cause can look like all of it.
        beside = [e for e in explanations if e.drivers]
        fits = next((e for e in beside if rest_of(e) is None), None)
        told, given = (fits, beside) if fits else (chosen, explanations)
        least = NAMED * sum(e.probability for e in given)
        certain = frozenset(n for n in told.names if marginal(given, n) >= least)
        others = ([fits] if fits else []) + [*beside, *explanations]
        other = next((e for e in others if e.names == certain), told)
        return Verdict(other, {}, BESIDE_UNKNOWN, True, other.drivers or rest)
    inside = [e for e in explanations if not e.drivers]
    same = sum(e.probability for e in inside if is_same(e.names, chosen.names, classes))
    if chosen.names < likely.names:
        # Further effects usually correct the form of those that are named: their sets support the verdict.
        same = min(same + sum(e.probability for e in inside if chosen.names < e.names), NAMED)
    return Verdict(chosen, classes, min(same, 1.0), False, ())


def marginal(explanations: Sequence[Explanation[Any]], *names: Any) -> float:
    """Probability that one of these names is in the set that is right."""
    return min(sum(e.probability for e in explanations if not e.names.isdisjoint(names)), 1.0)


def is_same(members: frozenset[Any], names: frozenset[Any], classes: Mapping[Any, tuple[Any, ...]]) -> bool:
    """Whether a set of names is the verdict's, up to its classes."""
    if len(members) != len(names):
        return False
    left = list(names - members)
    return all(any(n in classes.get(e, ()) for e in left) for n in members - names)


def classes_of(every: Sequence[Explanation[S]], chosen: frozenset[Any]) -> dict[Any, tuple[Any, ...]]:
    """For each name those that can stand in its place, the others staying, the most probable first."""
    inside = {e.names: e.probability for e in every if not e.drivers}
    own = inside.get(chosen, 0.0)
    alike = [names for names, probability in inside.items() if probability * ODDS > own]
    found = {}
    for name in chosen:
        rest = chosen - {name}
        others = (names - rest for names in alike if rest <= names and name not in names)
        found[name] = tuple(next(iter(other)) for other in others if len(other) == 1)
    return found
