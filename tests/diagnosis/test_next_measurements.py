"""What to measure next: rows that tell two explanations apart, and say more than others would."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from _machines import NOISE, acting, cramped, measured, reached_with, rows_of
from torch import Tensor

from ccnn_torch.diagnosis import Diagnosis, diagnose_rows
from ccnn_torch.diagnosis.next_measurements import _candidates, _columns, _possible
from ccnn_torch.diagnosis.page.data import About
from ccnn_torch.diagnosis.page.tables import write_next_csv
from ccnn_torch.effects import Situation
from ccnn_torch.effects.covariates import covariate_units
from ccnn_torch.evidence.dictionary import FittedSet, covariance
from ccnn_torch.records import read_table, stack_columns

EXACT = torch.full((3,), NOISE, dtype=torch.float64)
# A wrong length of a rod, which in a small workspace looks like an offset, a gain or sag.
CAUSE = {"L1": 5e-4}
CANDIDATES = ["geometry", "joint_offset", "joint_gain", "gravity", "frame", "instrument"]


Confused = tuple[Situation, Diagnosis]


@pytest.fixture(scope="module")
def confused() -> Confused:
    """Rows in which the cause looks like others, and what is found in them."""
    rows = cramped("five_bar", 60, 0)
    return rows, diagnose_rows(rows, reached_with(rows, [acting(rows, "geometry", **CAUSE)], 5), EXACT, CANDIDATES)


def _more(rows: Situation, joints: Tensor, covariates: Mapping[str, Tensor]) -> Situation:
    """Rows measured after the others, a minute each."""
    late = rows.covariates["time"][-1] + 60 * torch.arange(1, len(joints) + 1, dtype=torch.float64)
    added = {**covariates, "time": late}
    both = {n: torch.cat([v, added[n]]) for n, v in rows.covariates.items()}
    pose = torch.cat([rows.pose, rows.mechanism.forward_kinematics(joints)])
    return replace(rows, joints=torch.cat([rows.joints, joints]), covariates=both, guess=pose)


def _proposed(said: Diagnosis) -> tuple[Tensor, dict[str, Tensor]]:
    wanted = said.next_measurements
    joints = torch.tensor([list(m["joints"].values()) for m in wanted], dtype=torch.float64)
    names = wanted[0]["covariates"]
    return joints, {n: torch.tensor([m["covariates"][n] for m in wanted], dtype=torch.float64) for n in names}


def _belief(rows: Situation, joints: Tensor, covariates: Mapping[str, Tensor], seed: int) -> float:
    """Probability of the cause once further rows are measured."""
    more = _more(rows, joints, covariates)
    said = diagnose_rows(more, reached_with(more, [acting(more, "geometry", **CAUSE)], seed), EXACT, CANDIDATES)
    return said.judgement.marginal["geometry"]


def test_rows_proposed_tell_two_confusable_causes_apart_and_better_than_rows_at_random(confused: Confused) -> None:
    rows, said = confused
    assert said.next_measurements[0]["separates"]
    anywhere, near = rows_of("five_bar", 8, 9), cramped("five_bar", 8, 9)
    places = (_proposed(said), (anywhere.joints, anywhere.covariates), (near.joints, near.covariates))
    # What is left of doubt about the true cause.
    proposed, elsewhere, close_by = (1 - _belief(rows, *place, 7) for place in places)
    assert proposed < 0.5 * elsewhere < elsewhere < close_by and close_by > 0.3


def test_chosen_rows_say_more_together_than_any_drawn_at_random_would(confused: Confused) -> None:
    _, said = confused
    analysis = said.analysis
    wanted = said.next_measurements

    def names(found: FittedSet) -> set[str]:
        return {analysis.atoms[i].name for i in found.members}

    first, *others = [e.best for e in said.judgement.leading if not e.drivers]
    second = next(one for one in others if sorted(names(first) ^ names(one)) == wanted[0]["separates"])
    there = _candidates(analysis, 0)
    x = torch.cat([_columns(analysis, first, there), -_columns(analysis, second, there)], -1)
    mean = torch.cat([*first.mean, *second.mean])
    own = [covariance(analysis.dictionary, one) for one in (first, second)]
    joint = torch.block_diag(*own)  # type: ignore[no-untyped-call]

    def said_by(chosen: Tensor) -> float:
        """Half the square of the difference in units of what is open, of all rows at once."""
        flat = x[chosen].flatten(0, 1)
        open_ = torch.eye(len(flat), dtype=flat.dtype) + flat @ joint @ flat.mT
        difference = flat @ mean
        return float(0.5 * difference @ torch.linalg.solve(open_, difference))

    chosen = torch.cdist(_proposed(said)[0], there.joints).argmin(-1)
    assert len(set(chosen.tolist())) == len(wanted) == 8
    gains = [m["gain"] for m in wanted]
    assert gains == sorted(gains, reverse=True)
    assert gains[0] == pytest.approx(said_by(chosen[:1]))
    generator = torch.Generator().manual_seed(1)
    drawn = [said_by(torch.randperm(len(there.joints), generator=generator)[:8]) for _ in range(40)]
    assert said_by(chosen) > 1.2 * max(drawn)


def test_a_cause_without_rival_is_made_sharper() -> None:
    rows = rows_of("five_bar", 60, 3)
    poses = reached_with(rows, [acting(rows, "compliance", q1=8e-6, q2=5e-6)], 4)
    said = diagnose_rows(rows, poses, EXACT, ["compliance"])
    assert said.verdict["effects"] == ["compliance"]
    wanted = said.next_measurements
    assert [m["separates"] for m in wanted] == [[]] * 8
    there, found = _candidates(said.analysis, 0), said.judgement.found
    x, own = _columns(said.analysis, found, there), covariance(said.analysis.dictionary, found)

    def information(chosen: Tensor) -> float:
        """Half the log determinant, of all rows at once."""
        flat = x[chosen].flatten(0, 1)
        return float(0.5 * torch.linalg.slogdet(torch.eye(len(flat)) + flat @ own @ flat.mT).logabsdet)

    chosen = torch.cdist(_proposed(said)[0], there.joints).argmin(-1)
    assert wanted[0]["gain"] == pytest.approx(information(chosen[:1]))
    generator = torch.Generator().manual_seed(1)
    # Next to a singularity every row says much, to first order.
    others = torch.nonzero(_possible(there)).flatten()
    drawn = [information(others[torch.randperm(len(others), generator=generator)[:8]]) for _ in range(40)]
    assert information(chosen) > 1.2 * max(drawn)


def test_where_there_is_only_noise_rows_tell_it_from_the_most_probable_effect() -> None:
    rows = rows_of("five_bar", 60, 3)
    said = diagnose_rows(rows, reached_with(rows, [], 4), EXACT, ["compliance", "joint_offset"])
    assert said.verdict["none"]
    assert {name for m in said.next_measurements for name in m["separates"]} <= {"compliance", "joint_offset"}
    assert all(len(m["separates"]) == 1 and m["gain"] < 3 for m in said.next_measurements)


def test_conditions_that_always_came_together_come_apart() -> None:
    rows = rows_of("five_bar", 60, 5)
    side = rows.covariates["direction1"]
    tied = replace(rows, covariates={**rows.covariates, "load_x": 50 * (1 + side), "direction2": side})
    said = diagnose_rows(tied, measured(tied, {"backlash": 6.0}, 6), effects=["backlash", "compliance"])
    there = _candidates(said.analysis, 0)
    assert torch.equal(there.covariates["direction1"], there.covariates["direction2"])
    loaded, back = there.covariates["load_x"] > 0, there.covariates["direction1"] > 0
    assert 0.2 < float((loaded == back).double().mean()) < 0.8
    assert bool((there.covariates["time"].diff() > 1).all())


def test_the_file_is_read_back_as_commands(confused: Confused, tmp_path: Path) -> None:
    rows, said = confused
    joints = rows.mechanism.joints
    units = covariate_units(rows.mechanism) | {j.name: j.unit for j in joints}
    write_next_csv(tmp_path / "next.csv", said.to_json(), About(units=units))
    table = read_table(tmp_path / "next.csv")
    read = torch.as_tensor(stack_columns(table, joints))
    assert torch.allclose(read, _proposed(said)[0], rtol=1e-14, atol=0.0)
    with (tmp_path / "next.csv").open(newline="") as file:
        header = next(csv.reader(file))
    assert header[:4] == ["q1[deg]", "q2[deg]", "temperature[degC]", "load_x[N]"] and header[-1] == "gain[1]"
    reached = rows.mechanism.forward_kinematics(read)
    assert bool(torch.isfinite(reached).all()) and bool(rows.mechanism.reachable(reached).all())
