"""A measured cable-driven arm: the approach of its joints is named, and not where directions are dealt anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ccnn_torch.diagnosis import diagnose
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.records import load_records

DATA = Path(__file__).parents[2] / "experiments" / "data"
APPROACH = {"backlash", "friction"}


@pytest.mark.parametrize("dealt", [False, True])
def test_the_approach_is_named_only_with_its_own_directions(dealt: bool) -> None:
    arm = load_mechanism(str(DATA / "wam.yaml"))
    records = load_records(DATA / "wam.csv", arm)
    order = torch.randperm(len(records), generator=torch.Generator().manual_seed(0)) if dealt else slice(None)
    records = replace(records, covariates=records.covariates[order])
    found = diagnose(records, arm, effects=[*APPROACH, "joint_gain", "gravity"])
    assert bool(APPROACH & set(found.verdict["effects"])) != dealt, found.verdict["text"]
    assert found.gap["after"] < 0.55 * found.gap["before"]
    if not dealt:
        without = [step for step in found.in_order if step["name"] not in APPROACH]
        assert without and found.gap["after"] < 2.1e-3
