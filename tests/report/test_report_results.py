"""Error measures against numpy and scikit-learn on unpadded data, the contract's forms, and the paper's own tables."""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np
import pytest
import torch
from frozen import frozen
from jsonschema import Draft202012Validator
from sklearn.metrics import mean_absolute_error, mean_squared_error

from ccnn_torch.calibration import result
from ccnn_torch.calibration.page import paper_case
from ccnn_torch.calibration.statistics import (
    before_block,
    constant_errors,
    floor_block,
    joint_errors,
    pose_block,
    ratio_to_floor,
    spread,
)
from ccnn_torch.coordinates import Coordinate
from ccnn_torch.errors import InputError
from ccnn_torch.report.json_files import plain, read_json, write_json
from ccnn_torch.report.results.run import KnownEffects, RunResults
from ccnn_torch.version import __version__

JOINTS = (Coordinate("q1", "m"), Coordinate("q2", "m"), Coordinate("q3", "m"))


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(3)


def test_spread_is_numpys_median_and_quantiles(generator: np.random.Generator) -> None:
    values = generator.normal(size=30)
    found = spread(torch.tensor(values))
    assert found["median"] == pytest.approx(np.median(values))
    assert (found["low"], found["high"]) == (
        pytest.approx(np.percentile(values, 5)),
        pytest.approx(np.percentile(values, 95)),
    )
    assert found["values"] == pytest.approx(list(values))


def test_a_repeat_that_is_not_finite_is_null_and_left_out() -> None:
    found = spread([1.0, np.nan, 3.0, np.inf])
    assert found["values"] == [1.0, None, 3.0, None]
    assert found["median"] == 2.0
    assert plain(spread([np.nan])) == {"median": None, "low": None, "high": None, "values": [None]}


def test_joint_errors_agree_with_scikit_learn(generator: np.random.Generator) -> None:
    predicted, measured = generator.normal(size=(2, 4, 25, 3))
    found = joint_errors(predicted, measured, None, JOINTS)
    for repeat in range(4):
        truth, guess = measured[repeat], predicted[repeat]
        squares = mean_squared_error(truth, guess, multioutput="raw_values")
        for i, joint in enumerate(JOINTS):
            assert found[joint.name]["mse"]["values"][repeat] == pytest.approx(squares[i])
            assert found[joint.name]["sse"]["values"][repeat] == pytest.approx(squares[i] * 25)
        assert found["all"]["mse"]["values"][repeat] == pytest.approx(mean_squared_error(truth, guess))
        assert found["all"]["mae"]["values"][repeat] == pytest.approx(mean_absolute_error(truth, guess))
        assert found["all"]["sse"]["values"][repeat] == pytest.approx(np.square(truth - guess).sum())


def test_padded_rows_do_not_count_whatever_stands_in_them(generator: np.random.Generator) -> None:
    predicted, measured = generator.normal(size=(2, 2, 10, 3))
    weights = np.ones((2, 10))
    weights[1, 6:] = 0
    spoiled = predicted.copy()
    spoiled[1, 6:] = np.nan
    found = joint_errors(spoiled, measured, weights, JOINTS)
    alone = joint_errors(predicted[1:, :6], measured[1:, :6], None, JOINTS)
    assert found["q2"]["mse"]["values"][1] == pytest.approx(alone["q2"]["mse"]["values"][0])
    assert found["all"]["sse"]["values"][1] == pytest.approx(alone["all"]["sse"]["values"][0])


def test_joints_of_two_units_have_no_common_error(generator: np.random.Generator) -> None:
    mixed = (Coordinate("q1", "m"), Coordinate("q2", "rad"))
    found = joint_errors(generator.normal(size=(1, 5, 2)), generator.normal(size=(5, 2)), None, mixed)
    assert set(found) == {"q1", "q2"}
    floor = floor_block(generator.normal(size=(1, 5, 2)), None, mixed, [1.0, 1.0])
    assert ratio_to_floor(found, floor) is None


def test_the_constant_predicts_the_training_mean(generator: np.random.Generator) -> None:
    train, test = generator.normal(size=(2, 20, 3)), generator.normal(size=(2, 5, 3))
    weights = np.ones((2, 20))
    weights[0, 15:] = 0
    found = constant_errors(train, test, weights, None, JOINTS)
    by_hand = np.square(test[0] - train[0, :15].mean(0)).mean()
    assert found["all"]["mse"]["values"][0] == pytest.approx(by_hand)


def test_before_is_signed_as_in_table_i() -> None:
    error = np.array([[[-1.0, 2.0, 0.0], [-3.0, -4.0, 0.0]]])
    found = before_block(error, None, JOINTS)
    assert (found["q1"]["mean"], found["q1"]["max"], found["q1"]["max_abs"]) == (-2.0, -1.0, 3.0)
    assert (found["q2"]["mean"], found["q2"]["max"], found["q2"]["max_abs"]) == (-1.0, 2.0, 4.0)


def test_floor_counts_the_unlearnable_part_only_where_asked(generator: np.random.Generator) -> None:
    noise, chirp = generator.normal(size=(2, 6, 40, 3)) * 1e-5
    found = floor_block(noise, None, JOINTS, np.full(3, 1e-10), unlearnable=chirp)
    assert found["realised"]["all"]["mse"]["values"] == pytest.approx(
        list(np.square(noise).mean((1, 2))), rel=1e-9, abs=0
    )
    assert found["expected"]["all"]["mse"]["values"] == pytest.approx([1e-10] * 6, rel=1e-9, abs=0)
    both = np.square(noise + chirp).mean((1, 2))
    assert found["with_unlearnable"]["all"]["mse"]["values"] == pytest.approx(list(both), rel=1e-9, abs=0)
    assert floor_block(noise, None, JOINTS, [1e-10] * 3)["with_unlearnable"] is None


def test_ratio_is_paired_repeat_by_repeat(generator: np.random.Generator) -> None:
    noise = generator.normal(size=(5, 25, 3))
    errors = joint_errors(noise * np.sqrt(1.1), np.zeros_like(noise), None, JOINTS)
    floor = floor_block(noise, None, JOINTS, np.ones(3))
    ratio = ratio_to_floor(errors, floor)
    assert ratio is not None and ratio["values"] == pytest.approx([1.1] * 5)
    assert ratio_to_floor(errors, None) is None
    silent = ratio_to_floor(errors, floor_block(noise * 0, None, JOINTS, np.zeros(3)))
    assert silent is not None and silent["values"] == [None] * 5


def test_pose_block(generator: np.random.Generator) -> None:
    before, after, turn, turned = np.abs(generator.normal(size=(4, 3, 8)))
    found = pose_block((before, turn), (after, turned), rotation_weight=0.04, not_compensable=(after / 2, None))
    assert found["position"]["before"]["rms"]["values"] == pytest.approx(list(np.sqrt(np.square(before).mean(1))))
    assert found["rotation"]["after"]["max"]["values"] == pytest.approx(list(turned.max(1)))
    assert found["energy"]["after"]["max"]["values"] == pytest.approx(list((after + 0.04 * turned).max(1)))
    assert found["position"]["not_compensable"]["max"]["values"] == pytest.approx(list(after.max(1) / 2))
    assert pose_block((before, None), (after, None))["rotation"] is None


@pytest.mark.parametrize(
    ("shape", "weights", "words"),
    [((1, 5, 2), None, "3 joints"), ((1, 5, 3), np.ones((1, 4)), "4 row weights"), ((1, 5, 3), np.zeros(5), "no row")],
)
def test_bad_shapes_are_named(shape: tuple[int, ...], weights: np.ndarray | None, words: str) -> None:
    with pytest.raises(InputError, match=words):
        before_block(np.zeros(shape), weights, JOINTS)


@pytest.mark.parametrize("case", ["tripod", "machine_tool:printed", "machine_tool:tabulated"])
def test_the_papers_all_joints_follow_our_definitions(case: str) -> None:
    """The printed columns obey: sse = mse x rows, and over all joints mse and mae are means and sse the sum."""
    paper = paper_case(case)
    assert paper is not None
    for method, figures in paper["methods"].items():
        mse, mae, sse = (figures[measure] for measure in ("mse", "mae", "sse"))
        assert np.array(sse[:3]) == pytest.approx(np.array(mse[:3]) * paper["rows"][1], rel=2e-4, abs=0)
        assert sse[3] == pytest.approx(mse[3] * paper["rows"][1] * 3, rel=2e-4, abs=0)
        # Table II's ENN is the one slip: its last column does not follow from its first three.
        follows = (case, method) != ("tripod", "enn")
        assert (mse[3] == pytest.approx(np.mean(mse[:3]), rel=2e-4, abs=0)) == follows
        assert (mae[3] == pytest.approx(np.mean(mae[:3]), rel=2e-4, abs=0)) == follows


def test_json_never_holds_nan(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"x": float("nan"), "y": np.array([1.0, np.inf]), "z": torch.ones(2), "n": None})
    text = (tmp_path / "a.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert read_json(tmp_path / "a.json") == {"x": None, "y": [1.0, None], "z": [1.0, 1.0], "n": None}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    with pytest.raises(TypeError, match="set"):
        plain({"a": {1, 2}})


@pytest.mark.parametrize(("text", "words"), [("[1]", "one JSON object"), ("{", "no JSON file")])
def test_a_bad_json_file_is_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(InputError, match=words):
        read_json(tmp_path / "results.json")
    with pytest.raises(InputError, match="there is no such file"):
        read_json(tmp_path / "other.json")


def test_the_card_schema_wants_hashes_and_what_a_user_must_know() -> None:
    validator = Draft202012Validator(frozen("card"))
    number = {"low": 0.0, "high": 1.0}
    card = {
        "format": "1",
        "files": {"model.onnx": "0" * 64},
        "sha256": {},
        "mechanism": {"name": "tripod"},
        "joints": [{"name": "q1", "unit": "m"}],
        "covariates": [],
        "pose": [],
        "network": {"kind": "constant"},
        "domain": {
            "inputs": {"q1": number},
            "principal": {"centre": [], "half_range": [], "directions": [], "low": [], "high": []},
        },
        "limits": {
            "q1": {"limit": 1e-4, "most_deviation": 1e-4, "safe_correction": 0.0, "safe_sd": 1e-5, "sd_scale": 1.0}
        },
        "lipschitz": 0.1,
        "iterations": 4,
        "data_sha256": "0" * 64,
        "metrics": {},
        "seed": 0,
        "versions": {"torch": "2.13.0"},
        "date": "2026-01-01",
        "notes": [],
        "more": "keys may follow",
    }
    assert validator.is_valid(card)
    for key in set(card) - {"more"}:
        assert not validator.is_valid({k: v for k, v in card.items() if k != key})
    assert not validator.is_valid(card | {"files": {"model.onnx": "abc"}})


def test_the_schema_refuses_what_the_contract_forbids(results: RunResults) -> None:
    validator = Draft202012Validator(frozen("results"))
    good = json.loads(json.dumps(plain(results)))
    assert validator.is_valid(good)
    for spoil in ("before", "pose", "floor", "rows"):
        assert not validator.is_valid({k: v for k, v in good.items() if k != spoil})
    assert not validator.is_valid(good | {"methods": {"ccnn": {"test": None}}})
    assert validator.is_valid(good | {"methods": {"ccnn": {"test": None, "failed": "Too few rows."}}})
    assert not validator.is_valid(
        good | {"pose": good["pose"] | {"position": good["pose"]["position"] | {"unit": "mm"}}}
    )


def test_a_result_is_read_back_as_it_was_written_or_refused(tmp_path: Path, results: RunResults) -> None:
    path = tmp_path / "results.json"
    write_json(path, results)
    again = RunResults.read(path)
    assert again == results and again["pose"]["position"] == results.pose.position
    known = KnownEffects.model_validate({"from": "diagnosis.json", "test": {}, "coefficients": {}})
    assert known["from"] == known.source == plain(known)["from"]
    write_json(path, plain(results) | {"seed": "first"})
    with pytest.raises(InputError, match=r"results\.json: is no results\.json of this version: seed: "):
        RunResults.read(path)


def test_versions_are_told_of_a_checkout_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def installed(name: str) -> str:
        if name == "ccnn-torch":
            raise PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(result, "version", installed)
    assert result.versions()["ccnn-torch"] == __version__
