"""Pose planning against plain twins: determinants computed anew, all designs tried, and fits of simulated machines."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch
from five_bar_leg import leg_problem
from hypothesis import given, settings, strategies as st
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification import ParameterChoice, Problem, inverse_problem, solve_lm
from ccnn_torch.mechanisms import load_mechanism
from ccnn_torch.numerics.designs import forward_substitute, log_determinant, small_cholesky
from ccnn_torch.planning import (
    choose_poses,
    draw_candidates,
    observability,
    plan_poses,
    recommended_count,
)
from ccnn_torch.planning.candidates import identification_rows
from ccnn_torch.planning.design import (
    _exchange_gain,
    add_best,
    exchange,
    make_design,
    order_by_worth,
    removal_loss,
    tightest_bound,
)


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def naive_index(matrix: Tensor) -> float:
    """O1 without its divisor, from numpy's singular values."""
    values = np.linalg.svd(matrix.numpy(), compute_uv=False)
    return float(np.prod(values) ** (1 / len(values)))


def test_the_index_is_that_of_the_printed_formula() -> None:
    matrices = draw(0, 3, 10, 4)
    found = observability(matrices, poses=5)
    for i, matrix in enumerate(matrices):
        assert float(found[i]) == pytest.approx(naive_index(matrix) / math.sqrt(5), rel=1e-12)
    assert float(observability(matrices)[0]) == pytest.approx(float(found[0]) / math.sqrt(2), rel=1e-12)


def test_what_cannot_be_seen_has_index_zero() -> None:
    blind = draw(0, 6, 3)
    blind[:, 2] = 0
    for matrix in (blind, draw(0, 2, 3)):  # a column of zeros; fewer rows than columns
        assert float(observability(matrix)) == 0
    with pytest.raises(InputError, match="at least one column"):
        observability(torch.zeros(3, 0))


@pytest.mark.parametrize("c", [1, 2, 4])
def test_small_factors_are_those_of_linalg(c: int) -> None:
    root = draw(1, 7, c, c)
    matrix = root @ root.mT + 0.1 * torch.eye(c, dtype=torch.float64)
    last = matrix.permute(1, 2, 0)
    factor = small_cholesky(last)
    assert torch.allclose(factor.permute(2, 0, 1), torch.linalg.cholesky(matrix), atol=1e-12)
    assert torch.allclose(log_determinant(factor), torch.logdet(matrix), atol=1e-12)
    right = draw(2, 7, c, 3)
    solved = forward_substitute(factor, right.permute(1, 2, 0)).permute(2, 0, 1)
    assert torch.allclose(torch.linalg.cholesky(matrix) @ solved, right, atol=1e-12)
    assert float(log_determinant(small_cholesky(-last))[0]) == -math.inf


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000), c=st.integers(1, 3), k=st.integers(1, 5))
def test_updates_of_a_design_are_the_inverse_computed_anew(seed: int, c: int, k: int) -> None:
    rows = draw(seed, 20, c, k)
    design = make_design(rows, torch.eye(k, dtype=torch.float64))
    for _ in range(6):
        add_best(design)
    for old in design.chosen[:2]:
        design.change(old, -1)
    own = rows[design.chosen[2:]].flatten(0, 1)
    inverse = torch.linalg.inv(torch.eye(k, dtype=torch.float64) + own.mT @ own)
    assert torch.allclose(design.inverse, inverse, atol=1e-9)
    spread = (rows @ inverse @ rows.mT).permute(1, 2, 0)
    assert torch.allclose(design.spread, spread, atol=1e-9)


@pytest.mark.parametrize("c", [1, 2])
def test_the_gain_of_every_exchange_is_that_of_determinants_computed_anew(c: int) -> None:
    rows = draw(3, 15, c, 3)
    design = make_design(rows)
    for _ in range(4):
        add_best(design)
    design.prior = torch.zeros(3, 3, dtype=torch.float64)
    design.refresh()
    information = rows.mT @ rows
    whole = information[design.chosen].sum(0)
    factor = small_cholesky(design.spread + torch.eye(c, dtype=torch.float64)[:, :, None])
    everyone = torch.arange(15)
    for old in design.chosen:
        for new in (everyone, everyone[:3]):
            gain = _exchange_gain(design, old, new, factor, log_determinant(factor))
            naive = torch.logdet(whole - information[old] + information[new]) - torch.logdet(whole)
            assert torch.allclose(gain, naive, atol=1e-8)
    naive_loss = torch.logdet(whole) - torch.logdet(whole - information[design.chosen])
    assert torch.allclose(removal_loss(design), naive_loss, atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_a_design_is_nearly_the_best_of_all_there_are_and_its_bound_holds(seed: int) -> None:
    rows = draw(seed, 13, 1, 3)
    design = make_design(rows)
    for _ in range(5):
        add_best(design)
    design.prior = torch.zeros(3, 3, dtype=torch.float64)
    assert exchange(design) and len(set(design.chosen)) == 5
    information = rows.mT @ rows
    sets = torch.tensor(list(itertools.combinations(range(13), 5)))
    best = float(torch.linalg.det(information[sets].sum(1)).max())
    reached = float(torch.linalg.det(information[design.chosen].sum(0)))
    share = (reached / best) ** (1 / 3)
    assert share > 0.97
    assert tightest_bound(design) <= share + 1e-9


def test_a_pose_may_be_repeated_where_that_is_allowed() -> None:
    rows = draw(5, 12, 1, 2)
    rows[0] *= 20
    rows[1] = 20 * torch.tensor([[-rows[0, 0, 1] / 20, rows[0, 0, 0] / 20]], dtype=torch.float64)
    once, often = make_design(rows), make_design(rows, repeat=True)
    for _ in range(6):
        add_best(once)
        add_best(often)
    assert len(set(once.chosen)) == 6 and set(often.chosen) == {0, 1}


def abstract(rows: Tensor) -> Problem:
    """A problem whose identification rows are given: residual = row times values."""
    problem, _ = leg_problem(rows=len(rows))
    k = rows.shape[-1]
    return dataclasses.replace(
        problem,
        parameters=problem.parameters[:k],
        start=torch.zeros(1, k, dtype=torch.float64),
        scale=torch.ones(k, dtype=torch.float64),
        prior_sd=torch.full((k,), math.inf, dtype=torch.float64),
        residual=lambda values, row: (row.reshape(*row.shape[:-1], -1, k) @ values[..., None])[..., 0],
        data=(rows.flatten(1)[None],),
        channels=problem.channels * rows.shape[1],
    )


def test_no_exchange_of_one_pose_betters_the_index() -> None:
    rows = draw(8, 25, 2, 3) * torch.tensor([1.0, 3.0, 0.3], dtype=torch.float64)
    told: list[float] = []
    found = choose_poses(abstract(rows), 4, progress=told.append)
    assert found.settled and told == sorted(told) and told[-1] == 1.0
    chosen = found.chosen.tolist()
    reached = naive_index(rows[chosen].flatten(0, 1))
    for place in range(4):
        for new in set(range(25)) - set(chosen):
            other = [*chosen[:place], new, *chosen[place + 1 :]]
            assert naive_index(rows[other].flatten(0, 1)) <= reached * (1 + 1e-6)


def test_the_figures_of_a_choice_are_those_of_its_first_poses() -> None:
    problem, _ = leg_problem(rows=300)
    rows = identification_rows(problem)
    found = choose_poses(problem, 12)
    gains = found.gains
    assert gains.count.tolist() == list(range(int(gains.count[0]), 19)) and int(gains.count[0]) == 6
    place = gains.count.tolist().index(9)
    matrix = rows[found.chosen[:9]].flatten(0, 1)
    assert float(gains.o1[place]) == pytest.approx(naive_index(matrix) / 3, rel=1e-9)
    sd = torch.linalg.inv(matrix.mT @ matrix).diagonal().sqrt()
    assert torch.allclose(gains.sd[place], sd * problem.scale, rtol=1e-6)
    assert float(gains.largest[place]) == pytest.approx(float(sd.max()), rel=1e-6)
    assert float(gains.information[place]) == pytest.approx(naive_index(matrix), rel=1e-9)
    assert float(gains.information_gain[place]) == pytest.approx(
        float(gains.information[place] / gains.information[place - 1] - 1)
    )
    assert bool((gains.information_gain[1:] > 0).all()) and bool((gains.sd_gain[1:] > -1e-9).all())


def test_the_first_poses_alone_are_nearly_as_good_as_a_plan_of_so_many() -> None:
    problem, _ = leg_problem(rows=500)
    rows = identification_rows(problem)
    ordered, ten = choose_poses(problem, 20).chosen[:10], choose_poses(problem, 10).chosen
    first, planned = (naive_index(rows[chosen].flatten(0, 1)) for chosen in (ordered, ten))
    assert first > 0.93 * planned


def test_worth_ends_where_a_direction_would_be_lost() -> None:
    rows = torch.eye(3, dtype=torch.float64)[[0, 1, 1, 2, 0]][:, None]
    order, first = order_by_worth(rows, torch.zeros(3, 3, dtype=torch.float64))
    assert first == 3 and sorted(order) == list(range(5)) and 3 in order[:3]
    assert torch.linalg.matrix_rank(rows[order[:3]].flatten(0, 1)) == 3


def test_the_stop_rule_waits_until_both_gains_are_small() -> None:
    problem, _ = leg_problem(rows=400)
    gains = choose_poses(problem, 40).gains
    found = recommended_count(gains, 0.02)
    assert found is not None
    place = gains.count.tolist().index(found)
    for gain in (gains.information_gain, gains.sd_gain):
        assert float(gain[place + 1 : place + 4].mean()) < 0.02
    before = gains.count.tolist().index(found - 1)
    assert max(float(g[before + 1 : before + 4].mean()) for g in (gains.information_gain, gains.sd_gain)) >= 0.02
    assert recommended_count(gains, 1e-6) is None


def test_combinations_that_no_pose_shows_are_left_out_all_at_once_unless_they_have_a_prior() -> None:
    rows = draw(9, 30, 1, 3)
    rows[..., 2] = 2 * rows[..., 1]
    problem = abstract(rows)
    found = choose_poses(problem, 6)
    assert found.kept.tolist() == [0, 2] and found.gains.sd.shape[-1] == 2
    assert len(found.left_out) == 1 and found.left_out[0].startswith("L1 and Ax1 only as 1.00 L1 + 2.00 Ax1")
    # Which of the two is held makes no difference to the plan: with L1 in place of Ax1 it is the same.
    assert found.chosen.tolist() == choose_poses(abstract(rows[..., :2]), 6).chosen.tolist()
    held = dataclasses.replace(problem, prior_sd=torch.tensor([math.inf, math.inf, 0.5], dtype=torch.float64))
    found = choose_poses(held, 6)
    assert bool(torch.isfinite(found.gains.sd).all()) and found.bound is None
    rows[..., 1:] = 0
    assert choose_poses(abstract(rows), 6).left_out == ("L1 not at all", "Ax1 not at all")
    with pytest.raises(InputError, match=r"no pose shows any of the parameters"):
        choose_poses(abstract(torch.zeros_like(rows)), 6)


def test_what_cannot_be_planned_is_said() -> None:
    problem, _ = leg_problem(rows=30)
    with pytest.raises(InputError, match=r"5 poses of 1 equation cannot determine 6 parameters; plan at least 6"):
        choose_poses(problem, 5)
    with pytest.raises(InputError, match="31 poses cannot be chosen from 30 candidates"):
        choose_poses(problem, 31)


def test_candidates_are_inside_the_limits_and_away_from_singularities() -> None:
    mechanism = load_mechanism("five_bar")
    found = draw_candidates(mechanism, 500, 1, limits={"x": (-0.1, 0.2), "q2": (0.0, 1.6)}, max_condition=2.0)
    assert found.joints.shape == found.pose.shape == (500, 2) and found.drawn > 500
    assert bool(((found.pose[:, 0] >= -0.1) & (found.pose[:, 0] <= 0.2) & (found.joints[:, 1] <= 1.6)).all())
    assert bool((mechanism.condition_number(found.joints, guess=found.pose) <= 2.0).all())
    assert torch.allclose(mechanism.solve_inverse(found.pose), found.joints)
    with pytest.raises(InputError, match=r"has no joint or pose coordinate 'q3'; "):
        draw_candidates(mechanism, 10, limits={"q3": (0.0, 1.0)})
    with pytest.raises(InputError, match=r"limits.x: the first number must be smaller"):
        draw_candidates(mechanism, 10, limits={"x": (1.0, 0.0)})
    with pytest.raises(InputError, match=r"only 0 of .* configurations are inside the limits"):
        draw_candidates(mechanism, 10, limits={"x": (5.0, 6.0)})


def test_fits_of_simulated_machines_scatter_as_the_plan_foretells() -> None:
    mechanism = load_mechanism("five_bar")
    noise = 1e-4
    (plan,) = plan_poses(mechanism, 24, pose_noise=noise, joint_noise=noise, candidates=2000)
    machines = 400
    truth = mechanism.nominal + 0.2 * plan.scale * draw(0, machines, 12)
    joints = plan.joints + noise * draw(1, machines, 24, 2)
    pose = mechanism.forward_kinematics(plan.joints, truth[:, None], plan.pose) + noise * draw(2, machines, 24, 2)
    fit = solve_lm(inverse_problem(mechanism, joints, pose, pose_noise=noise, joint_noise=noise))
    scatter = (fit.values - truth).square().mean(0).sqrt() / plan.sd
    assert bool(((scatter > 0.85) & (scatter < 1.15)).all())
    assert bool((plan.choice.random_sd > plan.sd).all())


def test_a_plan_for_each_leg_shows_that_leg_better_than_the_common_one() -> None:
    mechanism = load_mechanism("five_bar")
    keys = {"candidates": 2000, "pose_noise": 1e-4}
    legs = plan_poses(mechanism, 18, per_leg=True, **keys)
    assert [plan.leg for plan in legs] == [1, 2]
    assert all({p.leg for p in plan.parameters} == {plan.leg} for plan in legs)
    (common,) = plan_poses(mechanism, 18, **keys)
    of_leg = inverse_problem(mechanism, common.joints, common.pose, pose_noise=1e-4, per_leg=True)
    rows = identification_rows(of_leg)
    for number, plan in enumerate(legs):
        columns = [i for i, p in enumerate(of_leg.parameters) if p.leg == plan.leg]
        beside = naive_index(rows[:, number, columns]) / math.sqrt(18)
        assert beside < plan.o1
    again = plan_poses(mechanism, 18, per_leg=True, **keys)
    assert torch.equal(again[1].pose, legs[1].pose)


def test_a_serial_arm_is_planned_from_poses() -> None:
    links = [[0.1, math.pi / 2, 0.4, 0.0], [0.5, 0.0, 0.0, 0.0], [0.4, 0.0, 0.0, 0.0]]
    arm = load_mechanism("serial", name="arm", convention="standard", links=links, orientation="none")
    choice = ParameterChoice(free=["a?", "d1", "theta?"])
    (plan,) = plan_poses(arm, 10, choice=choice, candidates=300, max_condition=200)
    assert plan.joints.shape == (10, 3) and plan.o1 > plan.choice.random_o1
    assert torch.allclose(arm.forward_kinematics(plan.joints), plan.pose)
    with pytest.raises(InputError, match="per_leg: a pose depends on the parameters of all legs"):
        plan_poses(arm, 10, choice=choice, candidates=300, max_condition=200, per_leg=True)
