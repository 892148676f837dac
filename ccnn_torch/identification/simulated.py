"""Simulated machines: parameters drawn, poses chosen (random, even or planned), joints and measurements with noise.

A pose X is given and the machine with the parameters θ takes it with the joints g(X; θ): what a controller would have
to command, and what the encoders then say. A serial arm is given joints and takes the pose f(q; θ).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.config.sizes import size, sizes_by_name, sizes_of_joints, sizes_of_pose
from ccnn_torch.coordinates import plausible_error
from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig, SimulateConfig, base_method
from ccnn_torch.identification.judge import commanded, figures
from ccnn_torch.identification.measured import Kinematics, Measured, Rows, make_kinematics
from ccnn_torch.identification.solve import QUICK, Outcome, leg_of, pieces_of, run_method, select
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.planning import choose_poses
from ccnn_torch.simulation.places import Instrument, Places, generator_of, make_instrument, normal_draws

MAX_CONDITION = 50.0
"""Of the Jacobian at a planned pose."""
# Stream of the candidates, beside the seed of the first machine.
_CANDIDATES = 7


def choose_places(config: IdentifyConfig, places: Places, count: int, seeds: Sequence[int], stream: int) -> Tensor:
    """Places that need no plan, `s x .` (even, shared by the machines) or `r x s x .` (random, each its own)."""
    assert config.simulate is not None
    if config.simulate.design == "random":
        return torch.stack([places.random(count, generator_of(seed, stream)) for seed in seeds])
    return places.even(count)


def plan_places(
    config: IdentifyConfig,
    places: Places,
    instrument: Instrument,
    count: int,
    pose_noise: Tensor,
    joint_noise: Tensor | None,
) -> tuple[Tensor, dict[int, Tensor]]:
    """The most informative places for all parameters, `s x .`, and for each leg alone (`planned_per_leg`), by leg.

    Chosen at the nominal geometry, since no better one is known before measuring.
    """
    about, mechanism = config.simulate, places.mechanism
    assert about is not None
    candidates = places.random(about.candidates, generator_of(config.seed, _CANDIDATES))
    joints, pose = places.nominal(candidates)
    # The most informative poses of all are next to singular ones, where noise is no longer small.
    regular = mechanism.condition_number(joints, guess=pose) <= MAX_CONDITION
    candidates, joints, pose = candidates[regular], joints[regular], pose[regular]
    position, rotation = mechanism.frame(pose)
    rows = Rows(joints[None], instrument.observe(pose, position, rotation)[None])
    nominal = Measured(
        mechanism=mechanism,
        kinematics=Kinematics(mechanism),
        view=instrument.view,
        rows=rows,
        test=rows,
        start=mechanism.nominal[None],
        pose_noise=pose_noise,
        joint_noise=joint_noise,
    )
    one = torch.arange(1)
    whole = pieces_of(nominal, config, False, one)[0]
    common = candidates[choose_poses(whole, count).chosen]
    if about.design != "planned_per_leg":
        return common, {}
    legs = pieces_of(nominal, config, True, one)
    each = count // len(legs)
    if each * len(legs) != count:
        raise InputError(
            f"simulate.poses: {count} poses cannot be dealt to {len(legs)} legs; write a multiple of {len(legs)}"
        )
    return common, {leg_of(leg): candidates[choose_poses(leg, each).chosen] for leg in legs}


# Streams of random numbers of a machine, so that more poses do not change its errors.
_ERRORS, _ROWS, _TEST, _PLACES, _LEGS = 0, 1, 2, 3, 10


def simulate(config: IdentifyConfig, mechanism: Mechanism, poses: int | None = None) -> Measured:
    """Simulate the machines of a config.

    Args:
        poses: how many to measure of each machine, in place of `simulate.poses`.
    """
    about = config.simulate
    assert about is not None
    seeds = [config.seed + k for k in range(about.machines)]
    truth = mechanism.nominal + _errors(mechanism, about, seeds)
    instrument = make_instrument(mechanism, about.points)
    noise = sizes_of_pose(about.noise, instrument.view.pose, "simulate.noise")
    joint_sd = sizes_of_joints(about.joint_noise, mechanism.joints, "simulate.joint_noise")
    joint_noise = joint_sd if bool((joint_sd > 0).any()) else None
    places = Places(mechanism, truth, about.box, about.circle)
    count = about.poses if poses is None else poses
    of_legs: dict[int, Tensor] = {}
    if about.design.startswith("planned"):
        common, of_legs = plan_places(config, places, instrument, count, noise, joint_noise)
    else:
        common = choose_places(config, places, count, seeds, _PLACES)

    kinematics = make_kinematics(mechanism, about.as_built)

    def measure(joints: Tensor, pose: Tensor, stream: int) -> Rows:
        frame = kinematics.frame(joints, truth[:, None], pose) if about.points else (pose, None)
        observed = instrument.observe(pose, *frame)
        return Rows(
            joints + joint_sd * normal_draws(joints.shape[1:], seeds, stream, 1),
            observed + noise * normal_draws(observed.shape[1:], seeds, stream, 0),
        )

    test = places.random(about.test_poses, generator_of(config.seed, _TEST, 2))
    wanted_joints, wanted = places.taken(test)
    held_out = measure(wanted_joints, wanted, _TEST)
    return Measured(
        mechanism=mechanism,
        kinematics=kinematics,
        view=instrument.view,
        rows=measure(*places.taken(common), _ROWS),
        leg_rows={leg: measure(*places.taken(place), _LEGS + leg) for leg, place in of_legs.items()},
        test=Rows(held_out.joints, instrument.pose_of(held_out.observed)),
        start=mechanism.nominal.expand(len(seeds), -1).clone(),
        truth=truth,
        wanted=wanted,
        wanted_joints=wanted_joints,
        reached=kinematics.reached(wanted_joints, truth[:, None], wanted) if about.as_built else wanted,
        map=places.map(about.map) if about.map else None,
        pose_noise=noise,
        joint_noise=joint_noise,
    )


def _errors(mechanism: Mechanism, about: SimulateConfig, seeds: list[int]) -> Tensor:
    """Parameter errors, `r x K` [SI]: the given ones beside normal draws."""
    geometry = mechanism.geometry
    usual = [0.0 if p.held else plausible_error(p) for p in geometry]
    given = about.errors
    if isinstance(given, dict):
        sd = sizes_by_name(given, geometry, "simulate.errors", [0.0] * len(usual) if about.values else usual)
    else:
        sd = size(given, "1", "simulate.errors") * torch.tensor(usual, dtype=torch.float64)
    fixed = sizes_by_name(about.values, geometry, "simulate.values", [0.0] * len(geometry))
    return fixed + sd * normal_draws(sd.shape, seeds, _ERRORS, 0)


def count_study(config: IdentifyConfig, mechanism: Mechanism) -> list[dict[str, Any]]:
    """For each number of poses and each quick method: pose error under its exact commands, and parameter deviations."""
    if config.simulate is None:
        return []
    answer = []
    for poses in config.simulate.counts:
        measured = simulate(config, mechanism, poses)
        block: dict[str, Any] = {"poses": poses, "methods": {}}
        for method in (m for m in config.methods if base_method(m) in QUICK):
            outcome: Outcome = run_method(method, measured, config)
            found = commanded(measured, outcome.values, outcome.machines)
            assert found is not None and measured.truth is not None
            gap = select(measured, config).free(outcome.values - measured.truth[outcome.machines])
            block["methods"][method] = figures(
                {"position": found.exact.position.square().mean(-1).sqrt(), "deviation": gap.abs().mean(-1)}
            )
        answer.append(block)
    return answer
