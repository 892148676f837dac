"""The verdict on rows: which names, and what the rest follows."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from ccnn_torch.diagnosis.discrepancy.smooth import ANY, joint_moves
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.remainder import rest_of
from ccnn_torch.effects import EFFECTS, pose_residual
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet, gain_beside
from ccnn_torch.evidence.form_error import Posterior, with_form_error
from ccnn_torch.evidence.judge import ODDS, Explanation, Verdict, classes_of, judge, marginal, posterior
from ccnn_torch.evidence.sets import scored, subsets_with_one_less

# Log odds against the most probable set beyond which sets are not considered.
_FAR = 12.0
# Share of an effect's own squares that must not be borrowed from what other effects do.
_OWN = 0.1
# Or that must come from other coefficients than those that mend its form, where these are so many times as large, in
# plausible sizes.
_MAIN, _MENDED = 0.5, 15.0
# Plausible sizes that no cause has on a machine of usual quality: sealed machines whose gap was 30 times the noise had
# up to 185; a unit mistaken makes 1000.
_IMPLAUSIBLE = 250.0
# What a set does in a direction, against what it does in its strongest one, below which that is of second order.
_SECOND_ORDER = 1e-4
# Rank correlation with the time from which a joint was moved one way while the rows were measured.
_ONE_WAY = 0.9
_OF_TIME = frozenset({"drift", "frame_drift"})


@dataclass(frozen=True)
class Judgement:
    """The verdict on the names.

    Attributes:
        found: the set that represents the verdict.
        acting: its effects without discrepancy terms, fitted without these: a machine with their numbers is the nearest
            one that the names can be, and the one that rows outside the fit have judged.
        fullest: the most probable set that has the members of `acting` and more, whose coefficients are told; `acting`
            itself where there is none, or something is outside.
        names: library effects, the favourite of each class.
        classes: for each of them the names that cannot be distinguished from it.
        probability: that the verdict, classes taken as one, is right.
        outside: whether something is there that no library effect describes; `drivers` says what it follows.
        drivers: of the discrepancy terms, the one that does most first.
        marginal: probability of each candidate's name.
        leading: explanations, most probable first.
    """

    found: FittedSet
    acting: FittedSet
    fullest: FittedSet
    names: tuple[str, ...]
    classes: Mapping[str, tuple[str, ...]]
    probability: float
    outside: bool
    drivers: tuple[str, ...]
    marginal: dict[str, float]
    leading: list[Explanation[FittedSet]]


def judge_rows(analysis: Analysis) -> Judgement:
    """Weigh the sets that the search has found."""
    dictionary, sets = analysis.dictionary, analysis.found
    levels = with_form_error(dictionary, sets[0], analysis.floor, analysis.noise_is_known)
    usual, every = levels[0], _explanations(analysis, levels)
    leading = every
    # Effects that are supported by aliased coefficients alone are no candidates: sets of the others are searched anew,
    # since larger ones were looked for beside them only.
    while borrowed := borrowed_names(analysis, usual, leading[0].best):
        left = {i: g for i, g in dictionary.groups.items() if analysis.atoms[i].name not in borrowed}
        dictionary = replace(dictionary, groups=left)
        sets = [f for f in sets if not borrowed & _named(analysis, f)[0]]
        levels = with_form_error(dictionary, sets[0], analysis.floor, analysis.noise_is_known)
        usual, leading = levels[0], _explanations(analysis, levels)
    refitted = _fits(analysis.dictionary, [e.best.members for e in leading], {f.members: f for f in analysis.found})
    leading = [replace(e, best=fit) for e, fit in zip(leading, refitted, strict=True)]

    def fitted(explanation: Explanation[FittedSet]) -> FittedSet:
        """Of the shapes that form errors do not tell apart those that fit best."""
        same = (f for f in sets if _named(analysis, f) == (explanation.names, explanation.drivers))
        return max([explanation.best, *same], key=lambda f: f.log_posterior)

    verdict = judge(leading, every, lambda e: rest_of(analysis, fitted(e)))
    verdict = in_order_of_library(analysis, verdict, leading, every)
    names, found, drivers = verdict.chosen.names, fitted(verdict.chosen), verdict.drivers
    if verdict.outside:
        drivers = drivers or next((d for f in usual.found if (d := _named(analysis, f)[1])), ())
        drivers += _second_driver(analysis, usual, found)
        drivers = _time_first(analysis, drivers, leading)
    # The coefficients of effects that cannot be distinguished are not identifiable together, nor those of an effect
    # that does nothing that the others cannot do.
    alike = {name for some in verdict.classes.values() for name in some} - names
    more = sorted(
        (
            f
            for f in sets
            if found.members and set(found.members) <= set(f.members) and not alike & _named(analysis, f)[0]
        ),
        key=lambda f: -f.log_posterior,
    )
    acting = found
    if verdict.outside:
        effects = tuple(i for i in found.members if not analysis.atoms[i].is_discrepancy)
        acting = _fits(analysis.dictionary, [effects], {f.members: f for f in analysis.found})[0]
    return Judgement(
        found=found,
        acting=acting,
        fullest=acting
        if verdict.outside
        else next((f for f in more if f is found or _is_least(analysis, f.members)), found),
        names=tuple(sorted(names, key=lambda n: -_energy(analysis, found, n))),
        classes=verdict.classes,
        probability=verdict.probability,
        outside=verdict.outside,
        drivers=drivers,
        marginal={a.name: marginal(leading, a.name) for a in analysis.atoms if not a.is_discrepancy},
        leading=leading,
    )


def _rank(analysis: Analysis, members: Iterable[int]) -> int:
    """How many directions of the rows a set of effects can move."""
    flat, groups = analysis.dictionary.columns.flatten(0, 1), analysis.dictionary.groups
    chosen = [flat[:, groups[i]] for i in members]
    if not chosen:
        return 0
    sizes = torch.linalg.svdvals(torch.cat(chosen, -1))
    return int((sizes > _SECOND_ORDER * sizes[0]).sum())


def _is_least(analysis: Analysis, members: tuple[int, ...]) -> bool:
    """Whether each effect of a set can do something that the others cannot."""
    whole = _rank(analysis, members)
    return all(_rank(analysis, fewer) < whole for fewer in subsets_with_one_less(members))


def in_order_of_library(
    analysis: Analysis,
    verdict: Verdict[FittedSet],
    explanations: Sequence[Explanation[FittedSet]],
    every: Sequence[Explanation[FittedSet]],
) -> Verdict[FittedSet]:
    """The verdict by other names that do the very same on these rows, where the library lists those first.

    On axes that slide, scale and shear of a device are lead and squareness of the axes. Nothing changes where a name of
    the verdict adds nothing to what the others can do: only its size speaks for it then, unless fewer names do.
    """
    order, chosen = [*EFFECTS], verdict.chosen
    inside, own = [e for e in explanations if not e.drivers], chosen.best.members

    def is_same(e: Explanation[FittedSet]) -> bool:
        ranks = (_rank(analysis, members) for members in (e.best.members, own, {*e.best.members, *own}))
        return len(set(ranks)) == 1

    def place(names: frozenset[str]) -> int:
        return max((order.index(n) if n in order else len(order) for n in names), default=-1)

    def is_before(e: Explanation[FittedSet]) -> bool:
        return -1 < place(e.names - chosen.names) < place(chosen.names - e.names)

    if verdict.outside or not any(map(is_before, inside)):
        return verdict
    if not _is_least(analysis, own):
        inside = [e for e in inside if len(e.names) < len(chosen.names)]
    if not inside:
        return verdict
    # Where the data ask for implausible sizes, these tell apart what the columns do not.
    least = chosen.best.log_evidence - math.log(ODDS)
    same = [e for e in inside if e.best.log_evidence > least and is_same(e)]
    told = min(
        (e for e in same if is_before(e) and _is_least(analysis, e.best.members)),
        key=lambda e: place(e.names),
        default=None,
    )
    if told is None:
        return verdict
    probability = max(verdict.probability, min(sum(e.probability for e in same), 1.0))
    return replace(verdict, chosen=told, classes=classes_of(every, told.names), probability=probability)


def _time_first(
    analysis: Analysis, drivers: tuple[str, ...], explanations: Sequence[Explanation[FittedSet]]
) -> tuple[str, ...]:
    """Time before a joint that was moved one way while the rows were measured, where both explain what is left."""
    situation, first = analysis.situation, next(iter(drivers), "")
    joint = next((i for i, j in enumerate(situation.mechanism.joints) if first == f"joint {j.name}"), None)
    if joint is None or "time" not in situation.covariates:
        return drivers
    ranks = torch.stack(
        [v.argsort().argsort().double() for v in (situation.covariates["time"], situation.joints[:, joint])]
    )
    own = max((e.probability for e in explanations if first in e.drivers), default=1.0)
    by_time = (e for e in explanations if "time" in e.drivers or e.names & _OF_TIME)
    if abs(float(torch.corrcoef(ranks)[0, 1])) < _ONE_WAY or all(e.probability * ODDS < own for e in by_time):
        return drivers
    return ("time", *(d for d in drivers if d != "time"))


def without_names(analysis: Analysis, judgement: Judgement) -> Judgement:
    """None in the place of names that are not likely and that no row outside the fit shows."""
    empty = next(f for f in analysis.found if not f.members)
    return replace(judgement, found=empty, acting=empty, fullest=empty, names=(), classes={}, probability=0.5)


def _explanations(analysis: Analysis, levels: Sequence[Posterior]) -> list[Explanation[FittedSet]]:
    """Of the sets at each level of the form error."""

    def probable(found: Sequence[FittedSet]) -> Iterator[tuple[frozenset[str], tuple[str, ...], float, FittedSet]]:
        """Of the sets that say the same the most probable one: a search of shapes has charged the others."""
        seen = set()
        for one in found:
            key = _named(analysis, one)
            if key not in seen and one.log_posterior > found[0].log_posterior - _FAR:
                seen.add(key)
                yield *key, one.log_posterior, one

    return posterior((level.weight, [*probable(level.found)]) for level in levels)


def _fits(
    dictionary: Dictionary, sets: Sequence[tuple[int, ...]], tried: dict[tuple[int, ...], FittedSet]
) -> list[FittedSet]:
    """The sets, those fitted that are not among the tried."""
    fresh = [s for s in dict.fromkeys(sets) if s not in tried]
    tried = tried | dict(zip(fresh, scored(dictionary, fresh, tried), strict=True))
    return [tried[s] for s in sets]


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
    more = [i for i, atom in enumerate(atoms) if atom.is_discrepancy and not own[i]]
    if not more:
        return ()
    known = _fits(dictionary, [found.members], {f.members: f for f in posterior.found})[0]
    columns = analysis.whitened(atoms[i].columns for i in more)
    gains = gain_beside(dictionary, known, [c / size for c in columns])
    odds, best = max((gain + atoms[i].log_prior, i) for gain, i in zip(gains, more, strict=True))
    return (atoms[best].name,) if odds > 0 else ()


def borrowed_names(analysis: Analysis, posterior: Posterior, found: FittedSet) -> frozenset[str]:
    """Names of a set that rest on what other effects do as well, or on what should only correct their form, or that
    would be of a size beside others that no cause has."""
    dictionary, names, most = posterior.dictionary, set(), implausible_size(analysis)
    for i, mean in zip(found.members, found.mean, strict=True):
        atom, group = analysis.atoms[i], dictionary.groups[i]
        if atom.is_discrepancy:
            continue
        coefficients = atom.coefficients(analysis.situation)
        main_sizes = [abs(float(v)) for c, v in zip(coefficients, mean, strict=True) if not c.secondary]
        if len(found.members) > 1 and max(main_sizes, default=0.0) > most:
            names.add(atom.name)
            continue
        if not any(c.borrowed or c.mends for c in coefficients):
            continue
        borrowed, corrections = (
            torch.tensor(flags, dtype=torch.bool)
            for flags in zip(*((c.borrowed, c.mends) for c in coefficients), strict=True)
        )
        gram = dictionary.grams.xx[group][:, group]
        parts = (mean * ~borrowed, mean * ~corrections, mean)
        alone, main, whole = (float(m @ gram @ m) for m in parts)
        largest, mended = (float((mean * kind).abs().max()) for kind in (~corrections, corrections))
        if alone < _OWN * whole or (main < _MAIN * whole and mended > _MENDED * largest):
            names.add(atom.name)
    return frozenset(names)


def implausible_size(analysis: Analysis) -> float:
    """Size beyond which no cause is believed, in plausible sizes: the more, the worse the machine is as a whole.

    A machine's scale is the root mean square of its gap over that of what its joints make when each of them is off by
    as much as is to be expected; at least 1.
    """
    white, situation = analysis.whitening, analysis.situation
    rows, channels = white.keep(), white.channels[white.lengths if bool(white.lengths.any()) else ~white.lengths]
    gap = pose_residual(situation, analysis.measured)[rows][:, channels].square().mean()
    usual = joint_moves(situation, situation.jacobian)[rows][:, channels].square().sum(-1).mean()
    return _IMPLAUSIBLE * max(1.0, float((gap / usual.clamp_min(1e-300)).sqrt()))
