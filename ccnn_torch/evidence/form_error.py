"""The posterior over sets of causes whose forms are not those of the textbook.

A real cause differs from the effect that describes it. With y = Σ_g X_g θ_g + e + ε the form error e adds to the noise,
in every direction of the data, a variance of Σ_g φ_g E_g: a share φ of what each effect of the set does in all rows,
E_g = |X_g θ_g|². It grows with the rows as E_g does, so that no number of rows makes a small misfit into another cause
(model inadequacy: Kennedy and O'Hagan 2001).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ccnn_torch.evidence.beam import probable_sets
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet, with_noise

OF_EXACT, OF_FORM, OF_SMOOTH = 1e-6, 5e-5, 3e-4
"""Share φ of an effect's squares that its form error adds to the noise in every direction: of an exact form only
the second order; of other effects; and of a discrepancy term, which is smooth where the cause need not be."""
DIRECTIONS = 100
"""Directions that a form error has, so that all of it is this number times φ of the squares."""
LEVELS = (1.0, 0.25, 4.0)
"""Levels of the form error, equally probable: it is known to a factor of four or so."""
# Standard deviations of the noise's mean square that a remainder must exceed in any case; and within which it is none.
_CLEARLY, _SLIGHTLY = 5.0, 3.0
LOG_EXACT = math.log(0.001)
"""Log prior odds that all forms are those of the textbook, of two effects or so."""
# Directions in which a form error is sure to show.
_SEEN = 6


@dataclass(frozen=True)
class Posterior:
    """Sets by their posterior probability, at one level of the form error.

    Attributes:
        dictionary: candidates under noise and form error, whose squares are in units of their variance.
        found: sets, most probable first.
        weight: probability of the level.
        variance: of noise and form error, in units of the noise before.
    """

    dictionary: Dictionary
    found: list[FittedSet]
    weight: float
    variance: float


def with_form_error(dictionary: Dictionary, best: FittedSet, floor: float, is_known: bool) -> list[Posterior]:
    """Sets weighed again under the form error of the most probable one, at each of its levels, the usual one first.

    Args:
        dictionary: candidates.
        best: the most probable set.
        floor: mean square of the noise, in units of the dictionary's.
        is_known: whether the noise was given or the records show it.
    """
    made: _Searched = {}
    levels = [_at_level(dictionary, best, floor, level, made) for level in LEVELS]
    if not is_known:
        return levels
    every, usual = _at_level(dictionary, best, floor, 0.0, made), levels[0]
    exact = _without_discrepancies(every)
    count = dictionary.grams.values
    left, other = (_mean_square(one.found[0], one.dictionary) * one.variance / floor for one in (exact, usual))
    beaten = every.found[0].log_posterior - exact.found[0].log_posterior
    share = share_of_exact(left, other, usual.variance / floor, count, beaten)
    return [*(replace(one, weight=one.weight * (1 - share)) for one in levels), replace(exact, weight=share)]


def share_of_exact(left: float, other: float, usual: float, count: float, beaten: float) -> float:
    """Probability that all forms are those of the textbook.

    That is to be seen where the noise is known: the best set leaves that, and no more.

    Args:
        left: mean square that the best set leaves where forms are exact, in units of that of the noise.
        other: the same where they are not.
        usual: variance of noise and form errors, in the same units.
        count: how many values there are.
        beaten: log odds of what no effect describes, which may leave the noise, too, and say it with less.
    """
    shown = math.log(usual) + other / usual - left
    misfit = max(left - 1 - _SLIGHTLY * math.sqrt(2 / count), 0.0) * count / 2
    odds = LOG_EXACT + _SEEN * shown / 2 - misfit - beaten
    return 1 / (1 + math.exp(min(-odds, 700.0)))


def is_unexplained(dictionary: Dictionary, found: FittedSet, floor: float) -> bool:
    """Whether a set leaves clearly more than the noise (`floor`) and the form errors of its effects."""
    count = dictionary.grams.values
    above = _mean_square(found, dictionary) - floor
    allowed = DIRECTIONS * form_error_of(found, dictionary) / count
    return above > max(floor * _CLEARLY * math.sqrt(2 / count), allowed)


def form_error_of(found: FittedSet, dictionary: Dictionary) -> float:
    """Variance in every direction of what the effects of a set differ by, in units of the dictionary's noise."""
    shares = [dictionary.atoms[i].form_error for i in found.members]
    return form_variance(shares, found.energy, float(dictionary.grams.yy))


def form_variance(shares: Sequence[float], energies: Sequence[float], most: float) -> float:
    """Variance in every direction of what effects differ by from their forms.

    Args:
        shares: φ of each.
        energies: squares of each.
        most: none does more than all there is.
    """
    return sum(share * min(energy, most) for share, energy in zip(shares, energies, strict=True))


# By variance: where nothing is found all levels are of one.
_Searched = dict[float, tuple[Dictionary, list[FittedSet]]]


def _at_level(dictionary: Dictionary, best: FittedSet, floor: float, level: float, made: _Searched) -> Posterior:
    noise = max(floor, _mean_square(best, dictionary))
    variance = max(noise + level * form_error_of(best, dictionary), math.ulp(1.0))
    if variance not in made:
        made[variance] = (weighed := with_noise(dictionary, variance)), probable_sets(weighed)
    weighed, found = made[variance]
    if level:
        found = [replace(f, log_posterior=f.log_posterior - _lacking(weighed, f, level)) for f in found]
    return Posterior(weighed, sorted(found, key=lambda f: -f.log_posterior), 1 / len(LEVELS), variance)


def _lacking(dictionary: Dictionary, found: FittedSet, level: float) -> float:
    """Log odds against parts that nearly cancel each other: what their forms are wrong by would not cancel, and none of
    it is left."""
    yy, squares, beyond = float(dictionary.grams.yy), dictionary.grams.xx.diagonal(), 0.0
    for i, mean in zip(found.members, found.mean, strict=True):
        parts = float(mean.square() @ squares[dictionary.groups[i]])
        beyond += dictionary.atoms[i].form_error * max(parts - yy, 0.0)
    return _SEEN / 2 * math.log1p(level * beyond)


def _without_discrepancies(posterior: Posterior) -> Posterior:
    """Sets of library effects alone: what a discrepancy term describes has no form of the textbook."""
    atoms = posterior.dictionary.atoms
    found = [f for f in posterior.found if not any(atoms[i].is_discrepancy for i in f.members)]
    return replace(posterior, found=found)


def _mean_square(found: FittedSet, dictionary: Dictionary) -> float:
    """What a set leaves, in units of the dictionary's noise."""
    return found.rss / max(dictionary.grams.values - found.effective, 1.0)
