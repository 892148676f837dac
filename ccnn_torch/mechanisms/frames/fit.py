"""Base and tool frame of a serial arm from measured poses: measured data do not determine where the arm is mounted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.mechanisms.mechanism import Mechanism
from ccnn_torch.mechanisms.pose import Frame
from ccnn_torch.numerics.batching import leading_shape
from ccnn_torch.numerics.least_squares import levenberg_marquardt
from ccnn_torch.numerics.outliers import FAR, inlying, residual_scale
from ccnn_torch.numerics.rotations import (
    matrix_to_rotation_vector,
    nearest_rotation,
    rotation_vector_rate,
    rotation_vector_to_matrix,
    skew,
)

# Share of the largest singular value by which a rotation that the points do not show stays near none at all.
_STILL = 1e-9
# Of the squared lengths that rows of one metre have: what they show by less than 3 µm stays near zero.
_RIDGE = 1e-11


def closed_form_frames(rotation: Tensor, position: Tensor, measured: Frame, tool: Tensor, weights: Tensor) -> Tensor:
    """Base and tool frames near those that fit the rows, from three closed forms; which one is best the rows decide.

    1. Orientation: Shah's solution of A X = Z B (Shah 2013), a singular value decomposition. It is the best where the
       orientation varies about two axes, and means nothing where it does not. Without orientation as 2.
    2. Positions: a linear relaxation of the base rotation. It wants positions in all three dimensions.
    3. Both: the rigid motion (Kabsch 1976) that takes the points of the nominal tool to the measured ones. It holds
       with one orientation and with points in a plane; on a line the turn about it is left as it is.

    Args:
        rotation, position: the flange in the base, `... x s x 3 x 3` and `... x s x 3` [m].
        measured: position `... x s x 3` [m] and rotation `... x s x 3 x 3` (or None) in the record's frame.
        tool: nominal, `6`: position [m] and rotation vector [rad].
        weights: `... x s` [1].

    Returns:
        `3 x ... x 12`: base, then tool, each position [m] and rotation vector [rad].
    """
    points = position + (rotation @ tool[:3, None])[..., 0]
    by_points = rigid_body_frame((points, None), (measured[0], None), weights, 0.0)
    by_relaxation = _base_by_relaxation(rotation, position, measured[0], weights)
    bases = [by_relaxation, by_relaxation, rotation_vector_to_matrix(by_points[..., 3:])]
    if measured[1] is None:
        turn = rotation_vector_to_matrix(tool[3:])
        tools = [turn.expand_as(base) for base in bases]
    else:
        share = (weights / weights.sum(-1, keepdim=True))[..., None, None]
        shah = _rotations_by_kronecker(rotation, measured[1], weights)
        bases[0] = shah[0]
        there = [rotation.mT @ base.mT[..., None, :, :] @ measured[1] for base in bases[1:]]
        tools = [shah[1], *(nearest_rotation((share * turned).sum(-3)) for turned in there)]
    return _placed(torch.stack(bases), torch.stack(tools), rotation, position, measured[0], weights)


def best_closed_form(
    rotation: Tensor, position: Tensor, measured: Frame, tool: Tensor, weights: Tensor, rotation_weight: float
) -> Tensor:
    """The one of `closed_form_frames` that misses the rows least, `... x 12`; rotation_weight [m/rad]."""
    found = closed_form_frames(rotation, position, measured, tool, weights)
    base, turn = (rotation_vector_to_matrix(found[..., None, k : k + 3]) for k in (3, 9))
    lever = position + (rotation @ found[..., None, 6:9, None])[..., 0]
    miss = (base @ lever[..., None])[..., 0] + found[..., None, :3] - measured[0]
    square = miss.square().sum(-1)
    if measured[1] is not None:
        angle = matrix_to_rotation_vector(base @ rotation @ turn @ measured[1].mT)
        square = square + rotation_weight**2 * angle.square().sum(-1)
    best = (weights * square).sum(-1).argmin(0)
    return found.gather(0, best[None, ..., None].expand(1, *found.shape[1:]))[0]


def _placed(
    base: Tensor, tool: Tensor, rotation: Tensor, position: Tensor, measured: Tensor, weights: Tensor
) -> Tensor:
    """Both frames of two rotations `... x 3 x 3`: R_a t + u = R_bᵀ p_m - p_a is linear in the tool's t and R_bᵀ t_b."""
    right = measured @ base - position
    eye = torch.eye(3, dtype=base.dtype).expand_as(rotation)
    solved = _weighted_linear(torch.cat([rotation, eye], dim=-1), right, weights)
    shift = (base @ solved[..., 3:, None])[..., 0]
    parts = [shift, matrix_to_rotation_vector(base), solved[..., :3], matrix_to_rotation_vector(tool)]
    return torch.cat(parts, dim=-1)


def rigid_body_frame(here: Frame, there: Frame, weights: Tensor, rotation_weight: float) -> Tensor:
    """The rigid motion that takes some frames nearest to others (Kabsch 1976, with orientation beside the points).

    Points in one plane leave no choice of its normal: of the two motions that fit them up to a reflection, the proper
    rotation keeps their order in the plane. A rotation about collinear points stays near zero.

    Args:
        here, there: position `... x s x 3` [m] and rotation `... x s x 3 x 3`, or None.
        weights: `... x s` [1].
        rotation_weight: of orientation against position [m/rad].

    Returns:
        `... x 6`: position [m] and rotation vector [rad].
    """
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    middles = [(share * p).sum(-2, keepdim=True) for p in (here[0], there[0])]
    moment = ((there[0] - middles[1]) * share).mT @ (here[0] - middles[0])
    if here[1] is not None and there[1] is not None:
        moment = moment + rotation_weight**2 * (share[..., None] * (there[1] @ here[1].mT)).sum(-3)
    size = torch.linalg.matrix_norm(moment)[..., None, None].clamp_min(1e-30)
    turn = nearest_rotation(moment + _STILL * size * torch.eye(3, dtype=moment.dtype))
    shift = middles[1][..., 0, :] - (turn @ middles[0].mT)[..., 0]
    return torch.cat([shift, matrix_to_rotation_vector(turn)], dim=-1)


def _rotations_by_kronecker(rotation: Tensor, measured: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """R_b = R_m R_tᵀ R_aᵀ for all rows: the first singular pair of the mean of R_m ⊗ R_a (Shah 2013, eq. 28-31)."""
    share = (weights / weights.sum(-1, keepdim=True))[..., None]
    mean = (share * measured.flatten(-2)).mT @ rotation.flatten(-2)
    mean = mean.reshape(*mean.shape[:-2], 3, 3, 3, 3).transpose(-3, -2).flatten(-4, -3).flatten(-2)
    left, _, right = torch.linalg.svd(mean)
    base, tool = left[..., 0].reshape(*left.shape[:-2], 3, 3), right[..., 0, :].reshape(*left.shape[:-2], 3, 3)
    sign = torch.linalg.det(base).sign()[..., None, None]
    return nearest_rotation(base * sign), nearest_rotation(tool * sign).mT


def _base_by_relaxation(rotation: Tensor, position: Tensor, measured: Tensor, weights: Tensor) -> Tensor:
    """R_bᵀ p_m - R_a t - u = p_a is linear once R_bᵀ may be any matrix; the nearest rotation to that matrix."""
    centred = measured - measured.mean(-2, keepdim=True)
    eye = torch.eye(3, dtype=position.dtype)
    matrix = torch.einsum("il,...j->...ilj", eye, centred).flatten(-2)
    lead = leading_shape(matrix[..., 0], rotation[..., 0])
    parts = (matrix, -rotation, -eye)
    design = torch.cat([part.expand(*lead, 3, part.shape[-1]) for part in parts], dim=-1)
    solved = _weighted_linear(design, position, weights)
    relaxed = solved[..., :9].reshape(*solved.shape[:-1], 3, 3)
    return nearest_rotation(relaxed).mT


def _weighted_linear(design: Tensor, right: Tensor, weights: Tensor) -> Tensor:
    """Weighted least squares, `... x m`, what the rows hardly show near zero; the last three columns are a shift.

    design `... x s x 3 x m`, right `... x s x 3`, weights `... x s`.
    """
    flat = design.flatten(-3, -2)
    weighed = (flat * weights.repeat_interleave(3, -1)[..., None]).mT
    ridge = torch.full((design.shape[-1],), _RIDGE, dtype=design.dtype)
    ridge[-3:] = 0
    solved: Tensor = torch.linalg.solve(
        weighed @ flat + torch.diag_embed(ridge * weights.sum(-1, keepdim=True)), weighed @ right.flatten(-2)[..., None]
    )
    return solved[..., 0]


ROTATION_WEIGHT = 0.3
"""Of orientation against position [m/rad]: 1 mrad counts as 0.3 mm, about an arm's ratio of the two errors."""

TOOL_SPREAD = 0.25
"""Standard deviation of the tool's position about its nominal one, as a share of the reach. With one orientation in all
rows the tool's position and the base's cannot be separated, and nothing else would hold either of them."""

# Rounds of reweighting: soft ones (Cauchy's weights) from every start, then the best start without gross outliers.
_SOFT, _HARD = 4, 3
# Where Cauchy's weights bend, in standard deviations (Holland and Welsch 1977).
_BEND = 2.385


def fit_frames(
    arm: SerialArm,
    joints: Tensor,
    pose: Tensor,
    weights: Tensor | None = None,
    rotation_weight: float = ROTATION_WEIGHT,
    columns: Mapping[str, NDArray[np.float64]] | None = None,
) -> Tensor:
    """Fit the unknown ones of base and tool frame to rows, nominal links kept; each repeat on its own rows.

    With orientation both frames are fitted in (position, rotation_weight x rotation vector); without, the base frame
    and the tool's position (the rows do not determine the tool's rotation then, which stays nominal). Damped
    least squares from several closed-form starts, the best of which is kept; gross outliers are first weighed down and
    then left out. Directions that the rows do not show (the roll of a plate about the line of its two sockets) stay at
    the start, and the tool's position is drawn to its nominal one by a quarter of the reach.

    Args:
        arm: the arm; `arm.unknown_frames` lists what is fitted, `arm.frame_per` and `arm.tool_per` per which groups.
        joints: `s x n` [SI].
        pose: measured, `s x p` [SI]; a row that lacks a part of it (NaN) is left out.
        weights: `r x s` or `s` [1]; 0 leaves a row out (held-out rows); all 1 when None.
        rotation_weight: of orientation against position [m/rad].
        columns: the records' other columns, `s` each; needed for `frame_per` and `tool_per`.

    Returns:
        All parameters: `r x k` [SI] (`k` when the weights have no repeats), the same for all rows; `r x s x k` where
        the arm has frames per group.

    Raises:
        InputError: too few training rows, in all or in a group, or a group column that is not there.
    """
    weights, pose = whole_rows(pose, weights)
    grouped = arm.grouped
    lead = weights.shape[:-1]
    if not arm.unknown_frames:
        return arm.nominal.expand(*lead, *([len(joints)] if grouped else []), -1).clone()
    base_of, base_names = groups_of(arm, "frame_per", arm.frame_per, columns, len(joints))
    tool_of, tool_names = groups_of(arm, "tool_per", arm.tool_per, columns, len(joints))
    needed = 3 if grouped or arm.orientation == "rotation_vector" else 5
    for group_of, names in ((base_of, base_names), (tool_of, tool_names)):
        for group, name in enumerate(names):
            check_rows_of(arm.name, name, weights[..., group_of == group], needed)
    rotation, position = arm.flange(joints)
    measured = arm.frame(pose)
    rows = slice(None) if grouped else slice(0, 1)
    values = arm.nominal.expand(*lead, len(base_of[rows]), -1).clone()
    if arm.orientation == "direction":
        tip = position + (rotation @ arm.nominal[-6:-3, None])[..., 0]
        values[..., 3:6] = _turned(tip, measured[0], weights, base_of, len(base_names))[..., base_of[rows], :]
        return values if grouped else values[..., 0, :]
    base = arm.nominal[:6].expand(*lead, len(base_names), 6).clone()
    tool = arm.nominal[-6:].expand(*lead, len(tool_names), 6).clone()
    free_tool = 0 if "tool" not in arm.unknown_frames else 6 if arm.orientation == "rotation_vector" else 3
    free_base = 6 if "base" in arm.unknown_frames else 0
    # Each pair of a base and a tool group is started for itself; a group takes the start of its largest pair.
    pairs, pair_of, sizes = torch.unique(
        torch.stack([base_of, tool_of]), dim=1, return_inverse=True, return_counts=True
    )
    shares = (pair_of == torch.arange(pairs.shape[1])[:, None]).to(weights.dtype)
    starts = closed_form_frames(rotation, position, measured, arm.nominal[-6:], weights[..., None, :] * shares)
    base, tool = (frames.expand(len(starts), *frames.shape).clone() for frames in (base, tool))
    for i in torch.argsort(sizes).tolist():
        base[..., pairs[0, i], :free_base] = starts[..., i, :free_base]
        tool[..., pairs[1, i], :free_tool] = starts[..., i, 6 : 6 + free_tool]
    problem = _Problem(
        rotation,
        position,
        *measured,
        weights,
        rotation_weight,
        base_of,
        tool_of,
        base,
        tool,
        free_base,
        free_tool,
        arm.nominal[-6:],
        TOOL_SPREAD * arm.reach,
        weights.new_zeros(()),
    )
    base, tool = _descend(problem)
    values[..., :6], values[..., -6:] = base[..., base_of[rows], :], tool[..., tool_of[rows], :]
    return values if grouped else values[..., 0, :]


def whole_rows(pose: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Weights `... x s` (1 when None), 0 in rows that lack a part of their pose `s x p`, and poses without NaN."""
    weights = torch.ones(pose.shape[:-1], dtype=pose.dtype) if weights is None else weights
    return torch.where(pose.isnan().any(-1), 0.0, weights), pose.nan_to_num()


def _turned(here: Tensor, there: Tensor, weights: Tensor, group_of: Tensor, groups: int) -> Tensor:
    """Rotation vectors that take directions to measured ones, group by group, `... x b x 3`, without outliers.

    Args:
        here, there: `s x 3` [1].
        weights: `... x s` [1].
        group_of: number of each row's group, `s`.
        groups: how many there are, `b`.
    """
    fine = weights
    for _ in range(_HARD):
        shares = fine[..., None, :] * (group_of == torch.arange(groups)[:, None]).to(here.dtype)
        turn = nearest_rotation((shares[..., None] * there).mT @ here)
        left = (turn[..., group_of, :, :] @ here[..., None])[..., 0] - there
        fine = weights * inlying(torch.linalg.vector_norm(left, dim=-1), weights > 0, 2, 3 * groups)
    return matrix_to_rotation_vector(turn)


def _descend(problem: _Problem) -> tuple[Tensor, Tensor]:
    """The frames with the least residual of those that the starts lead to, gross outliers left out."""
    free, used = problem.start(), problem.weights > 0
    channels = 3 if problem.measured_rotation is None else 6
    about = (used, channels, free.shape[-1])
    for _ in range(_SOFT):
        length = problem.length(free)
        ratio = length / (_BEND * residual_scale(length, *about)).clamp_min(torch.finfo(length.dtype).tiny)
        free = _solved(problem, free, 1 / (1 + ratio.square()), channels, max_iterations=20)
    length = problem.length(free)
    bound = FAR * residual_scale(length, *about).amin(0)
    best = (problem.weights * length.clamp_max(bound).square()).sum(-1).argmin(0)
    problem, free = problem.only(best), _pick(free, best)
    for _ in range(_HARD):
        kept = inlying(problem.length(free), *about).to(free.dtype)
        free = _solved(problem, free, kept, channels, max_iterations=100)
    return problem.frames(free)


def _solved(problem: _Problem, free: Tensor, factor: Tensor, channels: int, max_iterations: int) -> Tensor:
    """Least squares with weights times a factor, `... x s`, and the prior as the residuals that are left weigh it."""
    weights = problem.weights * factor
    square = (weights * problem.length(free).square()).sum(-1) / (channels * weights.sum(-1))
    now = replace(problem, weights=weights, noise=square.sqrt())
    return levenberg_marquardt(now.residual, free, now.jacobian, max_iterations=max_iterations, damping=1e-6).value


def _pick(values: Tensor, best: Tensor) -> Tensor:
    """Of `c x ... x k...` the entry that `best` `...` names, `... x k...`."""
    index = best.reshape(1, *best.shape, *[1] * (values.dim() - 1 - best.dim()))
    return values.gather(0, index.expand(1, *values.shape[1:]))[0]


def groups_of(
    arm: Mechanism, key: str, names: Sequence[str], columns: Mapping[str, NDArray[np.float64]] | None, rows: int
) -> tuple[Tensor, list[str]]:
    """Group number of each row, `s` int64, and what each group is called."""
    if not names:
        return torch.zeros(rows, dtype=torch.int64), ["all rows"]
    known = columns or {}
    for name in names:
        if name not in known:
            there = ", ".join(known) or "none"
            raise InputError(f"{arm.name}: {key} names the column '{name}', which the records lack; they have {there}")
    table = np.stack([np.asarray(known[name], dtype=np.float64) for name in names], axis=-1)
    values, number = np.unique(table, axis=0, return_inverse=True)
    said = [", ".join(f"{n} {v:.10g}" for n, v in zip(names, row, strict=True)) for row in values]
    return torch.from_numpy(number.reshape(-1).astype(np.int64)), said


def check_rows_of(machine: str, group: str, weights: Tensor, needed: int) -> None:
    """Refuse a group of rows, of weights `... x s`, that is too small for a frame of its own."""
    rows = int((weights > 0).sum(-1).min())
    if rows < needed:
        raise InputError(f"{machine}: {group}: a frame needs at least {needed} training rows, got {rows}")


@dataclass(frozen=True)
class _Problem:
    """Weighted residuals of all rows over the free frame parameters, with their Jacobian in closed form.

    rotation `s x 3 x 3`, position `s x 3`: the flange in the base. measured_position `s x 3`, measured_rotation
    `s x 3 x 3` or None. weights `... x s`. base_of, tool_of: `s`, group of each row. base `... x b x 6`, tool
    `... x t x 6`: start and what stays. free_base, free_tool: how many of the six, from the first on, are fitted.
    nominal_tool `6`, and the standard deviation of a tool's position about it, tool_spread [m], against the noise
    `...` [m] of the rows.
    """

    rotation: Tensor
    position: Tensor
    measured_position: Tensor
    measured_rotation: Tensor | None
    weights: Tensor
    rotation_weight: float
    base_of: Tensor
    tool_of: Tensor
    base: Tensor
    tool: Tensor
    free_base: int
    free_tool: int
    nominal_tool: Tensor
    tool_spread: float
    noise: Tensor

    def only(self, best: Tensor) -> _Problem:
        """The problem of the starts that `best` names."""
        return replace(self, base=_pick(self.base, best), tool=_pick(self.tool, best))

    def start(self) -> Tensor:
        """The free parameters at the start, `... x f`: all base groups, then all tool groups."""
        free = [self.base[..., : self.free_base].flatten(-2), self.tool[..., : self.free_tool].flatten(-2)]
        return torch.cat(free, dim=-1)

    def frames(self, free: Tensor) -> tuple[Tensor, Tensor]:
        """Base `... x b x 6` and tool `... x t x 6` of the free parameters."""
        base, tool = self.base.clone(), self.tool.clone()
        split = base.shape[-2] * self.free_base
        base[..., : self.free_base] = free[..., :split].reshape(*base.shape[:-1], self.free_base)
        tool[..., : self.free_tool] = free[..., split:].reshape(*tool.shape[:-1], self.free_tool)
        return base, tool

    def _placed(self, base: Tensor, tool: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of each row: tool position seen from the base's origin, tool rotation, flange rotation; record's axes."""
        base_rotation = rotation_vector_to_matrix(base[..., 3:])[..., self.base_of, :, :]
        tool_rotation = rotation_vector_to_matrix(tool[..., 3:])[..., self.tool_of, :, :]
        flange = base_rotation @ self.rotation
        lever = (base_rotation @ self.position[..., None] + flange @ tool[..., self.tool_of, :3, None])[..., 0]
        return lever, flange @ tool_rotation, flange

    def _gap(self, free: Tensor) -> Tensor:
        """Predicted less measured position and weighted rotation vector, `... x s x c` [m]."""
        base, tool = self.frames(free)
        lever, rotation, _ = self._placed(base, tool)
        rows = lever + base[..., self.base_of, :3] - self.measured_position
        if self.measured_rotation is None:
            return rows
        turn = matrix_to_rotation_vector(rotation @ self.measured_rotation.mT)
        return torch.cat([rows, self.rotation_weight * turn], dim=-1)

    def length(self, free: Tensor) -> Tensor:
        """Length of each row's residual, `... x s` [m]."""
        length: Tensor = torch.linalg.vector_norm(self._gap(free), dim=-1)
        return length

    def residual(self, free: Tensor) -> Tensor:
        """Of the rows, weighted, and of the tools' positions about their nominal ones."""
        rows = (self._gap(free) * self.weights.sqrt()[..., None]).flatten(-2)
        target, pull = self._prior(free)
        return torch.cat([rows, (free - target) * pull], dim=-1)

    def _prior(self, free: Tensor) -> tuple[Tensor, Tensor]:
        """What the free parameters are drawn to, `f`, and how strongly, `... x f`; a base and a rotation to nothing."""
        of_base, tools = self.base.shape[-2] * self.free_base, self.tool.shape[-2]
        stiffness = free.new_tensor([1 / self.tool_spread] * 3 + [0.0] * 3)[: self.free_tool].repeat(tools)
        target = self.nominal_tool[: self.free_tool].repeat(tools)
        none = free.new_zeros(of_base)
        return torch.cat([none, target]), self.noise[..., None] * torch.cat([none, stiffness])

    def jacobian(self, free: Tensor) -> Tensor:
        # The derivative of log(R Rmᵀ) is taken as the rate of rotation itself: the gradient is the same.
        base, tool = self.frames(free)
        lever, _, flange = self._placed(base, tool)
        base_rate = rotation_vector_rate(base[..., 3:])[..., self.base_of, :, :]
        eye = torch.eye(3, dtype=lever.dtype).expand(*flange.shape)
        none = torch.zeros_like(flange)
        rows = torch.cat([eye, -skew(lever) @ base_rate, flange, none], dim=-1)
        if self.measured_rotation is not None:
            tool_rate = flange @ rotation_vector_rate(tool[..., 3:])[..., self.tool_of, :, :]
            turning = torch.cat([none, base_rate, none, tool_rate], dim=-1)
            rows = torch.cat([rows, self.rotation_weight * turning], dim=-2)
        rows = rows * self.weights.sqrt()[..., None, None]
        place, column = self._columns(free.shape[-1])
        prior = torch.diag_embed(self._prior(free)[1])
        spread = torch.zeros(*rows.shape[:-1], free.shape[-1], dtype=rows.dtype)
        spread.scatter_(-1, column[:, None, :].expand(*rows.shape[:-1], -1), rows[..., place])
        return torch.cat([spread.flatten(-3, -2), prior], dim=-2)

    def _columns(self, count: int) -> tuple[Tensor, Tensor]:
        """Which of a row's 12 derivatives are free, `f'`, and where in all free parameters they belong, `s x f'`."""
        base, tool = torch.arange(self.free_base), torch.arange(self.free_tool)
        tools = count - self.tool.shape[-2] * self.free_tool
        column = [self.base_of[:, None] * self.free_base + base, tools + self.tool_of[:, None] * self.free_tool + tool]
        return torch.cat([base, 6 + tool]), torch.cat(column, dim=-1)
