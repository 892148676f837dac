"""Whether it is worth searching again about the best set, and which shapes to search again."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.residual.whitening import Whitening
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet
from ccnn_torch.evidence.sets import subsets_with_one_less

# Share of the gap's energy that goes with effects that were added and not without them, below which they are no reason
# to search again: they correct the form of the others.
_ADDED = 0.004
# A fit is settled where the noise of the channels changed among each other by less than this (logarithm), and what it
# leaves by such a share of the noise's square.
_SAME_NOISE, _SAME_FIT = 0.2, 0.01
# An effect is inactive where the sets that it takes part in are so far behind the best (log odds), and by such a
# share of what the best explains: shapes found beside something else may be that much worse.
_BEHIND, _SHARE = 20.0, 0.05


def is_converged(dictionary: Dictionary, best: FittedSet, old: Whitening, new: Whitening, left: Tensor) -> bool:
    """Whether the channels' noise is in the same proportion as before, and what the best set leaves of every row by the
    machine itself is what the linear model says.

    Args:
        dictionary: candidates.
        best: the set.
        old, new: noise and weights then, and with what the fits leave.
        left: what the set leaves by the machine itself, `s x c0` [m, rad].
    """
    change = (new.sigma / old.sigma).log()
    if float((change - change.mean()).abs().max()) > _SAME_NOISE:
        return False
    linear = dictionary.y
    for i, mean in zip(best.members, best.mean, strict=True):
        linear = linear - dictionary.columns[..., dictionary.groups[i]] @ mean
    return float((old(torch.nan_to_num(left))[old.keep()] - linear).square().mean()) < _SAME_FIT


def has_new_effects(
    dictionary: Dictionary, found: Sequence[FittedSet], best: FittedSet, before: Set[str], gap: float
) -> bool:
    """Whether effects joined the set since the last search that do more than correct the form of the others.

    Those that fell away do not matter: shapes found beside more than there is are as good, where what was too much
    explains nothing any more.

    Args:
        dictionary: candidates.
        found: sets that were tried.
        best: the set.
        before: names of the effects that acted in the last search.
        gap: squares above the noise.
    """
    old = tuple(i for i in best.members if dictionary.atoms[i].name in before)
    if old == best.members:
        return False
    without = next((f for f in found if f.members == old), None)
    return without is None or without.rss - best.rss > _ADDED * gap


def discrepancy_is_active(dictionary: Dictionary, found: Sequence[FittedSet], best: FittedSet) -> bool:
    """Whether a discrepancy term does something beside a set that is not far behind the best one of the library.

    Args:
        dictionary: candidates.
        found: sets that were tried.
        best: the most probable one of the library.
    """
    tried = {f.members: f.log_posterior for f in found}
    for one in found:
        bare = tuple(i for i in one.members if not dictionary.atoms[i].is_discrepancy)
        if bare != one.members and one.log_posterior > max(best.log_posterior - _BEHIND, tried.get(bare, math.inf)):
            return True
    return False


def most_probable_shapes(atoms: Sequence[Atom], found: Sequence[FittedSet]) -> dict[str, Atom]:
    """The atom of every effect that has shapes, by name, in the most probable set that is less so without it.

    Beside a set that is as probable without it an effect has what suits the noise: that counts only where it takes part
    in no set.

    Args:
        atoms: candidates.
        found: sets that were tried, most probable first.
    """
    tried = {f.members: f.log_posterior for f in found}
    parts = [(f, i, other) for f in found for i, other in zip(f.members, subsets_with_one_less(f.members), strict=True)]
    takes_part = [i for f, i, other in parts if f.log_posterior > tried.get(other, math.inf)]
    first: dict[str, Atom] = {}
    for atom in (atoms[i] for i in (*takes_part, *(i for _, i, _ in parts))):
        if atom.effect is not None and atom.shape.numel():
            first.setdefault(atom.name, atom)
    return first


def known_shapes(
    atoms: Sequence[Atom], found: Sequence[FittedSet], best: FittedSet, sought: Set[str] | None
) -> dict[str, list[Atom]]:
    """Effects whose shapes are not searched again, by name, with the atoms whose shapes they keep: those inactive
    with the most probable one, those active with all that they have.

    Args:
        atoms: candidates.
        found: sets that were tried, most probable first.
        best: the most probable one of the library, whose effects are active.
        sought: names whose shapes are searched again; None = of all that are active.
    """
    tried = {f.members: f.log_posterior for f in found}
    least = best.log_posterior - _BEHIND - _SHARE * max(best.log_posterior - tried[()], 0.0)
    likely = most_probable_shapes(atoms, found)
    in_play = {atoms[i].name for i in best.members}
    for one in found:
        for i, others in zip(one.members, subsets_with_one_less(one.members), strict=True):
            # Beside a set that is as probable without it an effect takes no part.
            if one.log_posterior > max(least, tried.get(others, math.inf)):
                in_play.add(atoms[i].name)
    every = {name: [a for a in atoms if a.effect is atom.effect] for name, atom in likely.items()}
    known = {name: every[name] if name in in_play else [atom] for name, atom in likely.items()}
    return {name: shapes for name, shapes in known.items() if name not in (in_play if sought is None else sought)}
