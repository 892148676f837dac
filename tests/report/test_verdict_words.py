"""A verdict in plain English."""

from __future__ import annotations

import pytest
from diagnosis_cases import CASES, indistinguishable, none, one_effect, outlier, outside, two_effects, with_rotation

from ccnn_torch.diagnosis.page.data import About
from ccnn_torch.diagnosis.page.tables import (
    gap_table,
)
from ccnn_torch.diagnosis.verdict.text import (
    driver_words,
    effect_words,
    probability_words,
    verdict_text,
)


@pytest.mark.parametrize("name", CASES)
def test_a_verdict_is_two_sentences_with_its_figures(name: str) -> None:
    results = CASES[name]()[0]
    text = verdict_text(results)
    assert text.endswith(".") and text.count(". ") == 1 and "_" not in text and "None" not in text
    gap, verdict = results["gap"], results["verdict"]
    assert f"{gap['before'] / gap['noise_floor']:.{0 if gap['before'] > 10 * gap['noise_floor'] else 1}f}" in text
    assert probability_words(verdict["probability"]) in text
    for effect in verdict["effects"]:
        assert effect == "outlier" or effect_words(effect).lower() in text.lower()
    if verdict["shrink_ci95"] and verdict["effects"] != ["outlier"]:
        low, high = (float(v) for v in text.partition("% [")[2].partition("]")[0].split(","))
        assert [low, high] == pytest.approx([100 * v for v in verdict["shrink_ci95"]], abs=0.51)


def test_a_cause_is_told_as_a_fact_only_where_it_is_nearly_sure() -> None:
    results = one_effect()[0]
    for probability, words in ((0.94, "is the likeliest explanation"), (0.96, "explains it")):
        results["verdict"]["probability"] = probability
        assert words in verdict_text(results)


def test_the_verdict_of_each_kind() -> None:
    assert verdict_text(one_effect()[0]) == (
        "The gap of 420 µm is 20 times the noise. Joint compliance under load explains it (probability 0.98) and would "
        "remove 93 % [91, 95] of what is above the noise on data not used for fitting (420 µm → 113 µm)."
    )
    assert "backlash together explain it (probability 0.95) and would remove 99.5 % [98.0" in verdict_text(
        two_effects()[0]
    )
    assert verdict_text(none()[0]).endswith("No cause beyond the noise is to be seen (probability above 0.99).")
    assert "It comes from 2 bad rows, set aside" in verdict_text(outlier()[0])
    assert (
        "or an error of the geometry or a shifted or tilted base frame (these data do not distinguish them: "
        "on these poses their signatures are up to 11.5° apart), explains"
    ) in verdict_text(indistinguishable()[0])
    assert "420 µm and 900 µrad is 20 and 8.2 times" in verdict_text(with_rotation()[0])
    results = outside()[0]
    assert "; the rest follows the temperature, and no effect of the library describes it" in verdict_text(results)
    results["verdict"] |= {"effects": [], "shrink": None, "shrink_ci95": None, "driver": "joint q2"}
    assert verdict_text(results).endswith(
        "No effect of the library explains it: the residual follows joint q2 (probability 0.97)."
    )
    results["not_seen"] = {"latency": "the time of each row: time[s]"}
    assert "No effect that these records can show explains it" in verdict_text(results)
    results["effects"] = results["effects"][:1]
    assert f"None of the effects that were tried ({results['effects'][0]['name']}) explains it" in verdict_text(results)
    results["verdict"]["driver"] = None
    assert "has no known driver" in verdict_text(results)
    unsure = one_effect()[0]
    unsure["verdict"]["probability"] = 0.6
    assert "under load is the likeliest explanation (probability 0.60) and would remove" in verdict_text(unsure)
    unsure["verdict"]["probability"] = 0.004
    assert "The rows do not determine the cause. Joint compliance under load is the likeliest" in verdict_text(unsure)


def test_gaps_that_cannot_be_put_against_a_floor() -> None:
    results = one_effect()[0]
    results["gap"]["noise_floor"] = None
    assert verdict_text(results).startswith("The gap is 420 µm; how large the noise is, is not known. Joint")
    turning = with_rotation()[0]
    turning["gap"] |= {"before": 0.0, "after": 0.0}
    assert verdict_text(turning).startswith("The gap of 900 µrad is 8.2 times the noise.")
    assert verdict_text(turning).endswith("(900 µrad → 200 µrad).")
    turning["gap"] = turning["gap_rotation"]
    turning["gap_rotation"] = None
    assert [row[0] for row in gap_table(turning, About()).rows] == ["rotation [µrad]"]
    turning["gap"]["before"] = 0.0
    assert verdict_text(turning).startswith("There is no gap between model and machine")


def test_words() -> None:
    assert effect_words("my_effect") == "the effect my_effect"
    told = [driver_words(d) for d in ("workspace", "load z", "direction 2", "joint", "odd", None)]
    assert told[1:3] == ["the load along z", "the direction of joint 2"]
    assert told[3:] == ["joint", "odd", "nothing that was recorded"]
    assert [probability_words(p) for p in (1.0, 0.983, 0.004)] == ["above 0.99", "0.98", "below 0.01"]


def test_noise_that_was_estimated_is_no_floor() -> None:
    results = one_effect()[0]
    assert gap_table(results, About()).columns[3] == "noise floor"
    results["noise"] = "estimated"
    assert gap_table(results, About()).columns[3] == "noise, estimated"
    unknown = "The gap is 420 µm; the best explanation leaves 21.0 µm, and how much of that is noise is not known."
    assert verdict_text(results).startswith(unknown)
    assert "93 % of its mean square" in verdict_text(results)
    # What is left of a motion is 1.1 steps of the encoder, or 4.
    for step, said in ((1e-4, False), (3e-5, True)):
        assert ("noise is not known" in verdict_text(results | {"encoder_step": step})) is said
    results["noise"] = "repeats"
    assert "20 times the noise (from repeated readings of one target)" in verdict_text(results)
