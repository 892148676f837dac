"""Which sets of candidates are probable: all singles and pairs, then a beam to sets of four."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from torch import Tensor

from ccnn_torch.evidence.dictionary import Candidate, Dictionary, FittedSet, dictionary_of, singles_of
from ccnn_torch.evidence.sets import promising

_MOST = 4
# Pairs that go on to sets of three; in a quick search, which ends with pairs, the atoms that these are made of.
_BEAM, _LIKELIEST = 5, 8
# Discrepancy terms that are put beside library effects, how many of these may be of one driver, and how many plain ones
# are put there, too: nearly of the library's own forms, these often do most by themselves and least beside it.
_CATCH_ALLS, _OF_ONE_DRIVER, _PLAIN = 4, 2, 1
# Sets of the same names at other shapes that go on to larger ones.
_ALIKE = 2


def search(
    atoms: Sequence[Candidate],
    x: Sequence[Tensor],
    y: Tensor,
    noise_dof: float,
    quick: bool = False,
    values: float | None = None,
) -> tuple[Dictionary, list[FittedSet]]:
    """Sets by log posterior, best first; no set holds a name twice, or two discrepancy terms.

    Args:
        atoms: candidates.
        x: whitened columns of each, `s x c x m`.
        y: what they explain, whitened, `s x c`.
        noise_dof: as for `fit_sets`.
        quick: whether to look at pairs with the likeliest atoms only, for a start.
        values: how many values are explained, where some of y were not measured and are 0; all when None.
    """
    alone = singles_of(atoms, x, y, noise_dof, values)
    ranked = _ranked(alone.found)
    known = [i for i in ranked if not atoms[i].is_discrepancy]
    others = _of_several_drivers([i for i in ranked if atoms[i].is_discrepancy], atoms)
    firsts = known[:_LIKELIEST] if quick else None
    dictionary = dictionary_of(atoms, x, y, others, alone, noise_dof, firsts)
    return dictionary, probable_sets(dictionary, firsts)


def probable_sets(dictionary: Dictionary, firsts: Sequence[int] | None = None) -> list[FittedSet]:
    """Sets of what the inner products of a dictionary are known for, by log posterior, best first.

    Args:
        dictionary: candidates.
        firsts: atoms of which one is in every set, pairs at most; None = any, sets of up to four.
    """
    atoms, tried = dictionary.atoms, dict(dictionary.alone)
    discrepancies = {i for i in dictionary.groups if atoms[i].is_discrepancy}
    ranked = [i for i in _ranked(dictionary.alone) if i in dictionary.groups]
    known, others = ([i for i in ranked if (i in discrepancies) == wild] for wild in (False, True))
    firsts, most = (known, _MOST) if firsts is None else (firsts, 2)
    seen: set[tuple[int, ...]] = set()

    def fit_all(sets: Sequence[tuple[int, ...]]) -> None:
        fresh = sorted(set(sets) - seen)
        seen.update(fresh)
        # Each kind separately: the best that the library can do is needed, too, however far a discrepancy term is
        # ahead.
        for wild in (False, True):
            mine = [s for s in fresh if discrepancies.isdisjoint(s) != wild]
            top = _top(f for s, f in tried.items() if discrepancies.isdisjoint(s) != wild)
            tried.update((f.members, f) for f in promising(dictionary, mine, top, tried))

    def best(size: int, count: int) -> list[FittedSet]:
        ranked = sorted((f for s, f in tried.items() if len(s) == size), key=lambda f: -f.log_posterior)
        chosen: list[FittedSet] = []
        same: Counter[tuple[str, ...]] = Counter()
        for found in ranked:
            names = tuple(sorted(atoms[i].name for i in found.members))
            same[names] += 1
            chosen += [found] * (same[names] <= _ALIKE)
        return chosen[:count]

    def better(size: int) -> bool:
        """Whether a set of this size beats the smaller ones, among all or among those of the library."""
        return any(
            _top(f for s, f in mine.items() if len(s) == size) > _top(f for s, f in mine.items() if len(s) < size)
            for mine in (tried, {s: f for s, f in tried.items() if discrepancies.isdisjoint(s)})
        )

    fit_all([s for i in firsts for j in (*known, *others) if (s := _extended((i,), j, atoms))])
    for size in range(2, most):
        if not better(size) or (size > 2 and best(size, 1)[0].log_posterior < _top(tried.values())):
            break
        wide = _BEAM if size == 2 else _BEAM // 2
        fit_all([s for f in best(size, wide) for j in (*known, *others) if (s := _extended(f.members, j, atoms))])
    return sorted(tried.values(), key=lambda f: -f.log_posterior)


def _ranked(alone: Mapping[tuple[int, ...], FittedSet]) -> list[int]:
    """Atoms by the log posterior of each alone, best first."""
    singles = sorted((f for s, f in alone.items() if s), key=lambda f: -f.log_posterior)
    return [f.members[0] for f in singles]


def _top(found: Iterable[FittedSet]) -> float:
    return max((f.log_posterior for f in found), default=-math.inf)


def _of_several_drivers(ranked: Sequence[int], atoms: Sequence[Candidate]) -> list[int]:
    """The first few discrepancy terms, no more than some of one driver, and the first of the plain ones."""
    chosen: list[int] = []
    for i in (i for i in ranked if not atoms[i].plain):
        if sum(atoms[k].name == atoms[i].name for k in chosen) < _OF_ONE_DRIVER:
            chosen.append(i)
    return chosen[:_CATCH_ALLS] + [i for i in ranked if atoms[i].plain][:_PLAIN]


def _extended(members: tuple[int, ...], extra: int, atoms: Sequence[Candidate]) -> tuple[int, ...]:
    """The set with one more, in order; () where that would say something twice."""
    if extra in members or atoms[extra].name in {atoms[i].name for i in members}:
        return ()
    if atoms[extra].is_discrepancy and any(atoms[i].is_discrepancy for i in members):
        return ()
    return tuple(sorted((*members, extra)))
