"""Poses at which simulated machines are measured: random, even, or planned."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.identification.config import IdentifyConfig
from ccnn_torch.identification.measured.kinematics import Kinematics
from ccnn_torch.identification.measured.measured import Measured, Rows
from ccnn_torch.identification.solve import pieces_of
from ccnn_torch.planning import choose_poses
from ccnn_torch.simulation.places import Instrument, Places, generator_of

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
        leg_rows={},
        test=rows,
        start=mechanism.nominal[None],
        pose_noise=pose_noise,
        joint_noise=joint_noise,
    )
    one = torch.arange(1)
    whole = pieces_of(nominal, config, False, one)[0].problem
    common = candidates[choose_poses(whole, count).chosen]
    if about.design != "planned_per_leg":
        return common, {}
    legs = pieces_of(nominal, config, True, one)
    each = count // len(legs)
    if each * len(legs) != count:
        raise InputError(
            f"simulate.poses: {count} poses cannot be dealt to {len(legs)} legs; write a multiple of {len(legs)}"
        )
    return common, {leg.leg: candidates[choose_poses(leg.problem, each).chosen] for leg in legs if leg.leg is not None}
