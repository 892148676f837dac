"""What something outside the library follows: smooth functions of speed, position, time and the like, added to the
simulated position, or a torque that the axis moves under."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.stretches import direction

# Knots of a cubic spline: at quantiles of a driver, and evenly spaced ones of a position and of the time.
_KNOTS, _EVENLY = 7, 9
# Time constants of what fades after a reversal [s].
_FADING = (0.03, 0.1, 0.3)
# Changes of the temperature below this show nothing [K].
_WARMER = 5.0
# Share of the motion from which the lead of the command over the position is a torque.
_LOADED = 1e-4
# Quantiles between which the knots lie.
_ENDS = (0.02, 0.98)
# Share of the motion by which a torque moves the axis for its columns, and how far the columns reach.
_STEP, _SIZE = 1e-3, 0.05


class Driver(NamedTuple):
    """A driver, what makes its columns `m x b x s` in plausible sizes [rad or m], and whether they are torques over the
    gain or added to the positions."""

    name: str
    columns: Callable[[], Tensor]
    is_torque: bool


def drivers_of(problem: Problem, axis: int, moved: Tensor) -> list[Driver]:
    """Each driver on a motion of an axis, `b x s`, torques last; columns of what does not vary are 0."""
    data = problem.data
    place, fast = data.position[axis], data.speed[axis]
    speed = _slope(moved, data.time)
    error = problem.driven.followed[axis] - moved
    # An axis that follows exactly has no torque, and what rounding leaves of it has the sign of the speed.
    span = place.max() - place.min()
    loaded = error.abs().max() > _LOADED * span
    sign = direction(speed, speed.abs().mean())

    def of_speed(count: int | None = None) -> Tensor:
        return _smooth(speed, fast, data.judged, count)

    def of_place(count: int = _EVENLY) -> Tensor:
        return _smooth(moved, place, data.judged, count)

    direct = {
        "speed": of_speed,
        "acceleration": lambda: _smooth(_slope(speed, data.time), None, data.judged),
        "reversal": lambda: _fading(speed, data.time),
        "position": of_place,
        "torque": lambda: _smooth(error, None, data.judged) * loaded,
        # A constant of its own: what drifts begins somewhere.
        "time": lambda: torch.cat([torch.ones_like(moved)[None], _over_time(problem)]),
    }
    # Friction comes and goes with the place, the time and the temperature as well; what is as smooth as a cubic is told
    # by fewer numbers.
    pushed = [("speed", of_speed), ("position", of_place), ("position", lambda: of_place() * sign)]
    pushed += [("speed", lambda: of_speed(2)), ("position", lambda: of_place(2))]
    pushed.append(("time", lambda: _over_time(problem) * sign))
    warmest = problem.driven.warm.abs().max()
    if float(warmest) >= _WARMER:
        warm = (problem.driven.warm / warmest).expand_as(moved)[None]
        direct["temperature"] = lambda: warm
        pushed.append(("temperature", lambda: warm * sign))

    def sized(made: Callable[[], Tensor]) -> Callable[[], Tensor]:
        return lambda: _SIZE * span * made()

    both = [*((name, made, False) for name, made in direct.items()), *((name, made, True) for name, made in pushed)]
    return [Driver(name, sized(made), is_torque) for name, made, is_torque in both]


def done(problem: Problem, theta: Tensor, axis: int, moved: Tensor, torques: Tensor) -> Tensor:
    """What torques `m x b x s` of plausible size do to the positions `moved`, `b x s`, of an axis with numbers `theta`,
    `m x b x s`."""
    every = (torques * (_STEP / _SIZE)).expand(len(problem.axes), *torques.shape)
    return (problem.pushed(theta[None], torch.tensor([axis]), every)[0] - moved) * (_SIZE / _STEP)


def _slope(values: Tensor, time: Tensor) -> Tensor:
    """Between the neighbours of each sample, `b x s`."""
    slope = (values[:, 2:] - values[:, :-2]) / (time[:, 2:] - time[:, :-2]).clamp_min(1e-9)
    return torch.cat([slope[:, :1], slope, slope[:, -1:]], -1)


def _smooth(values: Tensor, like: Tensor | None, judged: Tensor, count: int | None = None) -> Tensor:
    """Cubic B-splines of values `b x s`, `m x b x s`, with so many evenly spaced knots, or at quantiles, of what is
    measured of them."""
    share = torch.linspace(*((*_ENDS, _KNOTS) if count is None else (0, 1, count)), dtype=values.dtype)
    some = (values if like is None else like)[judged]
    even = some.min() + share * (some.max() - some.min())
    knots = torch.unique(torch.quantile(some, share) if count is None else even).numpy()
    found = values.new_zeros(len(share) + 2, *values.shape)
    if len(knots) > 1:
        ends = np.concatenate([knots[:1].repeat(3), knots, knots[-1:].repeat(3)])
        columns = BSpline.design_matrix(values.flatten().numpy().clip(knots[0], knots[-1]), ends, 3).toarray()
        found[: columns.shape[1]] = torch.from_numpy(columns.T).reshape(-1, *values.shape)
    return found


def _fading(speed: Tensor, time: Tensor) -> Tensor:
    """What jumps with the sign of the speed at a reversal and fades, `m x b x s`."""
    sign = torch.sign(speed)
    turned = torch.zeros_like(sign)
    turned[:, 1:] = 0.5 * sign.diff(dim=-1)
    fall = torch.exp(-time.diff(dim=-1) / torch.tensor(_FADING, dtype=time.dtype)[:, None, None])
    columns = turned.repeat(len(_FADING), 1, 1)
    for k in range(1, sign.shape[-1]):
        columns[..., k] += columns[..., k - 1] * fall[..., k - 1]
    return columns


def _over_time(problem: Problem) -> Tensor:
    """Smooth functions of the time in each run, `m x b x s`."""
    data = problem.data
    share = torch.zeros_like(data.time)
    for run in sorted(set(data.run.tolist())):
        mine = data.run == run
        ends = data.time[mine][data.judged[mine]]
        share[mine] = ((data.time[mine] - ends.min()) / (ends.max() - ends.min()).clamp_min(1e-9)).clamp(0, 1)
    return _smooth(share, None, data.judged, _EVENLY)
