"""Which sets of candidates are probable: all singles and pairs, then a beam to sets of four."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.diagnosis._atoms import Atom
from ccnn_torch.diagnosis._evidence import Grams, fit_sets, of_like_width

__all__ = ["Dictionary", "Found", "scored", "search"]

_MOST = 4
# A third cause at once is rarer still than a second one.
_CROWD = math.log(0.1)


@dataclass(frozen=True)
class Dictionary:
    """Atoms with their columns side by side: `groups[i]` are the columns of atom i in `grams`."""

    atoms: tuple[Atom, ...]
    groups: tuple[Tensor, ...]
    grams: Grams
    noise_dof: float


@dataclass(frozen=True)
class Found:
    """A set of atoms with its log posterior (up to a constant), log evidence, and fit.

    `mean` are the coefficients, atom by atom, in units of their plausible sizes; `energy` the squares that each atom's
    own part makes; `rss` what the set leaves.
    """

    members: tuple[int, ...]
    log_posterior: float
    log_evidence: float
    mean: tuple[Tensor, ...]
    covariance: Tensor
    energy: tuple[float, ...]
    rss: float
    noise: float
    effective: float


def scored(dictionary: Dictionary, sets: Sequence[tuple[int, ...]], iterations: int = 8) -> list[Found]:
    """Fit the sets, those of like width side by side."""
    groups = [[dictionary.groups[i] for i in s] for s in sets]
    found: dict[int, Found] = {}
    for members in of_like_width(groups):
        fits = fit_sets(dictionary.grams, [groups[k] for k in members], dictionary.noise_dof, iterations)
        for row, k in enumerate(members):
            prior = sum(dictionary.atoms[i].log_prior for i in sets[k]) + _CROWD * max(len(sets[k]) - 2, 0)
            evidence = float(fits.log_evidence[row])
            evidence = evidence if math.isfinite(evidence) else -math.inf
            sizes = [len(dictionary.groups[i]) for i in sets[k]]
            mean = fits.mean[row, : sum(sizes)]
            found[k] = Found(
                members=tuple(sets[k]),
                log_posterior=evidence + prior,
                log_evidence=evidence,
                mean=torch.split(mean, sizes) if sizes else (),
                covariance=fits.covariance[row, : sum(sizes), : sum(sizes)],
                energy=tuple(float(e) for e in fits.energy[row, : len(sizes)]),
                rss=float(fits.rss[row]),
                noise=float(fits.noise[row]),
                effective=float(fits.effective[row]),
            )
    return [found[k] for k in range(len(sets))]


def search(dictionary: Dictionary, beam: int = 5) -> list[Found]:
    """Sets by log posterior, best first; no set holds a name twice, or two catch-alls."""
    atoms = dictionary.atoms
    tried: dict[tuple[int, ...], Found] = {}

    def look(sets: Sequence[tuple[int, ...]]) -> None:
        fresh = sorted({s for s in sets if s not in tried})
        tried.update(zip(fresh, scored(dictionary, fresh), strict=True))

    def best(size: int, count: int) -> list[Found]:
        return sorted((f for s, f in tried.items() if len(s) == size), key=lambda f: -f.log_posterior)[:count]

    look([(), *((i,) for i in range(len(atoms)))])
    singles = best(1, len(atoms))
    known = [f.members[0] for f in singles if not atoms[f.members[0]].catch_all]
    others = [f.members[0] for f in singles if atoms[f.members[0]].catch_all][:4]
    look([s for i in known for j in (*known, *others) if (s := _joined((i,), j, atoms))])
    for size in range(2, _MOST):
        candidates = [*known, *others]
        wide = beam if size == 2 else max(2, beam // 2)
        look([s for f in best(size, wide) for j in candidates if (s := _joined(f.members, j, atoms))])
        if best(size + 1, 1) and best(size + 1, 1)[0].log_posterior < max(f.log_posterior for f in tried.values()):
            break
    return sorted(tried.values(), key=lambda f: -f.log_posterior)


def _joined(members: tuple[int, ...], extra: int, atoms: Sequence[Atom]) -> tuple[int, ...]:
    """The set with one more, in order; () where that would say something twice."""
    if extra in members or atoms[extra].name in {atoms[i].name for i in members}:
        return ()
    if atoms[extra].catch_all and any(atoms[i].catch_all for i in members):
        return ()
    return tuple(sorted((*members, extra)))
