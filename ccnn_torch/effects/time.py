"""Effects that depend on the column of times: latency, drift of joints and frame, zeros found anew."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.effects.columns import TWIST, OfJoints, by_joint, of_rows, shown_columns
from ccnn_torch.effects.constant import frame_columns
from ccnn_torch.effects.joints import JointOffset
from ccnn_torch.effects.protocol import Coefficient, Effect, Shape
from ccnn_torch.effects.situation import Situation
from ccnn_torch.mechanisms import Mechanism

# Rows farther apart are not one trajectory [s].
_SAME_MOTION = 1.0


def elapsed(time: Tensor) -> Tensor:
    """Time since the first row, `... x s` [s]."""
    return time - time.amin(-1, keepdim=True)


def lagged(time: Tensor, value: Tensor, lag: Tensor) -> Tensor:
    """A body of one heat capacity behind its surroundings: y' = (value - y) / lag, settled at the first time.

    Exact for a value that is linear between the rows. The recurrence y_k = a_k y_(k-1) + b_k over the rows in the order
    of time is solved by doubling (Hillis and Steele 1986): log2(s) steps for all rows at once, and no exponential of a
    large number, as a running sum would need.

    Args:
        time: `... x s` [s], in any order.
        value: `... x s`.
        lag: `...` [s]; 0 = no lag.

    Returns:
        `... x s`.
    """
    time, value, behind = torch.broadcast_tensors(time, value, lag.unsqueeze(-1))  # type: ignore[no-untyped-call]
    order = torch.argsort(time, dim=-1, stable=True)
    t, v, behind = time.gather(-1, order), value.gather(-1, order), behind[..., 1:].clamp_min(1e-9)
    ratio = t.diff(dim=-1) / behind
    keep = torch.exp(-ratio)
    # Mean of what has passed, weighted by what is kept of it: (1 - e^-r)/r, near 0 by its series.
    small = ratio < 1e-6
    safe = torch.where(small, 1.0, ratio)
    mean = torch.where(small, 1 - ratio / 2, -torch.expm1(-safe) / safe)
    gain = v[..., 1:] * (1 - mean) + v[..., :-1] * (mean - keep)
    factor = torch.cat([torch.zeros_like(v[..., :1]), keep], -1)
    state = torch.cat([v[..., :1], gain], -1)
    reach = 1
    while reach < state.shape[-1]:
        state = torch.cat([state[..., :reach], state[..., reach:] + factor[..., reach:] * state[..., :-reach]], -1)
        factor = torch.cat([factor[..., :reach], factor[..., reach:] * factor[..., :-reach]], -1)
        reach *= 2
    return torch.zeros_like(state).scatter(-1, order, state)


def velocity(time: Tensor, joints: Tensor) -> Tensor:
    """Velocities by differences of the neighbouring rows in time, `... x s x n` [joint's unit per s].

    Rows more than a second from either neighbour are not part of a trajectory: their velocity is 0.

    Args:
        time: `... x s` [s], in any order.
        joints: `... x s x n`.
    """
    if joints.shape[-2] < 2:
        return torch.zeros_like(joints)
    order = torch.argsort(time.expand(joints.shape[:-1]), dim=-1, stable=True)
    t = time.expand(joints.shape[:-1]).gather(-1, order)
    at = order.unsqueeze(-1).expand_as(joints)
    q = joints.gather(-2, at)
    gap = t.diff(dim=-1).unsqueeze(-1)
    moving = (gap > 0) & (gap <= _SAME_MOTION)
    slope = torch.where(moving, q.diff(dim=-2) / torch.where(moving, gap, 1.0), 0.0)
    # The parabola through three rows: each side's slope, weighted by the other side's gap.
    before, after = torch.cat([slope[..., :1, :], slope], -2), torch.cat([slope, slope[..., -1:, :]], -2)
    first, last = torch.cat([gap[..., :1, :], gap], -2), torch.cat([gap, gap[..., -1:, :]], -2)
    known = torch.cat([moving[..., :1, :], moving], -2) & torch.cat([moving, moving[..., -1:, :]], -2)
    whole = (first + last).clamp_min(1e-300)
    middle = torch.where(known, (before * last + after * first) / whole, 0.0)
    return torch.zeros_like(joints).scatter(-2, at, middle)


_DELAY = 5e-3


class Latency(Effect):
    """Δq_i = -(τ + τ_i) dq_i/dt: the machine is where the command was τ before; τ_i is what one drive lags behind.

    Velocities are the columns speed1… where the records have them, else differences along a trajectory: rows that are
    more than a second apart are none.
    """

    name = "latency"
    kind = "joints"
    description = "poses recorded on the move that lag behind their commands"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Velocities, or the time along a trajectory."""
        speeds = [f"speed{i + 1}" for i in range(len(mechanism.joints))]
        if "time" in covariates or any(s in covariates for s in speeds):
            return ""
        unit = mechanism.joints[0].unit
        return (
            f"the joints' velocities, speed1[{unit}/s]…, or time[s] along a trajectory with rows under a second apart"
        )

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """The delay of all, then that of each joint on top."""
        own = [Coefficient(j.name, "s", 0.3 * _DELAY, joint=j.name, secondary=True) for j in situation.mechanism.joints]
        return (Coefficient("delay", "s", _DELAY), *own)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x (1 + n)`."""
        behind = -_velocity(situation)
        return torch.cat([behind.unsqueeze(-1), by_joint(behind.unsqueeze(-1))], -1)


def _velocity(situation: Situation) -> Tensor:
    columns = [situation.covariates.get(f"speed{i + 1}") for i in range(situation.joints.shape[-1])]
    time = situation.covariates.get("time")
    if time is None or any(c is not None for c in columns):
        zero = torch.zeros_like(situation.joints[..., 0])
        return torch.stack([zero if c is None else c.expand_as(zero) for c in columns], -1)
    return velocity(time, situation.joints)


# In an hour.
_SCALE = {"m": 3e-5, "rad": 5e-5}
_HOUR = 3600.0
# Terms of the random walk's expansion; what they leave out is 5 % of its variance at its end.
_WALK = 4
_RATES = 8
# The logarithm's time constant, as shares of the whole time.
_SHARES = (0.003, 1.0)


class Drift(OfJoints):
    """Δq_i = a_i t + b_i ln(1 + t / r) + a random walk; t since the first row.

    r is how long it takes for the drift to slow down. The random walk (secondary) is the Karhunen-Loève expansion of
    Brownian motion over the time T of the rows, its first four terms √2 sin((k - ½) π t / T) / ((k - ½) π).
    """

    name = "drift"
    description = "drift of the joints in time: linear, logarithmic, or random"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Time."""
        return "" if "time" in covariates else "the time of each row: time[s]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Steady, logarithmic, and the terms of the random walk, joint by joint."""
        found = []
        for j in situation.mechanism.joints:
            size = _SCALE[j.unit]
            found.append(Coefficient(f"{j.name} steady", f"{j.unit}/s", size / _HOUR, joint=j.name))
            found.append(Coefficient(f"{j.name} slowing", j.unit, size / 3, joint=j.name))
            found += [
                Coefficient(f"{j.name} walk {k + 1}", j.unit, size / 2, joint=j.name, secondary=True)
                for k in range(_WALK)
            ]
        return tuple(found)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """The time in which the drift slows down."""
        whole = _duration(situation)
        low, high = (math.log(share * whole) for share in _SHARES)
        step = (high - low) / (_RATES - 1)
        return (Shape("slowing", "s", tuple(math.exp(low + step * k) for k in range(_RATES)), _slowing(situation)),)

    def moves(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor:
        """The same course for each joint."""
        time = elapsed(situation.covariates["time"]).expand(situation.joints.shape[:-1])
        whole = _duration(situation)
        share = time / whole
        rate = shape.clamp_min(1e-9)
        parts = [time, torch.log1p(time / rate)]
        turns = [(k + 0.5) * math.pi for k in range(_WALK)]
        parts += [math.sqrt(2) * torch.sin(turn * share) / turn for turn in turns]
        same = torch.stack(torch.broadcast_tensors(*parts), -1)  # type: ignore[no-untyped-call]
        return of_rows(same.unsqueeze(-2).expand(*same.shape[:-1], situation.joints.shape[-1], -1), rows, -3)


def _duration(situation: Situation) -> float:
    """Of the longest set of rows [s]."""
    return max(float(elapsed(situation.covariates["time"]).max()), 1e-6)


def _slowing(situation: Situation) -> tuple[int, ...]:
    return tuple((2 + _WALK) * i + 1 for i in range(len(situation.mechanism.joints)))


# A pause is so many times as long as the usual step, and no shorter [s]; a session has so many rows or more.
_USUAL_STEPS, _PAUSE, _SESSION_ROWS = 20, 300.0, 6
# Parts of the time at whose ends a zero may change where there is no pause.
_ZERO_BEGINS = 40


class Homing(Effect):
    """Δq_i = c_is in session s: homed, or an encoder's zero found, anew after each pause between the rows.

    Without pauses, or with too many, Δq_i = c_i from the time t₀ on, a shape: a belt skipped a tooth, an encoder lost
    counts. The zero before that is `joint_offset`.
    """

    name = "homing"
    kind = "joints"
    description = "zeros of the joints that are found anew after each pause, as by homing, or are others from a row on"

    def __init__(self, begins: Tensor | None = None) -> None:
        """begins: of each session but the first, since the first row [s]; None = those of the rows given."""
        self.begins = begins

    def of(self, situation: Situation) -> Homing:
        """The same with the sessions of these rows, also on others."""
        return Homing(self._begins(situation))

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Time, or the order of the rows."""
        return "" if "time" in covariates or ROW in covariates else "the time of each row: time[s]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """One a joint and session; without pauses one a joint."""
        zeros = JointOffset().coefficients(situation)
        count = len(self._begins(situation))
        names = [f"session {k + 1}" for k in range(count + 1)] if count else ["from then on"]
        return tuple(replace(zero, name=f"{zero.name} {name}") for zero in zeros for name in names)

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """From when on the zeros are others; () where pauses tell."""
        if len(self._begins(situation)):
            return ()
        whole = max(float(_passed(situation).max()), 1e-6)
        unit = "s" if "time" in situation.covariates else ""
        begins = tuple(whole * k / _ZERO_BEGINS for k in range(1, _ZERO_BEGINS))
        return (Shape("begin", unit, begins, moments=_moments(situation)[1:]),)

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x n x (n · sessions)`."""
        begins, joints = self._begins(situation), situation.joints.shape[-1]
        time = _passed(situation).expand(situation.joints.shape[:-1])
        after = time.unsqueeze(-1) >= (begins if len(begins) else shape).unsqueeze(-2)
        if len(begins):
            after = torch.nn.functional.one_hot(after.sum(-1), len(begins) + 1)
        return by_joint(after.to(time.dtype).unsqueeze(-2).expand(*after.shape[:-1], joints, -1))

    def _begins(self, situation: Situation) -> Tensor:
        if self.begins is not None:
            return self.begins
        if "time" not in situation.covariates:
            return situation.joints.new_zeros(0)
        time = torch.unique(_passed(situation))
        steps = time.diff()
        usual = float(steps.median()) if len(steps) else 0.0
        begins: Tensor = time[1:][steps > max(_USUAL_STEPS * usual, _PAUSE)]
        most = situation.joints.shape[-2] // _SESSION_ROWS
        return begins if len(begins) <= most else begins[:0]


ROW = "row"
"""Stands for the time where that is no input, for the measuring frame alone: time since the first row of the file [s],
or the number of the row in the order measured."""
_FRAME_SCALE = 1e-4
_BEGINS = 20
# Time constants as shares of the whole time: a step, settling, and what is nearly a line (to 0.4 % of it).
_SETTLINGS = (0.0, 0.02, 0.06, 0.15, 0.4, 1.0, 30.0)


class FrameDrift(Effect):
    """Δposition = g(t) (d + ω x (position - middle of the workspace)), Δrotation = g(t) ω, in the base frame.

    g goes from 0 at the time t₀ to 1 at the last row, as 1 - exp(-(t - t₀) / r): with r = 0 a step at t₀ (somebody
    touched the stand), with r far beyond the time of all rows a line (it creeps), between them what settles (it warms
    up). t since the first row; without a column of times its number.
    """

    name = "frame_drift"
    kind = "pose"
    description = "a measuring frame that moves in time: steadily, settling, or in a step"

    def missing(self, mechanism: Mechanism, covariates: Sequence[str]) -> str:
        """Time."""
        return "" if "time" in covariates or ROW in covariates else "the time of each row: time[s]"

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """How far the frame is gone at the last row; as many of shift and turn as the pose shows."""
        return tuple(Coefficient(*TWIST[k], _FRAME_SCALE) for k in shown_columns(situation, frame_columns))

    def shapes(self, situation: Situation) -> tuple[Shape, ...]:
        """When it begins and how fast it settles."""
        whole = max(float(_passed(situation).max()), 1e-6)
        unit = "s" if "time" in situation.covariates else ""
        begins = tuple(whole * k / _BEGINS for k in range(_BEGINS))
        settlings = tuple(whole * share for share in _SETTLINGS)
        return (
            Shape("begin", unit, begins, usual=0.0, moments=_moments(situation)[:-1]),
            Shape("settling", unit, settlings, usual=settlings[-1]),
        )

    def basis(self, situation: Situation, shape: Tensor) -> Tensor:
        """`... x s x c x m`."""
        return situation.once(self.fixed_columns) * self.column_factors(situation, shape).unsqueeze(-2)

    def fixed_columns(self, situation: Situation) -> Tensor:
        """Of the columns what does not depend on the shapes, `... x s x c x m`, to be times `column_factors`."""
        return frame_columns(situation)[..., shown_columns(situation, frame_columns)]

    def column_factors(self, situation: Situation, shape: Tensor) -> Tensor:
        """How much of the way the frame is gone, `... x s x m`, the same in all columns."""
        passed = _passed(situation).expand(situation.joints.shape[:-1])
        begin, rate = (shape[..., k, None] for k in (0, 1))
        rate = rate.clamp_min(1e-9 * float(passed.max().clamp_min(1e-6)))
        since = passed - begin
        gone = -torch.expm1(-since.clamp_min(0.0) / rate)
        whole = -torch.expm1(-(passed.amax(-1, keepdim=True) - begin).clamp_min(1e-300) / rate)
        share = (gone / whole).unsqueeze(-1)
        return share.expand(*share.shape[:-1], len(self.coefficients(situation)))


def _moments(situation: Situation) -> tuple[float, ...]:
    """All times of rows, as of `_passed`, ascending."""
    return tuple(torch.unique(_passed(situation)).tolist())


def _passed(situation: Situation) -> Tensor:
    """Time since the first row, or rows since, `... x s`."""
    return elapsed(situation.covariates["time"]) if "time" in situation.covariates else situation.covariates[ROW]
