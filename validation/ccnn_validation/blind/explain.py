"""The best explanation of a sealed case by the effects library: how much of the true gap each name leaves.

This is the judge's side. It sees the true poses, without noise, and fits the library's effects to them in the true
kinematics; the blind machines themselves do not know the library.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ccnn_torch.effects import EFFECTS, Acting, Effect, Situation, default_gravity, make_effect, reached, signature
from ccnn_torch.effects.apply import pose_residual
from ccnn_torch.numerics.least_squares import jacobian_of
from ccnn_torch.numerics.rotations import matrix_to_rotation_vector, rotation_vector_to_matrix
from ccnn_validation.blind.case import BlindCase

__all__ = ["AS_WELL", "Explained", "Judge"]

AS_WELL = 6.0
"""Squares in units of the noise that one explanation may leave more than another: odds of twenty to one."""
_SHARE = 0.1
"""Of the gap's squares, at most, that an explanation may leave: columns under an angle of cosine 0.95."""
_FREE = 1e3
"""Prior scale of the coefficients in units of what is plausible: it only keeps the fit regular."""
_STEPS = 3
_FAR = 3.0
"""Rows in which the joints move the platform so many times as far as usual are not described by first-order columns:
they are left out."""
_SWEEPS, _REFINEMENTS = 3, 3
_CHUNK = 16


@dataclass(frozen=True)
class Explained:
    """What a set of effects leaves of the true gap.

    Attributes:
        left: sum of the squares of what is left, in units of the noise.
        coefficients: how many of them these rows determine.
        before, after: squares of the position error of each row, `s` [m²].
    """

    left: float
    coefficients: float
    before: Tensor
    after: Tensor

    def shrink(self, set_aside: Sequence[int] = ()) -> float:
        """Share of the mean squared position error that it takes away, over the rows that were not set aside."""
        kept = torch.ones(len(self.before), dtype=torch.bool)
        kept[list(set_aside)] = False
        before, after = float(self.before[kept].sum()), float(self.after[kept].sum())
        return 1 - after / before if before > 0 else 0.0


class Judge:
    """One opened case before the effects library."""

    def __init__(self, case: BlindCase) -> None:
        """Take the case; nothing is fitted yet."""
        mechanism = case.machine.mechanism
        covariates = {c.name: values for c, values in case.columns.items()}
        self._case = case
        self._situation = Situation(mechanism, case.joints, covariates, default_gravity(mechanism), None, case.pose)
        self._gap = pose_residual(self._situation, case.true)
        self._shapes: dict[str, Tensor] = {}
        self._known: dict[tuple[str, ...], Explained] = {}
        self.names = tuple(n for n in EFFECTS if not make_effect(n).missing(mechanism, list(covariates)))

    @property
    def numbers(self) -> int:
        """Number of measured values: rows times pose coordinates."""
        return int(self._regular.sum()) * self._case.true.shape[-1]

    @cached_property
    def total(self) -> float:
        """Squares of the whole gap in units of the noise."""
        return float(self._white(self._gap).square().sum())

    def explained(self, names: Sequence[str]) -> Explained:
        """What these effects leave, fitted together through the true kinematics; unknown names explain nothing."""
        key = tuple(sorted(set(names) & set(self.names)))
        if key not in self._known:
            self._known[key] = self._fit([make_effect(n) for n in key])
        return self._known[key]

    def as_well(self, names: Sequence[str], than: Sequence[str]) -> bool:
        """Whether these rows cannot distinguish the names from others: the residuals are equal to within the noise.

        An explanation with fewer coefficients may leave more: as much as the others' freedom costs (Schwarz 1978), but
        never more than a tenth of the gap.
        """
        here, there = self.explained(names), self.explained(than)
        spared = max(0.0, there.coefficients - here.coefficients) * math.log(self.numbers)
        if here.left <= there.left + AS_WELL:
            return True
        return here.left <= there.left + AS_WELL + spared and here.left <= _SHARE * self.total

    def members(self, names: Sequence[str]) -> list[str]:
        """Single names that explain the gap as well as `names` do."""
        return [name for name in self.names if self.as_well([name], names)]

    @cached_property
    def _channels(self) -> Tensor:
        """From channels (position, rotation vector) to pose coordinates in units of their noise, `s x p x c`."""
        case, mechanism = self._case, self._situation.mechanism
        if case.machine.orientation:
            return torch.diag(1 / case.sd).expand(len(case.pose), -1, -1)

        def flat(pose: Tensor) -> Tensor:
            return _difference(mechanism.frame(pose), mechanism.frame(case.pose))

        inverse: Tensor = torch.linalg.pinv(jacobian_of(flat, case.pose)[1])
        return inverse / case.sd[:, None]

    @cached_property
    def _regular(self) -> Tensor:
        """Rows that count, `s`; by the true machine's own measure of how near singular they are."""
        weight = torch.tensor([1.0, 1.0, 1.0, 0.3, 0.3, 0.3], dtype=torch.float64)
        jacobian = torch.nan_to_num(self._situation.jacobian)
        size = torch.linalg.matrix_norm(jacobian * weight[: jacobian.shape[-2], None], 2)
        kept: Tensor = size <= _FAR * size.median()
        return kept.double()

    def _white(self, channels: Tensor) -> Tensor:
        """Channels `s x c x …` as pose coordinates in units of their noise, flat: `sp x …`."""
        wide = channels.flatten(2) if channels.dim() > 2 else channels[..., None]
        return (self._regular[:, None, None] * (self._channels @ wide)).flatten(0, 1).reshape(-1, *channels.shape[2:])

    def _columns(self, effect: Effect, shape: Tensor) -> Tensor:
        """Signatures at several shapes `g x h`, in units of the noise per `_FREE` plausible sizes, `g x sp x m`."""
        scale = torch.tensor([c.scale for c in effect.coefficients(self._situation)], dtype=torch.float64) * _FREE
        raw = signature(self._situation, effect, shape)
        raw = torch.nan_to_num(raw).expand(len(shape), *raw.shape[-3:])
        return (self._regular[:, None, None] * (self._channels @ raw)).flatten(1, 2) * scale

    def _fit(self, effects: Sequence[Effect]) -> Explained:
        """Shapes first, one after the other, then the coefficients in the true kinematics."""
        values = [self._shapes.get(e.name, _middle(e, self._situation)) for e in effects]
        y = self._white(self._gap)
        several = len(effects) > 1 or any(len(v) > 1 for v in values)
        for _ in range(_SWEEPS if several else 1):
            before = [value.clone() for value in values]
            for i, effect in enumerate(effects):
                others = [
                    self._columns(e, v[None])[0] for j, (e, v) in enumerate(zip(effects, values, strict=True)) if j != i
                ]
                fixed = torch.cat([y.new_zeros(len(y), 0), *others], dim=-1)
                values[i] = self._best_shape(effect, values[i], y, fixed)
            if all(torch.allclose(v, b, rtol=1e-3) for v, b in zip(values, before, strict=True)):
                break
        if len(effects) == 1:
            self._shapes[effects[0].name] = values[0]
        z = torch.cat(
            [y.new_zeros(len(y), 0), *(self._columns(e, v[None])[0] for e, v in zip(effects, values, strict=True))], -1
        )
        gram = z.mT @ z
        ridge = gram + torch.eye(len(gram), dtype=torch.float64)
        found, off = y.new_zeros(z.shape[1]), self._gap
        for _ in range(_STEPS):
            found = found + torch.linalg.solve(ridge, z.mT @ self._white(off))
            off = self._remaining(effects, values, found)
        left = self._white(off)
        free = float(torch.linalg.solve(ridge, gram).trace()) if len(gram) else 0.0
        return Explained(float(left.square().sum()), free, *(d[:, :3].square().sum(-1) for d in (self._gap, off)))

    def _remaining(self, effects: Sequence[Effect], values: Sequence[Tensor], found: Tensor) -> Tensor:
        """True pose less the one that the effects reach, as channels `s x c`."""
        acting, first = [], 0
        for effect, value in zip(effects, values, strict=True):
            known = effect.coefficients(self._situation)
            scale = torch.tensor([c.scale for c in known], dtype=torch.float64) * _FREE
            acting.append(Acting(effect, value, found[first : first + len(known)] * scale))
            first += len(known)
        there = reached(self._situation, acting)
        turned = rotation_vector_to_matrix(there[..., 3:]) if there.shape[-1] == 6 else None
        return _difference(self._situation.mechanism.frame(self._case.true), (there[..., :3], turned))

    def _best_shape(self, effect: Effect, value: Tensor, y: Tensor, fixed: Tensor) -> Tensor:
        """Shapes that leave least of `y` beside fixed columns, `h`: over each one's grid, then between neighbours."""
        for h, shape in enumerate(effect.shapes(self._situation)):
            own = self._columns(effect, value[None])[0]
            moving = list(range(own.shape[1]) if shape.columns is None else shape.columns)
            still = [m for m in range(own.shape[1]) if m not in moving]
            aside = torch.linalg.qr(torch.cat([fixed, own[:, still]], -1))[0] if fixed.shape[1] + len(still) else None
            grid = torch.tensor(shape.grid, dtype=torch.float64)
            for _ in range(1 + _REFINEMENTS):
                tried = value.expand(len(grid), -1).clone()
                tried[:, h] = grid
                gains = torch.cat([self._gain(effect, t, moving, y, aside) for t in torch.split(tried, _CHUNK)])
                best = int(gains.argmax())
                value = tried[best]
                low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
                grid = low + (high - low) * torch.linspace(0, 1, 9, dtype=torch.float64)
        return value

    def _gain(self, effect: Effect, tried: Tensor, moving: list[int], y: Tensor, aside: Tensor | None) -> Tensor:
        """Squares of `y` that the moving columns explain at each shape tried, beside those set aside; `g`."""
        z = self._columns(effect, tried)[..., moving]
        rest = y
        if aside is not None:
            z, rest = z - aside @ (aside.mT @ z), y - aside @ (aside.mT @ y)
        right = z.mT @ rest
        ridge = z.mT @ z + torch.eye(z.shape[-1], dtype=torch.float64)
        explained: Tensor = (right * torch.linalg.solve(ridge, right)).sum(-1)
        return explained


def _middle(effect: Effect, situation: Situation) -> Tensor:
    return torch.tensor([s.grid[len(s.grid) // 2] for s in effect.shapes(situation)], dtype=torch.float64)


def _difference(there: tuple[Tensor, Tensor | None], here: tuple[Tensor, Tensor | None]) -> Tensor:
    """Channels from one frame to another, `… x c`: position [m] and rotation vector [rad] in the base frame."""
    position = there[0] - here[0]
    if there[1] is None or here[1] is None:
        return position
    return torch.cat([position, matrix_to_rotation_vector(there[1] @ here[1].mT)], dim=-1)
