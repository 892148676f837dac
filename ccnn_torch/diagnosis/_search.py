"""Which sets of candidates are probable: all singles and pairs, then a beam to sets of four."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.diagnosis._alone import NOTHING, fit_alone, own_products
from ccnn_torch.diagnosis._atoms import Atom
from ccnn_torch.diagnosis._evidence import Grams, grams_of
from ccnn_torch.diagnosis._joined import Joined, fit_joined

__all__ = ["Dictionary", "Found", "covariance", "scored", "search"]

_MOST = 4
# Updates of a fit; after the short one no set that came within 12 of the best in the end was 85 below it, in trials.
_UPDATES, _SHORT, _HOPELESS = 8, 1, 100.0
# Sets are fitted side by side where their widths differ by less than this.
_ALIKE = 16
# Pairs that go on to sets of three; in a quick search, atoms that pairs are made of.
_BEAM, _LIKELIEST = 5, 8
# Catch-alls that are put beside library effects, and how many of these may be of one driver.
_CATCH_ALLS, _OF_ONE_DRIVER = 4, 2
# A third cause at once is rarer still than a second one.
_CROWD = math.log(0.1)


@dataclass(frozen=True)
class Dictionary:
    """Candidates, and the inner products of those that sets are made of.

    Attributes:
        atoms: all candidates.
        columns: whitened, of the library effects and then of the catch-alls that are put beside them, side by side,
            `s x c x P`; rows that count.
        groups: which of the columns are those of an atom, for the atoms that have such.
        grams: of the columns; NaN between catch-alls, which are in no set together.
        axes: principal axes of the columns of each of these atoms, `m x m`.
        turned: `grams` with every group in its axes.
        alone: no atom, and each by itself.
        noise_dof: as for `fit_sets`.
    """

    atoms: tuple[Atom, ...]
    columns: Tensor
    groups: Mapping[int, Tensor]
    grams: Grams
    axes: Mapping[int, Tensor]
    turned: Grams
    alone: Mapping[tuple[int, ...], Found]
    noise_dof: float


@dataclass(frozen=True)
class Found:
    """A set of atoms with its log posterior (up to a constant), log evidence, and fit.

    `mean` are the coefficients, atom by atom, in units of their plausible sizes, and `log_scale` log α² of each atom's;
    `energy` the squares that each atom's own part makes; `rss` what the set leaves.
    """

    members: tuple[int, ...]
    log_posterior: float
    log_evidence: float
    mean: tuple[Tensor, ...]
    log_scale: tuple[float, ...]
    energy: tuple[float, ...]
    rss: float
    noise: float
    effective: float


def covariance(dictionary: Dictionary, found: Found) -> Tensor:
    """Posterior covariance of the coefficients of a set, atom by atom, in units of their plausible sizes, `m x m`."""
    index = torch.cat([torch.arange(0), *(dictionary.groups[i] for i in found.members)])
    own = [m.new_full((len(m),), s / 2).exp() for m, s in zip(found.mean, found.log_scale, strict=True)]
    scale = torch.cat([dictionary.grams.xy[:0], *own])
    inner = scale[:, None] * dictionary.grams.xx[index][:, index] * scale / found.noise
    inverse: Tensor = torch.linalg.inv(inner + torch.eye(len(inner), dtype=inner.dtype))
    return scale[:, None] * inverse * scale


def scored(dictionary: Dictionary, sets: Sequence[tuple[int, ...]]) -> list[Found]:
    """Fit the sets, those of like widths side by side."""
    found: dict[tuple[int, ...], Found] = {}
    for lot in _lots(dictionary, sets):
        found |= _read(dictionary, lot, _fitted(dictionary, lot, _started(dictionary, lot, {}), _UPDATES))
    return [found[s] for s in sets]


def _promising(
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
    return sorted(members, key=lambda i: (-len(dictionary.groups[i]), i))


def _lots(dictionary: Dictionary, sets: Sequence[tuple[int, ...]]) -> list[list[tuple[int, ...]]]:
    """Sets whose widest groups are about as wide, and the others together as well."""
    lots: dict[tuple[int, int], list[tuple[int, ...]]] = {}
    for members in sets:
        widths = [len(dictionary.groups[i]) for i in members]
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
        widths = [len(dictionary.groups[i]) for i in ordered]
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


def search(
    atoms: Sequence[Atom], x: Sequence[Tensor], y: Tensor, noise_dof: float, quick: bool = False
) -> tuple[Dictionary, list[Found]]:
    """Sets by log posterior, best first; no set holds a name twice, or two catch-alls.

    Args:
        atoms: candidates.
        x: whitened columns of each, `s x c x m`.
        y: what they explain, whitened, `s x c`.
        noise_dof: as for `fit_sets`.
        quick: whether to look at sets of the likeliest atoms only, for a start.
    """
    tried, axes = _singles(atoms, x, y, noise_dof)
    singles = sorted((f for s, f in tried.items() if s), key=lambda f: -f.log_posterior)
    known = [f.members[0] for f in singles if not atoms[f.members[0]].catch_all]
    others = _of_several_drivers([f.members[0] for f in singles if atoms[f.members[0]].catch_all], atoms)
    dictionary = _dictionary(atoms, x, y, others, axes, dict(tried), noise_dof)
    seen: set[tuple[int, ...]] = set()

    def look(sets: Sequence[tuple[int, ...]]) -> None:
        fresh = sorted(set(sets) - seen)
        seen.update(fresh)
        # Each kind by itself: what the library can do at best is asked for, too, however far a catch-all is ahead.
        for wild in (False, True):
            mine = [s for s in fresh if _has_catch_all(s, atoms) == wild]
            top = max(
                (f.log_posterior for s, f in tried.items() if _has_catch_all(s, atoms) == wild), default=-math.inf
            )
            tried.update((f.members, f) for f in _promising(dictionary, mine, top, tried))

    def best(size: int, count: int) -> list[Found]:
        return sorted((f for s, f in tried.items() if len(s) == size), key=lambda f: -f.log_posterior)[:count]

    firsts, beam = (known[:_LIKELIEST], 2) if quick else (known, _BEAM)
    look([s for i in firsts for j in (*known, *others) if (s := _joined((i,), j, atoms))])
    for size in range(2, _MOST):
        candidates = [*known, *others]
        wide = beam if size == 2 else max(2, beam // 2)
        look([s for f in best(size, wide) for j in candidates if (s := _joined(f.members, j, atoms))])
        if best(size + 1, 1) and best(size + 1, 1)[0].log_posterior < max(f.log_posterior for f in tried.values()):
            break
    return dictionary, sorted(tried.values(), key=lambda f: -f.log_posterior)


def _singles(
    atoms: Sequence[Atom], x: Sequence[Tensor], y: Tensor, noise_dof: float
) -> tuple[dict[tuple[int, ...], Found], list[Tensor]]:
    """No atom, and each by itself; and the principal axes of each."""
    products = [NOTHING, *(own_products(columns, y) for columns in x)]
    fits = fit_alone(products, y.square().sum(), float(y.numel()), noise_dof)
    numbers = zip(
        *(v.tolist() for v in (fits.log_evidence, fits.log_scale, fits.energy, fits.rss, fits.noise, fits.effective)),
        strict=True,
    )
    found: dict[tuple[int, ...], Found] = {}
    for k, (mean, (evidence, log_scale, energy, rss, noise, effective)) in enumerate(
        zip(fits.mean, numbers, strict=True)
    ):
        members = (k - 1,) if k else ()
        prior = atoms[k - 1].log_prior if k else 0.0
        found[members] = Found(
            members=members,
            log_posterior=evidence + prior,
            log_evidence=evidence,
            mean=(mean,)[: len(members)],
            log_scale=(log_scale,)[: len(members)],
            energy=(energy,)[: len(members)],
            rss=rss,
            noise=noise,
            effective=effective,
        )
    return found, fits.axes[1:]


def _dictionary(
    atoms: Sequence[Atom],
    x: Sequence[Tensor],
    y: Tensor,
    others: Sequence[int],
    axes: Sequence[Tensor],
    alone: Mapping[tuple[int, ...], Found],
    noise_dof: float,
) -> Dictionary:
    """Of the library effects and the catch-alls `others`."""
    library = [i for i, a in enumerate(atoms) if not a.catch_all]
    columns = torch.cat([y[..., None][..., :0], *(x[i] for i in (*library, *others))], -1)
    ends = torch.tensor([x[i].shape[-1] for i in (*library, *others)], dtype=torch.int64).cumsum(0).tolist()
    groups = {i: torch.arange(e - x[i].shape[-1], e) for i, e in zip((*library, *others), ends, strict=True)}
    grams = grams_of(columns, y)
    wild = torch.tensor([-1] * (ends[len(library) - 1] if library else 0) + [k for k in others for _ in groups[k]])
    apart = (wild[:, None] >= 0) & (wild >= 0) & (wild[:, None] != wild)
    grams = grams._replace(xx=grams.xx.masked_fill_(apart, torch.nan))
    own = {i: axes[i] for i in groups}
    return Dictionary(tuple(atoms), columns, groups, grams, own, _turned(grams, groups, own), alone, noise_dof)


def _turned(grams: Grams, groups: Mapping[int, Tensor], axes: Mapping[int, Tensor]) -> Grams:
    """Every group in its principal axes."""
    xx, xy = torch.empty_like(grams.xx), torch.empty_like(grams.xy)
    for i, group in groups.items():
        place = slice(int(group[0]), int(group[-1]) + 1)
        xx[place], xy[place] = axes[i].mT @ grams.xx[place], axes[i].mT @ grams.xy[place]
    for i, group in groups.items():
        place = slice(int(group[0]), int(group[-1]) + 1)
        xx[:, place] = xx[:, place] @ axes[i]
    return grams._replace(xx=xx, xy=xy)


def _of_several_drivers(ranked: Sequence[int], atoms: Sequence[Atom]) -> list[int]:
    """The first few catch-alls, no more than some of one driver."""
    chosen: list[int] = []
    for i in ranked:
        if sum(atoms[k].name == atoms[i].name for k in chosen) < _OF_ONE_DRIVER:
            chosen.append(i)
    return chosen[:_CATCH_ALLS]


def _joined(members: tuple[int, ...], extra: int, atoms: Sequence[Atom]) -> tuple[int, ...]:
    """The set with one more, in order; () where that would say something twice."""
    if extra in members or atoms[extra].name in {atoms[i].name for i in members}:
        return ()
    if atoms[extra].catch_all and _has_catch_all(members, atoms):
        return ()
    return tuple(sorted((*members, extra)))


def _has_catch_all(members: tuple[int, ...], atoms: Sequence[Atom]) -> bool:
    return any(atoms[i].catch_all for i in members)
