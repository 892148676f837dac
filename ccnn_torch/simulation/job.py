"""Simulated records: a machine with effects, measured with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

import torch
from torch import Tensor

from ccnn_torch.config.noise import Noise, noise_of_pose
from ccnn_torch.effects import Acting, Situation, default_gravity, measured_pose, reached
from ccnn_torch.effects.covariates import directions
from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms import Mechanism, load_mechanism
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.simulation.acting import Injected, act, read_wanted, units_of
from ccnn_torch.simulation.config import SimulateConfig
from ccnn_torch.simulation.limits import refuse_beyond_bounds
from ccnn_torch.simulation.outliers import bad_rows
from ccnn_torch.simulation.rows import draw_moves, draw_poses

# Rounds in which rows without a pose are drawn anew.
_TRIES = 50


@dataclass(frozen=True)
class Simulated:
    """Rows of a simulated machine.

    Attributes:
        mechanism: the nominal one.
        joints: commanded, `s x n` [SI].
        pose: measured, `s x p` [SI].
        covariates: by name, `s` each [SI].
        injected: the effects that act on the machine.
        outliers: numbers of the bad rows, from 0.
        gap: root of the mean square of the position's error by all effects, without noise and bad rows [m].
    """

    mechanism: Mechanism
    joints: Tensor
    pose: Tensor
    covariates: dict[str, Tensor]
    injected: tuple[Injected, ...]
    outliers: tuple[int, ...]
    gap: float


def simulate_records(
    mechanism: str | Mechanism,
    effects: Sequence[str],
    rows: int,
    noise: Noise = 0.0,
    config: SimulateConfig | None = None,
    seed: int = 0,
) -> Simulated:
    """Simulate a machine with effects.

    Args:
        mechanism: a name, a file, or a mechanism.
        effects: each `NAME` or `NAME:parameter=value,…`; none = a machine that equals its model.
        rows: their number.
        noise: standard deviation of each measured coordinate, in SI or with a unit (`10um`), one for all, or by name or
            unit (others 0).
        config: defaults when None.
        seed: of all random numbers.

    Raises:
        InputError: an unknown effect, parameter or coordinate, an effect that these rows cannot show, values that no
            machine has, or effects so large that the machine does not reach its poses.
    """
    config = config or SimulateConfig()
    if rows < 1:
        raise InputError(f"--rows: simulate at least 1 row, not {rows}")
    machine = load_mechanism(mechanism, **config.mechanism_keys) if isinstance(mechanism, str) else mechanism
    sigma = _noise(noise, machine)
    wanted = [read_wanted(text) for text in effects]
    generator = torch.Generator().manual_seed(seed)
    moving = config.rows == "trajectory" or (config.rows == "auto" and any(w.name == "latency" for w in wanted))
    joints, columns = (draw_moves if moving else draw_poses)(machine, rows, config, generator)
    gravity = default_gravity(machine)
    if config.gravity is not None:
        gravity = torch.tensor(config.gravity, dtype=torch.float64)
    situation = Situation(machine, joints, _kept(columns, config.covariates), gravity)
    acting = [act(w, situation, generator) for w in wanted if not w.outlier]
    refuse_beyond_bounds(situation, acting)
    frame = reached(situation, acting)
    lost = ~torch.isfinite(frame).all(-1)
    for _ in range(_TRIES if not moving and 2 * int(lost.sum()) <= rows else 0):
        if not bool(lost.any()):
            break
        # At the edge of what the nominal machine reaches: the changed one gets others in the place of these.
        joints = torch.where(lost[:, None], draw_poses(machine, rows, config, generator)[0], joints)
        first = torch.stack([columns[f"direction{i + 1}"][:1] for i in range(joints.shape[-1])], -1)
        columns |= directions(joints, first)
        situation = replace(situation, joints=joints, covariates=_kept(columns, config.covariates))
        frame = reached(situation, acting)
        lost = ~torch.isfinite(frame).all(-1)
    if bool(lost.any()):
        raise InputError(
            f"--effect: with these effects the machine has no pose in {int(lost.sum())} of {rows} rows; "
            "make them smaller"
        )
    nominal = reached(situation, [])
    gap = _rms(frame - nominal)
    alone = iter([_injected(situation, one, nominal) for one in acting])
    injected, outliers = [], set[int]()
    for one in wanted:
        if one.outlier:
            chosen, added, parameters = bad_rows(one, rows, frame.shape[-1], generator)
            frame = _moved(frame, (situation.visible @ added.unsqueeze(-1)).squeeze(-1))
            outliers |= set(chosen.tolist())
            injected.append(Injected(one.name, parameters, _rms(added)))
        else:
            injected.append(next(alone))
    pose = measured_pose(situation, frame)
    errors = sigma * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    pose = _moved(pose, errors) if machine.orientations and pose.shape[-1] == 6 else pose + errors
    kept = dict(situation.covariates)
    return Simulated(machine, joints, pose, kept, tuple(injected), tuple(sorted(outliers)), gap)


def _injected(situation: Situation, acting: Acting, nominal: Tensor) -> Injected:
    effect = acting.effect
    values = dict(zip((c.name for c in effect.coefficients(situation)), acting.coefficients.tolist(), strict=True))
    units = units_of(effect, situation)
    shown = {name: value for name, value in values.items() if value}
    there = list(values.values())
    for shape, value in zip(effect.shapes(situation), acting.shape.tolist(), strict=True):
        # A shape whose coefficients are all 0 has no influence.
        if any(there[k] for k in (range(len(there)) if shape.columns is None else shape.columns)):
            shown[shape.name] = value
    gap = _rms(reached(situation, [acting]) - nominal)
    return Injected(effect.name, {name: (value, units[name]) for name, value in shown.items()}, gap)


def _rms(change: Tensor) -> float:
    return float(change[..., :3].square().sum(-1).mean().sqrt())


def _moved(frame: Tensor, change: Tensor) -> Tensor:
    """Positions shifted and, where there are any, rotations turned in the base frame; `... x c` both."""
    position = frame[..., :3] + change[..., :3]
    if frame.shape[-1] == 3:
        return position
    turned = rotation_vector_to_matrix(change[..., 3:]) @ rotation_vector_to_matrix(frame[..., 3:])
    return torch.cat([position, matrix_to_rotation_vector(turned)], -1)


def _kept(columns: dict[str, Tensor], wanted: list[str] | None) -> dict[str, Tensor]:
    if wanted is None:
        return columns
    for pattern in wanted:
        if not any(fnmatchcase(name, pattern) for name in columns):
            raise InputError(f"covariates: there is no column '{pattern}'; these rows have {', '.join(columns)}")
    return {name: v for name, v in columns.items() if any(fnmatchcase(name, pattern) for pattern in wanted)}


def _noise(given: Noise, machine: Mechanism) -> Tensor:
    by_name = noise_of_pose(given, machine.pose)
    return torch.tensor([by_name.get(c.name, 0.0) for c in machine.pose], dtype=torch.float64)
