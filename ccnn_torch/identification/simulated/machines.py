"""Simulated machines: parameters drawn, poses chosen, joints and measurements with noise.

A pose X is given and the machine with the parameters θ takes it with the joints g(X; θ): what a controller would have
to command, and what the encoders then say. A serial arm is given joints and takes the pose f(q; θ).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ccnn_torch.config.sizes import size, sizes_by_name, sizes_of_joints, sizes_of_pose
from ccnn_torch.coordinates import plausible_error
from ccnn_torch.identification.config import IdentifyConfig, SimulateConfig
from ccnn_torch.identification.measured.kinematics import make_kinematics
from ccnn_torch.identification.measured.measured import Measured, Rows
from ccnn_torch.identification.simulated.designs import choose_places, plan_places
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.simulation.instrument import make_instrument
from ccnn_torch.simulation.places import Places
from ccnn_torch.simulation.random_numbers import generator_of, normal_draws

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
    usual = [0.0 if about.values else plausible_error(p) for p in geometry]
    given = about.errors
    if isinstance(given, dict):
        sd = sizes_by_name(given, geometry, "simulate.errors", usual)
    else:
        factor = size(given, "1", "simulate.errors")
        sd = factor * torch.tensor([plausible_error(p) for p in geometry], dtype=torch.float64)
    fixed = sizes_by_name(about.values, geometry, "simulate.values", [0.0] * len(geometry))
    return fixed + sd * normal_draws(sd.shape, seeds, _ERRORS, 0)
