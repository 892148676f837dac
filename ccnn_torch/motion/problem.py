"""The residual of many models at once: measured less simulated positions, whitened."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from ccnn_torch.evidence.shrink import FOLDS
from ccnn_torch.motion.axis import Drive, simulate_axes
from ccnn_torch.motion.effects.bodies import CARRIED
from ccnn_torch.motion.effects.registry import OWN
from ccnn_torch.motion.known import OF, TIME, share_of
from ccnn_torch.motion.library import Library
from ccnn_torch.motion.nominal import Driven
from ccnn_torch.motion.stage import ABSENT
from ccnn_torch.motion.stretches import Stretches
from ccnn_torch.motion.whiten import Whitening
from ccnn_torch.numerics.trees import below, mapped

# Of an axis that ran away: no residual is larger, in thousandths of the motion.
_FARTHEST = 1e4


@dataclass(frozen=True)
class Problem:
    """Stretches of logs, the library for their axes, and the nominal positions that the axes are commanded by.

    Attributes:
        data: `n` joints, `b` stretches, `s` samples.
        library: effects.
        driven: what drives the axes.
        unit: of whitened residuals, about a thousandth of the motion of each axis, so that no least number is one of
            rad or m; a power of two, which rounds nothing; `n` [rad or m].
        parted: whether folds are parts of the runs, where these could be folds.
        known: shares to which values of the nominal model and time stamps are known, as of `shares_of`.
        pool: so many samples are averaged before they are judged: what is faster than the motion is noise.
    """

    data: Stretches
    library: Library
    driven: Driven
    unit: Tensor
    pool: int = 1
    parted: bool = False
    known: Mapping[str, float] = field(default_factory=dict)

    @property
    def axes(self) -> Tensor:
        """The number of each axis, `n`."""
        return torch.arange(len(self.unit))

    def of(self, rows: Tensor) -> Problem:
        """The same of some stretches."""

        def some(values: Tensor) -> Tensor:
            return values.index_select(max(values.dim() - 2, 0), rows)

        return replace(self, data=mapped(some, self.data), driven=mapped(some, self.driven))

    @cached_property
    def _start(self) -> Tensor:
        data = self.data
        start = torch.stack([data.position[:, :, 0], data.speed[:, :, 0]], -1)
        return start if data.begin is None else torch.cat([start, data.begin], -1)

    def positions(self, theta: Tensor, axis: Tensor) -> Tensor:
        """Simulated positions of models of axes.

        Args:
            theta: numbers of each model, `p x k`.
            axis: which axis each is of, `p`.

        Returns:
            `p x b x s` [rad or m].
        """
        moved = self._moved(theta, axis)
        return moved if self.driven.simulated is None else moved + self._beyond[axis]

    @cached_property
    def _beyond(self) -> Tensor:
        """What a simulator makes of the commands less what its axes make of them, `n x b x s`."""
        simulated = self.driven.simulated
        assert simulated is not None
        speed = simulated[..., :2].diff(dim=-1) / self.data.time[:, :2].diff(dim=-1)
        start, there = torch.cat([simulated[..., :1], speed], -1), self.driven._replace(torque=self.driven.there)
        return simulated - replace(self, driven=there)._moved(self.nothing, self.axes, start)

    @property
    def nothing(self) -> Tensor:
        """Numbers of the nominal model of every axis, `n x k`."""
        return torch.zeros(len(self.unit), self.library.size, dtype=torch.float64)

    def under(self, axis: int, torque: Tensor) -> Problem:
        """The same with a torque that resists the motor of an axis, over the gain, `b x s` [rad or m]."""
        push = torch.zeros_like(self.driven.followed) if self.driven.torque is None else self.driven.torque.clone()
        push[axis] += torque
        return replace(self, data=self.data.under(push), driven=self.driven._replace(torque=push))

    def pushed(self, theta: Tensor, axis: Tensor, torque: Tensor) -> Tensor:
        """Positions under torques that resist the motors, over the gain, one after the other.

        Args:
            theta, axis: as of `positions`.
            torque: of every axis, `n x m x b x s` [rad or m].

        Returns:
            `p x m x b x s`.
        """
        n, m, b, s = torque.shape
        own = self.driven
        every = (torque if own.torque is None else torque + own.torque[:, None]).reshape(n, m * b, s)
        # A stretch, and a run, for every torque.
        wide = self.of(torch.arange(b).repeat(m))
        run = wide.data.run + (int(wide.data.run.max()) + 1) * torch.arange(m).repeat_interleave(b)
        data, driven = wide.data._replace(run=run), wide.driven._replace(torque=every)
        moved = replace(wide, data=data.under(every), driven=driven)._moved(theta, axis).reshape(-1, m, b, s)
        return moved if own.simulated is None else moved + self._beyond[axis][:, None]

    def nuisance(self, theta: Tensor) -> Tensor:
        """What the positions change by when a nominal parameter is off by what it is known to, `k x n x b x s`.

        About `theta`, `n x k`, the machine as it seems to be: a model that is wrong may be near to its stability.
        """
        nominal, absent = self.library.nominal, torch.zeros_like(self.unit)
        plain, columns = self._moved(theta, self.axes), []
        for key, share in self.unsure.items():
            # The direction of a weight is known as well as its size.
            size = torch.hypot(*(nominal.get(name, absent) for name in OF["mass"])) if key == "mass" else None
            for name in OF[key]:
                before = nominal.get(name, absent + ABSENT[name])
                moved = before + share * (before if size is None else size)
                other = self.library._replace(nominal={**nominal, name: moved})
                columns.append(replace(self, library=other)._moved(theta, self.axes) - plain)
        return torch.stack([*columns, self.stamped])

    @property
    def unsure(self) -> dict[str, float]:
        """Shares to which the values that the nominal model has are known, by key."""
        there = ["gain", *self.library.nominal] if self.library.nominal else []
        return {key: share_of(self.known, key) for key, own in OF.items() if any(name in there for name in own)}

    @property
    def stamped(self) -> Tensor:
        """What the positions change by when time stamps are off by what they are known to, `n x b x s`."""
        # Of the log itself, of which every so many samples are evaluated.
        rows = self.data.log
        there = (rows >= 0)[:, 1:]
        step = self.data.time.diff(dim=-1)[there] / rows.diff(dim=-1)[there]
        return share_of(self.known, TIME) * float(step.median()) * self.data.speed

    @cached_property
    def _drive(self) -> Drive:
        """All axes in all stretches, one axis after the other."""
        data, own = self.data, self.driven
        torque = None if own.torque is None else own.torque.flatten(0, 1)
        usual = data.time.diff(dim=-1).median(-1).values
        command, begin = own.followed.flatten(0, 1), self._start.flatten(0, 1)
        return Drive(data.time, command, begin, own.supply, own.warm, torque, data.bent, usual)

    def _moved(self, theta: Tensor, axis: Tensor, start: Tensor | None = None) -> Tensor:
        """As `positions`, without what a simulator adds; start: as of `Drive`, of every axis and stretch."""
        drive, which = self._drive, axis[:, None] * len(self.data.time) + torch.arange(len(self.data.time))
        if start is not None:
            drive = drive._replace(start=start.flatten(0, 1))
        parameters = self.library.parameters(theta, axis)
        own, mass, changed = below(parameters, OWN), parameters.get(CARRIED), dict[str, Tensor]()
        if mass is not None and self.driven.carried is not None:
            torque = mass[:, None, None] * self.driven.carried[axis]
            changed["torque"] = torque if self.driven.torque is None else torque + self.driven.torque[axis]
        if own and self.driven.own:
            changed["command"] = self._followed(torch.stack([own[name] for name in own], -1), [*own], axis)
        if changed:
            # Each model has runs of its own then; what all axes share is repeated for them.
            shared = ("time", "supply", "warm", "bent", "usual")
            each = {n: v[which.flatten()] for n, v in drive._asdict().items() if v is not None and n not in shared}
            drive = drive._replace(**each | {name: v.flatten(0, 1) for name, v in changed.items()})
            which = torch.arange(which.numel()).reshape(which.shape)
        return simulate_axes(drive, {name: value[:, None] for name, value in parameters.items()}, rows=which)

    def _followed(self, own: Tensor, names: Sequence[str], axis: Tensor) -> Tensor:
        """What axes are commanded by as a simulator's own parameters are moved, `p x k` of these names; `p x b x s`.

        What an axis does to a simulator's positions it does to what these change of them.
        """
        found = self.driven.followed.new_empty(len(axis), *self.driven.followed.shape[1:])
        makes = torch.stack([self.driven.own[name] for name in names], 1).flatten(2)
        for i in set(axis.tolist()):
            here = axis == i
            moved = self.driven.followed[i].flatten() + own[here] @ makes[i]
            found[here] = moved.reshape(-1, *found.shape[1:])
        return found

    def residual(self, theta: Tensor, axis: Tensor) -> Tensor:
        """Measured less simulated, as `positions`; finite."""
        return self.left_by(self.positions(theta, axis), axis)

    def left_by(self, moved: Tensor, axis: Tensor) -> Tensor:
        """Measured less simulated, `p x b x s`, of positions that were simulated; finite."""
        far, left = _FARTHEST * self.unit[axis, None, None], self.data.position[axis].sub_(moved)
        # What is no number is far away.
        return left.nan_to_num_(nan=math.inf).clamp_(-far, far)

    def pooled(self, residual: Tensor) -> Tensor:
        """Means over `pool` samples each, `... x s` -> `... x t`."""
        m = self.pool
        kept = residual[..., : residual.shape[-1] // m * m]
        found = kept[..., ::m].clone()
        for k in range(1, m):
            found += kept[..., k::m]
        return found.div_(m)

    @cached_property
    def fold(self) -> Tensor:
        """Fold of each stretch, `b`: whole runs, dealt out in order; parts of it where there is one alone."""
        run = self.data.run
        runs = torch.tensor(sorted(set(run.tolist())))
        if len(runs) < 2 or self.parted:
            return self.part
        return (torch.arange(len(runs)) % min(FOLDS, len(runs)))[torch.searchsorted(runs, run)]

    @cached_property
    def part(self) -> Tensor:
        """Folds that are a part of every run each, `b`."""
        run = self.data.run
        found = torch.zeros_like(run)
        for one in set(run.tolist()):
            count = int((run == one).sum())
            found[run == one] = torch.arange(count) * min(FOLDS, count) // count
        return found

    @cached_property
    def judged(self) -> Tensor:
        """Which of the means count, `b x t`."""
        return self.pooled(self.data.judged.double()) == 1

    @property
    def values(self) -> float:
        """How many of them count."""
        return float(self.judged.sum())

    def whitened(self, residual: Tensor, axis: Tensor, whitening: Whitening) -> Tensor:
        """Whitened means of residuals `p x b x s` of the axes `p` in `unit`, `p x (b t)`; 0 where they do not count."""
        return whitening(self.pooled(residual), axis).mul_(self.judged / self.unit[axis, None, None]).flatten(1)
