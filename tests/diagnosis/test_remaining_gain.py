"""What a network on the remainder would still gain: found where something is left, not made up where nothing is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from _machines import NOISE, measured, reached_with, rows_of

from ccnn_torch.diagnosis import diagnose_rows, with_network
from ccnn_torch.diagnosis.result import Diagnosis
from ccnn_torch.effects import Situation

EXACT = torch.full((3,), NOISE, dtype=torch.float64)


def _withheld(rows: int) -> tuple[Situation, Diagnosis]:
    """A periodic error that the library was not given, beside a compliance that it was."""
    here = rows_of("five_bar", rows, 3)
    poses = measured(here, {"compliance": 12.0, "transmission": 6.0}, 4)
    return here, diagnose_rows(here, poses, None, ["compliance", "geometry"])


def test_a_network_finds_what_no_effect_describes_and_the_noise_was_taken_for() -> None:
    _, said = _withheld(120)
    assert said.network is None
    shares: list[float] = []
    found = with_network(said, progress=shares.append)
    network = found.network
    assert {**found.to_json(), "network": None} == said.to_json()
    assert network is not None and network["unit"] == "m" and network["reason"] == ""
    assert network["gap_before"] == pytest.approx(said.gap["after"])
    assert network["gap_after"] < 0.6 * network["gap_before"]
    assert network["gain"] == pytest.approx(network["gap_before"] - network["gap_after"])
    for key in ("gap_after", "gain"):
        low, high = network[f"{key}_ci95"]
        assert 0 < low < network[key] < high
    # Noise of two coordinates, which no honest answer is below.
    assert network["gap_after"] > 2**0.5 * NOISE
    assert shares == sorted(shares) and shares[-1] == 1.0


def test_the_seed_decides_and_global_random_numbers_are_left_alone() -> None:
    _, said = _withheld(60)
    state = torch.random.get_rng_state()
    first, again, other = (with_network(said, seed).network for seed in (1, 1, 2))
    assert first == again and first != other
    assert torch.equal(state, torch.random.get_rng_state())


def test_where_only_noise_is_left_a_network_gains_nothing() -> None:
    rows = rows_of("five_bar", 120, 5)
    poses = measured(rows, {"compliance": 12.0}, 6)
    estimated = with_network(diagnose_rows(rows, poses, None, ["compliance"])).network
    assert estimated is not None and estimated["gap_after"] == pytest.approx(estimated["gap_before"], rel=0.1)
    assert estimated["gain_ci95"][0] <= 0
    given = with_network(diagnose_rows(rows, poses, EXACT, ["compliance"])).network
    assert given is not None and given["gap_after"] is None and given["gain_ci95"] is None
    assert given["reason"] == "what the effects leave is no more than the noise"


def test_the_gap_that_is_judged_was_not_trained_on() -> None:
    """Noise that a network could learn by heart: as many rows as it has nodes, ten times the noise that was given."""
    rows = rows_of("five_bar", 30, 7)
    poses = reached_with(rows, [], 8, noise=10 * NOISE)
    network = with_network(diagnose_rows(rows, poses, EXACT, ["joint_gain"])).network
    assert network is not None and network["gap_after"] is not None
    assert network["gap_after"] > 0.9 * network["gap_before"] and network["gain_ci95"][0] <= 0


def test_many_rows_are_drawn_and_constant_conditions_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    here = rows_of("five_bar", 200, 9)
    still = replace(
        here, covariates={**here.covariates, "temperature": torch.full((200,), 293.15, dtype=torch.float64)}
    )
    poses = measured(still, {"compliance": 12.0, "joint_gain": 8.0}, 10)
    said = diagnose_rows(still, poses, None, ["compliance"])
    monkeypatch.setattr("ccnn_torch.diagnosis.discrepancy.network._ROWS", 150)
    network = with_network(said).network
    assert network is not None and network["rows"] == 150 and network["gain_ci95"][0] > 0
