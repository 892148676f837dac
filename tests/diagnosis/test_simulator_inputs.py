"""What a diagnosis tells beside its verdict: effects in order, why some are not told apart, what was not recorded."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from _machines import NOISE, acting, cramped, measured, reached_with, rows_of
from scipy.linalg import subspace_angles

from ccnn_torch.diagnosis import diagnose, diagnose_rows
from ccnn_torch.effects import Situation
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records
from ccnn_torch.simulation.job import simulate_records, write_simulated

EXACT = torch.full((3,), NOISE, dtype=torch.float64)
# Where no other effect is in question.
FEW = ["geometry", "joint_offset", "compliance", "backlash"]


def test_effects_are_added_in_order_the_largest_first() -> None:
    rows = rows_of("five_bar", 150, 3)
    said = diagnose_rows(rows, measured(rows, {"compliance": 12.0, "backlash": 6.0}, 4), None, FEW)
    steps = said.in_order
    assert [s["name"] for s in steps] == said.verdict["effects"] and len(steps) > 1
    gaps = [said.gap["before"], *(s["gap_after"] for s in steps)]
    assert gaps == sorted(gaps, reverse=True)
    # The first by itself, all of them together: both are told elsewhere, too.
    alone = next(e for e in said.effects if e["name"] == steps[0]["name"])
    assert steps[0]["gap_after"] == pytest.approx(alone["gap_after"])
    assert steps[0]["shrink_ci95"] == pytest.approx(alone["shrink_ci95"])
    assert (gaps[-1], steps[-1]["shrink"]) == (said.gap["after"], said.verdict["shrink"])
    floor, before = said.gap["noise_floor"], said.gap["before"]
    for step in steps:
        low, high = step["shrink_ci95"]
        plain = 1 - (step["gap_after"] ** 2 - floor**2) / (before**2 - floor**2)
        assert low <= step["shrink"] <= high and step["shrink"] == pytest.approx(plain)
    assert diagnose_rows(rows, measured(rows, {}, 5), None, ["geometry", "compliance"]).in_order == []


def test_numbers_are_told_beside_what_is_too_little_to_be_named() -> None:
    situation = rows_of("delta", 120, 1)
    offset = {"q1": 2e-3, "q2": -2e-3, "q3": 2.5e-3}
    sag = acting(situation, "gravity", q1=2e-4, q2=2e-4, q3=3e-4)
    poses = reached_with(situation, [acting(situation, "joint_offset", **offset), sag], 2, 1e-5)
    said = diagnose_rows(situation, poses, effects=["geometry", "joint_offset", "joint_gain", "gravity"])
    assert said.verdict["effects"] == ["joint_offset"]
    told = next(e for e in said.effects if e["name"] == "joint_offset")["parameters"]
    for name, value in offset.items():
        assert abs(told[name]["value"] - value) < 3 * told[name]["sd"] < 3e-4
    assert any("the values of joint_offset are from a fit that also holds gravity" in n for n in said.notes)


def test_what_no_name_stands_for_is_told_beside_nothing() -> None:
    situation = rows_of("five_bar", 200, 1)
    change = 2e-3 * torch.exp(-(((situation.joints[:, 1] - situation.joints[:, 1].median()) / 0.15) ** 4))
    moved = (situation.jacobian[..., 1] * change[:, None])[:, :2]
    offset = reached_with(situation, [acting(situation, "joint_offset", q1=3e-5)], 2)
    said = diagnose_rows(situation, offset + moved, effects=[*FEW, "joint_gain", "transmission"])
    assert said.verdict["outside_library"] and not said.verdict["effects"]
    assert not any("also holds" in note for note in said.notes)


def test_why_one_effect_is_not_told_from_another_is_their_angle() -> None:
    rows = cramped("five_bar", 60, 0)
    said = diagnose_rows(rows, measured(rows, {"joint_offset": 8.0, "compliance": 8.0}, 50), EXACT)
    assert set(said.verdict["effects"]) == {"joint_offset", "compliance"}
    effect = next(e for e in said.effects if e["name"] == "joint_offset")
    assert effect["indistinguishable_from"] and set(effect["signatures"]) == set(effect["indistinguishable_from"])
    # The gain of a joint has a zero of its own, so that it can do all that an offset does.
    assert effect["signatures"]["joint_gain"]["angle"] < 1e-6
    assert "on these poses their signatures are" in said.verdict["text"]
    # What to measure next is what tells such names apart.
    pairs = [{"joint_offset", other} for other in effect["signatures"]]
    assert all(set(m["separates"]) in pairs for m in said.next_measurements[:3])
    analysis, found = said.analysis, said.judgement.found
    dictionary = analysis.dictionary

    def columns(name: str) -> np.ndarray:
        atom = next(i for i, a in enumerate(dictionary.atoms) if a.name == name)
        return dictionary.columns[..., dictionary.groups[atom]].flatten(0, 1).numpy()

    q, _ = np.linalg.qr(columns("compliance"))
    place = [dictionary.atoms[i].name for i in found.members].index("joint_offset")
    own = columns("joint_offset") @ found.mean[place].numpy()
    own = (own - q @ (q.T @ own))[:, None]
    for other, told in effect["signatures"].items():
        if sum(a.name == other for a in dictionary.atoms) > 1:
            continue
        z = columns(other)
        angle = float(subspace_angles(own, z - q @ (q.T @ z))[0])
        assert told["angle"] == pytest.approx(angle, abs=1e-6)
        assert told["separation"] == pytest.approx(float(np.linalg.norm(own)) * math.sin(angle), abs=1e-4)
    assert next(e for e in said.effects if e["name"] == "compliance")["signatures"].keys() == set(
        next(e for e in said.effects if e["name"] == "compliance")["indistinguishable_from"]
    )


def _without(rows: Situation, *kinds: str) -> Situation:
    return replace(rows, covariates={n: v for n, v in rows.covariates.items() if not n.startswith(kinds)})


def test_columns_that_are_missing_are_proposed_with_what_they_would_show() -> None:
    rows = rows_of("five_bar", 80, 6)
    poses = reached_with(rows, [acting(rows, "compliance", q1=4e-6)], 7)
    said = diagnose_rows(_without(rows, "load", "direction", "time"), poses)
    assert set(said.not_seen) >= {"compliance", "backlash", "friction", "drift", "latency"}
    proposed = {tuple(entry["columns"]): entry["effects"] for entry in said.missing_covariates}
    assert set(proposed[("load_x[N]", "load_y[N]")]) == {"compliance"}
    assert set(proposed[("direction1[1]", "direction2[1]")]) == {"backlash", "friction"}
    assert set(proposed[("time[s]",)]) == {"drift"}
    largest = [max(entry["effects"].values()) for entry in said.missing_covariates]
    assert largest == sorted(largest, reverse=True) and largest[-1] > 1e-6 and largest[0] < 1e-3
    # No column brings a turning platform, and what was recorded is not asked for.
    assert "tool" in said.not_seen and not any("tool" in effects for effects in proposed.values())
    assert diagnose_rows(rows, poses).missing_covariates == []


def test_a_cause_that_nothing_recorded_shows_is_not_passed_off_as_noise() -> None:
    rows = rows_of("five_bar", 80, 2)
    poses = measured(rows, {"backlash": 5.0}, 4)
    bare = _without(rows, "load", "direction", "time", "temperature")
    guessed = diagnose_rows(bare, poses)
    # It scatters unlike noise: something is there, and what it follows is not sure.
    assert guessed.verdict["outside_library"] and guessed.verdict["probability"] <= 0.6
    assert not guessed.verdict["effects"]
    assert any("the noise was not given" in n and "direction1[1], direction2[1]" in n for n in guessed.notes)
    given = diagnose_rows(bare, poses, EXACT, effects=["geometry", "joint_offset", "joint_gain", "backlash"])
    assert given.verdict["outside_library"] and not given.verdict["none"]
    assert not any("the noise was not given" in n for n in given.notes)


def test_the_temperature_is_asked_for_first_where_the_rest_follows_the_time() -> None:
    rows = rows_of("five_bar", 150, 8)
    poses = measured(rows, {"thermal": 12.0}, 9)
    # Growth itself would be named by its course in time.
    effects = ["geometry", "compliance", "thermal_compliance", "backlash"]
    said = diagnose_rows(_without(rows, "temperature"), poses, None, effects)
    assert said.verdict["outside_library"] and said.verdict["driver"] == "time"
    assert said.missing_covariates[0]["columns"] == ["temperature[degC]"]


def test_every_row_set_aside_has_its_reason() -> None:
    rows = rows_of("five_bar", 120, 10)
    poses = measured(rows, {"joint_offset": 8.0}, 11)
    poses[40] += 100 * NOISE
    poses[50] += 10.0
    said = diagnose_rows(rows, poses, None, FEW)
    why = dict(zip(said.rows_set_aside, said.why_set_aside, strict=True))
    assert why[40] == "far from what any fit to the other rows says"
    assert why[50] == "far from where its joints put it"
    looked_at = torch.tensor([row for row in range(120) if row != 50])
    near = looked_at[said.analysis.near_singular].tolist()
    assert {row for row, reason in why.items() if reason == "next to a singularity"} == set(near)


def test_noise_in_words_is_refused_where_numbers_are_asked_for(tmp_path: Path) -> None:
    write_simulated(tmp_path / "rows.csv", simulate_records("five_bar", ["backlash"], 40, 1e-5))
    records = load_records(tmp_path / "rows.csv", load_mechanism("five_bar"), learns=False)
    with pytest.raises(InputError, match=r"noise: '10um' is a text; give a number in SI"):
        diagnose(records, load_mechanism("five_bar"), noise="10um")  # type: ignore[arg-type]
