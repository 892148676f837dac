"""Constraints instead of poses: a ball in sockets of a plate, distances, points on a plane.

Each builder gives a `Problem` in the free parameters of the machine and in what is unknown of the constraint itself,
which the same fit finds: the place of a plate, an anchor, a plane. Neither needs a measuring device. What such rows
cannot tell by their nature is left out: the arm's base frame (the constraint moves along with it), the tool's
orientation (only its point is held), the roll of a plate about a single line of sockets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.coordinates import Parameter
from ccnn_torch.display import count_text
from ccnn_torch.errors import InputError
from ccnn_torch.identification.problems.parameters import ParameterChoice, Selection, select_parameters
from ccnn_torch.identification.problems.problem import Channel, Problem, check_equations
from ccnn_torch.identification.problems.whitened import check_finite
from ccnn_torch.mechanisms import Mechanism, SerialArm
from ccnn_torch.numerics.rotations import rotation_vector_to_matrix

# Plausible errors of what a constraint is unknown in, after a start from the nominal machine [m, rad].
_PLACE, _TURN = 5e-3, 2e-2
# Directions in which points spread less than this share of their largest extent do not show a rotation.
_THIN = 1e-6


def tool_points(mechanism: Mechanism, joints: Tensor, parameters: Tensor | None = None) -> Tensor:
    """Position of the tool, `... x 3` [m]; joints `... x n` [SI], parameters `... x k` [SI]."""
    if isinstance(mechanism, SerialArm):
        return mechanism.forward_frame(joints, parameters)[0]
    return mechanism.frame(mechanism.forward_kinematics(joints, parameters))[0]


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
    machine = _machine(mechanism, joints, weights, choice, start, noise)
    group, parts = machine.groups(placement, "placement", 1)
    if points.shape != (len(joints), 3):
        raise InputError(f"points must be one place on the plate for each of {len(joints)} rows, got {points.shape}")
    distinct = torch.unique(points, dim=0)
    extent = float(torch.cdist(distinct, distinct).max())
    unknown, turned, turns = [], torch.zeros_like(points), torch.zeros(len(joints), 9, dtype=torch.float64)
    if plate_tolerance > 0:
        if noise is None:
            raise InputError("plate_tolerance: it can be weighed against the rows only if their noise is given")
        if extent == 0:
            raise InputError("plate_tolerance: a plate with a single socket has no scale; leave it out")
        sd = plate_tolerance / extent
        unknown.append(_Unknown("plate_scale", "1", 1.0, sd, sd))
    columns = torch.zeros(len(joints), 6, dtype=torch.int64)
    for g, (label, mine) in enumerate(parts):
        rotation, place, axes = _plate_start(points[mine], machine.there[mine])
        turned[group == g] = points[group == g] @ rotation.mT
        turns[group == g, : 3 * len(axes)] = axes.flatten()
        first = len(unknown)
        unknown += _place(f"plate{label}", place)
        unknown += [_Unknown(f"plate{label}_turn{i + 1}", "rad", 0.0, _TURN) for i in range(len(axes))]
        # A turn that does not exist reads any column, since its axis is 0.
        columns[group == g] = torch.tensor([min(first + i, len(unknown) - 1) for i in range(6)])

    def gap(full: Tensor, others: Tensor, q: Tensor, x: Tensor, axes: Tensor, where: Tensor) -> Tensor:
        own = _take(others, where)
        spin = (own[..., 3:, None] * axes.reshape(*axes.shape[:-1], 3, 3)).sum(-2)
        scale = others[..., :1] if plate_tolerance > 0 else 1.0
        socket = (rotation_vector_to_matrix(spin) @ x[..., None])[..., 0] * scale
        return tool_points(mechanism, q, full) - own[..., :3] - socket

    return machine.problem(gap, (joints, turned, turns, columns), unknown, ("x", "y", "z"))


def distance_problem(
    mechanism: Mechanism,
    joints: Tensor,
    anchor: Tensor,
    distance: Tensor,
    noise: float | None = None,
    weights: Tensor | None = None,
    choice: ParameterChoice | None = None,
    start: Tensor | None = None,
) -> Problem:
    """Measured distance of the tool from an anchor at an unknown place (draw wire, telescopic ball bar).

    Args:
        anchor: number of the anchor, `s`, any numbers.
        distance: `s` [m].
        joints, noise, weights, choice, start: as `socket_problem`.

    Returns:
        Problem with the parameters chosen, then `anchorA_x`, `_y`, `_z` of each anchor A.

    Raises:
        InputError: as `socket_problem`, or fewer than four rows of an anchor.
    """
    machine = _machine(mechanism, joints, weights, choice, start, noise)
    group, parts = machine.groups(anchor, "anchor", 4)
    unknown: list[_Unknown] = []
    for label, mine in parts:
        p, d = machine.there[mine], distance[mine]
        # |p|² - d² = 2 p·a - |a|² is linear in a and |a|².
        left = torch.cat([2 * p, -torch.ones_like(p[:, :1])], dim=-1)
        place = torch.linalg.lstsq(left, (p.square().sum(-1) - d.square())[:, None], driver="gelsd").solution[:3, 0]
        unknown += _place(f"anchor{label}", place)

    def gap(full: Tensor, others: Tensor, q: Tensor, d: Tensor, where: Tensor) -> Tensor:
        away = tool_points(mechanism, q, full) - _take(others, where)
        length: Tensor = torch.linalg.vector_norm(away, dim=-1, keepdim=True)
        return length - d

    columns = 3 * group[:, None] + torch.arange(3)
    return machine.problem(gap, (joints, distance[:, None], columns), unknown, ("distance",))


def pair_problem(
    mechanism: Mechanism,
    joints: Tensor,
    others: Tensor,
    distance: Tensor,
    noise: float | None = None,
    weights: Tensor | None = None,
    choice: ParameterChoice | None = None,
    start: Tensor | None = None,
) -> Problem:
    """Measured distance of two places that the machine reached itself (scale bar, tape between holes, printed part).

    Args:
        others: joints of the second place of each row, `s x n` [SI].
        distance: `s` [m].
        joints, noise, weights, choice, start: as `socket_problem`.

    Returns:
        Problem with the parameters chosen.

    Raises:
        InputError: as `socket_problem`.
    """
    machine = _machine(mechanism, joints, weights, choice, start, noise)
    _machine(mechanism, others, weights, choice, start, noise)

    def gap(full: Tensor, unknown: Tensor, q: Tensor, there: Tensor, d: Tensor) -> Tensor:
        apart = tool_points(mechanism, q, full) - tool_points(mechanism, there, full)
        length: Tensor = torch.linalg.vector_norm(apart, dim=-1, keepdim=True)
        return length - d

    return machine.problem(gap, (joints, others, distance[:, None]), [], ("distance",))


def plane_problem(
    mechanism: Mechanism,
    joints: Tensor,
    plane: Tensor,
    reading: Tensor | None = None,
    noise: float | None = None,
    weights: Tensor | None = None,
    choice: ParameterChoice | None = None,
    start: Tensor | None = None,
) -> Problem:
    """The tool's point on a plane at an unknown place, or a dial gauge's reading of its distance from it.

    Args:
        plane: number of the plane, `s`, any numbers.
        reading: distance from the plane, `s` [m], positive on the side that all readings of a plane agree on; 0 when
            None.
        joints, noise, weights, choice, start: as `socket_problem`.

    Returns:
        Problem with the parameters chosen, then of each plane P `planeP_height` over the base's origin and the turns of
        its normal away from the start, `planeP_turn1` and `_turn2`.

    Raises:
        InputError: as `socket_problem`, or fewer than four rows of a plane.
    """
    machine = _machine(mechanism, joints, weights, choice, start, noise)
    group, parts = machine.groups(plane, "plane", 4)
    reading = torch.zeros(len(joints), dtype=torch.float64) if reading is None else reading
    unknown: list[_Unknown] = []
    normals = torch.zeros(len(joints), 9, dtype=torch.float64)
    for g, (label, mine) in enumerate(parts):
        p, r = machine.there[mine], reading[mine]
        frame = torch.linalg.svd(p - p.mean(0), full_matrices=True)[2].flip(0)
        height = p @ frame[0]
        if float(((height - height.mean()) * (r - r.mean())).sum()) < 0:
            frame, height = -frame, -height
        normals[group == g] = frame.flatten()
        unknown.append(_Unknown(f"plane{label}_height", "m", float((height - r).mean()), _PLACE))
        unknown += [_Unknown(f"plane{label}_turn{i}", "rad", 0.0, _TURN) for i in (1, 2)]

    def gap(full: Tensor, others: Tensor, q: Tensor, r: Tensor, frame: Tensor, where: Tensor) -> Tensor:
        own = _take(others, where)
        axes = frame.reshape(*frame.shape[:-1], 3, 3)
        turn = (own[..., 1:, None] * axes[..., 1:, :]).sum(-2)
        normal = (rotation_vector_to_matrix(turn) @ axes[..., 0, :, None])[..., 0]
        height = (tool_points(mechanism, q, full) * normal).sum(-1, keepdim=True)
        return height - own[..., :1] - r

    columns = 3 * group[:, None] + torch.arange(3)
    return machine.problem(gap, (joints, reading[:, None], normals, columns), unknown, ("height",))


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


def _place(name: str, start: Tensor) -> list[_Unknown]:
    """An unknown point, `3` [m]."""
    return [_Unknown(f"{name}_{axis}", "m", value, _PLACE) for axis, value in zip("xyz", start.tolist(), strict=True)]


@dataclass(frozen=True)
class _Machine:
    """The mechanism's side of a problem; `there`: where the tool is at the start of the search, `s x 3` [m]."""

    selection: Selection
    there: Tensor
    weights: Tensor
    noise: float | None

    def groups(self, numbers: Tensor, what: str, least: int) -> tuple[Tensor, list[tuple[str, Tensor]]]:
        """Group number of each row, `s` int64; and of each group what it is called and which rows count, `s` bool."""
        rows = len(self.there)
        if numbers.shape != (rows,):
            raise InputError(f"{what} must be one number for each of {rows} rows, got {tuple(numbers.shape)}")
        values, group = torch.unique(numbers, return_inverse=True)
        used = (self.weights > 0).any(0)
        parts = [(f"{value:g}", (group == g) & used) for g, value in enumerate(values.tolist())]
        for label, mine in parts:
            count = int(mine.sum())
            if count < least:
                raise InputError(
                    f"{what} {label}: needs at least {count_text(least, 'row')} that count, got {count}; measure it "
                    "more often, or leave its rows out of the records"
                )
        return group, parts

    def problem(
        self, gap: Callable[..., Tensor], data: Sequence[Tensor], unknown: list[_Unknown], names: Sequence[str]
    ) -> Problem:
        """gap: `(full ... x K, others ... x u, *data)` -> `... x c` [m]; data: `s x d` each."""
        selection, noise = self.selection, self.noise
        k, unit = len(selection.parameters), 1.0 if noise is None else noise
        if noise is None and bool(torch.isfinite(selection.prior_sd).any()):
            raise InputError("parameters.prior: a prior can be weighed against the rows only if their noise is given")
        fixed = selection.fixed[0]

        def residual(values: Tensor, *rows: Tensor) -> Tensor:
            full = values[..., :k] @ selection.spread + fixed
            return gap(full, values[..., k:], *rows) / unit

        machines = len(self.weights)
        stated = [[u.start, u.scale, u.prior_sd] for u in unknown]
        others = torch.tensor(stated, dtype=torch.float64).reshape(-1, 3).mT
        problem = Problem(
            parameters=(*selection.parameters, *(Parameter(u.name, u.unit, u.start) for u in unknown)),
            start=torch.cat([selection.start[0], others[0]]).expand(machines, -1).clone(),
            scale=torch.cat([selection.scale, others[1]]),
            prior_sd=torch.cat([selection.prior_sd, others[2]]),
            residual=residual,
            data=tuple(d.to(torch.float64).unsqueeze(0) for d in data),
            weights=self.weights,
            channels=tuple(Channel(name) for name in names),
            noise_known=noise is not None,
        )
        check_equations(problem)
        return problem


def _machine(
    mechanism: Mechanism,
    joints: Tensor,
    weights: Tensor | None,
    choice: ParameterChoice | None,
    start: Tensor | None,
    noise: float | None,
) -> _Machine:
    if noise is not None and not noise > 0:
        raise InputError(f"noise: {noise:g} is no standard deviation; write a length above 0 in m, or leave it out")
    begin = mechanism.nominal if start is None else start.detach()
    if choice is None:
        there = [p.name for p in mechanism.geometry]
        fixed = [n for n in there if n.startswith(("base_", "tool_r"))]
        choice = ParameterChoice(fixed=fixed)
    rows = torch.ones(len(joints), dtype=torch.float64) if weights is None else weights
    points = tool_points(mechanism, joints, begin)
    used = torch.ones(1, len(joints), dtype=torch.bool)
    check_finite(points[None], used, joints[None], mechanism.joints, f"mechanism '{mechanism.name}'", "xyz")
    selection = select_parameters(mechanism.geometry, choice, begin)
    return _Machine(selection, points, rows.reshape(-1, len(joints)), noise)


def _take(others: Tensor, where: Tensor) -> Tensor:
    """The unknowns that each row reads; others `... x u`, where `... x d` (whole numbers), returns `... x d`."""
    index = where.to(torch.int64)
    lead = torch.broadcast_shapes(others.shape[:-1], index.shape[:-1])  # type: ignore[no-untyped-call]
    return others.expand(*lead, -1).gather(-1, index.expand(*lead, -1))


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
