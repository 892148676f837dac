"""What a residual may follow that no effect describes: speed, acceleration, reversal, position, torque, time and
temperature.

Each is a group of columns that are added to the simulated position, or a torque that the axis moves under. Where one of
them is part of the most probable set, the cause is outside the library, and its driver says where to look.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.motion.problem import Problem
from ccnn_torch.motion.spec import Spec

# Knots of a piecewise linear function: at quantiles of a driver, and evenly spaced ones of a position and of the time.
_KNOTS, _EVENLY = 7, 9
# Time constants of what fades after a reversal [s].
_FADING = (0.03, 0.1, 0.3)
# Share of the mean speed at which a direction is settled.
_SOFT = 0.1
# Changes of the temperature below this show nothing [K].
_WARMER = 5.0
# Share of the motion from which the lead of the command over the position is a torque.
_LOADED = 1e-4
# Quantiles between which the knots lie.
_ENDS = (0.02, 0.98)
# Share of the motion by which a torque moves the axis for its columns, and how far the columns reach.
_STEP, _SIZE = 1e-3, 0.05


class Driver(NamedTuple):
    """A driver and its columns in plausible sizes [rad or m], `n x m x b x s`."""

    name: str
    columns: Tensor


def driver_columns(problem: Problem, specs: list[Spec]) -> list[Driver]:
    """Columns of each driver, and those of a torque that follows it; drivers that do not vary are left out.

    Args:
        problem: the data.
        specs: of each axis the set whose motion tells speed, acceleration and torque.
    """
    data = problem.data
    theta = torch.stack([spec.theta for spec in specs])
    moved = problem.positions(theta, problem.axes)
    step = data.time.diff(dim=-1).clamp_min(1e-9)
    speed = _slope(moved, step)
    acceleration = _slope(speed, step)
    error = problem.followed - moved
    # An axis that follows exactly has no torque, and what rounding leaves of it has the sign of the speed.
    span = (data.position.amax((-1, -2)) - data.position.amin((-1, -2)))[:, None, None, None]
    loaded = error.abs().amax((-1, -2))[:, None, None, None] > _LOADED * span
    place, over = _evenly(moved, data.judged), _over_time(problem)
    sign = _direction(speed)[:, None]
    fast = _hats(speed, data.judged)
    direct = {
        "speed": fast,
        "acceleration": _hats(acceleration, data.judged),
        "reversal": _fading(speed, data.time),
        "position": place,
        "torque": _hats(error, data.judged) * loaded,
        # A constant of its own: what drifts begins somewhere.
        "time": torch.cat([torch.ones_like(over[:, :1]), over], 1),
    }
    # Friction comes and goes with the place, the time and the temperature as well.
    pushed = [("speed", fast), ("position", place), ("position", place * sign), ("time", over * sign)]
    if float(problem.warm.abs().max()) >= _WARMER:
        warm = (problem.warm / problem.warm.abs().max()).expand(len(moved), -1, -1)[:, None]
        pushed.append(("temperature", warm * sign))
        direct["temperature"] = warm
    found = [Driver(name, _SIZE * span * columns) for name, columns in direct.items()]
    under = problem.pushed(theta, torch.cat([_STEP * span * columns for _, columns in pushed], 1))
    columns = (under - moved[:, None]) * (_SIZE / _STEP)
    widths = [c.shape[1] for _, c in pushed]
    return found + [Driver(n, c) for (n, _), c in zip(pushed, torch.split(columns, widths, 1), strict=True)]


def _direction(speed: Tensor) -> Tensor:
    """The sign of the speed, soft near standstill."""
    size = speed.abs().mean((-1, -2), keepdim=True)
    return torch.tanh(speed / (_SOFT * size).clamp_min(1e-12))


def _slope(values: Tensor, step: Tensor) -> Tensor:
    slope = values.diff(dim=-1) / step
    return torch.cat([slope[..., :1], slope], -1)


def _hats(driver: Tensor, judged: Tensor) -> Tensor:
    """Piecewise linear functions with their knots at quantiles, `n x m x b x s`."""
    found = []
    for one in driver:
        some = one[judged][:: max(int(judged.sum()) // 10_000, 1)]
        knots = torch.unique(torch.quantile(some, torch.linspace(*_ENDS, _KNOTS, dtype=one.dtype)))
        if len(knots) < 3:
            found.append(torch.zeros(_KNOTS, *one.shape, dtype=one.dtype))
            continue
        place = (torch.searchsorted(knots, one.contiguous()) - 1).clamp(0, len(knots) - 2)
        share = ((one - knots[place]) / (knots[place + 1] - knots[place])).clamp(0, 1)
        hats = torch.zeros(_KNOTS, *one.shape, dtype=one.dtype)
        hats.scatter_(0, place[None], (1 - share)[None])
        hats.scatter_(0, place[None] + 1, share[None])
        found.append(hats)
    return torch.stack(found)


def _evenly(driver: Tensor, judged: Tensor) -> Tensor:
    """Piecewise linear functions with evenly spaced knots, `n x m x b x s`."""
    low = torch.stack([one[judged].min() for one in driver])[:, None, None]
    high = torch.stack([one[judged].max() for one in driver])[:, None, None]
    return _tents((driver - low) / (high - low).clamp_min(1e-12))


def _tents(share: Tensor) -> Tensor:
    """Of a driver from 0 to 1, `n x b x s`."""
    knots = torch.linspace(0, 1, _EVENLY, dtype=share.dtype)[:, None, None]
    return (1 - (share[:, None] - knots).abs() * (_EVENLY - 1)).clamp_min(0)


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
    """Piecewise linear functions of the time in each run, `n x m x b x s`."""
    data = problem.data
    share = torch.zeros_like(data.time)
    for run in sorted(set(data.run.tolist())):
        mine = data.run == run
        ends = data.time[mine][data.judged[mine]]
        share[mine] = ((data.time[mine] - ends.min()) / (ends.max() - ends.min()).clamp_min(1e-9)).clamp(0, 1)
    return _tents(share[None]).expand(len(problem.followed), -1, -1, -1)
