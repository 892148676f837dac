"""The command of a machine by its own forward map: against the machine itself, near singular poses, at all bounds."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from machines import (
    AROUND,
    MACHINES,
    SEVEN_HIGH,
    SEVEN_HOME,
    Known,
    around,
    compensated,
    known,
    near,
    seven_arm,
    sliding_arm,
    with_effects,
    wrist,
)
from stand_ins import fields
from torch import Tensor

from ccnn_torch.compensation import Compensator, Solution, load_model, save_model
from ccnn_torch.compensation.expanded_machine import ExpandedMachine
from ccnn_torch.compensation.fit import all_over, machine_alone
from ccnn_torch.compensation.inverse_machine import InverseMachine
from ccnn_torch.compensation.machine import SETTLED, Machine, limits_of
from ccnn_torch.compensation.targets.from_model import form_of
from ccnn_torch.compensation.targets.golden import probe_points, run_form
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector

EXACT, OUTSIDE, NOT_FINITE, DAMPED = range(4)
NAN, INF = math.nan, math.inf
# What is left where the last step moved each joint by less than `SETTLED` [m], [rad].
TOLERANCE = 2e-9
# Fewer joints than coordinates: the closest pose.
CLOSEST = ("scara", "five axes")
# More joints than coordinates: many ways back.
MANY = ("arm by positions", "seven joints")
OTHERS = [name for name in MACHINES if name not in CLOSEST]
# What the slope of a polynomial leaves of a deviation of a millimetre, and turns of `frame` that two joints cannot do.
EXPANDED = {"polynomials": 3e-7}


def points(made: Compensator, reach: float = 1.0, count: int = 200, seed: int = 7) -> tuple[Tensor, Tensor]:
    """Joints and covariates up to `reach` half ranges from the domain's centre."""
    domain, n = made.domain, len(made.joints)
    draw = torch.rand(count, len(domain.centre), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    rows = domain.centre + reach * domain.half_range * (2 * draw - 1)
    return rows[:, :n].contiguous(), rows[:, n:].contiguous()


@torch.no_grad()
def solved(made: Compensator, joints: Tensor, covariates: Tensor | None = None) -> Solution:
    return made.solve(joints, covariates if made.covariates else None)


@torch.no_grad()
def reached(machine: Known, made: Compensator, command: Tensor, covariates: Tensor) -> Tensor:
    """Frame of the true machine, which is the identified one with what was learned, `s x c`."""
    learned = made.learned(command, covariates if made.covariates else None)
    return machine.frame(command + learned, made.held(covariates))


def wanted(machine: Known, joints: Tensor) -> Tensor:
    """Nominal frame of ideal joints, `s x c`."""
    bare = replace(machine, identified=machine.mechanism.nominal, acting=[], covariates={})
    return bare.frame(joints, joints[:, :0])


def apart(found: Tensor, frame: Tensor) -> Tensor:
    """Distance of positions [m] and, with a weight of 1 m/rad, of small rotations, `s`."""
    return (found - frame).norm(dim=-1)


@pytest.mark.parametrize("name", OTHERS)
def test_where_the_status_is_0_the_true_machine_reaches_the_nominal_pose(name: str) -> None:
    machine, made = known(name), compensated(name)
    joints, covariates = points(made)
    found = solved(made, joints, covariates)
    exact = found.status == EXACT
    frame = wanted(machine, joints)
    left = apart(reached(machine, made, found.command, covariates), frame)[exact]
    before = apart(machine.frame(joints, covariates), frame)[exact]
    assert int(exact.sum()) > 30
    assert float(left.max()) < EXPANDED.get(name, TOLERANCE) < 1e-3 * float(before.median())
    torch.testing.assert_close(found.command + found.deviation, joints, rtol=0, atol=1e-14)
    assert bool((found.deviation.abs() <= made.most).all())


@pytest.mark.parametrize("name", CLOSEST)
def test_with_fewer_joints_than_coordinates_it_is_the_closest_pose(name: str) -> None:
    machine, made = known(name), compensated(name)
    joints, covariates = points(made)
    found = solved(made, joints, covariates)
    exact = found.status == EXACT
    assert int(exact.sum()) > 150
    slope = objective_slope(machine, made, found.command, joints, 0.0)
    # The slope of the square of a distance of 1 mm by a joint that is off by 1e-9.
    assert float(slope[exact].abs().max()) < 1e-8
    assert float(objective(machine, made, found.command, joints, 0.0)[exact].max()) < 1e-6


@pytest.mark.parametrize("name", MACHINES)
def test_the_way_back_undoes_the_command(name: str) -> None:
    machine, made = known(name), compensated(name)
    joints, covariates = points(made)
    found = solved(made, joints, covariates)
    again = solved(made, found.command, covariates)
    both = (found.status == EXACT) & (again.ideal_status == EXACT)
    assert int(both.sum()) >= 0.98 * int((found.status == EXACT).sum()) > 30
    if name in MANY:
        # Not the same joints, but the same pose.
        assert float(apart(wanted(machine, again.ideal), wanted(machine, joints))[both].max()) < TOLERANCE
    else:
        # The closest poses of two machines differ by the product of what is left and what they differ by.
        allowed = 1e-6 if name in CLOSEST else 10 * TOLERANCE
        assert float((again.ideal - joints)[both].abs().max()) < allowed


def pull_of(made: Compensator, joints: Tensor) -> Tensor:
    """λ² of ideal joints, `s` [m² per joint unit²]."""
    assert made.machine is not None
    with torch.no_grad():
        return made.machine.aim(joints)[:, -1]


def objective(machine: Known, made: Compensator, command: Tensor, joints: Tensor, pull: Tensor | float) -> Tensor:
    """|W (f(c) - X)|² + λ² |c - q|² of a machine without effects, by its own kinematics, `s` [m²]."""
    assert made.machine is not None and not machine.acting
    mechanism, moved = machine.mechanism, command + made.learned(command)
    there = mechanism.frame(mechanism.forward_kinematics(moved, machine.identified))
    aim = mechanism.frame(mechanism.forward_kinematics(joints))
    gap = (there[0] - aim[0]).square().sum(-1)
    if there[1] is not None and aim[1] is not None:
        # Of a small turn: half of the square of the matrices' difference.
        gap = gap + made.machine.rule.rotation_weight**2 * (there[1] - aim[1]).square().sum((-2, -1)) / 2
    return gap + pull * (command - joints).square().sum(-1)


@torch.no_grad()
def objective_slope(
    machine: Known, made: Compensator, command: Tensor, joints: Tensor, pull: Tensor | float, step: float = 1e-5
) -> Tensor:
    """Its derivative by the command, central differences, `s x n`."""
    unit = step * torch.eye(command.shape[-1], dtype=torch.float64)
    parts = [
        objective(machine, made, command + one, joints, pull) - objective(machine, made, command - one, joints, pull)
        for one in unit
    ]
    return torch.stack(parts, -1) / (2 * step)


@cache
def at_the_wrist() -> tuple[Known, Compensator]:
    machine = wrist()
    return machine, machine.compensator(1e-6)


def line_through_the_wrist(count: int = 200) -> Tensor:
    """Joints that move evenly, and stretch the wrist in the middle."""
    share = torch.linspace(-1, 1, count, dtype=torch.float64).unsqueeze(-1)
    middle, way = AROUND.clone(), torch.tensor([0.1, 0.05, -0.1, 0.1, 0.3, -0.1], dtype=torch.float64)
    middle[4] = 0.0
    return middle + share * way


def test_near_a_wrist_the_command_is_damped_bounded_and_still_better_than_none() -> None:
    machine, made = at_the_wrist()
    joints, _ = points(made, count=600)
    found = solved(made, joints)
    damped = found.status == DAMPED
    assert 0.03 < float(damped.double().mean()) < 0.6
    assert bool((found.deviation.abs() <= made.most).all())
    with torch.no_grad():
        left, before = (objective(machine, made, at, joints, 0.0)[damped] for at in (found.command, joints))
    assert bool((left < before).all())
    assert float(left.mean().sqrt()) < 0.5 * float(before.mean().sqrt())


def test_on_a_line_through_a_wrist_the_command_does_not_jump() -> None:
    _, made = at_the_wrist()
    joints = line_through_the_wrist()
    found = solved(made, joints)
    assert DAMPED in found.status[80:120] and EXACT in found.status[:30]
    jump, ideal = (v.diff(dim=0).abs().max() for v in (found.command, joints))
    assert float(jump) < 1.5 * float(ideal)


def test_a_damped_command_is_where_its_objective_has_no_slope() -> None:
    machine, made = at_the_wrist()
    joints = torch.cat([line_through_the_wrist(), points(made, count=600)[0]])
    found, pull = solved(made, joints), pull_of(made, joints)
    # Damped, but neither at a bound nor on its way: steps farther do not move it.
    twin = copy.copy(made)
    twin.iterations += 20
    moved = (solved(twin, joints).command - found.command).abs().amax(-1)
    settled = (found.status == DAMPED) & (pull > 0) & (moved < SETTLED)
    assert int(settled.sum()) > 20
    slope = objective_slope(machine, made, found.command, joints, pull)
    undamped = objective_slope(machine, made, joints, joints, pull)
    # The squares of W f'' are left out of Gauss and Newton's steps, not of their end.
    assert float(slope[settled].norm(dim=-1).max()) < 1e-3 * float(undamped[settled].norm(dim=-1).median())


def test_it_does_not_depend_on_the_number_of_steps_where_it_is_exact() -> None:
    _, made = at_the_wrist()
    joints, _ = points(made)
    twin = copy.copy(made)
    twin.iterations += 20
    found, later = solved(made, joints), solved(twin, joints)
    exact = found.status == EXACT
    assert bool((later.status[exact] == EXACT).all())
    torch.testing.assert_close(later.command[exact], found.command[exact], rtol=0, atol=10 * SETTLED)


def test_with_seven_joints_nothing_moves_that_need_not() -> None:
    """The command differs from the ideal joints by the least that reaches the pose, to first order."""
    machine = known("seven joints")
    made = machine.compensator(0.0)
    joints, _ = points(made)
    found = solved(made, joints)
    exact = found.status == EXACT
    assert isinstance(made.machine, Machine)
    weight = torch.tensor([1.0] * 3 + [made.machine.rule.rotation_weight] * 3, dtype=torch.float64)
    jacobian = weight[:, None] * machine.mechanism.with_nominal(machine.identified).jacobian(joints)
    aim, there = (
        machine.mechanism.frame(wanted(machine, joints)),
        machine.mechanism.frame(machine.frame(joints, joints[:, :0])),
    )
    assert aim[1] is not None and there[1] is not None
    turn = matrix_to_rotation_vector(aim[1] @ there[1].mT)
    gap = weight * torch.cat([aim[0] - there[0], turn], -1)
    least = (torch.linalg.pinv(jacobian) @ gap.unsqueeze(-1)).squeeze(-1)
    change = found.command - joints
    assert float((change - least)[exact].norm(dim=-1).max()) < 0.05 * float(change[exact].norm(dim=-1).median())


def test_effects_of_an_arm_of_any_number_of_joints_are_commanded_and_held_in_a_file(tmp_path: Path) -> None:
    """What effects see of an arm is its own closed form: as a sum of all products of sines it had 6,561 terms."""
    links = [[0.1, math.pi / 2 * (-1) ** k, 0.1, 0.0] for k in range(8)]
    rows = around([0.3, -0.7, 0.9, 0.5, -0.8, 0.4, 0.6, -0.5], 0.3)
    machine = with_effects(
        near(SerialArm("eight", "standard", links), 5e-5, rows), ("compliance",), ("load_x", "load_z")
    )
    made = machine.compensator()
    joints, covariates = points(made)
    found = solved(made, joints, covariates)
    exact, frame = found.status == EXACT, wanted(machine, joints)
    left = apart(reached(machine, made, found.command, covariates), frame)[exact]
    before = apart(machine.frame(joints, covariates), frame)[exact]
    assert int(exact.sum()) > 30 and float(left.max()) < TOLERANCE < 1e-3 * float(before.median())
    mechanism = {"name": "eight", "joints": [c.header for c in made.joints], "pose": []}
    paths = save_model(tmp_path, made, fields() | {"mechanism": mechanism}, forms=())
    assert paths["safetensors"].stat().st_size < 100_000
    again = load_model(paths["safetensors"]).compensator
    assert again is not None and torch.equal(solved(again, joints, covariates).command, found.command)


@pytest.mark.parametrize("name", ["arm", "sliding arm with effects", "delta"])
def test_outside_of_what_was_measured_physics_stays_and_what_was_learned_fades(name: str) -> None:
    machine, made = known(name), compensated(name)
    domain, n = made.domain, len(made.joints)
    joints, covariates = points(made, 0.3)
    # One joint half a range outside.
    joints[:, 0] = domain.centre[0] + 1.7 * domain.half_range[0]
    found = solved(made, joints, covariates)
    outside = found.status == OUTSIDE
    assert not bool(found.inside_domain.any()) and int(outside.sum()) > 40
    left = apart(reached(machine, made, found.command, covariates), wanted(machine, joints))
    assert float(left[outside].max()) < TOLERANCE
    far = torch.cat([joints, covariates], -1)
    far[:, 0] = domain.centre[0] + 3 * domain.half_range[0]
    learned = made.learned(far[:, :n], far[:, n:] if made.covariates else None)
    assert torch.equal(learned, made.safe.expand_as(learned))


def test_polynomials_are_held_where_they_end() -> None:
    """Beyond their box the correction is that at its edge, there and back."""
    machine, made = known("polynomials"), compensated("polynomials")
    assert isinstance(made.machine, ExpandedMachine)
    far = made.domain.centre + torch.tensor([[30.0, 0.0], [0.0, -30.0], [30.0, 30.0]], dtype=torch.float64)
    found, edge = solved(made, far), made.machine.known(far)
    at_edge = solved(made, edge)
    assert found.status.tolist() == [OUTSIDE] * 3
    assert float((found.deviation - at_edge.deviation).abs().max()) < 3 * float(made.limit.max())
    torch.testing.assert_close(solved(made, found.command).ideal, far, rtol=0, atol=3 * float(made.limit.max()))
    left = apart(reached(machine, made, at_edge.command, far[:, :0]), wanted(machine, edge))
    before = apart(machine.frame(edge, far[:, :0]), wanted(machine, edge))
    assert float((left / before).max()) < 0.02


def test_covariates_are_held_at_ends_by_what_was_measured() -> None:
    name = "sliding arm with effects"
    machine, made = known(name), compensated(name)
    joints, covariates = points(made, 0.5)
    rows = machine.inputs[:, machine.joints.shape[1] :]
    low, high = rows.amin(0), rows.amax(0)
    # Loads there, a temperature half its range farther.
    farther = (high - low) / 2 * torch.tensor([1.0, 0.0, 0.0])
    low, high = low - farther, high + farther
    assert torch.allclose(torch.stack(made.ends), torch.stack([low, high]), rtol=0, atol=1e-9)
    # Far warmer than measured, with a load of a ton.
    beyond = high + torch.tensor([500.0, 5e3, 1e4], dtype=torch.float64)
    found, at_end = (solved(made, joints, v.expand_as(covariates)) for v in (beyond, high))
    assert bool((found.status == OUTSIDE).all()) and not bool(found.inside_domain.any())
    # The learned part is another; physics is not.
    assert float((found.command - at_end.command).abs().max()) < 3 * float(made.limit.max())
    left = apart(reached(machine, made, found.command, beyond.expand_as(covariates)), wanted(machine, joints))
    assert float(left.max()) < TOLERANCE
    below = solved(made, joints, low.expand_as(covariates)).command
    assert float((found.command - below).abs().max()) > 10 * float(made.limit.max())


def test_effects_follow_a_covariate_to_the_ends_that_were_told(tmp_path: Path) -> None:
    machine = with_effects(sliding_arm(), ("compliance",), ("load_z",), 0.01)
    far = 3 * machine.covariates["load_z"].mul_(100).abs().amax().reshape(1, 1)
    narrow = machine.compensator()
    joints = narrow.domain.centre[None, :3]

    def missed(found: torch.Tensor) -> float:
        moved = found + narrow.learned(found, far)
        return float(apart(machine.frame(moved, far), wanted(machine, joints)))

    assert missed(solved(narrow, joints, far).command) > 1e4 * TOLERANCE
    wide = machine.compensator(ends={"load_z": (-2 * float(far), 2 * float(far))})
    assert solved(wide, joints, far).status.tolist() == [OUTSIDE] and bool((wide.most > narrow.most).any())
    paths = save_model(tmp_path, wide, fields() | {"mechanism": machine.mechanism.describe()}, forms=("onnx",))
    for form in ("safetensors", "onnx"):
        assert missed(torch.from_numpy(load_model(paths[form])(joints.numpy(), far.numpy())["command"])) < TOLERANCE
    assert missed(torch.from_numpy(run_form(form_of(wide), joints.numpy(), far.numpy())["command"])) < TOLERANCE


def test_a_load_above_1e3_newton_is_a_number() -> None:
    """Only joints beyond 1e3 are none."""
    machine = with_effects(sliding_arm(), ("compliance",), ("load_z",), 0.01)
    machine.covariates["load_z"].mul_(100)
    made = machine.compensator()
    joints, covariates = made.domain.centre[None, :3], torch.full((1, 1), 4e3, dtype=torch.float64)
    assert float(machine.covariates["load_z"].abs().max()) > 4e3
    found = solved(made, joints, covariates)
    assert found.status.tolist() == [EXACT]
    assert float(apart(reached(machine, made, found.command, covariates), wanted(machine, joints))) < TOLERANCE


def test_limits_of_a_urdf_are_kept_and_said() -> None:
    arm = seven_arm()
    low, high = limits_of(arm)
    assert (float(low[3]), float(high[3]), float(high[1])) == (-1.7, SEVEN_HIGH, 2.9)
    # A joint without limits turns on and on.
    assert (float(low[0]), float(high[0])) == (-INF, INF)
    middle = torch.tensor(SEVEN_HOME, dtype=torch.float64)
    middle[0], middle[3] = 3.1, SEVEN_HIGH - 1e-3
    draw = 2 * torch.rand(200, 7, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 1
    joints = middle + draw * torch.tensor([0.1, 0.1, 0.1, 1e-3, 0.1, 0.1, 0.1], dtype=torch.float64)
    made = near(arm, -2e-4, joints).compensator(0.0)
    found = solved(made, joints)
    assert bool((found.command[:, 3] <= SEVEN_HIGH).all())
    clipped = found.command[:, 3] == SEVEN_HIGH
    assert bool(clipped.any()) and bool((found.status[clipped] == DAMPED).all())
    assert bool((found.status == EXACT).any()) and bool((found.command[found.status == EXACT][:, 0] > math.pi).any())
    # Ideal joints that are beyond a limit are not taken farther.
    joints[:, 3] += 0.01
    assert bool((solved(made, joints).command[:, 3] <= joints[:, 3]).all())


STRANGE = [NAN, INF, -INF, 1e300, -1e308, 1.01e3, -5e3, 1e155]


@pytest.mark.parametrize("name", ["sliding arm with effects", "tripod", "delta", "polynomials"])
@pytest.mark.parametrize("value", STRANGE)
def test_inputs_that_are_none_are_commanded_as_they_are(name: str, value: float) -> None:
    made = compensated(name)
    domain, n = made.domain, len(made.joints)
    rows = domain.centre.repeat(n, 1)
    rows[:, :n].fill_diagonal_(value)
    found = solved(made, rows[:, :n], rows[:, n:])
    assert (found.status == NOT_FINITE).all() and (found.ideal_status == NOT_FINITE).all()
    assert bool((found.deviation == 0).all()) and torch.equal(found.ideal, found.command)
    edge = domain.centre if math.isnan(value) else domain.high if value > 0 else domain.low
    assert torch.equal(found.command.diagonal(), edge[:n])
    assert torch.equal(found.deviation_sd, made.fallback_sd.expand(n, n))
    if made.covariates and not abs(value) < 1e300:
        strange = rows.clone()
        strange[:, :n], strange[:, n] = domain.centre[:n], value
        assert (solved(made, strange[:, :n], strange[:, n:]).status == NOT_FINITE).all()


@pytest.mark.parametrize("name", ["sliding arm with effects", "framed stewart with effects", "polynomials"])
def test_every_form_gives_the_same_commands(name: str, tmp_path: Path) -> None:
    made, mechanism = compensated(name), known(name).mechanism
    about = fields() | {"mechanism": mechanism.describe()}
    paths = save_model(tmp_path, made, about, forms=("onnx", "float32.onnx"))
    # Single precision does not hold kinematics.
    assert "float32.onnx" not in paths
    joints, covariates = probe_points(made, 1000)
    given = joints.numpy(), None if covariates is None else covariates.numpy()
    with torch.no_grad():
        expected = {k: v.numpy() for k, v in made.solve(joints, covariates)._asdict().items()}
    assert {*expected["status"].tolist()} >= {EXACT, OUTSIDE, NOT_FINITE}
    for form in ("safetensors", "onnx"):
        found = load_model(paths[form])(*given)
        assert not found["fallback"].any()
        _assert_same(found, expected, made)
        # The file is the identified machine wherever one is asked for.
        nominal = load_mechanism(str(paths[form])).nominal
        torch.testing.assert_close(nominal, known(name).identified, rtol=0, atol=0)


def _assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], made: Compensator) -> None:
    """To 1e-9 of the bound, and near singular poses a thousand times that."""
    for output, state in (("command", "status"), ("deviation", "status"), ("ideal", "ideal_status")):
        np.testing.assert_array_equal(found[state], expected[state])
        allowed = 1e-9 * made.most.numpy() * np.where(expected[state] == DAMPED, 1e3, 1.0)[:, None]
        rounding = 4 * np.spacing(np.abs(expected[output]))
        assert (np.abs(found[output] - expected[output]) <= allowed + rounding).all(), output


def test_a_joint_beyond_1e3_is_no_fallback_of_the_guard(tmp_path: Path) -> None:
    made, mechanism = compensated("sliding arm"), known("sliding arm").mechanism
    paths = save_model(tmp_path, made, fields() | {"mechanism": mechanism.describe()}, forms=())
    rows = made.domain.centre.repeat(len(STRANGE), 1)
    rows[:, 1] = torch.tensor(STRANGE, dtype=torch.float64)
    found = load_model(paths["safetensors"])(rows.numpy())
    assert (found["status"] == NOT_FINITE).all() and not found["fallback"].any()
    assert np.isfinite(found["command"]).all() and (found["deviation"] == 0).all()


def test_the_whole_deviation_has_a_bound_of_its_own() -> None:
    """Where a machine misses by more than its bound the command stays within it, and is damped."""
    made = copy.deepcopy(compensated("arm"))
    made.most.copy_(1e-4 * torch.ones(6, dtype=torch.float64))
    joints, _ = points(made)
    found = solved(made, joints)
    assert bool((found.deviation.abs() <= made.most).all())
    bounded = (found.deviation.abs() == made.most).any(-1)
    assert bool(bounded.any()) and bool((found.status[bounded] == DAMPED).all())
    assert bool((made.limit < compensated("arm").most).all())
    needed = solved(compensated("arm"), joints)
    # All joints together: the command lies on the way to the exact one, and is better than none.
    one, other = (v[bounded & (needed.status <= 1)] for v in (found.deviation, needed.deviation))
    assert float(torch.cosine_similarity(one, other, -1).min()) > 0.99
    frame, (at, still) = wanted(known("arm"), joints), (found.command, joints)
    left, before = (apart(reached(known("arm"), made, v, joints[:, :0]), frame)[bounded] for v in (at, still))
    assert bool((left < before).all())
    # Three times the largest one that is needed where rows were measured and around, more than these show.
    bound = compensated("arm").most / needed.deviation[needed.status <= 1].abs().amax(0)
    assert bool((bound > 2.4).all()) and bool((bound < 6).all()), bound


def test_which_machine_is_inverted_and_which_is_none() -> None:
    for name in MACHINES:
        inverse = "stewart" in name or "tripod" in name
        assert isinstance(compensated(name).machine, InverseMachine) == inverse
        assert isinstance(compensated(name).machine, ExpandedMachine) == (name in EXPANDED)
    assert isinstance(known("arm").mechanism, SerialArm)
    assert load_mechanism("overconstrained_2dof").closed_form is None


def test_what_the_real_machine_cannot_reach_is_no_exact_command() -> None:
    """Legs so much shorter that a part of the nominal poses is out of their reach."""
    tripod = load_mechanism("tripod")
    values = tripod.nominal.clone()
    values[0] = 0.68
    pose = torch.tensor([[0.0, 0.69, 0.0], [0.0, 0.5, 0.0]], dtype=torch.float64)
    assert torch.isfinite(tripod.solve_inverse(pose, values)).all(-1).tolist() == [False, True]
    joints = tripod.solve_inverse(pose)
    made = machine_alone(all_over(tripod), values, margin=0.0)
    with torch.no_grad():
        found = made.solve(joints)
    # Commands so far from the nominal joints are outside what was sampled.
    assert found.status.tolist() == [3, 1]
    assert torch.equal(found.command[0], joints[0])
    reached = tripod.forward_kinematics(found.command[1:], values, pose[1:])
    torch.testing.assert_close(reached, pose[1:], rtol=0, atol=1e-9)
