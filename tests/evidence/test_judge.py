"""Verdicts on posteriors made by hand: names, classes, probability, outside or not."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch

from ccnn_torch.evidence.beam import probable_sets
from ccnn_torch.evidence.dictionary import dictionary_of, singles_of
from ccnn_torch.evidence.judge import Explanation, Verdict, judge, marginal, posterior
from ccnn_torch.evidence.priors import EFFECT, OUTSIDE, crowd

Shares = dict[str, float]


def explained(shares: Shares) -> list[Explanation[str]]:
    """`"a b|time": 0.2` is the set of a and b beside a term that follows the time."""
    found = []
    for words, share in shares.items():
        names, _, driver = words.partition("|")
        found.append(Explanation(frozenset(names.split()), (driver,) if driver else (), share, words))
    return sorted(found, key=lambda e: -e.probability)


def verdict(shares: Shares, *unexplained: str) -> Verdict[str]:
    """unexplained: sets that leave clearly more than the noise."""
    made = explained(shares)
    return judge(made, made, lambda e: ("rest",) if e.best in unexplained else None)


def said(found: Verdict[str]) -> tuple[set[str], float, bool, tuple[str, ...]]:
    return {*found.chosen.names}, pytest.approx(found.probability, abs=1e-12), found.outside, found.drivers


@pytest.mark.parametrize(
    ("shares", "names", "probability"),
    [
        ({"a": 0.97, "": 0.03}, "a", 0.97),
        ({"": 0.96, "a": 0.04}, "", 0.96),
        # Less than 0.9 for b, and the set without it is probable: what holds it supports a, up to 0.9.
        ({"a b": 0.6, "a": 0.395, "": 0.005}, "a", 0.9),
        ({"a b": 0.45, "a": 0.3, "c": 0.2, "": 0.05}, "a b", 0.45),
        ({"a b": 0.92, "a": 0.08}, "a b", 0.92),
        # The same where the set without b is improbable: another one could stand in its place.
        ({"a b": 0.8, "a c d": 0.17, "a": 0.03}, "a", 0.9),
        # Nothing is sure: the most probable set stands for itself.
        ({"a": 0.5, "": 0.3, "b": 0.02, "c d": 0.18}, "a", 0.5),
    ],
)
def test_names_are_those_of_the_most_probable_set_that_are_sure(shares: Shares, names: str, probability: float) -> None:
    assert said(verdict(shares)) == ({*names.split()}, probability, False, ())


def test_a_rest_that_a_likely_name_takes_is_not_outside() -> None:
    shares = {"a b": 0.6, "a": 0.395, "": 0.005}
    assert said(verdict(shares, "a")) == ({"a"}, 0.9, False, ())
    assert said(verdict(shares, "a", "a b")) == ({"a"}, 0.6, True, ("rest",))


def test_where_names_have_few_forms_one_that_is_sure_as_one_of_a_class_stays() -> None:
    def names(shares: Shares, of_classes: bool) -> str:
        made = explained(shares)
        return "".join(sorted(judge(made, made, of_classes=of_classes).chosen.names))

    # What corrects a may be b or d: in many forms neither is a cause.
    either = {"a b": 0.5, "a d": 0.44, "a": 0.02, "": 0.04}
    assert (names(either, True), names(either, False)) == ("ab", "a")
    # Of b the data are not sure either, but without it the set is less than a 20th as probable.
    unsure = {"a b": 0.8, "a c d": 0.17, "a": 0.03}
    assert (names(unsure, True), names(unsure, False)) == ("ab", "a")


def test_names_that_the_data_do_not_distinguish_count_as_one() -> None:
    found = verdict({"a": 0.5, "b": 0.46, "c": 0.04})
    assert found.chosen.names == {"a"} and found.classes == {"a": ("b", "c")}
    assert found.probability == pytest.approx(1.0)
    # 20 to 1 are distinguished; a pair keeps the one that stays.
    apart = verdict({"a c": 0.7, "b c": 0.26, "a": 0.034, "": 0.006})
    assert apart.chosen.names == {"a", "c"} and apart.classes == {"a": ("b",), "c": ()}
    assert apart.probability == pytest.approx(0.96)


def test_what_is_no_candidate_can_still_be_mistaken_for_a_name() -> None:
    found = judge(explained({"a": 0.98, "": 0.02}), explained({"a": 0.6, "b": 0.39, "": 0.01}))
    assert found.classes == {"a": ("b",)} and found.probability == pytest.approx(0.98)


def test_what_is_outside_is_said_where_it_is_more_probable_than_not() -> None:
    shares = {"|time": 0.3, "a": 0.31, "|load x": 0.25, "b|time": 0.1, "": 0.04}
    assert said(verdict(shares)) == (set(), pytest.approx(0.65), True, ("time",))
    less = {"|time": 0.4, "a": 0.35, "": 0.25}
    assert said(verdict(less)) == ({"a"}, pytest.approx(0.35), False, ())


def test_a_name_beside_what_is_outside_is_worth_less() -> None:
    assert said(verdict({"a|time": 0.98, "a": 0.02})) == ({"a"}, 0.6, True, ("time",))
    assert said(verdict({"a|time": 0.55, "a": 0.45})) == ({"a"}, pytest.approx(0.55), True, ("time",))
    # Unsure names beside it are not named.
    assert said(verdict({"a|time": 0.5, "|time": 0.4, "": 0.1})) == (set(), pytest.approx(0.9), True, ("time",))


def test_a_set_that_leaves_more_than_the_noise_has_something_outside_beside_it() -> None:
    shares = {"a": 0.9, "b|time": 0.06, "a|load x": 0.04}
    assert said(verdict(shares, "a")) == ({"b"}, 0.6, True, ("time",))
    assert said(verdict(shares, "a", "b|time")) == ({"a"}, 0.6, True, ("load x",))
    assert said(verdict(shares, *shares)) == ({"a"}, 0.6, True, ("load x",))
    assert said(verdict({"a": 1.0}, "a")) == ({"a"}, 0.6, True, ("rest",))
    # Beside something unknown a is not sure any more.
    unsure = {"a": 0.9, "a|time": 0.06, "|time": 0.04}
    assert said(verdict(unsure, "a")) == (set(), 0.6, True, ("time",))
    # Neither b nor c is sure, though one of them is.
    either = {"a b": 0.5, "a c": 0.44, "a": 0.03, "a|time": 0.02, "b|load x": 0.01}
    assert said(verdict(either, *either)) == ({"a"}, 0.6, True, ("time",))


def test_levels_of_the_form_error_are_averaged_by_their_weights() -> None:
    a, none = frozenset("a"), frozenset("")
    first = [(a, (), 2.0, "a 1"), (none, (), 0.0, "none"), (a, (), 1.0, "a 2")]
    second = [(none, (), 0.0, "none"), (a, (), 0.0, "a 2")]
    found = posterior([(0.75, first), (0.25, second)])
    weights = [2.718281828459045**k for k in (2, 1, 0)]
    share = 0.75 * (weights[0] + weights[1]) / sum(weights) + 0.25 * 0.5
    assert [(e.best, pytest.approx(e.probability)) for e in found] == [("a 1", share), ("none", 1 - share)]
    assert marginal(found, "a") == pytest.approx(share) and marginal(found, "b", "c") == 0.0


def test_a_third_cause_is_ten_times_as_rare_and_something_outside_a_hundred_times() -> None:
    assert [pytest.approx(10**x) for x in (0, 0, 0, -1, -2)] == [2.718281828459045 ** crowd(n) for n in range(5)]
    assert pytest.approx(-crowd(4)) == EFFECT - OUTSIDE


class Cause(NamedTuple):
    name: str
    log_prior: float = EFFECT
    is_discrepancy: bool = False
    plain: bool = False
    form_error: float = 0.0


def names_beside(third: float) -> set[str]:
    """Names where two causes are plain to see under noise of 1 and a third has this size."""
    x = torch.linalg.qr(torch.randn(60, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)).Q
    y = (x @ torch.tensor([40.0, 30.0, third], dtype=torch.float64))[:, None]
    causes, columns = [Cause(name) for name in "abc"], [x[:, None, k : k + 1] for k in range(3)]
    dictionary = dictionary_of(causes, columns, y, [], singles_of(causes, columns, y, 6000.0), 6000.0)
    sets = probable_sets(dictionary)
    named = [(frozenset(causes[i].name for i in s.members), (), s.log_posterior, s.members) for s in sets]
    explanations = posterior([(1.0, named)])
    return {*judge(explanations, explanations).chosen.names}


def test_a_third_cause_has_to_show_more_than_a_second() -> None:
    # Were it as probable beforehand as a second one, four standard deviations would do.
    assert names_beside(4.0) == {"a", "b"}
    assert names_beside(4.6) == {"a", "b", "c"}
