"""Simulated real machines: what each cause does is checked against mechanics written down a second time."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from ccnn_validation.realistic.machine import _GRID, CAUSES, MACHINES, RealisticMachine, _follow, build_machine
from ccnn_validation.realistic.structure import GRAVITY, ArmStructure, LegStructure
from scipy.spatial.transform import Rotation
from torch import Tensor

from ccnn_torch.calibration.config import RunConfig
from ccnn_torch.calibration.prepare import Prepared, prepare
from ccnn_torch.errors import InputError

ROWS = 24


def machine(name: str, cause: str = "mixed", **keys: Any) -> RealisticMachine:
    about: dict[str, Any] = {"strength": 1.0, "rows": ROWS, "noise": 5e-6, "seeds": [0, 1]}
    return build_machine(name, cause, **(about | keys))


def prepared(name: str, cause: str = "mixed", **keys: Any) -> Prepared:
    about = {"machine": name, "cause": cause, "rows": 40}
    return prepare(RunConfig.from_keys(case="realistic", realistic=about | keys.pop("realistic", {}), **keys))


@pytest.mark.parametrize("name", MACHINES)
def test_without_strength_the_machine_is_the_nominal_one(name: str) -> None:
    built = machine(name, strength=0.0)
    error = built.mechanism.pose_error(built.reached, built.pose)
    assert float(error.position.max()) < 1e-11
    assert error.rotation is not None and float(error.rotation.max()) < 1e-11


@pytest.mark.parametrize("cause", CAUSES)
@pytest.mark.parametrize("name", MACHINES)
def test_strength_one_is_a_fraction_of_a_millimetre_and_strength_scales(name: str, cause: str) -> None:
    rms = []
    for strength in (1.0, 2.0):
        built = machine(name, cause, strength=strength, rows=15)
        rms.append(float(built.mechanism.pose_error(built.reached, built.pose).position.square().mean().sqrt()))
    assert 0.02e-3 < rms[0] < 0.35e-3
    assert rms[1] == pytest.approx(2 * rms[0], rel=0.05)


def test_a_cause_alone_is_its_part_of_the_mixed_machine() -> None:
    alone, mixed = (machine("tripod", cause).built.causes for cause in ("geometry", "mixed"))
    assert torch.allclose(mixed.geometry, 0.5 * alone.geometry)
    assert not alone.backlash.any() and not alone.growth.any() and bool(mixed.backlash.any())


@pytest.mark.parametrize("name", ["tripod", "machine_tool"])
def test_every_leg_has_its_own_length_at_the_pose_that_was_solved(name: str) -> None:
    found = machine(name)
    drives, parameters, pose = found.built.equilibrium(found.joints, found.pose)
    structure = found.built.structure
    assert isinstance(structure, LegStructure)
    for row in range(0, ROWS, 5):
        at = pose[1, row].numpy()
        if name == "tripod":
            position, turn = np.array([0.0, at[0], at[1]]), Rotation.from_rotvec([0.0, -at[2], 0.0])
        else:
            position, turn = np.array([0.0, 0.0, at[2]]), Rotation.from_euler("XY", at[:2])
        for leg, values in enumerate(parameters[1, row].reshape(3, 9).numpy()):
            foot, joint, length, off = values[:3], values[3:6], values[6], values[7:]
            along = structure.directions[leg].numpy() + off @ structure.across[leg].numpy()
            along /= np.linalg.norm(along)
            slider = foot + float(drives[1, row, leg]) * along
            assert np.linalg.norm(position + turn.apply(joint) - slider) == pytest.approx(length, abs=1e-11)
    # The legs are really not those of the nominal machine.
    assert float((parameters - structure.parameters).abs().max()) > 3e-5


def test_the_arm_stands_where_its_own_frames_put_it() -> None:
    found = machine("arm")
    drives, parameters, pose = found.built.equilibrium(found.joints, found.pose)
    for row in range(0, ROWS, 7):
        turn, place = Rotation.identity(), np.zeros(3)
        frames = parameters[0, row].reshape(8, 6).numpy()
        for frame, angle in zip(frames[1:7], drives[0, row].tolist(), strict=True):
            place = place + turn.apply(frame[:3])
            turn = turn * Rotation.from_euler("xyz", frame[3:]) * Rotation.from_rotvec([0.0, 0.0, angle])
        place = place + turn.apply(frames[7, :3])
        turn = turn * Rotation.from_rotvec(frames[7, 3:])
        assert np.allclose(place, pose[0, row, :3], atol=1e-12)
        assert (turn * Rotation.from_rotvec(pose[0, row, 3:]).inv()).magnitude() < 1e-8


@pytest.mark.parametrize("name", ["tripod", "machine_tool"])
def test_legs_and_screws_are_in_equilibrium_under_weight_and_load(name: str) -> None:
    """The elastic energy less the work of weight and load does not change to first order, by automatic derivatives."""
    found = machine(name, "compliance")
    built, structure = found.built, found.built.structure
    assert isinstance(structure, LegStructure)
    drives, _, pose = built.equilibrium(found.joints, found.pose)
    still = built.parameters()
    compliance = structure.leg_compliance * built.causes.member_compliance

    def energy(pose: Tensor, drives: Tensor) -> Tensor:
        stretch = structure.closure(pose, drives, still)
        position, rotation = found.mechanism.frame(pose)
        assert rotation is not None
        height = (position + rotation @ structure.centre)[..., 2]
        work = (built.load * pose).sum()
        return (stretch.square() / compliance).sum() / 2 + (structure.mass * GRAVITY * height).sum() - work

    by_pose, by_drive = torch.func.grad(energy, argnums=(0, 1))(pose, drives)
    # Newtons: the weight alone is 245 N or more.
    assert float(by_pose.abs().max()) < 1e-4
    assert torch.allclose(built.deflection(-by_drive), drives - found.joints, atol=1e-12)
    assert float((drives - found.joints).abs().max()) > 1e-5


def test_the_arms_gears_hold_its_weight_and_load() -> None:
    found = machine("arm", "compliance")
    built, structure = found.built, found.built.structure
    assert isinstance(structure, ArmStructure)
    drives, parameters, _ = built.equilibrium(found.joints, found.pose)

    def potential(drives: Tensor) -> Tensor:
        frames = structure.built.link_frames(drives, parameters)[1:]
        parts = zip(frames, structure.masses, structure.centres, strict=True)
        height = sum(m * (p + r @ c)[..., 2] for (r, p), m, c in parts)
        tip = structure.built.forward_frame(drives, parameters)[0]
        return (GRAVITY * height - (built.load[..., :3] * tip).sum(-1)).sum()

    torque = -torch.func.grad(potential)(drives)
    assert torch.allclose(built.deflection(torque), drives - found.joints, atol=1e-13)
    assert float(torque[..., 1].abs().max()) > 20.0


def test_a_load_moves_the_platform_its_own_way() -> None:
    found = machine("tripod", "compliance")
    pushed = replace(found.built, load=found.built.load + torch.tensor([0.0, 50.0, 0.0]))
    higher = pushed.reach(found.joints, found.pose) - found.reached
    assert bool((higher[..., 1] > 0).all())


def test_transmission_errors_repeat_with_their_period() -> None:
    for name in ("tripod", "arm"):
        found = machine(name, "transmission")
        period = 2 * torch.pi / found.built.causes.frequency[..., 0]
        errors = [
            found.built.drives(command, found.pose) - command
            for command in (found.joints, found.joints + period[:, None])
        ]
        assert torch.allclose(*errors, atol=1e-15)
        assert float(errors[0].abs().max()) > 3e-5
        travel = found.built.structure.travel
        turns = (travel[:, 1] - travel[:, 0]) / period if name == "tripod" else 2 * torch.pi / period
        assert bool(((turns >= 0.999) & (turns <= 6.001)).all())


def test_play_lies_against_the_motion_unless_the_load_is_larger() -> None:
    found = machine("arm", "backlash")
    there, back = (replace(found.built, direction=torch.full_like(found.joints, sign)) for sign in (1.0, -1.0))
    gap = back.drives(found.joints, found.pose) - there.drives(found.joints, found.pose)
    assert bool((gap >= 0).all()) and bool((gap <= 2 * found.built.causes.backlash + 1e-15).all())
    # The first axis stands upright, so that its weight does not choose; the second carries the arm.
    assert float((gap / (2 * found.built.causes.backlash))[..., 0].min()) > 0.5
    assert float((gap / (2 * found.built.causes.backlash))[..., 1].min()) < 0.5


def test_a_body_follows_a_step_of_its_surroundings_exponentially() -> None:
    time = np.arange(0, 4000, _GRID)
    followed = _follow(np.ones_like(time), 1800.0, 0.0)
    assert np.allclose(followed, 1 - np.exp(-(time + _GRID) / 1800.0), atol=1e-12)
    assert np.allclose(_follow(np.full(50, 3.0), 700.0, 3.0), 3.0)


def test_heat_makes_every_length_and_screw_grow() -> None:
    climate = machine("tripod", "thermal").built.climate
    assert climate.time[0].tolist() == pytest.approx(np.linspace(0, 8 * 3600, ROWS).tolist())
    assert float(climate.surroundings.min()) > 280 and float(climate.surroundings.max()) < 312
    # Nothing has warmed up when the day begins, and the drives are warmer than the hall at its end.
    assert torch.allclose(climate.structure[:, 0, :2] + 293.15, climate.surroundings[:, :1].expand(-1, 2))
    assert bool((climate.drives[:, -1] + 293.15 > climate.surroundings[:, -1:]).all())


@pytest.mark.parametrize("name", MACHINES)
def test_the_deviation_is_the_joint_change_that_explains_the_measured_pose(name: str) -> None:
    found = prepared(name)
    applied = found.joints + found.dataset.deviation
    reached = found.mechanism.forward_kinematics(applied, guess=found.pose)
    error = found.mechanism.pose_error(reached, found.pose)
    # A serial arm's deviations are damped, as for records: a thousandth of its error stays.
    bound = 2e-6 if name == "arm" else 1e-10
    assert float(error.position.max()) < bound
    assert bool(found.dataset.usable.all())
    assert found.dataset.jacobian is not None and found.dataset.jacobian.shape[:2] == (1, 40)


@pytest.mark.parametrize("name", ["machine_tool"])
def test_repeat_k_belongs_to_seed_plus_k_alone(name: str) -> None:
    many = prepared(name, repeats=3, seed=4, split={"kind": "block"})
    alone = prepared(name, repeats=1, seed=6, split={"kind": "block"})
    for one, other in (
        (many.dataset.inputs[2], alone.dataset.inputs[0]),
        (many.dataset.deviation[2], alone.dataset.deviation[0]),
        (many.pose[2], alone.pose[0]),
    ):
        assert torch.allclose(one, other, rtol=0, atol=1e-12)
    assert torch.equal(many.dataset.splits[2].test, alone.dataset.splits[0].test)
    assert torch.equal(many.dataset.periodic, alone.dataset.periodic)
    assert not torch.allclose(many.joints[0], many.joints[1])


@pytest.mark.parametrize("name", ["machine_tool"])
def test_the_expected_floor_is_what_the_noise_makes_on_average(name: str) -> None:
    found = prepared(name, "geometry", repeats=12, realistic={"noise": 1e-5})
    simulation = found.simulation
    assert simulation is not None
    drawn, expected = simulation.noise.square().mean((0, 1)), simulation.noise_variance.mean((0, 1))
    # 480 squares of each joint scatter by 1/sqrt(240).
    assert torch.allclose(drawn, expected, rtol=4 / math.sqrt(240))
    half = prepared(name, "geometry", repeats=1, realistic={"noise": 5e-6})
    assert half.simulation is not None
    assert torch.allclose(4 * half.simulation.noise_variance[0], simulation.noise_variance[0], rtol=1e-3)


@pytest.mark.parametrize(
    ("cause", "names"),
    [
        ("geometry", []),
        ("compliance", ["load_y", "load_z", "load_phi"]),
        ("thermal", ["time", "temperature"]),
        ("backlash", ["direction1", "direction2", "direction3"]),
    ],
)
def test_a_cause_brings_the_covariates_that_it_depends_on(cause: str, names: list[str]) -> None:
    found = prepared("tripod", cause)
    assert [coordinate.name for coordinate in found.covariate_coordinates] == names
    assert found.dataset.inputs.shape == (1, 40, 3 + len(names))


def test_covariates_can_be_chosen_or_left_out() -> None:
    assert prepared("arm", covariates=[]).dataset.inputs.shape[-1] == 6
    chosen = prepared("arm", covariates=["load_*", "time"])
    assert [(c.name, c.unit) for c in chosen.covariate_coordinates][:2] == [("time", "s"), ("load_x", "N")]
    with pytest.raises(InputError, match="there is no column 'humidity'; the arm with the cause mixed has time"):
        prepared("arm", covariates=["humidity"])


def test_the_section_belongs_to_its_case() -> None:
    with pytest.raises(InputError, match="these keys need case=realistic"):
        RunConfig.from_keys(case="tripod", realistic={"rows": 60})
    with pytest.raises(InputError, match="random poses"):
        RunConfig.from_keys(case="realistic", order="raster")
