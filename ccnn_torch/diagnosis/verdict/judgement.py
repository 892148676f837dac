"""From the posterior over sets to the verdict: names, classes, probability, outside or not."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.discrepancy.smooth import ANY
from ccnn_torch.diagnosis.evidence.dictionary import FittedSet
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.essential import (
    FORM_DISCREPANCY,
    FORM_EXACT,
    above_noise,
    essential,
    fits,
    is_exact,
    is_known,
    smallest,
    unexplained,
)
from ccnn_torch.diagnosis.verdict.plausible import implausible_size

__all__ = ["Judgement", "judge", "without_names"]

# What a claim is worth where a name carries less than this share of the gap, or where there are three names or more:
# the textbook forms of effects are too rough to be surer.
_SMALL, _UNSURE = 0.1, 0.85
# A name is not claimed more surely than this where it could as well take over another candidate's typical part of the
# gap, all but so many squares in units of the noise: then it could take over what the library does not know, too.
_MIMIC, _MIMICKED = 0.9, 60.0
# Share of an effect's own squares that must not be borrowed from what other effects do, and of what may be doubtful.
_OWN, _DOUBTED = 0.1, 0.5
# Or that must come from other coefficients than those that mend its form, where these are so many times as large, in
# plausible sizes.
_MAIN, _MENDED = 0.5, 15.0
# Share of the gap that the best explanation must account for; below it no name is given.
_LEAST_EXPLAINED = 0.5
# Log odds that a cause of another form may lose for its sizes.
_FAR_FETCHED = 20.0
# Odds up to which the data do not distinguish one name from another.
_ODDS = math.log(20.0)
# Log odds against the most probable set beyond which sets are not considered.
_FAR = 12.0


@dataclass(frozen=True)
class Judgement:
    """The verdict on the names.

    Attributes:
        found: the set that represents the verdict.
        fullest: the most probable set with the same members and with what corrects their form, whose coefficients are
            told; `found` itself where it has no corrections.
        names: library effects, the favourite of each class.
        classes: for each of them the names that cannot be distinguished from it.
        probability: that the verdict, classes taken as one, is right.
        outside: whether something is there that no library effect describes; `driver` says what it follows.
        driver: of the discrepancy term, or None.
        marginal: probability of each candidate's name.
        leading: name sets by probability, most probable first (library names, driver or None, probability, set).
    """

    found: FittedSet
    fullest: FittedSet
    names: tuple[str, ...]
    classes: dict[str, tuple[str, ...]]
    probability: float
    outside: bool
    driver: str | None
    marginal: dict[str, float]
    leading: list[tuple[frozenset[str], str | None, float, FittedSet]]


def judge(analysis: Analysis) -> Judgement:
    """Weigh the sets that the search has found."""
    groups: dict[tuple[frozenset[str], str | None], list[FittedSet]] = {}
    top = analysis.found[0].log_posterior
    tried = {f.members: f for f in analysis.found}
    near = [f for f in analysis.found if f.log_posterior > top - _FAR]
    for found, least in zip(near, essential(analysis, near, tried), strict=True):
        groups.setdefault(_named(analysis, least), []).extend([found, least])
    weights = {key: math.exp(max(f.log_posterior for f in fs) - top) for key, fs in groups.items()}
    total = sum(weights.values())
    leading = sorted(((k[0], k[1], w / total, _plainest(groups[k])) for k, w in weights.items()), key=lambda x: -x[2])
    names, driver, probability, found = leading[0]
    alike = [f for f in groups[names, driver] if set(found.members) <= set(f.members)]
    fullest = max(alike, key=lambda f: f.log_posterior)
    plainer = _library_form(analysis, found, frozenset(), tried) if driver is not None else None
    if plainer is not None:
        found = fullest = plainer
        names, driver = _named(analysis, found)
    outside = driver is not None
    if not outside and unexplained(analysis, found):
        outside = True
        driver = _driver_of_remainder(analysis)
    borrowed = _borrowed(analysis, found, tried)
    if borrowed:
        # Something is there that looks like a part of these effects, and nothing of what makes them what they are.
        other = _library_form(analysis, found, borrowed, tried)
        found = fullest = other or _best_without(analysis, borrowed, tried) or found
        names, driver = _named(analysis, found)
        names, outside = names - borrowed, other is None or unexplained(analysis, found)
        driver = (driver or _driver_of_single(analysis)) if outside else None
    if outside and _little(analysis):
        found = fullest = next(f for f in analysis.found if not f.members)
        names = frozenset()
    marginal: dict[str, float] = {a.name: 0.0 for a in analysis.dictionary.atoms if not a.is_discrepancy}
    for members, _, p, _ in leading:
        for name in members:
            marginal[name] += p
    classes = {} if outside else _classes(analysis, found, names, tried)
    if not outside:
        same = [p for members, drive, p, _ in leading if drive is None and _equals(members, names, classes)]
        probability = sum(same) if plainer is None and not borrowed else _UNSURE
    else:
        # What is left above a noise that is known is no noise, whatever it follows.
        known = is_known(analysis)
        told = [p for members, drive, p, _ in leading if drive is not None or (known and members == names)]
        probability = sum(told) if leading[0][1] is not None or (known and not borrowed) else 0.5
    if (names and (len(names) > 2 or smallest(analysis, found, tried) < _SMALL)) or (
        names and not outside and above_noise(analysis, found)
    ):
        probability *= _UNSURE
    if names and not outside and _could_be_another(analysis, found):
        probability = min(probability, _MIMIC)
    ordered = tuple(sorted(names, key=lambda n: -_energy(analysis, found, n)))
    return Judgement(found, fullest, ordered, classes, min(probability, 1.0), outside, driver, marginal, leading)


def without_names(analysis: Analysis, judgement: Judgement) -> Judgement:
    """None in the place of names that are not likely and that no row outside the fit shows."""
    empty = next(f for f in analysis.found if not f.members)
    return replace(judgement, found=empty, fullest=empty, names=(), classes={}, probability=0.5)


def _library_form(
    analysis: Analysis, found: FittedSet, without: frozenset[str], tried: dict[tuple[int, ...], FittedSet]
) -> FittedSet | None:
    """A set of as few names of the library that explains a set up to a small change of form; None where there is none.

    A cause need not have the form of the textbook, and a discrepancy term can have any.

    Args:
        analysis: with the sets that were tried.
        found: the set.
        without: names that are not to be in it.
        tried: all sets that were fitted, by their members.
    """
    atoms = analysis.dictionary.atoms
    most = max(1, sum(not atoms[i].is_discrepancy for i in found.members))
    empty = next(f for f in analysis.found if not f.members)
    explained = max(empty.rss - found.rss, 1e-300)
    known, count = analysis.dictionary.noise_dof, analysis.dictionary.grams.values
    for f in sorted(analysis.found, key=lambda f: (len(f.members), -f.log_posterior)):
        mine = {atoms[i].name for i in f.members}
        if not 0 < len(f.members) <= most or mine & without or any(_bends(analysis, i) for i in f.members):
            continue
        form = FORM_EXACT if is_exact(analysis, f.members) else FORM_DISCREPANCY
        # What is lost beyond what the rows show is lost to implausible sizes, which no other form excuses.
        shown = 0.5 * (count + known) * math.log((f.rss + known) / max(found.rss + known, 1e-300))
        implausible = found.log_posterior - f.log_posterior - max(shown, 0.0) > _FAR_FETCHED
        if (f.rss - found.rss) / explained < form and not implausible and not _borrowed(analysis, f, tried):
            return f
    return None


def _bends(analysis: Analysis, member: int) -> bool:
    """Whether an atom can have nearly any form: a discrepancy term, an effect with no usual shape, all couplings."""
    atom = analysis.dictionary.atoms[member]
    if atom.effect is None or any(shape.usual is None for shape in atom.effect.shapes(analysis.situation)):
        return True
    # Between all joints they are any linear map, which is near to much of what geometry does.
    return atom.name == "coupling" and atom.used is None


def _little(analysis: Analysis) -> bool:
    """Whether the best explanation of all accounts for little of the gap above the noise."""
    best, count = analysis.found[0], analysis.dictionary.grams.values
    left = best.rss / max(count - best.effective, 1.0) - analysis.floor
    return left > (1 - _LEAST_EXPLAINED) * max(float(analysis.dictionary.grams.yy) / count - analysis.floor, 0.0)


def _borrowed(analysis: Analysis, found: FittedSet, tried: dict[tuple[int, ...], FittedSet]) -> frozenset[str]:
    """Names of a set that rest on what other effects do as well, or on what should only correct their form, or that
    would be of a size beside others that no cause has."""
    grams, names, most = analysis.dictionary.grams, set(), implausible_size(analysis)
    for i, mean in zip(found.members, found.mean, strict=True):
        atom, group = analysis.dictionary.atoms[i], analysis.dictionary.groups[i]
        if atom.is_discrepancy:
            continue
        coefficients = atom.coefficients(analysis.situation)
        main_sizes = [abs(float(v)) for c, v in zip(coefficients, mean, strict=True) if not c.secondary]
        if len(found.members) > 1 and max(main_sizes, default=0.0) > most:
            names.add(atom.name)
            continue
        if not any(c.borrowed or c.doubtful or c.mends for c in coefficients):
            continue
        borrowed, doubtful, corrections = (
            torch.tensor(flags, dtype=torch.bool)
            for flags in zip(*((c.borrowed, c.doubtful, c.mends) for c in coefficients), strict=True)
        )
        gram = grams.xx[group][:, group]
        parts = (mean * ~borrowed, mean * doubtful, mean * ~corrections, mean)
        alone, unsure, main, whole = (float(m @ gram @ m) for m in parts)
        largest, mended = (float((mean * kind).abs().max()) for kind in (~corrections, corrections))
        if (
            alone < _OWN * whole
            or (main < _MAIN * whole and mended > _MENDED * largest)
            or (unsure > _DOUBTED * whole and not _follows_need(analysis, atom, tried))
        ):
            names.add(atom.name)
    return frozenset(names)


def _follows_need(analysis: Analysis, atom: Atom, tried: dict[tuple[int, ...], FittedSet]) -> bool:
    """Whether, without an effect, something outside the library seems to follow a covariate that the effect needs."""
    found = _best_without(analysis, frozenset({atom.name}), tried)
    driver = None if found is None else _named(analysis, found)[1]
    others = [c for c in analysis.situation.covariates if c != driver]
    assert atom.effect is not None
    return bool(atom.effect.missing(analysis.situation.mechanism, others))


def _best_without(
    analysis: Analysis, names: frozenset[str], tried: dict[tuple[int, ...], FittedSet]
) -> FittedSet | None:
    """The most probable set with a discrepancy term and none of these names."""
    atoms = analysis.dictionary.atoms
    for found in analysis.found:
        if any(atoms[i].is_discrepancy for i in found.members) and not names & {atoms[i].name for i in found.members}:
            return essential(analysis, [found], tried)[0]
    return None


def _could_be_another(analysis: Analysis, found: FittedSet) -> bool:
    """Whether what the effects of a set can do holds what some candidate beside it is likely to do, up to the noise.

    All that they can do, in any joints or legs: the one leg that explains most was picked from all of them.
    """
    atoms, groups, grams = analysis.dictionary.atoms, analysis.dictionary.groups, analysis.dictionary.grams
    names = {atoms[i].name for i in found.members}
    own = torch.cat([groups[_whole(analysis, i)] for i in found.members])
    inverse = torch.linalg.pinv(grams.xx[own][:, own], rtol=1e-9, hermitian=True)
    gap = analysis.gap
    for i, atom in enumerate(atoms):
        if atom.is_discrepancy or atom.name in names:
            continue
        group = groups[i]
        total = float(grams.xx[group, group].sum())
        if total <= 0:
            continue
        cross = grams.xx[own][:, group]
        if gap * (1 - float((cross * (inverse @ cross)).sum()) / total) < _MIMICKED:
            return True
    return False


def _whole(analysis: Analysis, member: int) -> int:
    """The atom with all coefficients of an effect of which one has some; itself where there is none of its shapes."""
    atoms = analysis.dictionary.atoms
    mine = atoms[member]
    alike = (i for i, a in enumerate(atoms) if a.effect is mine.effect and a.used is None)
    return next((i for i in alike if not mine.is_discrepancy and torch.equal(atoms[i].shape, mine.shape)), member)


def _plainest(found: list[FittedSet]) -> FittedSet:
    """Of sets that come to the same names the smallest, and of those the most probable."""
    return min(found, key=lambda f: (len(f.members), -f.log_posterior))


def _named(analysis: Analysis, found: FittedSet) -> tuple[frozenset[str], str | None]:
    atoms = analysis.dictionary.atoms
    names = frozenset(atoms[i].name for i in found.members if not atoms[i].is_discrepancy)
    driver = next((atoms[i].name for i in found.members if atoms[i].is_discrepancy), None)
    if driver is not None and driver.endswith(ANY):
        driver = _leader(analysis, driver.removesuffix(ANY))
    return names, driver


def _leader(analysis: Analysis, kind: str) -> str:
    """Of drivers of one kind the one that explains most alone."""
    atoms = analysis.dictionary.atoms
    alone = (f for f in analysis.found if len(f.members) == 1)
    names = (atoms[f.members[0]].name for f in alone)
    return next(n for n in names if n.startswith(kind) and not n.endswith(ANY))


def _energy(analysis: Analysis, found: FittedSet, name: str) -> float:
    return sum(e for i, e in zip(found.members, found.energy, strict=True) if analysis.dictionary.atoms[i].name == name)


def _driver_of_remainder(analysis: Analysis) -> str | None:
    """The driver of the most probable set that has one."""
    for found in analysis.found:
        driver = _named(analysis, found)[1]
        if driver is not None:
            return driver
    return None


def _driver_of_single(analysis: Analysis) -> str | None:
    """The driver that explains most alone."""
    atoms = analysis.dictionary.atoms
    alone = (f for f in analysis.found if len(f.members) == 1 and atoms[f.members[0]].is_discrepancy)
    return next((_named(analysis, f)[1] for f in alone), None)


def _classes(
    analysis: Analysis, found: FittedSet, names: frozenset[str], tried: dict[tuple[int, ...], FittedSet]
) -> dict[str, tuple[str, ...]]:
    """For each name of the set those that these rows cannot distinguish from it."""
    atoms = analysis.dictionary.atoms
    library = [i for i, a in enumerate(atoms) if not a.is_discrepancy]
    classes: dict[str, tuple[str, ...]] = {}
    for i in found.members:
        if atoms[i].is_discrepancy:
            continue
        others = [j for j in library if atoms[j].name not in names]
        sets = [tuple(sorted(j if m == i else m for m in found.members)) for j in others]
        trials = fits(analysis, sets, tried)
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
