"""Base and tool frame of a serial arm from measured poses: measured data do not determine where the arm is mounted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ccnn_torch.errors import InputError
from ccnn_torch.mechanisms.frames.closed_form_start import closed_form_frames
from ccnn_torch.mechanisms.machines.serial import SerialArm
from ccnn_torch.numerics.least_squares import levenberg_marquardt
from ccnn_torch.numerics.outliers import FAR, inlying, residual_scale
from ccnn_torch.numerics.rotations import (
    matrix_to_rotation_vector,
    rotation_vector_rate,
    rotation_vector_to_matrix,
    skew,
)

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
        pose: measured, `s x p` [SI].
        weights: `r x s` or `s` [1]; 0 leaves a row out (held-out rows); all 1 when None.
        rotation_weight: of orientation against position [m/rad].
        columns: the records' other columns, `s` each; needed for `frame_per` and `tool_per`.

    Returns:
        All parameters: `r x k` [SI] (`k` when the weights have no repeats), the same for all rows; `r x s x k` where
        the arm has frames per group.

    Raises:
        InputError: too few training rows, in all or in a group, or a group column that is not there.
    """
    weights = torch.ones(len(joints), dtype=torch.float64) if weights is None else weights
    grouped = bool(arm.frame_per or arm.tool_per)
    lead = weights.shape[:-1]
    if not arm.unknown_frames:
        return arm.nominal.expand(*lead, *([len(joints)] if grouped else []), -1).clone()
    base_of, base_names = _groups(arm, "frame_per", arm.frame_per, columns, len(joints))
    tool_of, tool_names = _groups(arm, "tool_per", arm.tool_per, columns, len(joints))
    needed = 3 if grouped or arm.orientation == "rotation_vector" else 5
    for group_of, names in ((base_of, base_names), (tool_of, tool_names)):
        _check_rows(arm, weights, group_of, names, needed)
    rotation, position = arm.flange(joints)
    measured = arm.frame(pose)
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
    rows = slice(None) if grouped else slice(0, 1)
    values = arm.nominal.expand(*lead, len(base_of[rows]), -1).clone()
    values[..., :6], values[..., -6:] = base[..., base_of[rows], :], tool[..., tool_of[rows], :]
    return values if grouped else values[..., 0, :]


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


def _groups(
    arm: SerialArm, key: str, names: Sequence[str], columns: Mapping[str, NDArray[np.float64]] | None, rows: int
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
    said = [", ".join(f"{n} {v:g}" for n, v in zip(names, row, strict=True)) for row in values]
    return torch.from_numpy(number.reshape(-1).astype(np.int64)), said


def _check_rows(arm: SerialArm, weights: Tensor, group_of: Tensor, names: list[str], needed: int) -> None:
    for group, name in enumerate(names):
        rows = int((weights[..., group_of == group] > 0).sum(-1).min())
        if rows < needed:
            raise InputError(f"{arm.name}: {name}: a frame needs at least {needed} training rows, got {rows}")


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
        if free.shape[-1] == len(place):  # one group: every free parameter acts on every row
            return torch.cat([rows[..., place].flatten(-3, -2), prior], dim=-2)
        spread = torch.zeros(*rows.shape[:-1], free.shape[-1], dtype=rows.dtype)
        spread.scatter_(-1, column[:, None, :].expand(*rows.shape[:-1], -1), rows[..., place])
        return torch.cat([spread.flatten(-3, -2), prior], dim=-2)

    def _columns(self, count: int) -> tuple[Tensor, Tensor]:
        """Which of a row's 12 derivatives are free, `f'`, and where in all free parameters they belong, `s x f'`."""
        base, tool = torch.arange(self.free_base), torch.arange(self.free_tool)
        tools = count - self.tool.shape[-2] * self.free_tool
        column = [self.base_of[:, None] * self.free_base + base, tools + self.tool_of[:, None] * self.free_tool + tool]
        return torch.cat([base, 6 + tool]), torch.cat(column, dim=-1)
