"""Configurations of simulated records: poses at rest over the workspace, or moves."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ccnn_torch.effects.covariates import draw_covariates
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.simulation.config import SimulateConfig

# Between two moves; rows so far apart are not taken for one trajectory [s].
_PAUSE = 2.0
# For velocities, as a share of a move.
_INSTANT = 1e-4
_TRIES = 50

Rows = tuple[Tensor, dict[str, Tensor]]


def draw_poses(mechanism: Mechanism, rows: int, config: SimulateConfig, generator: torch.Generator) -> Rows:
    """Poses at rest, away from singularities: joints `s x n` [SI], and the columns beside them, `s` each.

    Raises:
        InputError: nearly all of the workspace is too close to a singularity.
    """

    def draw(count: int) -> tuple[Tensor]:
        joints = mechanism.sample_joints(count, generator)
        return (joints[_regular(mechanism, joints, config)],)

    (joints,) = _collect(mechanism, rows, config, draw)
    load = {"m": config.load, "rad": config.moment}
    return joints, draw_covariates(mechanism, joints, generator, config.duration, load)


def draw_moves(mechanism: Mechanism, rows: int, config: SimulateConfig, generator: torch.Generator) -> Rows:
    """Rows along moves from one drawn configuration towards another, with a pause after each.

    An arm moves on straight lines in its joints, other machines in their pose, with the least jerk (Flash and Hogan
    1985: 10 u³ - 15 u⁴ + 6 u⁵). The columns have the joints' velocities as well, and their signs as directions.

    Raises:
        InputError: nearly all moves come too close to a singularity.
    """
    each = max(round(config.move / config.step), 2)
    # Middle of each interval: at the ends of a move nothing moves.
    at = (torch.arange(each, dtype=torch.float64) + 0.5) / each
    places = torch.stack([at - _INSTANT, at, at + _INSTANT])
    share = (10 * places**3 - 15 * places**4 + 6 * places**5)[:, None, :, None]

    def draw(count: int) -> tuple[Tensor, Tensor]:
        moves = -(-count // each)
        arm = isinstance(mechanism, SerialArm)
        sample = mechanism.sample_joints if arm else mechanism.sample_workspace
        start, end = sample(2 * moves, generator).reshape(2, moves, 1, -1)
        path = start + config.way * (end - start) * share
        joints = path if arm else mechanism.solve_inverse(path)
        speed = (joints[2] - joints[0]) / (2 * _INSTANT * config.move)
        whole = _regular(mechanism, joints[1], config).all(-1) & torch.isfinite(joints).all(-1).all(-1).all(0)
        return joints[1][whole].flatten(0, 1), speed[whole].flatten(0, 1)

    joints, speed = _collect(mechanism, rows, config, draw)
    number = torch.arange(rows)
    time = number * config.step + (number // each) * _PAUSE
    load = {"m": config.load, "rad": config.moment}
    columns = draw_covariates(mechanism, joints, generator, 1.0, load) | {"time": time.double()}
    for i in range(joints.shape[-1]):
        columns[f"direction{i + 1}"] = torch.where(speed[:, i] < 0, -1.0, 1.0).double()
        columns[f"speed{i + 1}"] = speed[:, i]
    return joints, columns


def _regular(mechanism: Mechanism, joints: Tensor, config: SimulateConfig) -> Tensor:
    condition = mechanism.condition_number(joints, config.rotation_weight)
    return torch.isfinite(joints).all(-1) & (condition <= config.max_condition)


def _collect(
    mechanism: Mechanism, rows: int, config: SimulateConfig, draw: Callable[[int], tuple[Tensor, ...]]
) -> tuple[Tensor, ...]:
    found = draw(rows)
    for _ in range(_TRIES):
        if len(found[0]) >= rows:
            return tuple(part[:rows] for part in found)
        found = tuple(torch.cat(parts) for parts in zip(found, draw(rows), strict=True))
    raise InputError(
        f"mechanism '{mechanism.name}': hardly any configuration has a condition number under "
        f"{config.max_condition:g}; make max_condition larger"
    )
