"""Geometry and effects fitted together, and which effects stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from fitted import six_axis_arm
from torch import Tensor

from ccnn_torch.diagnosis.joint_fit import JointFit, effects_that_pay, fit_jointly
from ccnn_torch.effects import Acting, Situation, default_gravity, make_effect, reached
from ccnn_torch.mechanisms import SerialArm, load_mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix

NOISE = 2e-5
LIBRARY = ("joint_gain", "transmission", "gravity", "coupling")


def waves(orders: float, size: float, situation: Situation) -> Acting:
    """A periodic error of every joint, `orders` a turn."""
    effect = make_effect("transmission")
    values = torch.zeros(len(effect.coefficients(situation)), dtype=torch.float64)
    for k, c in enumerate(effect.coefficients(situation)):
        if c.name.partition(" ")[2] in ("sin", "cos"):
            values[k] = size * (1 if k % 4 else -0.7)
    return Acting(effect, torch.full((6,), orders, dtype=torch.float64), values)


def sagging(situation: Situation) -> Acting:
    effect = make_effect("gravity")
    values = [1e-3 * (c.name in ("q2", "q3", "q5")) for c in effect.coefficients(situation)]
    return Acting(effect, torch.zeros(0, dtype=torch.float64), torch.tensor(values, dtype=torch.float64))


def rows(count: int, seed: int) -> Situation:
    machine = six_axis_arm()
    joints = machine.sample_joints(count, torch.Generator().manual_seed(seed))
    return Situation(machine, joints, {}, default_gravity(machine))


def built(situation: Situation) -> Tensor:
    """Links as they were built: 0.3 mm and 0.3 mrad off."""
    generator = torch.Generator().manual_seed(9)
    nominal = situation.mechanism.nominal
    change = 3e-4 * torch.randn(len(nominal), generator=generator, dtype=torch.float64)
    change[:6] = change[-6:] = 0
    return nominal + change


def measured(situation: Situation, acting: list[Acting], noise: float, seed: int = 3) -> Tensor:
    frame = reached(situation, acting, built(situation))
    more = noise * torch.randn(frame.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    turn = rotation_vector_to_matrix(more[:, 3:]) @ rotation_vector_to_matrix(frame[:, 3:])
    return torch.cat([frame[:, :3] + more[:, :3], matrix_to_rotation_vector(turn)], -1)


def miss(found: JointFit, acting: list[Acting]) -> float:
    """RMS position error of the fitted machine on new rows, against the true one [m]."""
    new = rows(200, 2)
    gap = reached(new, found.acting, found.parameters) - reached(new, acting, built(new))
    return float(gap[:, :3].square().sum(-1).mean().sqrt())


def fitted(situation: Situation, pose: Tensor) -> tuple[list[str], JointFit]:
    fine, loose = torch.ones(len(pose), dtype=torch.bool), range(len(situation.mechanism.geometry))
    known = effects_that_pay(situation, pose, [make_effect(name) for name in LIBRARY], fine, loose)
    return [k.effect.name for k in known], fit_jointly(situation, pose, known, fine, loose)


Made = Callable[[Situation], list[Acting]]


@pytest.mark.parametrize(
    ("made", "there"),
    [
        (lambda s: [], set()),
        (lambda s: [waves(1.0, 1.5e-4, s), sagging(s)], {"transmission", "gravity"}),
    ],
    ids=["geometry", "both"],
)
def test_what_acts_stays_and_the_machine_is_found_to_the_noise(made: Made, there: set[str]) -> None:
    situation = rows(150, 1)
    acting = made(situation)
    names, found = fitted(situation, measured(situation, acting, NOISE))
    assert set(names) == there
    assert miss(found, acting) < NOISE
    # Without the effects geometry takes what it can, and misses the rest.
    if there:
        alone = fit_jointly(situation, measured(situation, acting, NOISE), [], torch.ones(150) > 0, range(48))
        assert miss(alone, acting) > 2 * miss(found, acting)


def test_drives_err_with_several_periods() -> None:
    situation = rows(250, 1)
    acting = [waves(1.0, 1.5e-4, situation), waves(11.0, 1e-4, situation), waves(47.0, 5e-5, situation)]
    names, found = fitted(situation, measured(situation, acting, NOISE))
    assert names.count("transmission") == 3
    assert {1.0, 11.0, 47.0} <= {float(order) for one in found.acting for order in one.shape}
    assert miss(found, acting) < 1.5 * NOISE


def test_drives_that_the_file_tells_are_looked_for_there_whatever_their_period() -> None:
    """No whole number a turn, and more of them than are searched."""
    situation = rows(250, 1)
    acting = [waves(50.4, 4e-5, situation)]
    pose = measured(situation, acting, NOISE)
    machine = SerialArm(**{**situation.mechanism.recipe["keys"], "gears": [50.4] * 6})
    told = replace(situation, mechanism=machine)
    names, found = fitted(told, pose)
    assert names == ["transmission"] and found.acting[0].shape.tolist() == [50.4] * 6
    assert miss(found, acting) < NOISE
    assert miss(fitted(situation, pose)[1], acting) > 1.5 * miss(found, acting)


def test_many_causes_are_not_the_noise_of_a_search_for_one_more() -> None:
    """The noise of the rows is estimated beside all that is there: beside a few causes a wave passed for one more."""
    generator = torch.Generator().manual_seed(12)
    bar = load_mechanism("five_bar", gears=[50, 50])
    joints, ramp = bar.sample_joints(60, generator), torch.linspace(290.15, 298.15, 60, dtype=torch.float64)
    covariates = {"temperature": ramp, "load_y": -20 + 10 * torch.rand(60, generator=generator, dtype=torch.float64)}
    for i in (1, 2):
        covariates[f"direction{i}"] = torch.randn(60, generator=generator, dtype=torch.float64).sign()
    situation = Situation(bar, joints, covariates, default_gravity(bar))
    acting = []
    for name, share, period in (
        *(("transmission", 0.05, 1.0), ("transmission", 0.5, 50.0), ("thermal", 0.5, 0.0)),
        *(("backlash", 0.3, 0.0), ("compliance", 0.3, 0.0), ("joint_gain", 0.3, 0.0)),
    ):
        effect = make_effect(name)
        sizes = [0.0 if c.secondary else share * c.scale for c in effect.coefficients(situation)]
        shape = [period or s.usual or s.grid[len(s.grid) // 2] for s in effect.shapes(situation)]
        acting.append(Acting(effect, *(torch.tensor(v, dtype=torch.float64) for v in (shape, sizes))))
    true = bar.nominal + 2e-4 * torch.randn(len(bar.nominal), generator=generator, dtype=torch.float64)
    noise = 3e-6 * torch.randn(60, 2, generator=generator, dtype=torch.float64)
    pose = reached(situation, acting, true)[:, :2] + noise
    library = [make_effect(name) for name in (*LIBRARY, "compliance", "thermal", "backlash", "friction")]
    known = effects_that_pay(situation, pose, library, torch.ones(60) > 0, range(len(true)))
    assert [k.shape.tolist() for k in known if k.effect.name == "transmission"] == [[50.0, 50.0]]


def test_parameters_that_are_not_loose_stay() -> None:
    situation = rows(60, 1)
    pose = measured(situation, [], NOISE)
    found = fit_jointly(situation, pose, [], torch.ones(60) > 0, [0, 1])
    same = torch.ones(len(found.parameters), dtype=torch.bool)
    same[:2] = False
    torch.testing.assert_close(found.parameters[same], situation.mechanism.nominal[same], rtol=0, atol=0)
    assert bool((found.parameters[:2] != situation.mechanism.nominal[:2]).all())


def test_where_nothing_is_loose_the_machine_stays_as_it_is() -> None:
    situation = rows(20, 6)
    found = fit_jointly(situation, measured(situation, [], NOISE), [], torch.ones(20) > 0, [])
    assert not found.acting and torch.equal(found.parameters, situation.mechanism.nominal)


def test_rows_that_are_not_used_change_nothing() -> None:
    situation = rows(120, 1)
    pose, used = measured(situation, [], NOISE), torch.arange(120) < 100
    first = fit_jointly(situation, pose, [], used, range(48)).parameters
    pose[110] += 1.0
    torch.testing.assert_close(fit_jointly(situation, pose, [], used, range(48)).parameters, first, rtol=0, atol=0)
    # They are no values from which noise or the size of what is fitted is known, either.
    few = Situation(situation.mechanism, situation.joints[used], {}, situation.gravity)
    there = fit_jointly(few, pose[used], [], torch.ones(100) > 0, range(48)).parameters
    torch.testing.assert_close(first, there, rtol=0, atol=1e-9)


@pytest.mark.parametrize("turning", [range(6), range(1)], ids=["all legs", "one leg"])
def test_screws_of_legs_turn_alike_unless_the_rows_say_otherwise(turning: range) -> None:
    """Waves that no leg shows by itself all legs show together; one screw that is worn is no fault of the others."""
    mechanism, drawn = load_mechanism("stewart"), torch.Generator().manual_seed(4)
    joints = mechanism.solve_inverse(mechanism.sample_workspace(50, drawn))
    situation, effect = Situation(mechanism, joints, {}, default_gravity(mechanism)), make_effect("transmission")
    size = 1.6e-5 if len(turning) > 1 else 6e-5
    values = torch.tensor(
        [size * (c.name in {f"q{i + 1} sin" for i in turning}) for c in effect.coefficients(situation)]
    )
    cause = Acting(effect, torch.full((6,), 2 * torch.pi / 5e-3, dtype=torch.float64), values.double())
    pose = reached(situation, [cause])
    pose = pose + NOISE * torch.randn(pose.shape, generator=drawn, dtype=torch.float64)
    (found,) = effects_that_pay(situation, pose, [effect], torch.ones(50) > 0, [])
    legs = {k // 8 for k in found.used}
    assert {8 * i + k for i in turning for k in (0, 1)} <= {*found.used}
    assert (len(legs) == 6) == (len(turning) == 6)
    periods = found.shape[list(turning)] * 5e-3 / (2 * torch.pi)
    assert float(periods.max()) == float(periods.min()) and abs(float(periods[0]) - 1.0) < 0.01


@pytest.mark.parametrize("first", ["temperature", "temperature_base"])
def test_one_link_grows_by_its_own_thermometer_and_no_other_does(first: str) -> None:
    """Without a thermometer of the surroundings the mean of all stands for it."""
    situation = rows(60, 1)
    warm = 293 + 4 * torch.rand(60, 2, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    columns = {first: warm[:, 0], "temperature_motor": warm[:, 1]}
    situation, effect = replace(situation, covariates=columns), make_effect("thermal")
    assert not effect.missing(situation.mechanism, [*columns])
    names = [c.name for c in effect.coefficients(situation)]
    grown = torch.tensor([1.2e-5 * (name in ("growth", "link 3 motor")) for name in names], dtype=torch.float64)
    cause = Acting(effect, torch.zeros(0, dtype=torch.float64), grown)
    pose = measured(situation, [cause], NOISE / 4)
    (found,) = effects_that_pay(situation, pose, [effect], torch.ones(60) > 0, range(48))
    own = {names[k] for k in found.used}
    # What one of two shows beyond their mean is what the other lacks.
    ends = ("motor", "base")[: 1 + (first == "temperature_base")]
    assert "growth" in own and {n.rpartition(" ")[0] for n in own if n.endswith(ends)} == {"link 3"}


@pytest.mark.parametrize("away", [0.0, 1.0])
def test_a_screw_grows_by_its_own_thermometer_where_many_are_told(away: float) -> None:
    """Seven thermometers of which one says something: the idle ones are no evidence against it. It is away from 20
    degrees at first, so that its own warmth and that beside the hall's are two things."""
    mechanism, drawn = load_mechanism("stewart"), torch.Generator().manual_seed(8)
    joints = mechanism.solve_inverse(mechanism.sample_workspace(80, drawn))
    names = ["temperature", *(f"temperature_q{i + 1}" for i in range(6))]
    warm = 293.15 + 5 * away + 4 * torch.rand(80, 7, generator=drawn, dtype=torch.float64)
    told = dict(zip(names, warm.unbind(-1), strict=True))
    situation = Situation(mechanism, joints, told, default_gravity(mechanism))
    effect = make_effect("thermal")
    own = [c.name for c in effect.coefficients(situation)]
    grown = torch.tensor([1.15e-5 * (name == "q3 travel q3") for name in own], dtype=torch.float64)
    pose = reached(situation, [Acting(effect, torch.zeros(0, dtype=torch.float64), grown)])
    pose = pose + NOISE / 4 * torch.randn(pose.shape, generator=drawn, dtype=torch.float64)
    (found,) = effects_that_pay(situation, pose, [effect], torch.ones(80) > 0, [])
    parts = {own[k] for k in found.used if effect.coefficients(situation)[k].part}
    assert "q3 travel q3" in parts and len(parts) < 3


def test_no_part_grows_by_one_of_thermometers_that_warm_together() -> None:
    """Of some thirty parts by four thermometers each, some fit the noise; on another day they are apart."""
    drawn = torch.Generator().manual_seed(11)
    whole = 293 + 12 * torch.rand(60, 1, generator=drawn, dtype=torch.float64)
    warm = whole + 0.3 * torch.randn(60, 4, generator=drawn, dtype=torch.float64)
    names = [f"temperature_motor{k + 1}" for k in range(4)]
    situation = replace(rows(60, 1), covariates=dict(zip(names, warm.unbind(-1), strict=True)))
    effect, found = make_effect("thermal"), 0
    own = effect.coefficients(situation)
    grown = torch.tensor([1.2e-5 * (c.name == "growth") for c in own], dtype=torch.float64)
    for seed in range(3):
        pose = measured(situation, [Acting(effect, torch.zeros(0, dtype=torch.float64), grown)], NOISE, seed)
        for known in effects_that_pay(situation, pose, [effect], torch.ones(60) > 0, range(48)):
            assert 0 in known.used
            found += sum(bool(own[k].part) for k in known.used)
    assert found == 0


def test_a_base_plate_grows_as_one_body() -> None:
    """The places of all joints on it, which no leg shows enough by itself."""
    mechanism, drawn = load_mechanism("stewart"), torch.Generator().manual_seed(9)
    joints = mechanism.solve_inverse(mechanism.sample_workspace(80, drawn))
    warm = 293.15 + 4 * torch.rand(80, generator=drawn, dtype=torch.float64)
    situation = Situation(mechanism, joints, {"temperature": warm}, default_gravity(mechanism))
    effect = make_effect("thermal")
    own = [c.name for c in effect.coefficients(situation)]
    plates = {c.name for c in effect.coefficients(situation) if c.part}
    assert len(plates) == 2
    plate = sorted(plates)[0]
    grown = torch.tensor([2.3e-5 * (name == plate) for name in own], dtype=torch.float64)
    pose = reached(situation, [Acting(effect, torch.zeros(0, dtype=torch.float64), grown)])
    pose = pose + NOISE * torch.randn(pose.shape, generator=drawn, dtype=torch.float64)
    (found,) = effects_that_pay(situation, pose, [effect], torch.ones(80) > 0, [])
    assert plate in {own[k] for k in found.used}


@pytest.mark.parametrize("wave", [3.5, 0.9, None])
def test_how_smooth_a_rail_is_is_asked_of_the_rows(wave: float | None) -> None:
    """A track of 4 m on rails with waves, long or short, or on straight ones."""
    links = [[0.0, -1.5707963267948966, 0.0, 0.0], [0.5, 0.0, 0.3, 0.0], [0.4, 0.0, 0.0, 0.0]]
    limits = [[0.0, 4.0], [-2.0, 2.0], [-2.0, 2.0]]
    arm = SerialArm("track", "standard", links, ["prismatic", "revolute", "revolute"], limits=limits)
    drawn = torch.Generator().manual_seed(7)
    joints = arm.sample_joints(200, drawn)
    situation = Situation(arm, joints, {}, default_gravity(arm))
    pose = reached(situation, [])
    if wave is not None:
        along = joints[:, :1] * 2 * torch.pi / wave + torch.arange(6)
        shift, turn = (2e-4 * torch.sin(along)).split(3, -1)
        carriage = joints[:, :1] * torch.tensor([0.0, 0.0, 1.0])
        place = pose[:, :3] + shift + torch.linalg.cross(turn, pose[:, :3] - carriage)
        turned = rotation_vector_to_matrix(turn) @ rotation_vector_to_matrix(pose[:, 3:])
        pose = torch.cat([place, matrix_to_rotation_vector(turned)], -1)
    really = pose
    pose = pose + NOISE * torch.randn(200, 6, generator=drawn, dtype=torch.float64)
    effect, fine = make_effect("error_motion"), torch.ones(200) > 0
    loose = range(len(arm.geometry))
    known = effects_that_pay(situation, pose, [effect], fine, loose)
    parts = {effect.coefficients(situation)[k].part for one in known for k in one.used}
    assert parts == {3.5: {"", "waves"}, 0.9: {"", "waves", "short waves"}, None: set()}[wave]
    left = really - reached(situation, *fit_jointly(situation, pose, known, fine, loose))
    assert float(left[:, :3].square().mean().sqrt()) < (0.9 if wave == 0.9 else 0.5) * NOISE
