"""What something outside the library follows: smooth functions of speed, position, time and the like, added to the
simulated position, or a torque that the axis moves under."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.spec import Spec
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
    """A driver, its columns `n x m x b x s` in plausible sizes [rad or m], and whether they are torques over the gain
    or added to the positions."""

    name: str
    columns: Tensor
    is_torque: bool


def driver_columns(problem: Problem, specs: list[Spec]) -> list[Driver]:
    """Columns of each driver; drivers that do not vary are left out.

    Args:
        problem: the data.
        specs: of each axis the set whose motion tells speed, acceleration and torque that positions follow.
    """
    data = problem.data
    theta = torch.stack([spec.theta for spec in specs])
    moved = problem.positions(theta, problem.axes)
    step = data.time.diff(dim=-1).clamp_min(1e-9)
    speed = _slope(moved, step)
    acceleration = _slope(speed, step)
    error = problem.driven.followed - moved
    # An axis that follows exactly has no torque, and what rounding leaves of it has the sign of the speed.
    span = (data.position.amax((-1, -2)) - data.position.amin((-1, -2)))[:, None, None, None]
    loaded = error.abs().amax((-1, -2))[:, None, None, None] > _LOADED * span
    over = _over_time(problem)
    direct = {
        "speed": _smooth(speed, data.judged),
        "acceleration": _smooth(acceleration, data.judged),
        "reversal": _fading(speed, data.time),
        "position": _smooth(moved, data.judged, True),
        "torque": _smooth(error, data.judged) * loaded,
        # A constant of its own: what drifts begins somewhere.
        "time": torch.cat([torch.ones_like(over[:, :1]), over], 1),
    }
    # A torque follows the motion that there is. What is as smooth as a cubic is told by fewer numbers; friction comes
    # and goes with the place, the time and the temperature as well.
    fast, place = _smooth(data.speed, data.judged), _smooth(data.position, data.judged, True)
    sign = direction(data.speed, data.speed.abs().mean((-1, -2), keepdim=True))[:, None]
    measured = ("speed", data.speed), ("position", data.position)
    pushed = [("speed", fast), ("position", place), ("position", place * sign), ("time", over * sign)]
    pushed += [(name, _smooth(values, data.judged, True, 2)) for name, values in measured]
    warmest = problem.driven.warm.abs().max()
    if float(warmest) >= _WARMER:
        warm = (problem.driven.warm / warmest).expand(len(moved), -1, -1)[:, None]
        pushed.append(("temperature", warm * sign))
        direct["temperature"] = warm
    both = [*((name, columns, False) for name, columns in direct.items()), *((n, c, True) for n, c in pushed)]
    return [Driver(name, _SIZE * span * columns, is_torque) for name, columns, is_torque in both]


def done(problem: Problem, drivers: Sequence[Driver], theta: Tensor, axis: Tensor) -> Tensor:
    """What drivers, those that are torques last, do to the positions of models `p x k` of the axes `p`,
    `p x m x b x s`."""
    direct = [d.columns[axis] for d in drivers if not d.is_torque]
    torque = torch.cat([d.columns for d in drivers if d.is_torque], 1) * (_STEP / _SIZE)
    under = problem.pushed(theta, axis, torque) - problem.positions(theta, axis)[:, None]
    return torch.cat([*direct, under * (_SIZE / _STEP)], 1)


def _slope(values: Tensor, step: Tensor) -> Tensor:
    slope = values.diff(dim=-1) / step
    return torch.cat([slope[..., :1], slope], -1)


def _smooth(driver: Tensor, judged: Tensor, is_even: bool = False, count: int = _EVENLY) -> Tensor:
    """Cubic B-splines, `n x m x b x s`, with their knots at quantiles, or so many evenly spaced ones."""
    share = torch.linspace(*((0, 1, count) if is_even else (*_ENDS, _KNOTS)), dtype=driver.dtype)
    found = driver.new_zeros(len(driver), len(share) + 2, *driver.shape[1:])
    for splines, one in zip(found, driver, strict=True):
        some = one[judged]
        even = some.min() + share * (some.max() - some.min())
        knots = torch.unique(even if is_even else torch.quantile(some, share)).numpy()
        if len(knots) > 1:
            ends = np.concatenate([knots[:1].repeat(3), knots, knots[-1:].repeat(3)])
            at = one.flatten().numpy().clip(knots[0], knots[-1])
            values = BSpline.design_matrix(at, ends, 3).toarray()
            splines[: values.shape[1]] = torch.from_numpy(values.T).reshape(-1, *one.shape)
    return found


def _fading(speed: Tensor, time: Tensor) -> Tensor:
    """What jumps with the sign of the speed at a reversal and fades, `n x m x b x s`."""
    sign = torch.sign(speed)
    turned = torch.zeros_like(sign)
    turned[..., 1:] = 0.5 * (sign[..., 1:] - sign[..., :-1])
    fall = torch.exp(-time.diff(dim=-1) / torch.tensor(_FADING, dtype=time.dtype)[:, None, None])
    columns = turned[:, None].repeat(1, len(_FADING), 1, 1)
    for k in range(1, sign.shape[-1]):
        columns[..., k] += columns[..., k - 1] * fall[..., k - 1]
    return columns


def _over_time(problem: Problem) -> Tensor:
    """Smooth functions of the time in each run, `n x m x b x s`."""
    data = problem.data
    share = torch.zeros_like(data.time)
    for run in sorted(set(data.run.tolist())):
        mine = data.run == run
        ends = data.time[mine][data.judged[mine]]
        share[mine] = ((data.time[mine] - ends.min()) / (ends.max() - ends.min()).clamp_min(1e-9)).clamp(0, 1)
    return _smooth(share[None], data.judged, True).expand(len(problem.axes), -1, -1, -1)
