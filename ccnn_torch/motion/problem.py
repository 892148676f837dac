"""The residual of many models at once: measured less simulated positions, whitened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.motion.axis import Drive, simulate_axes
from ccnn_torch.motion.effects.own_parameter import OWN
from ccnn_torch.motion.library import Library
from ccnn_torch.motion.stretches import Stretches

# Of an axis that ran away: no residual is larger, in units of the motion.
_FARTHEST = 10.0
_FOLDS = 5
# Share to which the values of a nominal model are known (standard deviation), and those that are.
_KNOWN = 0.03
_WEIGHT = ("gravity_sin", "gravity_cos")
_LOOSE = (*_WEIGHT, "gain", "inertia", "viscous", "coulomb", "load_friction", "stribeck", "weakness", "delay")


class Whitening(NamedTuple):
    """An autoregressive model of each axis' residual: e_t = r_t - sum_k a_k r_(t-k), `n x order`."""

    coefficients: Tensor

    def __call__(self, residual: Tensor) -> Tensor:
        """`n x ... x s`, of the same shape; the first samples, which lack some before them, are as they are."""
        white = residual.clone()
        shape = [-1] + [1] * (residual.dim() - 1)
        for k in range(1, self.coefficients.shape[1] + 1):
            white[..., k:] -= self.coefficients[:, k - 1].reshape(shape) * residual[..., :-k]
        return white


def white_noise(axes: int) -> Whitening:
    """No correlation."""
    return Whitening(torch.zeros(axes, 0, dtype=torch.float64))


@dataclass(frozen=True)
class Problem:
    """Stretches of logs, the library for their axes, and the nominal positions that the axes are commanded by.

    Attributes:
        data: `n` joints, `b` stretches, `s` samples.
        library: effects.
        followed: what the axes follow, `n x b x s`: the commands, or what a simulator makes of them.
        torque, simulated: as of `Driven`.
        supply, warm: as of `Drive`, `b x s`.
        own: what a unit of each of a simulator's own parameters changes in its positions, by name, `n x b x s`.
        pool: so many samples are averaged before they are judged: what is faster than the motion is noise.
    """

    data: Stretches
    library: Library
    followed: Tensor
    supply: Tensor
    warm: Tensor
    pool: int = 1
    torque: Tensor | None = None
    simulated: Tensor | None = None
    own: Mapping[str, Tensor] = field(default_factory=dict)

    def positions(self, theta: Tensor, chosen: Tensor | None = None) -> Tensor:
        """Simulated positions, `p x n x b x s`; theta: `p x n x k`; chosen: stretches, all when None."""
        data = self.data
        rows = torch.arange(len(data.time)) if chosen is None else chosen
        start = torch.stack([data.position[:, :, 0], data.speed[:, :, 0]], -1)
        moved = self._moved(theta, rows, start)
        return moved if self.simulated is None else moved + self._beyond[:, rows]

    @cached_property
    def _beyond(self) -> Tensor:
        """What a simulator makes of the commands less what its axes make of them, `n x b x s`."""
        assert self.simulated is not None
        begin, rows = self.simulated[..., :2], torch.arange(len(self.data.time))
        speed = begin.diff(dim=-1) / self.data.time[:, :2].diff(dim=-1)
        theta = torch.zeros(1, len(begin), self.library.size, dtype=torch.float64)
        return self.simulated - self._moved(theta, rows, torch.cat([begin[..., :1], speed], -1))[0]

    def pushed(self, theta: Tensor, torque: Tensor) -> Tensor:
        """Positions under torques that resist the motors, over the gain, one after the other.

        Args:
            theta: `n x k`.
            torque: `n x m x b x s` [rad or m].

        Returns:
            `n x m x b x s`.
        """
        n, m, b, s = torque.shape
        already = 0.0 if self.torque is None else self.torque[:, None]
        every = torque + already

        def many(values: Tensor) -> Tensor:
            return values.repeat(m, *[1] * (values.dim() - 1))

        # A stretch for every torque.
        data = self.data._replace(
            time=many(self.data.time),
            position=self.data.position.repeat(1, m, 1),
            speed=self.data.speed.repeat(1, m, 1),
        )
        wide = replace(
            self,
            data=data,
            followed=self.followed.repeat(1, m, 1),
            supply=many(self.supply),
            warm=many(self.warm),
            torque=every.reshape(n, m * b, s),
            simulated=None,
            own={name: v.repeat(1, m, 1) for name, v in self.own.items()},
        )
        moved = wide.positions(theta[None])[0].reshape(n, m, b, s)
        return moved if self.simulated is None else moved + self._beyond[:, None]

    def loose(self, theta: Tensor) -> Tensor:
        """What the positions change by when a nominal parameter is off by what it is known to, `k x n x b x s`.

        About `theta`, `n x k`, the machine as it seems to be: a model that is wrong may be near to its stability.
        """
        n, rows, nominal = len(self.followed), torch.arange(len(self.data.time)), self.library.nominal
        start = torch.stack([self.data.position[:, :, 0], self.data.speed[:, :, 0]], -1)
        plain, columns = self._moved(theta[None], rows, start), [theta.new_zeros(0, *self.followed.shape)]
        absent = torch.zeros(n, dtype=torch.float64)
        weight = torch.hypot(*(nominal.get(name, absent) for name in _WEIGHT))
        sizes = {"gain": torch.ones_like(absent), **nominal, **dict.fromkeys(_WEIGHT, weight)}
        for name, size in sizes.items() if nominal else ():
            if name in _LOOSE and bool((size != 0).any()):
                before = nominal.get(name, sizes["gain"] if name == "gain" else absent)
                other = self.library._replace(nominal={**nominal, name: before + _KNOWN * size})
                columns.append(replace(self, library=other)._moved(theta[None], rows, start) - plain)
        return torch.cat(columns)

    def _moved(self, theta: Tensor, rows: Tensor, start: Tensor) -> Tensor:
        data, n, b = self.data, len(self.followed), len(rows)
        time = data.time[rows].expand(n, -1, -1).reshape(n * b, -1)
        drive = Drive(
            time,
            self.followed[:, rows].reshape(n * b, -1),
            start[:, rows].reshape(n * b, 2),
            self.supply[rows].expand(n, -1, -1).reshape(n * b, -1),
            self.warm[rows].expand(n, -1, -1).reshape(n * b, -1),
            None if self.torque is None else self.torque[:, rows].reshape(n * b, -1),
        )
        parameters = self.library.parameters(theta)
        own = {name: parameters.pop(f"{OWN}{name}", None) for name in self.own}
        values = {
            name: value[..., None].expand(*value.shape, b).reshape(len(theta), n * b)
            for name, value in parameters.items()
        }
        moved = simulate_axes(drive, values).reshape(-1, n, b, time.shape[-1])
        for name, value in own.items():
            if value is not None:
                moved = moved + value[..., None, None] * self.own[name][:, rows]
        return moved.expand(len(theta), -1, -1, -1)

    def residual(self, theta: Tensor, chosen: Tensor | None = None) -> Tensor:
        """Measured less simulated, `p x n x b x s` [rad or m]; finite."""
        measured = self.data.position if chosen is None else self.data.position[:, chosen]
        far = _FARTHEST * (measured.amax((-1, -2)) - measured.amin((-1, -2)))[:, None, None] + 1e-12
        left = measured - self.positions(theta, chosen)
        return torch.maximum(torch.minimum(torch.nan_to_num(left, nan=torch.inf), far), -far)

    def pooled(self, residual: Tensor) -> Tensor:
        """Means over `pool` samples each, `... x s` -> `... x t`."""
        m = self.pool
        kept = residual[..., : residual.shape[-1] // m * m]
        return kept.reshape(*kept.shape[:-1], kept.shape[-1] // m, m).mean(-1)

    @cached_property
    def fold(self) -> Tensor:
        """Fold of each stretch, `b`: whole runs, dealt out in order; parts of the run where there is one alone."""
        run, count = self.data.run, len(self.data.run)
        runs = torch.tensor(sorted(set(run.tolist())))
        if len(runs) < 2:
            return torch.arange(count) * min(_FOLDS, count) // count
        return (torch.arange(len(runs)) % min(_FOLDS, len(runs)))[torch.searchsorted(runs, run)]

    @property
    def judged(self) -> Tensor:
        """Which of the means count, `b x t`."""
        return self.pooled(self.data.judged.double()) == 1

    def whitened(self, residual: Tensor, whitening: Whitening, chosen: Tensor | None = None) -> Tensor:
        """Whitened means of the residuals, `n x p x (b t)`; 0 where they do not count."""
        judged = self.judged if chosen is None else self.judged[chosen]
        return (whitening(self.pooled(residual).transpose(0, 1)) * judged).flatten(2)
