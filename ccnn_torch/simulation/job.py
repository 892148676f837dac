"""Simulated records: a machine with effects, measured with noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ccnn_torch.config.sizes import Noise, noise_of_pose
from ccnn_torch.effects import OUTLIER, Acting, Situation, default_gravity, measured_pose, reached
from ccnn_torch.effects.covariates import covariate_units, directions, draw_covariates, rest_torques
from ccnn_torch.effects.loads import Sag
from ccnn_torch.effects.time import Homing
from ccnn_torch.errors import InputError
from ccnn_torch.files.write import make_folder
from ccnn_torch.mechanisms import Mechanism, SerialArm, load_mechanism, sees_directions
from ccnn_torch.mechanisms.pose import only_turns
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_torch.records import name_lines, write_table
from ccnn_torch.records.covariates import asked_columns
from ccnn_torch.report.table import Table
from ccnn_torch.simulation.acting import Injected, Wanted, act, check_bounds, read_wanted, units_of
from ccnn_torch.simulation.config import SimulateConfig

# Between two moves; rows so far apart are not taken for one trajectory [s].
_PAUSE = 2.0
# Days that homing tells apart, and what is between two of them [s].
_DAYS, _NIGHT = 4, 16 * 3600.0
# For velocities, as a share of a move.
_INSTANT = 1e-4
_DRAWS = 50

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
    for _ in range(_DRAWS):
        if len(found[0]) >= rows:
            return tuple(part[:rows] for part in found)
        found = tuple(torch.cat(parts) for parts in zip(found, draw(rows), strict=True))
    raise InputError(
        f"mechanism '{mechanism.name}': hardly any configuration has a condition number under "
        f"{config.max_condition:g}; make max_condition larger"
    )


_KEYS = {"share": (0.03, "share of the rows"), "size": (1e-3, "standard deviation, in m and rad")}


def bad_rows(
    wanted: Wanted, rows: int, channels: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, dict[str, tuple[float, str]]]:
    """Gross errors of a share of the rows.

    Returns:
        Numbers of the rows, ascending; the displacements of their frames, `rows x c` [m, rad]; and the parameters.

    Raises:
        InputError: a parameter that does not exist or is out of range.
    """
    values = {}
    for name, text in wanted.values.items():
        try:
            values[name] = float(text)
        except ValueError:
            raise InputError(f"--effect outlier: {name}={text} is no number") from None
    wrong = sorted(set(values) - set(_KEYS))
    if wrong:
        known = ", ".join(f"{key} ({meaning})" for key, (_, meaning) in _KEYS.items())
        raise InputError(f"--effect outlier: it has no parameter '{wrong[0]}'; it has {known}")
    share, size = (values.get(key, default) for key, (default, _) in _KEYS.items())
    if not (0 < share <= 0.5 and size > 0):
        raise InputError("--effect outlier: share must be above 0 and at most 0.5, size above 0")
    count = max(round(share * rows), 1)
    chosen = torch.randperm(rows, generator=generator)[:count].sort().values
    added = torch.zeros(rows, channels, dtype=torch.float64)
    added[chosen] = size * torch.randn(count, channels, generator=generator, dtype=torch.float64)
    return chosen, added, {"share": (share, "1"), "size": (size, "m, rad")}


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
        gap: root of the mean square of the position's error by all effects, without noise and bad rows [m]; where the
            machine only turns, of the rotation's [rad].
        turns: whether it only turns.
    """

    mechanism: Mechanism
    joints: Tensor
    pose: Tensor
    covariates: dict[str, Tensor]
    injected: tuple[Injected, ...]
    outliers: tuple[int, ...]
    gap: float
    turns: bool


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
    config = config or SimulateConfig.from_keys()
    if rows < 1:
        raise InputError(f"--rows: simulate at least 1 row, not {rows}")
    machine = load_mechanism(mechanism, **config.mechanism_keys) if isinstance(mechanism, str) else mechanism
    sigma = _noise(noise, machine)
    wanted = [read_wanted(text) for text in effects]
    generator = torch.Generator().manual_seed(seed)
    names = {w.name for w in wanted}
    moving = config.rows == "trajectory" or (config.rows == "auto" and "latency" in names)
    joints, columns = (draw_moves if moving else draw_poses)(machine, rows, config, generator)
    if Homing.name in names:
        columns["time"] = columns["time"] + _NIGHT * (torch.arange(rows) * _DAYS // rows)
    situation = _situation(machine, joints, columns, config, Sag.name in names)
    acting = [act(w, situation, generator) for w in wanted if not w.outlier]
    check_bounds(situation, acting)
    frame = reached(situation, acting)
    lost = ~torch.isfinite(frame).all(-1)
    for _ in range(_TRIES if not moving and 2 * int(lost.sum()) <= rows else 0):
        if not bool(lost.any()):
            break
        # At the edge of what the nominal machine reaches: the changed one gets others in the place of these.
        joints = torch.where(lost[:, None], draw_poses(machine, rows, config, generator)[0], joints)
        first = torch.stack([columns[f"direction{i + 1}"][:1] for i in range(joints.shape[-1])], -1)
        columns |= directions(machine, joints, first)
        situation = _situation(machine, joints, columns, config, Sag.name in names)
        frame = reached(situation, acting)
        lost = ~torch.isfinite(frame).all(-1)
    if bool(lost.any()):
        raise InputError(
            f"--effect: with these effects the machine has no pose in {int(lost.sum())} of {rows} rows; "
            "make them smaller"
        )
    nominal = reached(situation, [])
    # One row alone does not tell whether its position moves.
    turns = only_turns(machine.frame(torch.cat([machine.home_pose[None], situation.pose])))
    gap = _rms(frame - nominal, turns)
    alone = iter([_injected(situation, one, nominal, turns) for one in acting])
    injected, outliers = [], set[int]()
    for one in wanted:
        if one.outlier:
            chosen, added, parameters = bad_rows(one, rows, frame.shape[-1], generator)
            turns = machine.frame(machine.home_pose)[1] is not None
            frame = _moved(frame, (situation.visible @ added.unsqueeze(-1)).squeeze(-1), turns)
            outliers |= set(chosen.tolist())
            injected.append(Injected(one.name, parameters, _rms(added, turns)))
        else:
            injected.append(next(alone))
    pose = _measured(situation, frame, sigma, generator)
    kept = dict(situation.covariates)
    return Simulated(machine, joints, pose, kept, tuple(injected), tuple(sorted(outliers)), gap, turns)


def _situation(
    mechanism: Mechanism, joints: Tensor, columns: dict[str, Tensor], config: SimulateConfig, torques: bool
) -> Situation:
    gravity = (
        default_gravity(mechanism) if config.gravity is None else torch.tensor(config.gravity, dtype=torch.float64)
    )
    situation = Situation(mechanism, joints, columns, gravity)
    columns = columns | (rest_torques(situation) if torques else {})
    names = asked_columns([*columns], config.covariates, "these rows have")
    return replace(situation, covariates={name: columns[name] for name in names})


def _measured(situation: Situation, frame: Tensor, sigma: Tensor, generator: torch.Generator) -> Tensor:
    """Poses of the frames, with noise."""
    machine, pose = situation.mechanism, measured_pose(situation, frame)
    errors = sigma * torch.randn(pose.shape, generator=generator, dtype=torch.float64)
    pose = _moved(pose, errors, True) if machine.orientations and pose.shape[-1] == 6 else pose + errors
    if sees_directions(machine):
        # A direction has no length that could be measured.
        pose = pose * (situation.pose.norm(dim=-1) / pose.norm(dim=-1))[:, None]
    return pose


def _injected(situation: Situation, acting: Acting, nominal: Tensor, turns: bool) -> Injected:
    effect = acting.effect
    values = dict(zip((c.name for c in effect.coefficients(situation)), acting.coefficients.tolist(), strict=True))
    units = units_of(effect, situation)
    shown = {name: value for name, value in values.items() if value}
    there = list(values.values())
    for shape, value in zip(effect.shapes(situation), acting.shape.tolist(), strict=True):
        # A shape whose coefficients are all 0 has no influence.
        if any(there[k] for k in (range(len(there)) if shape.columns is None else shape.columns)):
            shown[shape.name] = value
    gap = _rms(reached(situation, [acting]) - nominal, turns)
    return Injected(effect.name, {name: (value, units[name]) for name, value in shown.items()}, gap)


def _rms(change: Tensor, turns: bool) -> float:
    """Of the position, or of the rotation of a machine that only turns."""
    return float((change[..., 3:] if turns else change[..., :3]).square().sum(-1).mean().sqrt())


def _moved(frame: Tensor, change: Tensor, turns: bool) -> Tensor:
    """Positions shifted and, where they are part of it, rotations turned in the base frame; `... x c` both."""
    if not turns:
        return frame + change
    position = frame[..., :-3] + change[..., :-3]
    turned = rotation_vector_to_matrix(change[..., -3:]) @ rotation_vector_to_matrix(frame[..., -3:])
    return torch.cat([position, matrix_to_rotation_vector(turned)], -1)


def _noise(given: Noise, machine: Mechanism) -> Tensor:
    by_name = noise_of_pose(given, machine.pose)
    return torch.tensor([by_name.get(c.name, 0.0) for c in machine.pose], dtype=torch.float64)


def write_simulated(path: Path, simulated: Simulated) -> None:
    """Write the records: joints, pose, covariates, in SI.

    Raises:
        InputError: the name does not end in .csv, or the file cannot be written.
    """
    if path.suffix.lower() != ".csv":
        raise InputError(f"--out: '{path}' must end in .csv")
    machine, units = simulated.mechanism, covariate_units(simulated.mechanism)
    columns = {c.header: simulated.joints[:, i].numpy() for i, c in enumerate(machine.joints)}
    columns |= {c.header: simulated.pose[:, i].numpy() for i, c in enumerate(machine.pose)}
    columns |= {f"{name}[{units[name]}]": values.numpy() for name, values in simulated.covariates.items()}
    make_folder(path.parent)
    write_table(path, columns)


def injected_table(simulated: Simulated) -> Table:
    """What was injected, a row for each parameter."""
    rows = [
        (one.name, name, f"{value:.4g}", unit)
        for one in simulated.injected
        for name, (value, unit) in one.parameters.items()
    ]
    parts, (what, unit) = [], ("rotation", "µrad") if simulated.turns else ("position", "µm")
    effects = [one for one in simulated.injected if one.name != OUTLIER]
    if effects:
        alone = "; ".join(f"{one.name} alone {one.gap * 1e6:.3g} {unit}" for one in effects)
        without = "noise and bad rows" if simulated.outliers else "noise"
        parts.append(
            f"RMS error of the {what} {simulated.gap * 1e6:.3g} {unit} over all rows without {without} ({alone})"
        )
    if simulated.outliers:
        # As the file will have them, below a header.
        lines = np.arange(len(simulated.joints), dtype=np.int64) + 2
        added = sum(one.gap**2 for one in simulated.injected if one.name == OUTLIER) ** 0.5
        named = name_lines(lines, simulated.outliers, len(simulated.outliers))
        parts.append(f"RMS error by bad rows {added * 1e6:.3g} {unit} over all rows; bad rows: {named}")
    return Table("Injected", ("effect", "parameter", "value", "unit"), tuple(rows), "; ".join(parts))
