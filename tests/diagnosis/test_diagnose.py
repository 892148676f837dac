"""Causes that a diagnosis was not told, and what it may not say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jsonschema
import pytest
import torch
from diagnosis._machines import NOISE, acting, measured, reached_with, rows_of
from frozen import frozen

from ccnn_torch.diagnosis import Diagnosis, diagnose, diagnose_rows
from ccnn_torch.diagnosis.checks.identifiable import check_rows
from ccnn_torch.diagnosis.engine import candidates
from ccnn_torch.effects import Situation, default_gravity, make_effect
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records
from ccnn_torch.report.json_files import plain
from ccnn_torch.simulation.job import simulate_records, write_simulated


@pytest.mark.parametrize(
    ("machine", "causes", "tried"),
    [
        ("five_bar", ["compliance", "joint_offset"], None),
        ("tripod", ["thermal", "friction"], ["thermal", "friction", "backlash", "joint_gain", "compliance"]),
    ],
)
def test_it_names_the_causes(machine: str, causes: list[str], tried: list[str] | None) -> None:
    situation = rows_of(machine, 90, 3)
    pose = measured(situation, dict.fromkeys(causes, 12.0), 4)
    said = diagnose_rows(situation, pose, effects=tried)
    verdict = said.verdict
    assert set(verdict["effects"]) == set(causes), verdict
    assert not verdict["outside_library"] and not verdict["none"]
    assert verdict["shrink"] > 0.95 and verdict["shrink_ci95"][1] == 1.0
    assert said.gap["after"] == pytest.approx(said.gap["noise_floor"], rel=0.25)
    assert {a.effect.name for a in said.acting} == set(causes)
    jsonschema.validate(plain(said.to_json()), frozen("diagnosis"))


def near_singular(said: Diagnosis) -> list[int]:
    """Rows in which the platform moves three times as far with the joints as usual; few in a five-bar's workspace."""
    jacobian = said.analysis.situation.jacobian[:, :2]
    gain = torch.linalg.svdvals(jacobian)[:, 0]
    rows: list[int] = torch.nonzero(gain > 3 * gain.median()).flatten().tolist()
    assert len(rows) < 0.05 * len(gain)
    return rows


def test_an_eccentric_encoder_is_no_weight() -> None:
    """A wave once a turn needs no search, though what hangs on a crank makes nearly the same one."""
    mechanism, g = load_mechanism("delta"), torch.Generator().manual_seed(1)
    pose = mechanism.sample_workspace(150, g)
    joints = mechanism.solve_inverse(pose)
    phase = torch.arange(joints.shape[1]) * 0.7 + 1
    reached = mechanism.forward_kinematics(joints + 1e-3 * torch.sin(joints + phase), guess=pose)
    reached += 1e-5 * torch.randn(reached.shape, generator=g, dtype=torch.float64)
    said = diagnose_rows(Situation(mechanism, joints, {}, default_gravity(mechanism), None, pose), reached)
    assert said.verdict["effects"] == ["transmission"]
    # A third of a period is seen.
    assert said.verdict["probability"] <= 0.6


def test_a_period_that_the_file_tells_is_found_whatever_it_is() -> None:
    """Of joints that turn whole numbers a turn are searched; a gear of 27.5 : 1 is told."""
    there = rows_of("five_bar", 90, 3)
    situation = replace(there, mechanism=load_mechanism("five_bar", gears=[27.5, 27.5]))
    wave = acting(situation, "transmission", q1_sin=3e-4, q1_cos=2e-4, q2_cos=-3e-4)
    pose = reached_with(there, [wave._replace(shape=torch.full((2,), 27.5, dtype=torch.float64))], 4)
    said = diagnose_rows(situation, pose, effects=["transmission", "joint_gain", "compliance"])
    found = next(e["parameters"] for e in said.effects if e["name"] == "transmission")
    assert said.verdict["effects"] == ["transmission"] and not said.verdict["outside_library"]
    assert found["q1 frequency"]["value"] == 27.5
    assert found["q1 sin"]["value"] == pytest.approx(3e-4, rel=0.1)


def test_noise_alone_is_no_cause() -> None:
    situation = rows_of("five_bar", 60, 5)
    said = diagnose_rows(situation, measured(situation, {}, 6))
    assert said.verdict["none"] and said.verdict["effects"] == [] and said.by_block is None
    assert said.gap["reducible_share"] < 0.2


def test_a_cause_that_the_library_lacks_is_outside_and_its_driver_is_named() -> None:
    situation = rows_of("five_bar", 200, 7)
    pose = measured(situation, {"compliance": 15.0}, 8)
    said = diagnose_rows(situation, pose, effects=["frame", "joint_offset"])
    assert said.verdict["outside_library"] and said.verdict["driver"] in ("load x", "load y")
    assert not said.verdict["effects"] and said.next_measurements == []
    assert "None of the effects that were tried (frame, joint_offset) explains it" in said.verdict["text"]
    assert any("no measurement is proposed" in note for note in said.notes)


def test_a_direction_of_what_is_no_joint_is_a_driver_too() -> None:
    """As of a plate's belt behind the joints, `direction_phi`."""
    situation = rows_of("five_bar", 120, 7)
    way = torch.where(torch.rand(120, generator=torch.Generator().manual_seed(1)) < 0.5, -1.0, 1.0).double()
    situation = replace(situation, covariates={**situation.covariates, "direction_phi": way})
    pose = measured(situation, {}, 8) + 3e-4 * way[:, None]
    said = diagnose_rows(situation, pose, effects=["frame", "backlash"])
    assert said.verdict["driver"] == "direction phi" and "the direction of phi" in said.verdict["text"]


def test_play_and_springs_that_cancel_are_not_taken_for_friction() -> None:
    """Edges of the play many times as large as the play, against a compliance, come near what friction does."""
    situation = rows_of("delta", 80, 3)
    effects = ["geometry", "joint_offset", "backlash", "compliance"]
    said = diagnose_rows(situation, measured(situation, {"friction": 10.0}, 4), effects=effects)
    assert said.verdict["outside_library"] and said.verdict["driver"].startswith("direction")
    assert said.verdict["effects"] == []


def test_cranks_heavier_than_the_machine_are_no_sag() -> None:
    """The weights of a delta's cranks, thirty times as large as plausible, come near a gain of its drives."""
    situation = rows_of("delta", 100, 3)
    effects = ["geometry", "joint_offset", "joint_gain", "gravity", "compliance"]
    sags = diagnose_rows(situation, measured(situation, {"gravity": 10.0}, 53), effects=effects).verdict
    assert sags["effects"] == ["gravity"] and not sags["outside_library"] and sags["probability"] > 0.8
    effects.remove("joint_gain")
    said = diagnose_rows(situation, measured(situation, {"joint_gain": 10.0}, 53), effects=effects).verdict
    assert said["outside_library"] and "gravity" not in said["effects"]


def test_the_larger_of_two_causes_is_named_though_the_other_could_copy_it() -> None:
    """Over a short travel the weights of a delta's cranks do what offsets of its drives do."""
    situation = rows_of("delta", 200, 1)
    offset = acting(situation, "joint_offset", q1=1e-3, q2=-5e-4, q3=2e-4)
    sag = acting(situation, "gravity", q1=1e-3, q2=1e-3, q3=1e-3)
    effects = ["geometry", "joint_offset", "joint_gain", "gravity", "compliance"]
    said = diagnose_rows(situation, reached_with(situation, [offset, sag], 2, 1e-5), effects=effects).verdict
    assert set(said["effects"]) == {"joint_offset", "gravity"} and not said["outside_library"]


def test_bad_rows_are_set_aside_and_do_not_hide_the_cause() -> None:
    situation = rows_of("five_bar", 200, 9)
    pose = measured(situation, {"backlash": 10.0}, 10)
    bad = [3, 50, 51, 120, 199]
    pose[bad] += 100 * NOISE
    said = diagnose_rows(situation, pose, effects=["joint_offset", "backlash", "friction"])
    assert said.verdict["effects"] == ["backlash"] and not any("lie together" in text for text in said.cautions)
    assert set(said.rows_set_aside) == {*bad, *near_singular(said)}


def test_poses_as_the_model_says_to_the_last_digit_have_no_cause() -> None:
    situation = rows_of("five_bar", 60, 21)
    assert diagnose_rows(situation, situation.pose, effects=["geometry", "backlash"]).verdict["none"]


def test_one_row_of_a_heavy_tail_is_no_cause_and_one_far_beyond_is() -> None:
    situation = rows_of("five_bar", 200, 11)
    for times, none in ((25, True), (150, False)):
        pose = measured(situation, {}, 12)
        pose[20, 0] += times * NOISE
        said = diagnose_rows(situation, pose, effects=["geometry", "joint_offset", "backlash", "compliance"])
        assert said.verdict["none"] is none and (20 in said.rows_set_aside)
        assert said.verdict["effects"] == ([] if none else ["outlier"])


def test_what_the_records_lack_is_said_and_not_a_candidate() -> None:
    situation = rows_of("five_bar", 100, 13)
    bare = replace(situation, covariates={})
    said = diagnose_rows(bare, measured(situation, {"joint_offset": 10.0}, 14))
    assert "joint_offset" in said.verdict["effects"]
    assert not {"compliance", "backlash", "thermal"} & {e["name"] for e in said.effects}
    assert any("compliance" in n and "load" in n for n in said.notes)


def test_what_cannot_show_in_these_rows_is_said_and_not_a_candidate() -> None:
    situation = rows_of("five_bar", 60, 3)
    rested = situation.with_covariates(
        {**situation.covariates, **{f"speed{i}": torch.zeros(60, dtype=torch.float64) for i in (1, 2)}}
    )
    pose = measured(situation, {"joint_gain": 20.0}, 4)
    said = diagnose_rows(rested, pose, effects=["joint_gain", "latency"])
    assert said.not_seen == {"latency": "rows in which it shows: in these it changes no pose"}
    assert said.not_seen == check_rows(rested, pose, None, ["joint_gain", "latency"]).missing
    assert [e["name"] for e in said.effects] == ["joint_gain"]


def test_an_effect_of_ones_own_stands_beside_all_of_the_library() -> None:
    situation = rows_of("five_bar", 60, 3)
    usable, lacking = candidates(situation, ["all"])
    own = make_effect(f"{Path(__file__).parents[2] / 'experiments' / 'my_effect.py'}:HosePull")
    both, _ = candidates(situation, ["all", own])
    assert [e.name for e in both] == [*(e.name for e in usable), own.name] and lacking
    with pytest.raises(InputError, match=r"'backlash' is one name and not a list of names"):
        candidates(situation, "backlash")


def test_the_seed_decides_and_nothing_else() -> None:
    situation = rows_of("five_bar", 60, 15)
    pose = measured(situation, {"joint_gain": 10.0}, 16)
    state = torch.random.get_rng_state()
    some = ["joint_gain", "backlash"]
    first, again = (diagnose_rows(situation, pose, effects=some, seed=1).to_json() for _ in range(2))
    assert first == again
    assert torch.equal(state, torch.random.get_rng_state())


def test_rows_out_of_reach_are_set_aside_and_most_of_them_are_too_many() -> None:
    situation = rows_of("five_bar", 60, 17)
    pose = measured(situation, {"joint_offset": 10.0}, 18)
    joints = situation.joints.clone()
    joints[5] = torch.tensor([3.1, 0.0], dtype=torch.float64)
    lost = replace(situation, joints=joints, guess=None)
    assert 5 in diagnose_rows(lost, pose, effects=["joint_offset"]).rows_set_aside
    joints[:40] = torch.tensor([3.1, 0.0], dtype=torch.float64)
    with pytest.raises(InputError, match="outside the reach"):
        diagnose_rows(replace(situation, joints=joints, guess=None), pose)
    with pytest.raises(InputError, match="too few"):
        diagnose_rows(replace(situation, joints=situation.joints[:10], covariates={}, guess=None), pose[:10])


def test_the_check_tells_noise_and_what_looks_alike() -> None:
    situation = rows_of("five_bar", 150, 19)
    found = check_rows(situation, measured(situation, {"backlash": 5.0}, 20))
    assert found.noise["x"] == pytest.approx(NOISE, rel=0.3)
    pairs = {(a, b) for a, b, _ in found.confusable}
    # The five-bar's own parameters have the drives' offsets and gains among them.
    assert ("joint_offset", "geometry") in pairs and ("joint_gain", "geometry") in pairs
    assert ("backlash", "geometry") not in pairs
    assert "tool" in found.missing


def test_candidates_that_the_records_cannot_show_are_refused() -> None:
    situation = rows_of("five_bar", 60, 3)
    pose = measured(situation, {}, 4)
    blind = replace(situation, covariates={})
    with pytest.raises(InputError, match=r"none of the candidates: compliance needs a column of the load .*load_x"):
        diagnose_rows(blind, pose, effects=["compliance"])


def test_an_exact_effect_has_no_other_form_that_would_excuse_a_remainder() -> None:
    """Gains take over all but a hundredth of the cause's squares; a spring or a play might be of such another form."""
    situation = rows_of("delta", 120, 23)
    pose = measured(situation, {"geometry": 60.0}, 24)
    found = diagnose_rows(situation, pose, effects=["joint_gain", "frame", "backlash"])
    assert found.verdict["outside_library"]
    assert found.judgement.found.rss < 0.01 * float(found.analysis.dictionary.grams.yy)


def test_one_joint_off_is_an_offset_and_no_gain() -> None:
    """An arm's gain has a zero of its own for every joint; that of one joint alone is an offset all the same."""
    arm = load_mechanism(str(Path(__file__).parents[1] / "effects" / "arm.yaml"))
    joints = arm.sample_joints(100, torch.Generator().manual_seed(1))
    off = torch.zeros(6, dtype=torch.float64)
    off[1] = 8e-4
    pose = arm.forward_kinematics(joints + off)
    pose = pose + 2e-5 * torch.randn(pose.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rows = Situation(arm, joints, {}, default_gravity(arm), None, pose)
    found = diagnose_rows(rows, pose, effects=["geometry", "joint_offset", "joint_gain"])
    assert found.verdict["effects"] == ["joint_offset"], found.verdict["text"]


def test_plain_play_beside_an_offset_is_play_in_few_rows(tmp_path: Path) -> None:
    """Its usual form is a candidate whatever the search for a push that lifts the joint finds."""
    machine, path = load_mechanism("five_bar"), tmp_path / "rows.csv"
    causes = ["joint_offset:q1=0.02deg,q2=-0.01deg", "backlash:q1=0.3mrad"]
    write_simulated(path, simulate_records("five_bar", causes, 200, 1e-5, seed=5))
    path.write_text("".join(path.read_text(encoding="utf-8").splitlines(keepends=True)[:61]), encoding="utf-8")
    records = load_records(path, machine, learns=False)
    found = diagnose(records, machine, noise=1e-5, effects=["joint_offset", "joint_gain", "backlash", "friction"])
    assert set(found.verdict["effects"]) == {"joint_offset", "backlash"} and not found.verdict["outside_library"]


def test_the_numbers_of_an_effect_are_not_shared_with_one_that_cannot_be_told_from_it() -> None:
    rows = rows_of("stewart", 120, 1)
    rows = replace(rows, covariates={n: v for n, v in rows.covariates.items() if not n.startswith("load")})
    pose = reached_with(rows, [acting(rows, "backlash", q4=9e-5)], 6, 1e-5)
    found = diagnose_rows(rows, pose, effects=["backlash", "friction", "joint_offset"])
    entry = next(e for e in found.effects if e["name"] == "backlash")
    assert found.verdict["effects"] == ["backlash"] and entry["indistinguishable_from"] == ["friction"]
    assert entry["parameters"]["q4"]["value"] == pytest.approx(9e-5, rel=0.05)
