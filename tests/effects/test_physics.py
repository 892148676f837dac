"""What the effects do, against closed forms, naive loops and the laws that they come from."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from physical_rows import ARM, acting, columns, situation
from torch import Tensor

from ccnn_torch.effects import (
    Situation,
    default_gravity,
    make_effect,
    measured_pose,
    reached,
    signature,
)
from ccnn_torch.effects.covariates import covariate_units, draw_covariates
from ccnn_torch.effects.loads import members
from ccnn_torch.effects.time import velocity
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

GANTRY = Path(__file__).parent / "gantry.yaml"
NO_SHAPE = torch.zeros(0, dtype=torch.float64)


def test_velocities_are_those_of_a_parabola_and_none_across_a_pause() -> None:
    time = torch.tensor([0.0, 0.1, 0.25, 0.3, 0.5, 9.0, 9.2, 20.0], dtype=torch.float64)
    joints = torch.stack([2 * time + 3 * time**2, -time], -1)
    order = torch.tensor([3, 0, 7, 2, 5, 1, 6, 4])
    got = torch.zeros_like(joints)
    got[order] = velocity(time[order], joints[order])
    assert torch.allclose(got[1:4, 0], 2 + 6 * time[1:4]) and torch.allclose(got[1:4, 1], torch.tensor(-1.0).double())
    # The ends know one side only; a row more than a second from a neighbour stands on no trajectory.
    assert torch.allclose(got[0], torch.tensor([2.3, -1.0], dtype=torch.float64))
    assert bool((got[4:] == 0).all())


@pytest.mark.parametrize("name", ["stewart", "tripod", "machine_tool", "five_bar", ARM])
def test_a_load_does_the_work_on_the_pose_that_its_torques_do_on_the_joints(name: str) -> None:
    rows = situation(name)
    machine = rows.mechanism
    if isinstance(machine, SerialArm):
        along = rows.jacobian  # moments about the base frame's axes
    else:
        step = 1e-6 * torch.eye(len(machine.joints), dtype=torch.float64)[:, None]
        ends = [machine.forward_kinematics(rows.joints + s * step, guess=rows.pose) for s in (1, -1)]
        along = ((ends[0] - ends[1]) / 2e-6).movedim(0, -1)
    load = torch.stack([rows.covariates[f"load_{c.name}"] for c in machine.pose], -1)
    expected = (along.mT @ load[..., None])[..., 0]
    assert torch.allclose(rows.load_torque, expected, rtol=1e-6, atol=1e-5)
    assert torch.equal(replace(rows, covariates={}).load_torque, torch.zeros_like(rows.joints))


@pytest.mark.parametrize("name", ["stewart", "five_bar", ARM])
def test_what_gives_under_a_load_obeys_maxwell_and_betti(name: str) -> None:
    """One load's work on the displacement by another is the other's on that by the first, in every linear column."""
    pair = [situation(name, seed=0), situation(name, seed=1)]
    pair[1] = replace(pair[0], covariates=pair[1].covariates)
    effect = make_effect("compliance")
    first, second = (columns(effect, rows, NO_SHAPE) for rows in pair)
    # A load that acts elsewhere does its work elsewhere, too.
    linear = [n for n in first if not n.endswith(("stiffening", "hardening")) and " load " not in n]
    assert len(linear) > len(pair[0].mechanism.joints)
    for column in linear:
        one = (pair[1].wrench * first[column]).sum(-1)
        other = (pair[0].wrench * second[column]).sum(-1)
        assert torch.allclose(one, other, rtol=1e-8, atol=1e-12), column
        # A spring takes work up.
        assert bool(((pair[0].wrench * first[column]).sum(-1) >= -1e-12).all()), column


def test_a_load_beside_the_measured_point_of_an_arm_does_work_where_it_acts() -> None:
    """Joints that give under a force 8 cm away, by the slope of that point's work: two columns of a joint, one for
    each place of the force, are the joint's under the force where it acts."""
    rows = situation(ARM)
    arm, away = rows.mechanism, torch.tensor([0.03, -0.05, 0.06], dtype=torch.float64)
    assert isinstance(arm, SerialArm)
    rows = replace(rows, covariates={k: v for k, v in rows.covariates.items() if k in ("load_x", "load_y", "load_z")})

    def place(joints: Tensor) -> Tensor:
        point, rotation = arm.forward_frame(joints)
        return point + rotation @ away

    found = columns(make_effect("compliance"), rows, NO_SHAPE)
    for i, joint in enumerate(arm.joints):
        step = 1e-6 * torch.eye(len(arm.joints), dtype=torch.float64)[i]
        torque = (rows.wrench[:, :3] * (place(rows.joints + step) - place(rows.joints - step))).sum(-1) / 2e-6
        beside = sum((found[f"{joint.name} load {axis}"] * d for axis, d in zip("xyz", away, strict=True)))
        expected = rows.jacobian[..., i] * torque[:, None]
        assert torch.allclose(found[joint.name] + beside, expected, rtol=1e-6, atol=1e-6), joint.name


@pytest.mark.parametrize("name", ["compliance", "bending", "friction"])
def test_moments_on_an_arm_act_whatever_of_its_pose_is_measured(name: str) -> None:
    """The position moves as it does where the orientation is measured as well, also through a drive that couples."""
    links = [[0.05, -1.57, 0.3, 0], [0.4, 0, 0, 0], [0.03, -1.57, 0, 0], [0, 1.57, 0.4, 0], [0, 0, 0.08, 0]]
    joints = 0.5 + torch.rand(9, 5, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    ramp = torch.linspace(-5, 5, 9, dtype=torch.float64)
    given = {"load_z": ramp - 60, "load_rx": ramp, "load_rz": 3 - ramp} | {f"direction{k}": ramp for k in range(1, 6)}
    changes = []
    for orientation in ("rotation_vector", "none"):
        arm = SerialArm("five", "standard", links, drives=[(4, 5)], orientation=orientation)
        coupled = [0.3 * (g.name == "drive45") for g in arm.geometry]
        assert any(coupled)
        machine = arm.with_nominal(arm.nominal + torch.tensor(coupled))
        rows = Situation(machine, joints, given, default_gravity(arm))
        made, shape = make_effect(name), acting(name, situation(ARM)).shape
        assert not made.missing(machine, ["load_rx", *(n for n in given if n.startswith("direction"))])
        sizes = torch.tensor([c.scale * (1 + k % 5) for k, c in enumerate(made.coefficients(rows))])
        changes.append(signature(rows, made, shape)[..., :3, :] @ sizes.double())
        without = {k: v for k, v in given.items() if not k.startswith("load_r")}
        assert not torch.allclose(replace(rows, covariates=without).load_torque, rows.load_torque, rtol=1e-3)
    torch.testing.assert_close(*changes, rtol=1e-9, atol=1e-12)


def test_a_linear_spring_is_twice_as_far_out_under_twice_the_load_and_a_stiffening_one_four_times() -> None:
    rows = situation("five_bar")
    double = replace(rows, covariates={k: 2 * v if k.startswith("load") else v for k, v in rows.covariates.items()})
    effect = make_effect("compliance")
    once, twice = (columns(effect, r, NO_SHAPE) for r in (rows, double))
    assert torch.allclose(twice["q1"], 2 * once["q1"]) and torch.allclose(twice["leg 2"], 2 * once["leg 2"])
    assert torch.allclose(twice["q1 stiffening"], 4 * once["q1 stiffening"])


def test_an_arm_sags_by_the_slope_of_its_potential_energy() -> None:
    rows = situation(ARM, 4)
    arm = rows.mechanism
    assert isinstance(arm, SerialArm)

    # Of the weight: spread evenly over the origins of links and the tool, and the less of it the farther out.
    even, inner = torch.ones(7, dtype=torch.float64), torch.linspace(1, 0, 7, dtype=torch.float64)

    def energy(joints: Tensor, weight: Tensor) -> Tensor:
        heights = [place[..., 2] for _, place in arm.link_frames(joints, arm.nominal)[1:]]
        return torch.stack([*heights, arm.forward_frame(joints)[0][..., 2]], -1) @ (weight / weight.sum())

    basis = make_effect("gravity").basis(rows, NO_SHAPE)
    names = [c.name for c in make_effect("gravity").coefficients(rows)]
    for i in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[i] = 1e-6
        for name, weight in ((f"q{i + 1}", even), (f"q{i + 1} inner links", inner)):
            slope = (energy(rows.joints + step, weight) - energy(rows.joints - step, weight)) / 2e-6
            assert torch.allclose(basis[:, i, names.index(name)], -slope, atol=1e-8)


def test_a_platform_hangs_in_its_drives_with_its_weight() -> None:
    rows = situation("stewart")
    tension = rows.weight_torque
    # The legs' forces on the platform hold it: along z they sum up to its weight, sideways to nothing.
    machine = rows.mechanism
    rotation = rotation_vector_to_matrix(rows.pose[:, 3:])
    legs = machine.nominal.reshape(6, 8)
    leg = rows.pose[:, None, :3] + (rotation[:, None] @ legs[:, 3:6, None])[..., 0] - legs[:, :3]
    total = (tension[..., None] * leg / leg.norm(dim=-1, keepdim=True)).sum(-2)
    assert torch.allclose(total, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(total), atol=1e-9)


def test_a_centre_of_mass_beside_the_measured_point_asks_what_the_shifted_weight_does() -> None:
    rows = situation("stewart")
    basis = make_effect("gravity").basis(rows, NO_SHAPE)[..., -3:]
    shift, weight = torch.tensor([0.02, -0.03, 0.1], dtype=torch.float64), 70.0
    torque = rows.weight_torque * weight + (basis @ (weight * shift)) / 1e-7
    # The height of the shifted point, by differences along each joint.
    step = 1e-6 * torch.eye(6, dtype=torch.float64)[:, None]
    heights = []
    for s in (step, -step):
        pose = rows.mechanism.forward_kinematics(rows.joints + s, guess=rows.pose)
        heights.append(pose[..., 2] + (rotation_vector_to_matrix(pose[..., 3:]) @ shift)[..., 2])
    assert torch.allclose(torque, -weight * ((heights[0] - heights[1]) / 2e-6).mT, rtol=1e-6, atol=1e-5)


def test_what_a_load_holds_on_a_flank_does_not_depend_on_the_side_of_approach() -> None:
    rows = situation("tripod")
    heavy = torch.full((9,), 1e5, dtype=torch.float64)
    sides = []
    for sign in (1.0, -1.0):
        columns = {f"direction{i}": torch.full((9,), sign, dtype=torch.float64) for i in (1, 2, 3)}
        held = replace(rows, covariates={**columns, "load_z": heavy})
        play = {f"q{i}": 2e-4 for i in (1, 2, 3)}
        sides.append(acting("backlash", held, **play, hold=2.0, weight=10.0).change(held))
    push = held.push(torch.tensor(10.0, dtype=torch.float64))
    pushed = push.abs() > 20
    assert bool(pushed.any()) and torch.allclose(sides[0][pushed], sides[1][pushed], atol=1e-12)
    # The play is the way between the two sides of approach, which the soft edge leaves a little short of the flanks.
    flank = 1e-4 / math.tanh(1 / 0.3)
    assert torch.allclose(sides[0][pushed], flank * push[pushed].sign())


def test_play_is_the_way_between_both_sides_of_approach() -> None:
    rows = situation("five_bar")
    ends = []
    for sign in (1.0, -1.0):
        side = replace(rows, covariates={"direction1": torch.full((9,), sign, dtype=torch.float64)})
        ends.append(rows.joints + acting("backlash", side, q1=3e-4, hold=60.0).change(side))
    assert torch.allclose(ends[1] - ends[0], torch.tensor([3e-4, 0.0], dtype=torch.float64).expand(9, 2), atol=1e-7)
    names = [c.name for c in make_effect("backlash").coefficients(side)]
    assert names == ["q1", "q1 softer", "q1 harder"]  # nothing is known of the other joint's side
    # Where friction holds against any push, no edge stands for what grows with it.
    soft = acting("backlash", side, q1_softer=0.1, q1_harder=0.1, hold=60.0)
    assert bool((soft.change(side) == 0).all())


def test_a_gear_gives_over_a_range_of_the_push() -> None:
    rows = situation("five_bar")
    load = torch.linspace(-300, 300, 9, dtype=torch.float64)
    side = replace(rows, covariates={"direction1": torch.ones(9, dtype=torch.float64), "load_y": load})
    push = side.push(torch.tensor(0.0, dtype=torch.float64))[:, 0]
    for width in (0.3, 4.0):
        there = acting("backlash", side, q1=2e-4, hold=0.5, width=width, weight=0.0).change(side)[:, 0]
        wanted = 1e-4 * torch.tanh((push - 0.5) / (0.5 * width)) / math.tanh(1 / width)
        assert torch.allclose(there, wanted, atol=1e-12)


def test_friction_acts_against_the_last_motion_and_grows_with_the_load() -> None:
    rows = situation("five_bar")
    change = acting("friction", rows, q2_load=2e-6).change(rows)
    assert torch.allclose(change[:, 1], -rows.direction[:, 1] * 2e-6 * rows.load_torque[:, 1].abs())
    assert bool((change[:, 0] == 0).all())


def test_geometry_is_that_of_the_mechanism_with_these_parameters() -> None:
    rows = situation("five_bar")
    shifted = rows.mechanism.nominal.clone()
    shifted[0] += 2e-3
    expected = rows.mechanism.forward_kinematics(rows.joints, shifted)
    assert torch.equal(reached(rows, [acting("geometry", rows, l1=2e-3)])[:, :2], expected)


def test_a_frame_moves_the_machine_as_a_whole_and_a_tool_turns_with_the_platform() -> None:
    rows = situation("stewart")
    moved = reached(rows, [acting("frame", rows, x=1e-4, rz=1e-5)])
    nominal = rows.pose[:, :3]
    before, after = (torch.cdist(p, p) for p in (nominal, moved[:, :3]))
    assert float((before - after).abs().max()) < 1e-10  # rigid, to the second order of the turn
    tool = reached(rows, [acting("tool", rows, y=2e-4, rx=1e-4)])
    rotation = rotation_vector_to_matrix(rows.pose[:, 3:])
    assert torch.allclose(tool[:, :3] - nominal, 2e-4 * rotation[:, :, 1], atol=1e-15)
    turn = rotation.mT @ rotation_vector_to_matrix(tool[:, 3:])
    expected = torch.tensor([1e-4, 0.0, 0.0], dtype=torch.float64).expand(9, 3)
    assert torch.allclose(matrix_to_rotation_vector(turn), expected, atol=1e-14)


def test_an_instrument_stretches_distances_along_its_axes() -> None:
    rows = situation("five_bar")
    far = reached(rows, [acting("instrument", rows, scale_x=1e-3)])
    nominal = rows.platform[0]
    ratio = (far[1:] - far[:1]) / (nominal[1:] - nominal[:1])
    assert torch.allclose(ratio[:, :2], torch.tensor([1.001, 1.0], dtype=torch.float64).expand(8, 2))
    names = [c.name for c in make_effect("instrument").coefficients(rows)]
    assert names == ["scale x", "scale y", "shear xy", "lean xy", "zero x", "zero y"]  # what a plane shows
    # An axis that leans turns the device: distances stay.
    leaning = reached(rows, [acting("instrument", rows, lean_xy=1e-4)])[:, :3]
    assert torch.allclose(torch.cdist(leaning, leaning), torch.cdist(nominal, nominal), atol=1e-8)


def test_what_the_pose_does_not_show_is_no_coefficient() -> None:
    rows = situation("tripod")
    # y, z and phi about -y: a shift along x and the turn about z change none of them.
    assert [c.name for c in make_effect("frame").coefficients(rows)] == ["y", "z", "rx", "ry"]
    frame = reached(rows, [acting("frame", rows, y=1e-4, ry=-2e-4)])
    pose = measured_pose(rows, frame)
    assert torch.allclose((pose - rows.pose)[:, 2], torch.full((9,), 2e-4, dtype=torch.float64), atol=1e-10)
    position, rotation = rows.mechanism.frame(pose)
    assert rotation is not None
    assert torch.allclose(torch.cat([position, matrix_to_rotation_vector(rotation)], -1), frame, atol=1e-9)


def test_a_gears_error_comes_back_after_its_period() -> None:
    rows = situation(ARM)
    one = acting("transmission", rows, q2_sin=1e-4, q2_cos_2=3e-5, q2_frequency=5.0)
    turned = replace(rows, joints=rows.joints + 2 * math.pi / 5)
    assert torch.allclose(one.change(rows), one.change(turned), atol=1e-15)
    effect = one.effect
    for i, shape in enumerate(effect.shapes(rows)):
        moved = [effect.coefficients(rows)[k].joint for k in shape.columns or ()]
        assert moved == [f"q{i + 1}"] * 8


@pytest.mark.parametrize(("travel", "lead"), [(1.0, 10e-3), (0.12, 5e-3), (0.12, 2e-3)])
def test_screws_of_usual_leads_are_looked_for_over_the_travel_of_the_rows(travel: float, lead: float) -> None:
    rows = situation(str(GANTRY))
    joints = torch.linspace(0.2, 0.2 + travel, 9, dtype=torch.float64)[:, None].repeat(1, 3)
    # A row whose joints are not known.
    joints[4] = torch.nan
    rows = replace(rows, joints=joints)
    grid = torch.tensor(make_effect("transmission").shapes(rows)[0].grid)
    # A wave between two neighbours of the grid is seen by both.
    assert float((grid - 2 * math.pi / lead).abs().min()) < 2 * math.pi / travel / 4


def test_lengths_of_a_leg_grow_together_in_a_machine_file_as_in_the_drawing(tmp_path: Path) -> None:
    file = tmp_path / "machine.yaml"
    file.write_text(
        "{machine: hexapod, numbers: {base_radius: 280 mm, platform_radius: 160 mm, base_spread: 12 deg, "
        "platform_spread: 12 deg, height: 420 mm}}"
    )
    assert [m.name for m in members(load_mechanism(str(file)))] == [m.name for m in members(load_mechanism("stewart"))]


def test_a_random_walk_has_the_variance_of_its_time() -> None:
    rows = situation("five_bar", 50)
    basis = make_effect("drift").basis(rows, torch.tensor([600.0], dtype=torch.float64))[:, 0]
    share = torch.linspace(0, 1, 50, dtype=torch.float64)
    variance = basis[:, 2:6].square().sum(-1)
    assert float((variance - share).abs().max()) < 0.06
    assert torch.allclose(basis[:, 0], share * 8 * 3600) and torch.allclose(
        basis[:, 1], torch.log1p(share * 8 * 3600 / 600)
    )


def test_one_joints_motion_moves_another_and_a_gain_itself() -> None:
    rows = situation("stewart")
    low, high = rows.workspace
    middle = (low + high) / 2
    change = acting("coupling", rows, q3_by_q5=1e-3).change(rows)
    assert torch.allclose(change[:, 2], 1e-3 * (rows.joints[:, 4] - middle[4]))
    assert bool((change[:, [0, 1, 3, 4, 5]] == 0).all())
    gain = acting("joint_gain", rows, q4=1e-3).change(rows)
    assert torch.allclose(gain[:, 3], 1e-3 * (rows.joints[:, 3] - middle[3]))


def test_a_machine_that_lags_is_where_it_was_before() -> None:
    time = torch.arange(40, dtype=torch.float64) * 0.02
    machine = load_mechanism("five_bar")
    start, end = machine.sample_joints(2, torch.Generator().manual_seed(2))
    path = start + (end - start) * (time / 0.8)[:, None]
    rows = Situation(machine, path, {"time": time}, default_gravity(machine))
    late = reached(rows, [acting("latency", rows, delay=0.01)])
    before = machine.forward_kinematics(path - (end - start) * 0.01 / 0.8)
    assert torch.allclose(late[:, :2], before, atol=1e-12)


def test_covariates_are_columns_with_units_and_the_same_for_the_same_seed() -> None:
    machine = load_mechanism("stewart")
    joints = machine.sample_joints(30, torch.Generator().manual_seed(0))
    one, two = (draw_covariates(machine, joints, torch.Generator().manual_seed(5)) for _ in range(2))
    assert all(torch.equal(one[name], two[name]) for name in one) and set(one) <= set(covariate_units(machine))
    assert torch.equal(one["direction4"][1:], torch.sign(joints[:, 3].diff()))
    assert 285 < float(one["temperature"].min()) < float(one["temperature"].max()) < 305


def test_a_clamped_beam_gives_as_the_textbook_says_at_its_end_and_what_it_carries() -> None:
    """A crane: a mast that turns, a boom of 2 m and one of 0.5 m beyond it; pulled down by 30 N at the tip."""
    arm = SerialArm("crane", "standard", [[0.0, 0.0, 0.7, 0.0], [2.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]])
    joints, load, long, beyond = torch.zeros(1, 3, dtype=torch.float64), -30.0, 2.0, 0.5
    rows = Situation(arm, joints, {"load_z": torch.tensor([load], dtype=torch.float64)}, default_gravity(arm))
    found = columns(make_effect("bending"), rows, NO_SHAPE)["link 2 load"][0]
    turn = load * long**2 / 2 + load * beyond * long
    sink = load * long**3 / 3 + load * beyond * long**2 / 2 + turn * beyond
    wanted = torch.tensor([0, 0, sink, 0, -turn, 0], dtype=torch.float64)
    assert torch.allclose(found, wanted[: len(found)], atol=1e-9)


def test_a_base_tilts_under_the_moment_at_its_foot_softer_in_one_direction() -> None:
    """A mast of 0.7 m and a boom of 2 m, turned by a right angle, on a base that stands aside and turned by 90°."""
    base = [5.0, 6.0, 0.0, 0.0, 0.0, math.pi / 2]
    arm = SerialArm("crane", "standard", [[0.0, 0.0, 0.7, 0.0], [2.0, 0.0, 0.0, 0.0]], base=base)
    joints, load = torch.zeros(1, 2, dtype=torch.float64), -30.0
    rows = Situation(arm, joints, {"load_z": torch.tensor([load], dtype=torch.float64)}, default_gravity(arm))
    found = columns(make_effect("bending"), rows, NO_SHAPE)
    # The boom is along the frame's y: the moment is about its x, the base's -y.
    turn = load * 2.0
    tilted = torch.tensor([0, -0.7 * turn, 2.0 * turn, turn, 0, 0], dtype=torch.float64)
    across = torch.tensor([0.7 * -turn, 0, 0, 0, -turn, 0], dtype=torch.float64)
    for name, wanted in (("y", tilted), ("xy", across), ("x", 0 * tilted)):
        own = found[f"base load {name}"][0]
        assert torch.allclose(own, wanted[: len(own)], atol=1e-9)
    # Half of the weight hangs at the top of the mast, half at the tip.
    assert torch.allclose(found["base weight y"][0], found["base load y"][0] / -load / 2)


def test_a_guide_shifts_and_turns_all_that_it_carries_about_where_its_carriage_is() -> None:
    machine = load_mechanism(str(GANTRY))
    joints = torch.tensor([[0.25, 0.6, 0.1]], dtype=torch.float64)
    found = columns(make_effect("error_motion"), Situation(machine, joints, {}, default_gravity(machine)), NO_SHAPE)
    assert len(found) == 3 * (16 * 6 - 3) and "q1 x 1" not in found
    # Of x at a quarter of a metre u = -0.5: P0 = 1, P1 = -0.5, P2 = -0.125, P3 = 0.4375.
    assert torch.allclose(found["q1 y 2"][0, :3], -1.125 * torch.eye(3).double()[1])
    lever = torch.tensor([0.0, 0.6, 0.1], dtype=torch.float64)
    for name, form in (("q1 rx 1", -0.5), ("q1 rx 3", 0.9375)):
        turned = torch.linalg.cross(torch.eye(3).double()[0], lever)
        assert torch.allclose(found[name][0, :3], form * turned)
    legendre = np.polynomial.legendre.legvander(-0.5, 16).flatten()
    for k in range(2, 17):
        assert float(found[f"q1 y {k}"][0, 1]) == pytest.approx(legendre[k] - legendre[k - 2], abs=1e-14)
    # z carries the tool alone, which is at its carriage.
    assert not found["q3 rx 1"][:, :3].any()


def test_a_track_without_limits_is_described_over_where_its_rows_have_been() -> None:
    links = [[0.0, -1.5707963267948966, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]]
    arm = SerialArm("track", "standard", links, ["prismatic", "revolute"])
    joints = torch.tensor([[0.0, 0.3], [1.5, 0.2], [2.0, 0.1], [4.0, 0.0]], dtype=torch.float64)
    rows, effect = Situation(arm, joints, {}, default_gravity(arm)), make_effect("error_motion")
    shapes = effect.shapes(rows)
    assert [(s.name, s.unit, s.grid) for s in shapes] == [("q1 from", "m", (0.0,)), ("q1 to", "m", (4.0,))]
    ends = torch.tensor([s.grid[0] for s in shapes], dtype=torch.float64)
    # P2 - 1 of u = -1, -0.25, 0, 1.
    wanted = torch.tensor([0, -1.40625, -1.5, 0], dtype=torch.float64)
    shift = columns(effect, rows, ends)["q1 x 2"]
    assert torch.allclose(shift[:, :3].norm(dim=-1), wanted.abs())
    many = torch.stack([ends, torch.tensor([1.0, 3.0]).double()])
    assert torch.equal(effect.basis(rows, many)[0], effect.basis(rows, ends))
    told = SerialArm("track", "standard", links, ["prismatic", "revolute"], limits=[[0, 4], [-1, 1]])
    other = Situation(told, joints, {}, default_gravity(told))
    assert effect.shapes(other) == () and torch.equal(effect.basis(other, NO_SHAPE), effect.basis(rows, ends))


def test_a_table_that_wobbles_tilts_what_it_carries_across_its_axis(tmp_path: Path) -> None:
    file = tmp_path / "table.yaml"
    file.write_text("machine: five_axis_table_table\n")
    machine = load_mechanism(str(file))
    joints = torch.tensor([[0.5, 0.0, 0.1, 0.2, 0.3]], dtype=torch.float64)
    found = columns(make_effect("error_motion"), Situation(machine, joints, {}, default_gravity(machine)), NO_SHAPE)
    assert len(found) == 2 * 20 + 3 * (16 * 6 - 3) and "q1 rz sin" not in found and "q2 rx sin" not in found
    # Of the table C, which turns all that comes after it about -z.
    turn = torch.tensor([[0.877582561890, 0.479425538604], [-0.479425538604, 0.877582561890]], dtype=torch.float64)
    for name, size in (("x sin", 0.479425538604), ("x cos 2", 0.540302305868)):
        assert torch.allclose(found[f"q1 {name}"][0, :2], size * turn[:, 0])
    assert torch.allclose(found["q1 rx sin"][0, 3:5], 0.479425538604 * turn[:, 0])
