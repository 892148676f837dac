"""Rows that are not of the model are refused, the mistake named; what a verdict cannot rest on is said beside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from diagnosis._machines import NOISE, acting, measured, reached_with, rows_of
from torch import Tensor

from ccnn_torch.diagnosis import diagnose_rows, engine
from ccnn_torch.diagnosis.checks import cautions
from ccnn_torch.diagnosis.checks.identifiable import check_rows
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement, judge_rows
from ccnn_torch.effects import Situation, default_gravity
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

Mistake = Callable[[Situation, Tensor], tuple[Situation, Tensor]]
# Where the doubt is looked at and not which of all effects is named.
FEW = ["geometry", "joint_offset", "joint_gain", "backlash", "compliance"]


def _poses(change: Callable[[Tensor], Tensor]) -> Mistake:
    return lambda situation, pose: (replace(situation, guess=change(pose)), change(pose))


def _joints(change: Callable[[Tensor], Tensor]) -> Mistake:
    return lambda situation, pose: (replace(situation, joints=change(situation.joints)), pose)


def _other_axis(pose: Tensor) -> Tensor:
    return pose * torch.tensor([-1.0, 1.0], dtype=torch.float64)


def _one_in_millimetres(pose: Tensor) -> Tensor:
    return pose * torch.tensor([1000.0, 1.0], dtype=torch.float64)


def _shuffled(pose: Tensor) -> Tensor:
    return pose[torch.randperm(len(pose), generator=torch.Generator().manual_seed(0))]


def _from_a_tracker(pose: Tensor) -> Tensor:
    turn = rotation_vector_to_matrix(torch.tensor([0.1, -0.2, 1.3], dtype=torch.float64))
    return pose @ turn.mT + torch.tensor([2.0, 1.0, -0.5], dtype=torch.float64)


@pytest.mark.parametrize(
    ("machine", "mistake", "said"),
    [
        ("five_bar", _poses(lambda pose: 1000 * pose), "the pose's lengths seem to be in millimetres under m"),
        ("five_bar", _poses(lambda pose: 100 * pose), "the pose's lengths seem to be in centimetres under m"),
        ("five_bar", _poses(lambda pose: pose / 0.0254), "the pose's lengths seem to be in inches under m"),
        (
            "five_bar",
            _poses(lambda pose: pose / 1000),
            "the pose's lengths seem to be in metres under mm, or the model in millimetres under m",
        ),
        ("five_bar", _poses(lambda pose: pose / 25.4), "the pose's lengths seem to be in inches under mm"),
        (
            "delta",
            _poses(lambda pose: pose * torch.tensor([1.0, 1e-3, 1.0])),
            "y of the pose seems to be in metres under mm",
        ),
        (
            "five_bar",
            _joints(lambda joints: joints * torch.tensor([1.0, math.pi / 180])),
            "q2 seems to be in radians under deg",
        ),
        ("five_bar", _poses(_one_in_millimetres), "x of the pose seems to be in millimetres under m"),
        ("five_bar", _poses(lambda pose: pose + 0.7), r"seems to be shifted \(x by 0\.\d+ m, y by 0\.\d+ m\)"),
        ("five_bar", _poses(_other_axis), "x of the pose seems to be reversed"),
        ("five_bar", _poses(lambda pose: pose.flip(-1)), "x and y of the pose seem to be swapped"),
        ("five_bar", _joints(lambda joints: joints.flip(-1)), "the joints q1 and q2 seem to be swapped"),
        (
            "five_bar",
            _joints(lambda joints: joints * math.pi / 180),
            "the joints' angles seem to be in radians under deg",
        ),
        ("five_bar", _joints(lambda joints: joints[:1].expand_as(joints)), "joints and pose of a row belong together"),
        ("five_bar", _poses(_shuffled), "joints and pose of a row belong together"),
        ("tripod", _poses(lambda pose: pose * torch.tensor([1.0, 1.0, 180 / math.pi])), "angles .* in degrees"),
        (
            "delta_linear",
            _joints(lambda joints: joints * 1000),
            "the joints' lengths seem to be in millimetres under m",
        ),
        (
            "delta",
            _poses(_from_a_tracker),
            'seen from a frame .*=framed \'mechanism_keys={"mechanism": "delta"}\'',
        ),
    ],
)
def test_rows_of_another_model_are_refused_and_the_mistake_named(machine: str, mistake: Mistake, said: str) -> None:
    situation, pose = mistake(rows_of(machine, 60, 1), measured(rows_of(machine, 60, 1), {"joint_offset": 20.0}, 2))
    with pytest.raises(InputError, match=said):
        diagnose_rows(situation, pose)


def test_some_rows_in_millimetres_are_set_aside_and_said() -> None:
    situation = rows_of("five_bar", 90, 3)
    pose = measured(situation, {"joint_offset": 20.0}, 4)
    pose[::3] *= 1000
    found = diagnose_rows(situation, pose, effects=FEW)
    assert found.verdict["effects"] == ["joint_offset"]
    assert set(range(0, 90, 3)) <= set(found.rows_set_aside)
    assert "33 % of the rows are far from where their joints put them" in found.cautions[0]
    assert f"But {found.cautions[0]}." in found.verdict["text"] and found.verdict["probability"] <= 0.9
    assert "the pose's lengths seem to be in millimetres under m" in found.cautions[0]
    assert "33 %" in check_rows(situation, pose).cautions[0]


def test_rows_as_they_should_be_cause_no_doubt() -> None:
    situation = rows_of("five_bar", 90, 3)
    pose = measured(situation, {"compliance": 20.0}, 4)
    noise = torch.full((3,), NOISE, dtype=torch.float64)
    assert diagnose_rows(situation, pose, noise, FEW).cautions == [] and check_rows(situation, pose).cautions == []


def test_a_cause_a_thousand_times_too_large_is_doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loads in kilonewtons under N: the compliance is right, and its size cannot be."""
    situation = rows_of("five_bar", 120, 5)
    pose = reached_with(situation, [acting(situation, "compliance", q1=2e-6, q2=1e-6)], 6)
    columns = {n: v / 1000 if n.startswith("load") else v for n, v in situation.covariates.items()}
    found = diagnose_rows(replace(situation, covariates=columns), pose, effects=FEW)
    assert found.verdict["effects"] == ["compliance"] and found.verdict["probability"] <= 0.6
    assert any("times as large as is plausible" in caution for caution in found.cautions)
    # Not from rows that hardly determine it.
    certain = cautions.covariance
    monkeypatch.setattr(cautions, "covariance", lambda *of: 1e8 * certain(*of))
    found = diagnose_rows(replace(situation, covariates=columns), pose, effects=FEW)
    assert not any("times as large as is plausible" in caution for caution in found.cautions)


def test_a_temperature_of_no_workshop_is_doubted() -> None:
    situation = rows_of("five_bar", 60, 7)
    columns = dict(situation.covariates) | {"temperature": situation.covariates["temperature"] + 273.15}
    found = check_rows(replace(situation, covariates=columns), measured(situation, {}, 8))
    assert "check the unit of its column" in found.cautions[0]


def test_a_temperature_in_degf_is_found_out() -> None:
    """As degC it says that the machine hardly grows, and that something else follows the time."""
    rows = rows_of("delta_linear", 120, 7)
    hall = 293.15 + 4 * torch.sin(torch.linspace(0, 5, 120, dtype=torch.float64))
    situation = replace(rows, covariates=dict(rows.covariates) | {"temperature": hall})
    pose = reached_with(situation, [acting(situation, "thermal", growth=1.2e-5, q1_mount=6e-6)], 8)
    columns = dict(situation.covariates) | {"temperature": 273.15 + 32 + 1.8 * (hall - 273.15)}
    found = diagnose_rows(replace(situation, covariates=columns), pose, effects=[*FEW, "thermal", "frame_drift"])
    assert found.verdict["probability"] <= 0.9
    assert any("check the unit of its column, degC, degF or K" in caution for caution in found.cautions)
    said, corrected = next(cautions._corrections(replace(situation, covariates=columns), ["temperature"]))
    assert said == "temperature seems to be in degF" and torch.allclose(corrected["temperature"], hall)


@pytest.mark.parametrize(("inner", "doubted"), [(30.0, False), (0.0, True)])
def test_a_number_below_zero_that_another_makes_up_for_is_no_doubt(
    monkeypatch: pytest.MonkeyPatch, inner: float, doubted: bool
) -> None:
    """The torques of all links and of the inner ones look alike: what the joint does in all goes with its weight."""
    links = [[0.0, math.pi / 2, 0.4, 0.0], [0.7, 0.0, 0.0, 0.0], [0.6, 0.0, 0.0, 0.0]]
    arm = SerialArm("three", "standard", links)
    situation = Situation(arm, arm.sample_joints(90, torch.Generator().manual_seed(9)), {}, default_gravity(arm))
    pose = reached_with(
        situation, [acting(situation, "gravity", q2=2e-3, q3=1e-3, q2_inner_links=9e-3, q3_inner_links=5e-3)], 10
    )
    numbers = cautions._numbers

    def split(analysis: Analysis, judgement: Judgement):  # type: ignore[no-untyped-def]
        for i, name, coefficients, mean, sd in numbers(analysis, judgement):
            values = {"q2": -1.0, "q3": -1.0, "q2 inner links": inner, "q3 inner links": inner}
            yield i, name, coefficients, mean.new_tensor([values.get(c.name, 0.0) for c in coefficients]), 0.01 + 0 * sd

    monkeypatch.setattr(cautions, "_numbers", split)
    found = diagnose_rows(situation, pose, effects=["geometry", "joint_offset", "gravity"])
    assert found.verdict["effects"] == ["gravity"]
    assert any("would have to be negative (q2, q3)" in caution for caution in found.cautions) is doubted


def test_noise_that_hides_everything_is_doubted() -> None:
    situation = rows_of("five_bar", 90, 9)
    pose = measured(situation, {"joint_offset": 5.0}, 10)
    far = diagnose_rows(situation, pose, noise=torch.full((3,), 50 * NOISE, dtype=torch.float64), effects=FEW)
    assert any("times the noise that was given" in caution for caution in far.cautions)


def test_what_a_simulator_was_not_told_is_doubted_and_wanted() -> None:
    file = Path(__file__).parents[2] / "experiments" / "my_simulator.py"
    press = load_mechanism(f"{file}:PRESS")
    generator = torch.Generator().manual_seed(11)
    joints = press.sample_joints(60, generator)
    payload = 2 * torch.rand(60, generator=generator, dtype=torch.float64)
    loads = {f"load_{c}": 60 * torch.randn(60, generator=generator, dtype=torch.float64) for c in "xy"}
    whole = Situation(press, joints, loads | {"payload": payload}, default_gravity(press))
    pose = whole.pose + NOISE * torch.randn(60, 2, generator=generator, dtype=torch.float64)
    noise = torch.full((3,), NOISE, dtype=torch.float64)
    found = diagnose_rows(
        replace(whole, covariates=loads), pose, noise, ["geometry", "parameter spring1", "compliance"]
    )
    assert any("press takes payload, which was not recorded" in caution for caution in found.cautions)
    wanted = {c: e["effects"] for e in found.missing_covariates for c in e["columns"]}
    assert wanted["payload[kg]"]["press"] > NOISE


def test_one_row_of_another_place_is_an_outlier() -> None:
    situation = rows_of("five_bar", 90, 12)
    pose = measured(situation, {}, 13)
    pose[7] += 3.0
    found = diagnose_rows(situation, pose, effects=FEW)
    assert found.verdict["effects"] == ["outlier"] and found.rows_set_aside[:1] == [7] and not found.cautions


def test_play_against_its_directions_is_doubted() -> None:
    situation = rows_of("five_bar", 120, 14)
    pose = reached_with(situation, [acting(situation, "backlash", q1=4e-4, q2=3e-4)], 15)
    columns = {n: -v if n.startswith("direction") else v for n, v in situation.covariates.items()}
    found = diagnose_rows(replace(situation, covariates=columns), pose, effects=FEW)
    assert found.verdict["effects"] == ["backlash"] and found.verdict["probability"] <= 0.6
    assert any("negative (q1, q2), as in no machine" in caution for caution in found.cautions)


def test_rows_at_one_place_and_a_joint_that_stands_still_are_doubted() -> None:
    situation = rows_of("five_bar", 90, 16)
    one = replace(situation, joints=situation.joints[:1].expand_as(situation.joints).clone(), guess=None)
    found = diagnose_rows(one, measured(one, {"joint_offset": 15.0}, 17), effects=FEW)
    assert any("all rows are at one place" in caution for caution in found.cautions)
    assert found.verdict["probability"] <= 0.5
    joints = situation.joints.clone()
    joints[:, 1] = joints[0, 1]
    still = replace(situation, joints=joints, guess=None)
    assert any("q2 did not move" in caution for caution in check_rows(still, still.pose.clone()).cautions)


@pytest.mark.parametrize(
    ("steps", "said"), [(2, "before a change of load_x: it seems to be written down late"), (0, "")]
)
def test_a_load_that_is_written_down_late_is_found_out(steps: int, said: str) -> None:
    rows = rows_of("five_bar", 120, 21)
    drawn = torch.Generator().manual_seed(22)
    load = (900 * torch.rand(12, generator=drawn, dtype=torch.float64)).repeat_interleave(10)
    situation = replace(rows, covariates={"load_x": load})
    pose = reached_with(situation, [acting(situation, "compliance", q1=1e-6, q2=1e-6)], 23)
    noted = torch.cat([load[:steps], load[: len(load) - steps]])
    noise = torch.full((3,), NOISE, dtype=torch.float64)
    found = diagnose_rows(replace(situation, covariates={"load_x": noted}), pose, noise, FEW)
    assert found.verdict["effects"] == ["compliance"]
    assert any(said in caution for caution in found.cautions) if said else not found.cautions


@pytest.mark.parametrize("recorded", [True, False])
def test_a_drift_without_a_thermometer_is_doubted(recorded: bool) -> None:
    rows = rows_of("delta_linear", 120, 31)
    kept = [n for n in rows.covariates if n == "time" or (recorded and n == "temperature")]
    situation = replace(rows, covariates={n: rows.covariates[n] for n in kept})
    moved = acting(situation, "frame_drift", x=3e-4, z=2e-4)
    noise = torch.full((3,), NOISE, dtype=torch.float64)
    found = diagnose_rows(situation, reached_with(situation, [moved], 32), noise, [*FEW, "thermal", "frame_drift"])
    assert found.verdict["effects"] == ["frame_drift"]
    assert any("no temperature was recorded" in caution for caution in found.cautions) is not recorded


def test_growth_is_named_without_a_thermometer_and_doubted() -> None:
    rows = rows_of("delta_linear", 120, 33)
    time = rows.covariates["time"]
    warm = replace(rows, covariates={"time": time, "temperature": 293.15 + 6 * (1 - torch.exp(-time / 3000))})
    pose = reached_with(warm, [acting(warm, "thermal", growth=3e-5)], 34)
    noise = torch.full((3,), NOISE, dtype=torch.float64)
    unknown = replace(rows, covariates={"time": time})
    found = diagnose_rows(unknown, pose, noise, [*FEW, "thermal", "thermal_compliance", "drift", "frame_drift"])
    assert found.verdict["effects"] == ["thermal"] and 0.8 < found.verdict["probability"] <= 0.9
    assert any("growth was taken to settle in time" in caution for caution in found.cautions)
    assert found.missing_covariates[0]["columns"] == ["temperature[degC]"]
    assert {*found.missing_covariates[0]["effects"]} == {"thermal", "thermal_compliance"}


def test_copies_of_rows_count_once() -> None:
    situation = rows_of("five_bar", 60, 18)
    pose = measured(situation, {"backlash": 8.0}, 19)
    rows = torch.arange(60).repeat(4)
    columns = {n: v[rows] for n, v in situation.covariates.items()}
    copied = replace(situation, joints=situation.joints[rows], covariates=columns, guess=None)
    many, once = (diagnose_rows(*given, effects=FEW) for given in ((copied, pose[rows]), (situation, pose)))
    assert many.verdict == once.verdict and many.gap == once.gap
    assert "180 rows are exact copies of others and were counted once" in many.notes


def test_noise_far_too_small_is_doubted() -> None:
    situation = rows_of("five_bar", 90, 9)
    pose = measured(situation, {"backlash": 10.0}, 10)
    found = diagnose_rows(situation, pose, noise=torch.full((3,), NOISE / 20, dtype=torch.float64), effects=FEW)
    assert any("it is too small" in caution for caution in found.cautions) and found.verdict["probability"] <= 0.9


def test_what_held_out_rows_do_not_show_is_not_claimed() -> None:
    """Play without a column of directions is noise to every candidate; what is named then takes nothing away."""
    situation = rows_of("five_bar", 150, 20)
    pose = reached_with(situation, [acting(situation, "backlash", q1=4e-4, q2=3e-4)], 21)
    columns = {n: v for n, v in situation.covariates.items() if not n.startswith("direction")}
    effects = ["geometry", "joint_offset", "joint_gain", "compliance"]
    found = diagnose_rows(replace(situation, covariates=columns), pose, effects=effects)
    assert found.verdict["effects"] and found.verdict["shrink_ci95"][0] <= 0
    assert any("do not show that this takes anything away" in caution for caution in found.cautions)
    assert found.verdict["probability"] <= 0.5 and "would remove" not in found.verdict["text"]


@pytest.mark.parametrize(("probability", "none"), [(0.7, True), (0.85, False)])
def test_what_is_neither_likely_nor_shown_elsewhere_is_not_named(
    monkeypatch: pytest.MonkeyPatch, probability: float, none: bool
) -> None:
    situation = rows_of("five_bar", 100, 40)

    def weak(analysis: Analysis) -> Judgement:
        atoms = analysis.atoms
        found = next(f for f in analysis.found if [atoms[i].name for i in f.members] == ["joint_gain"])
        return replace(judge_rows(analysis), found=found, names=("joint_gain",), probability=probability)

    monkeypatch.setattr(engine, "judge_rows", weak)
    found = diagnose_rows(
        situation, measured(situation, {}, 41), torch.full((3,), NOISE, dtype=torch.float64), effects=FEW
    )
    assert found.verdict["none"] is none and found.verdict["probability"] == 0.5
    assert found.verdict["effects"] == ([] if none else ["joint_gain"]) and bool(found.cautions) is not none


def test_angles_of_the_model_in_degrees_are_named() -> None:
    arm = load_mechanism(str(Path(__file__).parents[1] / "effects" / "arm.yaml"))
    turns = torch.tensor([g.unit == "rad" for g in arm.geometry])
    wrong = arm.with_nominal(torch.where(turns, arm.nominal * 180 / math.pi, arm.nominal))
    joints = arm.sample_joints(40, torch.Generator().manual_seed(0))
    pose = arm.forward_kinematics(joints)
    situation = Situation(wrong, joints, {}, default_gravity(wrong))
    with pytest.raises(InputError, match="the angles of the model seem to be in degrees under rad"):
        diagnose_rows(situation, pose)


def test_a_table_of_the_other_convention_is_named() -> None:
    arm = load_mechanism(str(Path(__file__).parents[1] / "effects" / "arm.yaml"))
    assert isinstance(arm, SerialArm) and arm.convention == "standard"
    wrong = SerialArm(**{**arm.recipe["keys"], "convention": "modified"})
    joints = arm.sample_joints(40, torch.Generator().manual_seed(0))
    situation = Situation(wrong, joints, {}, default_gravity(wrong))
    with pytest.raises(InputError, match=r"table seems to be of the standard Denavit-Hartenberg convention.*leaves"):
        diagnose_rows(situation, arm.forward_kinematics(joints))


def test_rows_set_aside_that_lie_together_are_no_bad_rows() -> None:
    situation = rows_of("five_bar", 120, 3)
    pose = measured(situation, {"joint_offset": 20.0}, 4)
    corner = (pose - pose.median(0).values).norm(dim=-1).argsort()[:8]
    pose[corner] += torch.tensor([3e-3, -2e-3], dtype=torch.float64)
    found = diagnose_rows(situation, pose, effects=FEW)
    assert any("lie together" in text for text in found.cautions) and found.verdict["effects"] == ["joint_offset"]
    assert found.verdict["probability"] <= 0.5


def test_backlash_whose_direction_was_not_recorded_is_seen_by_the_scatter_of_a_joint() -> None:
    rows = rows_of("five_bar", 120, 2)
    bare = replace(rows, covariates={n: v for n, v in rows.covariates.items() if not n.startswith("direction")})
    found = diagnose_rows(bare, measured(rows, {"backlash": 6.0}, 12), effects=[*FEW, "transmission"])
    said = [text for text in found.cautions if "record direction2" in text]
    assert len(said) == 1 and found.verdict["probability"] <= 0.6, (found.verdict, found.cautions)
    text = found.verdict["text"].lower()
    assert "no effect that these records can show" in text or not found.verdict["outside_library"]
    gain = diagnose_rows(bare, measured(rows, {"joint_gain": 6.0}, 12), effects=FEW)
    assert not any("scatters as if" in text for text in gain.cautions)


def test_poses_that_are_no_numbers_are_refused_in_a_sentence() -> None:
    rows = rows_of("five_bar", 60, 2)
    nothing = torch.full_like(rows.pose, torch.nan)
    for pose in (nothing, torch.where(torch.arange(60)[:, None] < 40, nothing, rows.pose + 0.5)):
        with pytest.raises(InputError):
            diagnose_rows(rows, pose)


@pytest.mark.parametrize(("frequency", "doubted"), [(1.0, True), (9.0, False)])
def test_an_error_that_is_not_seen_to_repeat_is_not_surely_periodic(frequency: float, doubted: bool) -> None:
    rows = rows_of("five_bar", 200, 2)
    shift = 4e-4 * torch.sin(frequency * rows.joints[:, 0] + 0.5)
    pose = (
        rows.pose
        + (rows.jacobian[:, :2, 0] * shift[:, None])
        + 1e-5 * torch.randn(rows.pose.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )
    found = diagnose_rows(rows, pose, None, ["transmission", "compliance"])
    assert found.verdict["effects"] == ["transmission"]
    assert any("of the periodic error of joint 1 these rows show" in text for text in found.cautions) == doubted
    assert (found.verdict["probability"] <= 0.9) == doubted
