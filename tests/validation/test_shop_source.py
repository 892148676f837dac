"""The workshop's machines are those that the diagnosis is told, and its cases are as they say."""

import dataclasses

import numpy as np
import pytest
import torch
from ccnn_validation.sources.case import SourceCase
from ccnn_validation.sources.judge import judged
from ccnn_validation.sources.run import _mechanism
from ccnn_validation.sources.shop import FAMILIES, make
from ccnn_validation.sources.shop.cases import machine_of
from ccnn_validation.sources.shop.machine import difference

from ccnn_torch.diagnosis import diagnose
from ccnn_torch.errors import InputError
from ccnn_torch.records import load_records, write_table

NAMES = {"geometry", "joint_offset", "joint_gain", "transmission", "backlash", "friction", "compliance", "gravity"}
NAMES |= {"thermal", "drift", "frame", "tool", "coupling", "latency", "instrument", "outlier"}
MACHINES = ("painter6", "arm7", "scara", "planar3r", "gantry", "five_bar", "delta", "delta_linear", "stewart")


@pytest.mark.parametrize("name", MACHINES)
def test_the_machine_is_the_one_that_is_told(name, tmp_path):
    machine = machine_of(name)
    joints = machine.plan(20, np.random.default_rng(1), "random")
    text, keys = machine.told()
    mechanism = _mechanism(SourceCase("", text, {}, None, None, keys), tmp_path)
    place, rotation = mechanism.frame(mechanism.forward_kinematics(torch.from_numpy(joints)))
    seen = machine.pose(joints)
    np.testing.assert_allclose(seen[0], place.numpy(), rtol=0, atol=1e-9)
    if rotation is not None:
        assert np.abs(difference((seen[0], rotation.numpy()), seen)[:, 3:]).max() < 1e-9


@pytest.mark.parametrize("family", ["pair_1", "latency_2", "loose_1", "noise_t3_1"])
def test_a_case_is_repeatable_and_its_noise_is_as_given(family):
    case, again = make(family, 7), make(family, 7)
    assert dataclasses.replace(case, columns={}, clean=None) == dataclasses.replace(again, columns={}, clean=None)
    for header, values in case.columns.items():
        assert np.isfinite(values).all() and len(values) >= 90
        np.testing.assert_array_equal(values, again.columns[header])
    truth = case.truth
    assert set().union(*truth.accepted, *truth.enough) <= NAMES
    assert (frozenset() in truth.accepted) == (truth.kind in ("none", "outside"))
    if case.clean is not None and case.noise is not None:
        spread = np.std(np.asarray(case.columns["x[mm]"]) * 1e-3 - case.clean["x[m]"])
        assert spread == pytest.approx(case.noise["m"], rel=0.3)


def test_families_and_truths():
    assert len(FAMILIES) == len(set(FAMILIES)) == 104
    with pytest.raises(InputError, match="family 'rust_1' is not there; known: geometry_1"):
        make("rust_1", 4)
    # Play is enough for a loose joint, a compliance only beside "outside the library".
    truth = make("loose_1", 4).truth
    verdict = {"effects": ["backlash"], "outside_library": False, "driver": None, "drivers": [], "text": ""}
    answer = {"verdict": verdict | {"probability": 0.9}, "cautions": [], "notes": [], "rows_set_aside": []}
    assert judged(truth, answer, None)["right"]
    assert not judged(truth, answer | {"verdict": answer["verdict"] | {"effects": ["compliance"]}}, None)["right"]
    assert not judged(truth, answer | {"verdict": answer["verdict"] | {"effects": []}}, None)["right"]


def test_a_verdict_without_its_unsure_second_name_is_as_likely_as_its_first(tmp_path):
    case = make("instrument_3", 1)
    write_table(tmp_path / "records.csv", dict(case.columns))
    mechanism = _mechanism(case, tmp_path)
    found = diagnose(load_records(tmp_path / "records.csv", mechanism, learns=False), mechanism)
    assert found.verdict["effects"] == ["instrument"]
    # Which of several small corrections of its form goes with it is not known; none of them is named.
    best = found.judgement.leading[0]
    assert best.names > {"instrument"} and best.probability < 0.9 and found.verdict["probability"] == pytest.approx(0.9)


def test_backlash_whose_edge_is_wide_is_no_friction(tmp_path):
    """Of one width its corrections took so much beside a load that it was dropped, and friction named."""
    case = make("pair_8", 920)
    write_table(tmp_path / "records.csv", dict(case.columns))
    mechanism, noise = _mechanism(case, tmp_path), case.noise
    told = {c.name: noise[c.unit] for c in mechanism.pose if c.unit in noise}
    found = diagnose(load_records(tmp_path / "records.csv", mechanism, learns=False), mechanism, noise=told)
    assert {*found.verdict["effects"]} == {"compliance", "backlash"}
