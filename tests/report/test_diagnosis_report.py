"""Reports of made-up diagnoses, read back: the words, the tables, the pictures, and the page in a browser."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import find_browser, measured
from diagnosis_cases import CASES, indistinguishable, none, one_effect, two_effects, with_rotation
from rich.console import Console
from test_run_report import Page

from ccnn_torch.diagnosis.page.data import About, about_of, signatures_of
from ccnn_torch.diagnosis.page.figures import remainder_map, signature_plot
from ccnn_torch.diagnosis.page.report import diagnosis_page, print_diagnosis, write_diagnosis_report
from ccnn_torch.diagnosis.page.tables import (
    aside_table,
    confusable_table,
    effect_table,
    gap_table,
    next_table,
    order_table,
    quantity_text,
    region_table,
    shares,
    where_table,
    write_next_csv,
)
from ccnn_torch.diagnosis.verdict.text import (
    aside_text,
    network_text,
    verdict_text,
)
from ccnn_torch.display import unit_text
from ccnn_torch.errors import InputError
from ccnn_torch.report.arrays import load_tensors
from ccnn_torch.report.json_files import write_json


def _numpy(arrays: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in arrays.items()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of a class that the rows do not tell apart, to be read only."""
    folder = tmp_path_factory.mktemp("diagnosis")
    results, arrays, labels = indistinguishable()
    write_json(folder / "diagnosis.json", results)
    write_next_csv(folder / "next_measurements.csv", results, about_of(labels))
    write_diagnosis_report(folder, results, arrays, labels)
    return folder


def test_tables_hold_the_numbers() -> None:
    results, arrays, labels = with_rotation()
    about = about_of(labels)
    gap = gap_table(results, about)
    assert [row[0] for row in gap.rows] == ["position [µm]", "rotation [µrad]"]
    assert gap.rows[0][1:4] == ("420.0", "113.0", "21.00") and gap.note.endswith("(--noise).")
    effects = effect_table(results)
    assert effects is not None and len(effects.rows) == len(results["effects"])
    assert effects.rows[0][:5] == ("compliance ●", "joint compliance under load", "0.98", "113.0", "93.0 [91.0, 95.0]")
    regions = region_table(results, about)
    assert regions is not None
    assert regions.rows[0] == ("0 mm to 100 mm", "300 mm to 400 mm", "40.0", "34.0 to 46.0", "50")
    told = {part: (share, interval) for _, part, share, interval in shares(results, about)}
    assert told["output x"] == (0.7, [0.66, 0.74]) and told["load_z 60 N to 120 N"] == (0.85, [0.8, 0.9])
    aside = aside_table(results, _numpy(arrays), about)
    assert aside is not None and aside.columns == ("row", "residual [mm]", "why")
    expected = [1e3 * float(arrays["residual"][i, :3].norm()) for i in (17, 90)]
    assert [float(row[1]) for row in aside.rows] == pytest.approx(expected, rel=1e-3)
    assert [row[0] for row in aside.rows] == ["18", "91"]
    named = aside_table(results, _numpy(arrays), replace(about, lines=(19, 93)))
    assert named is not None and named.columns[:2] == ("line", "row")
    assert [row[:2] for row in named.rows] == [("19", "18"), ("93", "91")]


def test_rows_set_aside_are_told_by_reason_and_the_first_few_by_name() -> None:
    far, near = "far from the others", "next to a singularity"
    assert aside_text([], []) == ""
    assert aside_text([3], [far]) == "1 row set aside. Far from the others: 1, at row 4 (counted from 1)."
    rows = [2, 4, 6, 8, 10, 12, 30]
    told = aside_text(rows, [far, *[near] * 6], [row + 3 for row in rows])
    assert told == (
        "7 rows set aside. Far from the others: 1, at line 5 (row 3). "
        "Next to a singularity: 6, at lines 7, 9, 11, 13, 15 (rows 5, 7, 9, 11, 13) and 1 more."
    )


def test_pairs_are_told_once_with_their_angle_and_what_separates_them() -> None:
    results = indistinguishable()[0]
    table = confusable_table(results)
    assert table is not None
    assert tuple(table.rows) == (
        ("joint_offset or geometry", "0.52 or 0.31", f"{math.degrees(0.03):.1f}", "1.2", "number 1"),
        ("joint_offset or frame", "0.52 or 0.13", f"{math.degrees(0.2):.1f}", "2.5", "–"),
    )
    assert confusable_table(one_effect()[0]) is None
    del results["effects"][0]["signatures"]
    without = confusable_table(results)
    assert without is not None and [row[2:4] for row in without.rows] == [("–", "–")] * 2
    assert "(these data do not distinguish them)" in verdict_text(results)


def test_what_a_network_would_still_gain_is_one_sentence() -> None:
    results = one_effect()[0]
    assert network_text(results) == (
        "A network on what is left would gain 53.0 µm [30.0 µm, 70.0 µm] more on rows not used for training "
        "(113 µm → 60.0 µm)."
    )
    order = order_table(results)
    assert order is not None and order.rows[-2] == ("+ a network on the remainder", "60.00", "–", "–")
    assert order.rows[-3] == ("all of them, by block", "131.0", "91.0", "88.0 to 94.0")
    assert "Held out in 5 blocks" in order.note and "take the gap from 410 µm to 131 µm." in order.note
    results["gap"]["noise_floor"] = 9e-5
    assert network_text(results).endswith("less than the noise was taken for: part of that is no noise but repeats.")
    results["network"]["gain_ci95"] = [-1e-6, 3e-6]
    assert network_text(results).startswith("A network on what is left gains nothing on rows not used for training")
    results["network"] |= dict.fromkeys(("gap_after", "gap_after_ci95", "gain", "gain_ci95"))
    results["network"]["reason"] = "what the effects leave is no more than the noise"
    assert network_text(results) == (
        "A network has nothing left to learn: what the effects leave is no more than the noise."
    )
    results["in_order"], results["by_block"] = [], None
    assert order_table(results) is None
    assert network_text(two_effects()[0]) == ""


def test_what_is_not_seen_is_a_table_and_no_note_as_well() -> None:
    results = one_effect()[0]
    text = diagnosis_page(results).markdown()
    assert "latency cannot be seen" not in text and "a note of its own." in text
    assert "| latency | needs time[s] |" in text and "| speed1[rad/s] | latency | 42.0 |" in text


def test_units_are_written_as_in_print() -> None:
    written = ("rad/N/m", "rad/(N*m)", "m/N", "N*m", "1", "rad/N/m/K")
    assert [unit_text(u) for u in written] == ["rad/(N·m)", "rad/(N·m)", "m/N", "N·m", "1", "rad/(N·m·K)"]
    about = About()
    assert quantity_text(2.0, about.unit("load_rx")) == "2 N·m"


def test_a_terminal_shows_only_regimes_that_tell_something() -> None:
    results, _, labels = one_effect()
    about = about_of(labels)
    assert where_table(results, about, telling=True) == where_table(results, about)
    results["where_ci95"]["covariates"]["load_z"] = [[0.1, 0.6], [0.4, 0.9]]
    told = where_table(results, about, telling=True)
    assert told is not None and not any("load_z" in row[0] for row in told.rows)
    assert told.note.endswith("Not shown: load_z, over which these rows show no difference in the gap.")


def test_next_measurements_as_table_and_as_records_for_the_machine(folder: Path) -> None:
    results, _, labels = indistinguishable()
    table = next_table(results, about_of(labels))
    assert table is not None
    assert table.rows[0] == ("1", "0.6 rad", "1.4 rad", "100 N", "25.0 °C", "joint_offset or geometry", "0.420")
    with (folder / "next_measurements.csv").open(newline="") as file:
        header, first, second = csv.reader(file)
    assert header == ["q1[deg]", "q2[deg]", "load_z[N]", "temperature[degC]", "gain[1]"]
    in_degrees = [math.degrees(0.6), math.degrees(1.4), 100.0, 25.0, 0.42]
    assert [float(v) for v in first] == pytest.approx(in_degrees) and second[3] == ""


def test_the_page_is_whole_and_fetches_nothing(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    page.close()
    assert page.open == [] and "script" not in page.count and "link" not in page.count
    assert page.count["svg"] == 3 == page.count["figcaption"] and page.count["table"] == 10
    outside = {a for a in page.addresses if not a.startswith(("#", "data:"))}
    assert all((folder / address).is_file() for address in outside) and "diagnosis.json" in outside
    assert text.index('class="verdict"') < text.index("<svg") < text.index("What should be measured next?")
    stems = ("machine", "signatures", "map")
    assert {p.name for p in (folder / "plots").iterdir()} == {f"{s}.svg" for s in stems}


def test_a_browser_shows_all_of_the_page(folder: Path, tmp_path: Path) -> None:
    browser = find_browser()
    # A machine without a browser still holds the page to the test above.
    for width in (1280, 640) if browser else ():
        seen = measured(browser, folder / "report.html", tmp_path, width)
        assert seen["page"] <= seen["window"], "the page is wider than the window"
        assert seen["fetched"] == 0
        assert 0 < seen["verdict"]["top"] < 200 and seen["verdict"]["height"] > 20
        assert len(seen["figures"]) == 3 and len(seen["tables"]) == 10
        assert all(0.5 * min(width, 600) < f["width"] <= width and f["height"] > 60 for f in seen["figures"])
        assert "these data do not distinguish them" in seen["text"] and "&amp;" not in seen["text"]


def test_a_machine_of_many_joints_and_conditions_has_its_next_measurements_on_the_page(tmp_path: Path) -> None:
    results, arrays, labels = indistinguishable()
    joints = {f"q{i}": 0.6543 for i in range(1, 7)}
    conditions = {"temperature": 298.15, **{f"load_{n}": -160.8 for n in ("x", "y", "z", "rx", "ry", "rz")}}
    conditions |= {f"direction{i}": -1.0 for i in range(1, 7)}
    entry = results["next_measurements"][0] | {"joints": joints, "covariates": conditions}
    results["next_measurements"] = [entry] * 8
    labels["about"]["units"] = labels["about"].get("units", {}) | dict.fromkeys(joints, "m")
    table = next_table(results, about_of(labels))
    assert table is not None and table.columns == ("number", *map(str, range(1, 9)))
    assert [row[0] for row in table.rows] == [*joints, *conditions, "separates", "gain [nat]"]
    assert table.rows[0][1:] == ("654.3 mm",) * 8 and table.rows[-2][1] == "joint_offset or geometry"
    page = write_diagnosis_report(tmp_path, results, arrays, labels)
    browser = find_browser()
    # The narrower ones: what does not fit scrolls in its box, nothing else does.
    for width in (1100, 420) if browser else ():
        seen = measured(browser, page, tmp_path, width)
        assert seen["page"] <= seen["window"] and len(seen["boxes"]) == len(seen["tables"])
        assert all(box["overflow"] == "auto" and box["width"] <= width for box in seen["boxes"])
        if width > 1000:
            cut = [box["name"] for box in seen["boxes"] if box["content"] > box["inside"]]
            assert cut == [], cut


def test_the_same_files_give_the_same_page_and_text_is_escaped(folder: Path, tmp_path: Path) -> None:
    results, arrays, labels = none()
    labels = {"about": {"name": "<b>a & b</b>", "notes": ["x < y"]}}
    arrays["held_out"].fill_(1)
    write_json(tmp_path / "diagnosis.json", results)
    first = write_diagnosis_report(tmp_path, results, arrays, labels).read_text()
    again = write_diagnosis_report(tmp_path).read_text()
    assert first == again
    assert "200 rows · each judged by a fit to other rows" in first
    assert "&lt;b&gt;a &amp; b&lt;/b&gt;" in first and "x &lt; y" in first and "<b>a" not in first


@pytest.mark.parametrize("name", CASES)
def test_terminal_and_markdown_of_every_case(name: str) -> None:
    results, _, labels = CASES[name]()
    screen = io.StringIO()
    print_diagnosis(results, Console(file=screen, width=100), about_of(labels), details=True)
    told = " ".join(screen.getvalue().split())
    assert verdict_text(results) in told and "How large is the gap?" in told
    first = io.StringIO()
    print_diagnosis(results, Console(file=first, width=100), about_of(labels))
    lines = first.getvalue().splitlines()
    assert lines[0].startswith("What is wrong: ") and all("━" not in line for line in lines)
    assert "How large is the gap?" not in first.getvalue() and "--details" in first.getvalue()
    assert len(lines) < 30
    text = diagnosis_page(results, about_of(labels)).markdown()
    assert all(f"{note}." in text for note in results["notes"] if "cannot be seen" not in note)
    blocks = text.split("## ")[1:]
    for block in blocks:
        assert len({line.replace("\\|", "").count("|") for line in block.splitlines() if line.startswith("|")}) == 1


@pytest.mark.parametrize("name", CASES)
def test_pictures_of_every_case_show_the_numbers(name: str) -> None:
    results, tensors, labels = CASES[name]()
    arrays, about = _numpy(tensors), about_of(labels)
    verdict = results["verdict"]
    signatures = signatures_of(arrays, labels, verdict["effects"])
    drawn = signature_plot(signatures, arrays, verdict["effects"])
    assert (drawn is None) == (name in ("none", "outlier", "bare"))
    assert drawn is None or len(drawn.figure.axes) == len(signatures)
    assert remainder_map(arrays, about) is not None


def test_a_few_far_rows_are_cut_off() -> None:
    _, tensors, labels = one_effect()
    arrays = _numpy(tensors)
    arrays["signature.compliance.y"][3] = 1.0
    drawn = signature_plot(signatures_of(arrays, labels), arrays, ["compliance"])
    assert drawn is not None and drawn.figure.axes[0].get_ylim()[1] < 1000


def test_rows_without_a_place_are_drawn_over_the_joints() -> None:
    _, tensors, labels = with_rotation()
    arrays = _numpy(tensors)
    arrays["place"] = np.zeros_like(arrays["place"])
    arrays["residual"][:, :3] = 0
    arrays["joints"][3] = np.nan
    plot = remainder_map(arrays, about_of(labels))
    assert plot is not None and "rotation gap over the joints" in plot.caption and "µrad" in plot.caption
    assert plot.figure.axes[0].get_xlabel() == "q1 [mrad]"
    arrays["residual"][:] = 0
    assert remainder_map(arrays, about_of(labels)) is None


def test_what_is_not_as_promised_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"diagnosis\.safetensors is not there"):
        load_tensors(tmp_path / "diagnosis.safetensors")
    with pytest.raises(InputError, match="'about' holds 'colour', which is not known"):
        about_of({"about": {"colour": "red"}})
    with pytest.raises(InputError, match=r"diagnosis\.json: there is no such file"):
        write_diagnosis_report(tmp_path)


def test_units_of_columns_that_nobody_named() -> None:
    about = about_of({"thermal": {"x": {"name": "coolant", "unit": "K"}, "y": {"name": "r", "unit": "m"}}})
    named = ("coolant", "load_x", "load_rx", "direction2", "time", "z", "q1")
    assert [about.unit(n) for n in named] == ["K", "N", "N*m", "1", "s", "m", "SI"]
    bare: dict[str, Any] = {"signature.a.x": np.arange(3.0), "signature.a.y": np.arange(3.0)}
    assert signatures_of(bare, {}) == []
