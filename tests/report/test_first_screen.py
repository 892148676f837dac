"""The first screen of a diagnosis: what is wrong, how sure, what it removes, and what to do now."""

from __future__ import annotations

from typing import Any

import pytest
from diagnosis_cases import CASES, indistinguishable, none, one_effect, outlier, outside, two_effects

from ccnn_torch.diagnosis.page.data import About, about_of
from ccnn_torch.diagnosis.page.first_screen import cards, first_screen, joints_table, numbers_table, where_words
from ccnn_torch.diagnosis.verdict.findings import findings, frequency_words, places, size_words
from ccnn_torch.effects import EFFECTS, OUTLIER
from ccnn_torch.effects.words import words_of


def _told(results: dict[str, Any], about: About | None = None) -> dict[str, str]:
    return {answer.label: answer.text for answer in first_screen(results, about or About())}


def _with(name: str, parameters: dict[str, Any]) -> dict[str, Any]:
    """Results whose one effect has these parameters: value, standard deviation, unit, part, nominal."""
    results = one_effect()[0]
    keys = ("value", "sd", "unit", "part", "nominal")
    block = {n: dict(zip(keys, values, strict=False)) for n, values in parameters.items()}
    results["effects"] = [results["effects"][0] | {"name": name, "parameters": block}]
    results["verdict"]["effects"] = [name]
    return results


def test_every_effect_has_words_and_a_part_to_look_at() -> None:
    for name in (*EFFECTS, OUTLIER, "my_effect", "parameter spring1"):
        words = words_of(name)
        assert words.cause and words.short and words.look.endswith(".")
        assert "{" not in words.look.format(where="joint 2")
    assert len({words_of(name).look for name in EFFECTS}) == len(EFFECTS)
    assert not [name for name in EFFECTS if words_of(name).cause == f"the effect {name}"]


def test_a_harmonic_error_is_told_by_joint_amplitude_and_times_a_turn() -> None:
    parameters = {
        "q2 sin": (4.2e-5, 1e-6, "rad", "joint 2"),
        "q2 cos": (-5.6e-5, 1e-6, "rad", "joint 2"),
        "q2 sin 4": (3e-7, 1e-6, "rad", "joint 2"),
        "q2 frequency": (5.0, None, "1"),
        "q5 sin": (2e-7, 1e-6, "rad", "joint 5"),
        "q5 frequency": (7.0, None, "1"),
    }
    found = findings(_with("transmission", parameters))
    assert found[0].text == "harmonic error of joint 2: ±70.0 µrad, 5 times a turn"
    assert "Gear, belt, screw or encoder of joint 2" in found[0].look
    parameters["q2 sin 4"] = (4e-5, 1e-6, "rad", "joint 2")
    text = findings(_with("transmission", parameters))[0].text
    # In phase or not, the sum of both waves is above either.
    assert text.endswith("5 and 20 times a turn") and 70 < float(text.split("±")[1].split(" ")[0]) < 110.1
    assert frequency_words(1000.0, "rad/m") == "every 6.28 mm"


def test_parts_are_told_largest_first_and_only_what_is_clearly_not_zero() -> None:
    sizes = {1: 1e-4, 2: 3e-4, 3: 1e-6, 4: 2e-4, 5: 2.5e-4}
    parameters = {f"q{i}": (v, 4e-7, "rad", f"joint {i}") for i, v in sizes.items()}
    found = findings(_with("backlash", parameters))
    # Joint 3 is below three standard deviations.
    assert found[0].text == (
        "backlash of joints 1, 2, 4 and 5: largest in joint 2 300 µrad; joint 5 250 µrad; joint 4 200 µrad"
    )
    assert found[0].look.startswith("Gear, belt or screw of joints 2, 4 and 5")
    assert places(["leg 3", "leg 1", "leg 2"]) == "legs 1 to 3" and places(["joint 2", "leg 3"]) == "joint 2 and leg 3"
    assert findings(_with("latency", {"delay": (0.012, 1e-4, "s", None)}))[0].text == "delay: 12.0 ms"


def test_sizes_are_in_units_of_a_workshop() -> None:
    told = [size_words(*one) for one in ((-7.23e-3, "m"), (2.87e-6, "rad/N/m"), (1e-7, "m/N"), (-0.0062, "1"))]
    assert told == ["-7.23 mm", "2.87 µrad/(N·m)", "100 nm/N", "-0.620 %"]
    assert [size_words(*one) for one in ((1536.0, "s"), (1.1e-5, "1/K"), (1e-9, "rad/s"))] == [
        "25.6 min",
        "11.0 µm/(m·K)",
        "3.60 µrad/h",
    ]
    # Of a drive: a share of friction, a speed beside its standard deviation, a number whose unit is not known.
    told = [
        size_words(*one) for one in ((-0.0139, "1/K"), (3.1e-4, "1/K", 2, 0.01), (4e-5, "m/s", 2, 0.12), (0.302, ""))
    ]
    assert told == ["-1.39 %/K", "0.031 %/K", "0.040 mm/s", "0.302"]
    teeth = {"q1 sin": (0.25, 1e-3, "N*m", "joint 1"), "q1 cogging_order": (12.0, None, "1", "joint 1")}
    assert findings(_with("cogging", teeth))[0].text == "cogging of joint 1: ±0.250 N·m, 12 times a turn"


def test_the_numbers_to_enter_are_nominal_plus_error_with_their_digits() -> None:
    parameters = {
        "a3": (6.4e-4, 6.4e-5, "m", "link 3", -0.5723),
        "alpha3": (-1.68e-3, 4.8e-5, "rad", "link 3", 0.0),
        "d5": (1e-5, 6e-5, "m", "link 5", 0.1157),
    }
    table = numbers_table(_with("geometry", parameters), 6)
    assert table is not None and len(table.rows) == 2
    assert table.rows[0] == ("link 3 alpha3", "-1.680 mrad", "± 94 µrad", "-0.001680 rad = -0.0963°")
    assert table.rows[1] == ("link 3 a3", "640.0 µm", "± 130 µm", "-571.660 mm")
    fewer = numbers_table(_with("geometry", parameters | {f"x{i}": (1.0, 0.01, "m", None) for i in range(9)}), 6)
    assert fewer is not None and len(fewer.rows) == 6 and "5 more that are clearly not 0" in fewer.note
    bare = numbers_table(_with("backlash", {"q1": (2e-4, 1e-6, "rad", "joint 1")}), 6)
    assert bare is not None and bare.columns == ("number", "error found", "± (95 %)")
    assert numbers_table(_with("backlash", {"q1": (2e-7, 1e-6, "rad", "joint 1")}), 6) is None


def test_lines_and_cards_have_the_clearest_numbers_to_enter() -> None:
    parameters = {f"a{i}": (1e-3 * i, 1e-5, "m", f"link {i}", 0.1) for i in range(1, 6)}
    results = _with("geometry", parameters)
    enter = next(a for a in first_screen(results, About(folder="runs/d")) if a.label == "Enter instead")
    assert enter.commands[0] == "link 5 a5: 105.000 mm (off by 5.000 mm ± 20 µm)" and len(enter.commands) == 3
    assert enter.text == "all of these together, ± at 95 %; 2 more are in runs/d/report.html."
    (card,) = cards(results)
    assert card.title == "Geometry error" and card.numbers[:3] == enter.commands and card.look
    many = {f"a{i}": (1e-3 * i, 1e-5, "m", f"link {i}", 0.1) for i in range(1, 9)}
    results["effects"] = _with("geometry", many)["effects"]
    for block in results["effects"][0]["parameters"].values():
        block["together"] = 8
    enter = next(a for a in first_screen(results, About()) if a.label == "Enter instead")
    assert enter.text == "3 of 8 numbers, ± at 95 %; only all together repair the model: report.html."
    assert [card.title for card in cards(outside()[0])][-1] == "What is left" and cards(none()[0]) == []


def test_numbers_that_do_not_repair_the_model_are_not_to_be_entered() -> None:
    """Two of three that have to be entered together are clear: what is shown would leave more than was promised."""
    parameters = {"z3": (2e-3, 1e-5, "m", "link 3", 0.1), "z4": (1e-3, 1e-5, "m", "link 4", 0.2)}
    results = _with("geometry", parameters)
    for together, enter in ((2, ["102.000 mm", "201.000 mm"]), (3, None)):
        for block in results["effects"][0]["parameters"].values():
            block["together"] = together
        table = numbers_table(results, 6)
        assert table is not None and ("does not repair the model" in table.note) == (enter is None)
        assert [row[3] for row in table.rows if len(row) > 3] == (enter or [])


def test_what_it_removes_has_the_figure_by_block_beside_the_one_at_random() -> None:
    told = _told(one_effect()[0])
    assert told["What it removes"].startswith(
        "420 µm → 113 µm on rows at random, 410 µm → 131 µm where nothing was measured (by block); the noise is 21.0 µm"
    )
    assert told["How sure"] == (
        "Probability 0.98 that these causes act; they leave 5.4 times the noise: errors of their forms, or further "
        "causes of that size."
    )
    results = one_effect()[0]
    results["gap"]["after"] = 1.9 * results["gap"]["noise_floor"]
    assert _told(results)["How sure"] == "Probability 0.98 that these causes, and no others, act."
    next(e for e in results["effects"] if e["name"] == "thermal")["probability"] = 0.71
    assert _told(results)["How sure"] == (
        "Probability 0.98 that these causes act; likely beside them: thermal growth (0.71)."
    )
    results["effects"][0]["indistinguishable_from"] = ["thermal"]
    assert _told(results)["How sure"] == "Probability 0.98 that these causes, and no others, act."
    assert "not known where nothing was measured" in _told(two_effects()[0])["What it removes"]


def test_what_to_do_now_names_files_columns_and_commands() -> None:
    about = About(folder="runs/d", compensate=("These lines correct targets.", "ccnn run records=a.csv"))
    answers = first_screen(indistinguishable()[0], about)
    told = {answer.label: answer for answer in answers}
    assert [a.label for a in answers] == [
        *("What is wrong", "How sure", "What it removes", "Compensate", "Where", "Look at", "Measure next"),
    ]
    assert told["Compensate"].commands == ("ccnn run records=a.csv",)
    assert told["Measure next"].text == (
        "2 poses to tell joint_offset from geometry apart: runs/d/next_measurements.csv. "
        "Record as well: speed1[rad/s] (would show latency)."
    )
    results = indistinguishable()[0]
    results["next_measurements"][0]["separates"] = ["backlash"]
    assert _told(results)["Measure next"].startswith("2 poses to see whether backlash acts: next_measurements.csv.")
    results["noise"] = "estimated"
    assert "the noise estimated at 21.0 µm" in _told(results)["What it removes"]
    assert "the noise is not known" in _told(results)["How sure"]
    assert "or geometry error or base frame off: these data do not distinguish them" in told["What is wrong"].text


def test_nothing_bad_rows_and_what_is_outside_are_said() -> None:
    assert _told(none()[0])["What is wrong"].startswith("Nothing: model and machine differ by no more than the noise")
    assert "What it removes" not in _told(none()[0])
    doubted = none()[0] | {"noise": "estimated"}
    assert _told(doubted)["What is wrong"] == "Nothing beyond what is taken for noise."
    doubted["verdict"]["probability"] = 0.4
    assert _told(doubted)["What is wrong"] == "Nothing that these rows determine."
    bad = _told(outlier()[0])
    assert bad["What is wrong"] == "2 bad rows." and not {"Where", "What it removes"} & set(bad)
    wrong = _told(outside()[0])["What is wrong"]
    assert wrong.endswith("A rest that follows the temperature, which no effect of the library describes.")


def test_places_are_told_in_words() -> None:
    results, _, labels = one_effect()
    first, *rest = where_words(results, about_of(labels))
    assert first == "joint 1 55 % and joint 2 45 % of the gap"
    assert rest[0].startswith("40 % of it in 25 % of the rows: x 0 to 100 mm, y 300 to 400 mm, far from the base")
    assert rest[1] == "85 % of it in 50 % of the rows: load_z 60 N to 120 N"
    for region in results["where"]["regions"]:
        region["share"] = 0.25
    assert "spread over the whole workspace" in where_words(results, about_of(labels))
    assert where_words(none()[0], About()) == []


def test_numbers_that_a_file_calls_alike_are_told_apart() -> None:
    numbers = {f"base{i}": (4e-4 * i, 1e-5, "m", f"leg {i}", 0.2) for i in (1, 2)} | {
        "rod1": (3e-4, 1e-5, "m", "leg 1", 0.4)
    }
    results = _with("geometry", numbers)
    for name, block in results["effects"][0]["parameters"].items():
        block["word"] = "rod A" if name == "rod1" else "delta radius"
    table = numbers_table(results, 10)
    assert table is not None
    assert {row[0] for row in table.rows} == {"delta radius, leg 1", "delta radius, leg 2", "rod A"}


def test_a_joint_whose_error_has_no_name_is_not_said_to_have_none() -> None:
    about = {"classes": {}, "probability": 0.999, "gap_before": 2e-3, "gap_after": 1e-3}
    joints = [
        {"joint": "q1", "effects": [], "driver": None, **about},
        {"joint": "q2", "effects": [], "driver": "speed", **about},
        {"joint": "q3", "effects": ["delay"], "driver": "speed", **about},
    ]
    table = joints_table({"joints": joints, "effects": [{"name": "delay", "parameters": {}}], "gap": {"unit": "rad"}})
    assert table is not None
    told = [(row[1], row[-1]) for row in table.rows]
    assert told[:2] == [("–", "–"), ("what follows the speed and has no name", "–")]
    assert told[2] == (words_of("delay").short, "a rest follows the speed")


def test_of_several_joints_the_first_line_has_names_alone() -> None:
    results, _, labels = one_effect()
    shared = {"classes": {}, "driver": None, "probability": 0.9, "gap_before": 1e-3, "gap_after": 1e-4}
    results["joints"] = [
        {"joint": "q1", "effects": [], "word": "pan", **shared},
        {"joint": "q2", "effects": ["compliance", "backlash"], "word": "elbow", **shared},
    ]
    assert _told(results, about_of(labels))["What is wrong"] == "Joint 2 (elbow): compliance, backlash."


@pytest.mark.parametrize("name", CASES)
def test_every_case_has_its_answers(name: str) -> None:
    results, _, labels = CASES[name]()
    told = _told(results, about_of(labels))
    assert {"What is wrong", "How sure"} <= set(told)
    assert all(text.endswith(".") and "_text" not in text and "None" not in text for text in told.values())
