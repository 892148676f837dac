"""A constraint instead of poses: a ball on the tool in sockets of a plate.

The problem has the free parameters of the machine and what is unknown of the plate, whose place the same fit finds. It
needs no measuring device. What such rows cannot tell by their nature is left out: the arm's base frame (the plate moves
along with it), the tool's orientation (only its point is held), the roll of a plate about a single line of sockets.
Distances and planes are what instruments read (`ccnn_torch.mechanisms.frames.readings`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.parameters import ParameterChoice, select_parameters
from ccnn_torch.identification.problems.problem import Channel, Problem, check_equations
from ccnn_torch.identification.problems.whitened import check_finite
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.mechanisms.frames.part import place_of
from ccnn_torch.numerics.batching import expand_leading
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Plausible errors of what a constraint is unknown in, after a start from the nominal machine [m, rad].
_PLACE, _TURN = 5e-3, 2e-2
# Directions in which points spread less than this share of their largest extent do not show a rotation.
_THIN = 1e-6


def tool_points(mechanism: Mechanism, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
    """Position of the tool, `... x 3` [m]; joints `... x n` [SI], parameters `... x k` [SI]."""
    return place_of(mechanism, None, joints, mechanism.resolve(parameters)).position


def socket_problem(
    mechanism: Mechanism,
    joints: Tensor,
    placement: Tensor,
    points: Tensor,
    noise: float | None = None,
    weights: Tensor | None = None,
    choice: ParameterChoice | None = None,
    start: Tensor | None = None,
    plate_tolerance: float = 0.0,
) -> Problem:
    """The tool's ball in sockets of a plate at unknown places: b(q) - (c + R x), c and R unknown per placement.

    Sockets at known points x of the plate give the scale; a single socket (all points 0) holds one unknown point.

    Args:
        joints: `s x n` [SI].
        placement: number of the plate's placement, `s`, any numbers.
        points: the socket's place on the plate, `s x 3` [m].
        noise: standard deviation of each coordinate [m]; None = unknown, then priors are not possible.
        weights: `s` or `r x s` [1]; 0 leaves a row out; all 1 when None.
        choice: of the mechanism's parameters; all but base frame and tool orientation when None.
        start: the whole geometry from which the search begins, `K` [SI]; nominal when None.
        plate_tolerance: standard deviation of the plate's largest extent [m]; its scale is then a parameter, too.

    Returns:
        Problem with the parameters chosen, then `plate_scale` where there is a tolerance, then for each placement P
        `plateP_x`, `_y`, `_z` and its turns away from the start `plateP_turn1` ….

    Raises:
        InputError: shapes do not fit, joints that have no pose, a tolerance without noise, or fewer equations than
            parameters.
    """
    if noise is not None and not noise > 0:
        raise InputError(f"noise: {noise:g} is no standard deviation; write a length above 0 in m, or leave it out")
    begin = mechanism.nominal if start is None else start.detach()
    if choice is None:
        there = [p.name for p in mechanism.geometry]
        choice = ParameterChoice(fixed=[n for n in there if n.startswith(("base_", "tool_r"))])
    rows = (torch.ones(len(joints), dtype=torch.float64) if weights is None else weights).reshape(-1, len(joints))
    at = tool_points(mechanism, joints, begin)
    used = torch.ones(1, len(joints), dtype=torch.bool)
    check_finite(at[None], used, joints[None], mechanism.joints, f"mechanism '{mechanism.name}'", "xyz")
    selection = select_parameters(mechanism.geometry, choice, begin)
    if noise is None and bool(torch.isfinite(selection.prior_sd).any()):
        raise InputError("parameters.prior: a prior can be weighed against the rows only if their noise is given")
    group, parts = _placements(placement, rows)
    if points.shape != (len(joints), 3):
        raise InputError(f"points must be one place on the plate for each of {len(joints)} rows, got {points.shape}")
    unknown, turned, turns = [], torch.zeros_like(points), torch.zeros(len(joints), 9, dtype=torch.float64)
    if plate_tolerance > 0:
        unknown.append(_plate_scale(points, plate_tolerance, noise))
    columns = torch.zeros(len(joints), 6, dtype=torch.int64)
    for g, (label, mine) in enumerate(parts):
        rotation, place, axes = _plate_start(points[mine], at[mine])
        turned[group == g] = points[group == g] @ rotation.mT
        turns[group == g, : 3 * len(axes)] = axes.flatten()
        first = len(unknown)
        unknown += [_Unknown(f"plate{label}_{'xyz'[i]}", "m", float(place[i]), _PLACE) for i in range(3)]
        unknown += [_Unknown(f"plate{label}_turn{i + 1}", "rad", 0.0, _TURN) for i in range(len(axes))]
        # A turn that does not exist reads any column, since its axis is 0.
        columns[group == g] = torch.tensor([min(first + i, len(unknown) - 1) for i in range(6)])

    k, unit, fixed = len(selection.parameters), 1.0 if noise is None else noise, selection.fixed[0]

    def gap(values: Tensor, q: Tensor, x: Tensor, axes: Tensor, where: Tensor) -> Tensor:
        full, others = values[..., :k] @ selection.spread + fixed, values[..., k:]
        index = where.to(torch.int64)
        own = expand_leading(others, index).gather(-1, expand_leading(index, others))
        spin = (own[..., 3:, None] * axes.reshape(*axes.shape[:-1], 3, 3)).sum(-2)
        scale = others[..., :1] if plate_tolerance > 0 else 1.0
        socket = (rotation_vector_to_matrix(spin) @ x[..., None])[..., 0] * scale
        return (tool_points(mechanism, q, full) - own[..., :3] - socket) / unit

    stated = torch.tensor([[u.start, u.scale, u.prior_sd] for u in unknown], dtype=torch.float64).mT
    problem = Problem(
        parameters=(*selection.parameters, *(Parameter(u.name, u.unit, u.start) for u in unknown)),
        start=torch.cat([selection.start[0], stated[0]]).expand(len(rows), -1).clone(),
        scale=torch.cat([selection.scale, stated[1]]),
        prior_sd=torch.cat([selection.prior_sd, stated[2]]),
        residual=gap,
        data=tuple(d.to(torch.float64).unsqueeze(0) for d in (joints, turned, turns, columns)),
        weights=rows,
        channels=tuple(map(Channel, "xyz")),
        noise_known=noise is not None,
    )
    check_equations(problem)
    return problem


def _plate_scale(points: Tensor, tolerance: float, noise: float | None) -> _Unknown:
    """The scale of a plate that is not exactly as drawn; raises InputError where it cannot be fitted."""
    if noise is None:
        raise InputError("plate_tolerance: it can be weighed against the rows only if their noise is given")
    distinct = torch.unique(points, dim=0)
    extent = float(torch.cdist(distinct, distinct).max())
    if extent == 0:
        raise InputError("plate_tolerance: a plate with a single socket has no scale; leave it out")
    sd = tolerance / extent
    return _Unknown("plate_scale", "1", 1.0, sd, sd)


def scatter(points: Tensor, group: Tensor, weights: Tensor) -> Tensor:
    """Distance of every point from the mean of its group's points that count, `s` [m]: what a held point shows.

    Args:
        points: `s x 3` [m].
        group: number of each point's group, `s`, any numbers.
        weights: `s` [1]; the means are of the rows with weight, the distances of all rows.

    Raises:
        InputError: a group has no row that counts.
    """
    numbers, which = torch.unique(group, return_inverse=True)
    total = torch.zeros(len(numbers), dtype=points.dtype).index_add(0, which, weights)
    if bool((total <= 0).any()):
        raise InputError(f"group {float(numbers[total <= 0][0]):g} has no row that counts, so it has no mean")
    mean = torch.zeros(len(numbers), 3, dtype=points.dtype).index_add(0, which, points * weights[:, None])
    distance: Tensor = torch.linalg.vector_norm(points - (mean / total[:, None])[which], dim=-1)
    return distance


@dataclass(frozen=True)
class _Unknown:
    """A parameter of the constraint: where it starts, its plausible error, and its prior [SI]."""

    name: str
    unit: str
    start: float
    scale: float
    prior_sd: float = torch.inf


def _placements(numbers: Tensor, weights: Tensor) -> tuple[Tensor, list[tuple[str, Tensor]]]:
    """Which placement each row is of, `s` int64; and of each what it is called and which rows count, `s` bool."""
    rows = weights.shape[-1]
    if numbers.shape != (rows,):
        raise InputError(f"placement must be one number for each of {rows} rows, got {tuple(numbers.shape)}")
    values, group = torch.unique(numbers, return_inverse=True)
    parts = [(f"{v:g}", (group == g) & (weights > 0).any(0)) for g, v in enumerate(values.tolist())]
    for label, mine in parts:
        if not bool(mine.any()):
            raise InputError(
                f"placement {label}: needs at least 1 row that counts, got 0; measure it more often, or leave its rows "
                "out of the records"
            )
    return group, parts


def _plate_start(points: Tensor, there: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation `3 x 3` and place `3` [m] of a plate, points `s x 3` seen at `s x 3`; and the axes of the turns that the
    rows show, `t x 3`: all three, the two across a line of sockets, or none for a single one (Kabsch 1976)."""
    here, seen = points - points.mean(0), there - there.mean(0)
    left, _, right = torch.linalg.svd(seen.mT @ here)
    sign = torch.ones(3, dtype=points.dtype)
    sign[2] = torch.sign(torch.linalg.det(left @ right))
    rotation = (left * sign) @ right
    extent = torch.linalg.svdvals(here)
    rank = int((extent > _THIN * max(1e-3, float(extent[0]))).sum())
    axes = torch.eye(3, dtype=points.dtype)
    if rank == 1:
        axes = left.mT[1:]
    return rotation, there.mean(0) - rotation @ points.mean(0), axes if rank else axes[:0]
