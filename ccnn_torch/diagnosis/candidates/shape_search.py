"""Search of shapes (periods, lags, rates) over their grids, with all other columns projected out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import default_shape, scales
from ccnn_torch.diagnosis.candidates.nuisance import (
    FINE,
    ROUNDS,
    NuisanceFit,
    SharedColumns,
    TrialColumns,
    search_charge,
)
from ccnn_torch.diagnosis.residual.whitening import Whitening
from ccnn_torch.effects import Effect, Shape, Situation, signature

# Log odds, less than these being chance, for which values between those of the grid are evaluated.
_CHANCE = 5.0
# Values of the residual that the grids are evaluated on, for a start and then: so many or one in so many, whichever is
# more, but no more than the last.
_START, _THEN, _MOST = (900, 4), (1500, 2), 4800
# Values of a grid that explain so little less than the best may be meant, a few of them, where it is more than chance.
_AS_WELL, _FEW, _THERE = 20.0, 16, 100.0
# Peaks of a grid between whose neighbours values are evaluated: the four harmonics of a half, a third or a quarter of a
# frequency do nearly what those of the whole one do, and which is better shows only between the values of the grid,
# where peaks go on that are lower by no more than such a share.
_PEAKS, _AS_HIGH = 4, 0.02
# Shapes that share coefficients are searched together where that are no more values.
_TOGETHER = 300
# Times of rows near the best one that are tried in the end, for each row that was evaluated.
_MOMENTS = 16
# Log evidence for each coefficient whose shape is worth its search.
_PAYS = 1.5


class Shaped(NamedTuple):
    """Shapes found: `value` `h`; `used`, the coefficients whose shape is worth its charge (None = all); and `charge`,
    what looking for them costs in log odds: the logarithm of the share of the values evaluated that do as well, and
    nothing for those of the textbook."""

    value: Tensor
    used: tuple[int, ...] | None
    charge: float


@runtime_checkable
class _OneByOne(Protocol):
    """An effect on the joints with the content of `basis` without its zeros, for long grids."""

    def one_by_one(self, situation: Situation, shape: Tensor, rows: Tensor | None = None) -> Tensor: ...

    def of_motors(self, situation: Situation, shape: Tensor) -> Tensor: ...


@runtime_checkable
class _Factored(Protocol):
    """An effect on the pose whose `basis` is fixed columns, each times a number that depends on the shapes."""

    def fixed_columns(self, situation: Situation) -> Tensor: ...

    def column_factors(self, situation: Situation, shape: Tensor) -> Tensor: ...


class _Part(NamedTuple):
    """Shapes that share coefficients, and which those are; tied: whether the shapes have one value."""

    shapes: list[int]
    columns: list[int]
    tied: bool = False

    @property
    def one(self) -> bool:
        """Whether there is one value to be searched."""
        return self.tied or len(self.shapes) == 1


class _Turn(NamedTuple):
    """Candidates `g x h`, the columns of each part there, and those that a part uses: None = none this time."""

    candidates: Tensor
    columns: list[TrialColumns]
    tried: list[TrialColumns | None]


class SearchRows:
    """What is to be explained, and what else is there, on the rows that grids are evaluated on.

    Attributes:
        rows: evaluated, `t`; None = all.
        left: what the others leave there.
        times: how many values there are for each that is evaluated.
        rounds: how often values between the neighbours of the best are evaluated.
        every: whitened residual and columns of all rows.
    """

    def __init__(self, y: Tensor, others: Tensor, quick: bool = False) -> None:
        """y: whitened residual, `s x c`; others: whitened columns, in plausible sizes, `s x c x P`; quick:
        whether a start is enough."""
        drawn = torch.randperm(len(y), generator=torch.Generator().manual_seed(0))
        fewest, share = _START if quick else _THEN
        most = min(max(fewest, y.numel() // share), _MOST)
        count = max(1, most // max(y.shape[1], 1))
        self.rows = drawn[:count].sort().values if count < len(y) else None
        self.left = NuisanceFit(_of(y, self.rows, 0), _of(others, self.rows, 0))
        self.times = y.numel() / self.left.y.numel()
        self.rounds = 1 if quick else ROUNDS
        self.every = y, others

    @cached_property
    def left_of_all(self) -> NuisanceFit:
        """What the others leave in all rows."""
        return NuisanceFit(*self.every) if self.rows is not None else self.left


class Scan:
    """The columns of one effect over the grids of its shapes; they serve every search of the same rows."""

    def __init__(self, situation: Situation, there: Situation, effect: Effect, white: Whitening) -> None:
        """situation: the rows; there: the machine about which they are linear; white: noise and weights."""
        self.situation, self.effect, self.white = situation, effect, white
        self.shapes = effect.shapes(situation)
        coefficients = effect.coefficients(situation)
        self.size = scales(coefficients, situation.joints)
        self.parts = _parts(self.shapes, len(coefficients))
        self.start = default_shape(situation, effect)
        moved = {"joints": "jacobian", "parameters": "parameter_jacobian"}.get(effect.kind)
        moved = "motor_jacobian" if isinstance(effect, _OneByOne) else moved
        # What acts in two places of a row is no product of a derivative and a form.
        self.there = there if len(there.places) > 1 else None
        moved = moved if self.there is None else None
        self.lead = white(torch.nan_to_num(getattr(there, moved))) if moved is not None else None
        self.fixed: Tensor | None = None
        if isinstance(effect, _Factored) and self.there is None:
            self.fixed = white(torch.nan_to_num(situation.once(effect.fixed_columns))) * self.size
        # Which joint a column moves is a matter of the effect's form: the middle and the ends of its grids show it.
        ends = torch.tensor([[s.grid[0], s.grid[-1]] for s in self.shapes], dtype=self.start.dtype).mT
        first = self._basis(torch.stack([self.start, *ends]))
        self.movers = _movers(first) if self.lead is not None else None
        free = [c for c in range(len(coefficients)) if not any(c in p.columns for p in self.parts)]
        self.unshaped = self._whitened(first[:1], free, None)[0]
        self.coarse: list[_Turn] | None = None
        self.leads: dict[tuple[int, ...], SharedColumns] = {}
        # The same where parts that are made alike have one value.
        self.tied: Scan | None = None
        tied = _tied(self.shapes, self.parts)
        if len(tied) < len(self.parts):
            self.tied = copy(self)
            self.tied.parts = tied

    def columns(self, candidates: Tensor, rows: Tensor | None) -> list[TrialColumns]:
        """Of each part, whitened, in plausible sizes; candidates: `g x h`; rows: which, None = all."""
        if self.movers is not None and isinstance(self.effect, _OneByOne):
            moved = self.effect.one_by_one(self.situation, candidates, rows)
            return [self._by_movers(_of_run(moved, p.columns), p.columns, rows) for p in self.parts]
        if self.fixed is not None and isinstance(self.effect, _Factored):
            factors = _of(self.effect.column_factors(self.situation, candidates), rows, 1)[..., None]
            return [TrialColumns(factors[:, :, p.columns], self._lead(self.fixed, p.columns, rows)) for p in self.parts]
        basis = _of(self._basis(candidates), rows, 1)
        if self.movers is None:
            return [TrialColumns(self._whitened(basis, part.columns, rows)) for part in self.parts]
        return [self._by_movers(basis[..., self.movers[p.columns], p.columns], p.columns, rows) for p in self.parts]

    def _basis(self, shapes: Tensor) -> Tensor:
        """What each coefficient changes, or in rows of two places the pose by it; shapes `g x h`, `g x s x ... x m`."""
        if self.there is None:
            if isinstance(self.effect, _OneByOne):
                return self.effect.of_motors(self.situation, shapes)
            return self.effect.basis(self.situation, shapes)
        return torch.nan_to_num(signature(self.situation, self.effect, shapes, self.there))

    def _by_movers(self, moved: Tensor, columns: list[int], rows: Tensor | None) -> TrialColumns:
        """moved: change of the joint or parameter that each of the columns moves, in the rows, `g x s x m`."""
        assert self.lead is not None and self.movers is not None
        one = (moved * self.size[columns]).nan_to_num_()
        movers = self.movers[columns]
        which, each = torch.unique_consecutive(movers, return_counts=True)
        if len(columns) and bool((each == each[0]).all()):
            return TrialColumns(
                one.reshape(*one.shape[:-1], len(which), -1), self._lead(self.lead, which.tolist(), rows)
            )
        return TrialColumns(_of(self.lead, rows, 0)[..., movers] * one[..., None, :])

    def _lead(self, columns: Tensor, which: Sequence[int], rows: Tensor | None) -> SharedColumns:
        """Some of the columns in the rows evaluated, which are the same all along: one object, however often it is
        asked for."""
        key = (rows is None, *which)
        if key not in self.leads:
            self.leads[key] = SharedColumns(_of(columns, rows, 0)[..., list(which)])
        return self.leads[key]

    def _whitened(self, basis: Tensor, columns: list[int], rows: Tensor | None) -> Tensor:
        """basis: in the rows, `g x s x ... x m`; `g x s x c x m`."""
        mine = _of_run(basis, columns)
        if self.lead is not None:
            return (_of(self.lead, rows, 0) @ (mine * self.size[columns])).nan_to_num_()
        axes, channels = self.white.axes, self.white.channels
        mine = mine[:, :, channels] if axes is None else _of(axes, rows, 0) @ mine
        mine = mine * self.size[columns]
        return mine.mul_(_of(self.white.scale, rows, 0)[..., None]).nan_to_num_()

    def best(self, ground: SearchRows, start: Tensor | None = None) -> Shaped:
        """The shapes that explain most; of parts that are made alike one for all, where that is more probable.

        Args:
            ground: what is to be explained, and beside what.
            start: shapes found before, when the effect is known to be there: its parts are then searched beside each
                other.
        """
        found = [scan._searched(ground, start) for scan in (self, self.tied) if scan is not None]
        return max(found, key=lambda one: self._log_odds(ground, one)) if len(found) > 1 else found[0]

    def _log_odds(self, ground: SearchRows, found: Shaped) -> float:
        """Log evidence of the columns at the shapes found, less the charge."""
        used = [*range(len(self.size))] if found.used is None else [*found.used]
        basis = _of(self._basis(found.value[None]), ground.rows, 1)
        tried = TrialColumns(self._whitened(basis, used, ground.rows))
        return ground.times * float(ground.left.log_evidence(tried, torch.arange(1))) - found.charge

    def _searched(self, ground: SearchRows, start: Tensor | None) -> Shaped:
        value = self.start if start is None else start
        gains = [0.0] * len(self.parts)
        charges = [0.0] * len(self.parts)
        plain, times = ground.left.beside(_of(self.unshaped, ground.rows, 0)), ground.times
        peaks: list[Tensor | None] = [None] * len(self.parts)
        for level in range(ground.rounds + 1):
            if level == 1 and not self._promising(gains, charges):
                break
            for candidates, pieces, looked_at in self._level(value, level, ground.rows, peaks):
                chosen = [self._nearest(candidates, value, part) for part in self.parts]
                spent = [0.0] * len(self.parts)
                # Beside each other: over the grid once each alone before, and then about what that has found.
                both = start is not None and len(self.parts) > 1
                for sweep in ((0, 1) if level == 0 else (1,)) if both else (0,):
                    for i, tried in enumerate(looked_at):
                        if tried is None:
                            continue
                        own = [p.one(chosen[j]) for j, p in enumerate(pieces) if sweep and j != i]
                        left = plain.beside(torch.cat(own, -1)) if own else plain
                        # What chance explains does not grow with the rows.
                        score = times * (left.gain(tried) - tried.width) + tried.width
                        if level == 0:
                            chosen[i] = _likeliest(left, tried, score)
                            about = _peaks(score, chosen[i])
                        else:
                            # Near the best value sizes that no coefficient is likely to have are no explanation.
                            likely = score if level == 1 else left.log_evidence(tried, torch.arange(len(score)))
                            about = _tops(score, likely)
                            chosen[i] = int(about[likely[about].argmax()])
                        if self.parts[i].one:
                            peaks[i] = candidates[about, self.parts[i].shapes[0]]
                        gains[i] = float(score[chosen[i]])
                        if level == 0:
                            known = self._is_textbook(candidates[chosen[i]], self.parts[i])
                            spent[i] = 0.0 if known else search_charge(score)
                charges = [c + s for c, s in zip(charges, spent, strict=True)]
                value = value.clone()
                for i, part in enumerate(self.parts):
                    value[part.shapes] = candidates[chosen[i]][part.shapes]
        if self._promising(gains, charges):
            value = self._at_moments(value, ground)
        return self._worth(value, gains, charges, times)

    def _at_moments(self, value: Tensor, ground: SearchRows) -> Tensor:
        """Shapes with times from which on rows are others at one of these: a row that was not evaluated does not tell
        on which side it is, and one on the wrong side leaves more than noise."""
        for i, part in enumerate(self.parts):
            for h in part.shapes:
                moments = torch.tensor(self.shapes[h].moments, dtype=value.dtype)
                near = (moments - value[h]).abs().argsort()[: math.ceil(_MOMENTS * ground.times)]
                if len(near):
                    candidates = value.expand(len(near), -1).clone()
                    candidates[:, h] = moments[near]
                    left = ground.left_of_all.beside(self.unshaped)
                    value = candidates[int(left.gain(self.columns(candidates, None)[i]).argmax())]
        return value

    def _promising(self, gains: Sequence[float], charges: Sequence[float]) -> bool:
        """Whether any part explains more than chance at the best value of its grid."""
        parts = zip(self.parts, gains, charges, strict=True)
        return any((gain - len(part.columns)) / 2 - charge > _CHANCE for part, gain, charge in parts)

    def _level(self, value: Tensor, level: int, rows: Tensor | None, peaks: Sequence[Tensor | None]) -> list[_Turn]:
        """Candidates with their columns: of every part all its shapes at once where that are few, else one by one.

        peaks: of each part the values of its one shape about which to look, or None.
        """
        if level == 0 and self.coarse is not None:
            return self.coarse
        tables = [self._tables(value, part, level, own) for part, own in zip(self.parts, peaks, strict=True)]
        found = []
        for turn in range(max(map(len, tables), default=0)):
            mine = [
                table[turn] if turn < len(table) else value[part.shapes][None, :0]
                for part, table in zip(self.parts, tables, strict=True)
            ]
            candidates = value.expand(max(map(len, mine)), -1).clone()
            for part, table in zip(self.parts, mine, strict=True):
                if table.shape[-1]:
                    candidates[: len(table), part.shapes] = table
                    candidates[len(table) :, part.shapes] = table[-1]
            columns = self.columns(candidates, rows)
            tried = [c.first(len(t)) if t.shape[-1] else None for c, t in zip(columns, mine, strict=True)]
            found.append(_Turn(candidates, columns, tried))
        if level == 0:
            self.coarse = found
        return found

    def _tables(self, value: Tensor, part: _Part, level: int, peaks: Tensor | None) -> list[Tensor]:
        """Values to look at, one table a turn, `g x (shapes of the part)`."""
        grids = [self._grid(h, float(value[h]), level) for h in (part.shapes[:1] if part.one else part.shapes)]
        if peaks is not None:
            grids = [torch.cat([self._grid(part.shapes[0], float(peak), level) for peak in peaks])]
        if part.tied:
            refined = not level or self.shapes[part.shapes[0]].refined
            return [grids[0][:, None].expand(-1, len(part.shapes))] * refined
        if len(grids) > 1 and level == 0 and math.prod(map(len, grids)) <= _TOGETHER:
            return [torch.cartesian_prod(*grids)]
        found = []
        for k, grid in enumerate(grids):
            if level and not self.shapes[part.shapes[k]].refined:
                continue
            table = value[part.shapes].expand(len(grid), -1).clone()
            table[:, k] = grid
            found.append(table)
        return found

    def _grid(self, h: int, value: float, level: int) -> Tensor:
        grid = torch.tensor(self.shapes[h].grid, dtype=self.size.dtype)
        if level == 0:
            return grid
        k = int((grid - value).abs().argmin())
        low, high = float(grid[max(k - 1, 0)]), float(grid[min(k + 1, len(grid) - 1)])
        half = (high - low) / 2 * (2 / (FINE - 1)) ** (level - 1)
        fine = torch.linspace(-1, 1, FINE, dtype=grid.dtype) * half + value
        return fine.clamp(float(grid[0]), float(grid[-1]))

    def _is_textbook(self, value: Tensor, part: _Part) -> bool:
        """Whether the shapes of a part are those for which nobody needs to look."""
        return all(float(value[h]) == self.shapes[h].textbook for h in part.shapes)

    def _nearest(self, candidates: Tensor, value: Tensor, part: _Part) -> int:
        return int((candidates[:, part.shapes] - value[part.shapes]).abs().sum(-1).argmin())

    def _worth(self, value: Tensor, gains: Sequence[float], charges: Sequence[float], times: float) -> Shaped:
        """Only the parts that pay for their search and half a unit of log evidence a coefficient; at least the best.

        times: how much more than it is worth chance counts in the gains.
        """
        net = [g / 2 - c for g, c in zip(gains, charges, strict=True)]
        best = max(range(len(net)), key=lambda i: net[i])
        kept = [i for i, p in enumerate(self.parts) if i == best or net[i] > _PAYS * times * len(p.columns)]
        charge = sum(charges[i] for i in kept)
        if len(kept) == len(self.parts):
            return Shaped(value, None, charge)
        unshaped = set(range(len(self.size))) - {c for p in self.parts for c in p.columns}
        return Shaped(value, tuple(sorted(unshaped | {c for i in kept for c in self.parts[i].columns})), charge)


def _peaks(score: Tensor, chosen: int) -> Tensor:
    """Numbers of the values of a grid about which to look on: the chosen one, and the highest of the other peaks."""
    edge = score.new_full((1,), -math.inf)
    higher = (score > torch.cat([edge, score[:-1]])) & (score > torch.cat([score[1:], edge]))
    higher[chosen] = False
    others = torch.nonzero(higher).squeeze(-1)
    others = others[score[others].argsort(descending=True)[: _PEAKS - 1]]
    return torch.cat([others.new_tensor([chosen]), others])


def _tops(score: Tensor, likely: Tensor) -> Tensor:
    """Numbers of the likeliest values about each peak, of the peaks that explain about as much as the best of them."""
    tops = likely.reshape(-1, FINE).argmax(-1)
    tops += FINE * torch.arange(len(tops))
    most = float(score[tops].max())
    high: Tensor = tops[score[tops] >= most - max(_AS_WELL, _AS_HIGH * most)]
    return high


def _likeliest(left: NuisanceFit, tried: TrialColumns, score: Tensor) -> int:
    """Of values that explain about as much the one that does so with coefficients of the likeliest sizes.

    Eight waves of the wrong, low frequency can be bent to any other over a short travel.
    """
    best = int(score.argmax())
    near = torch.nonzero(score > score[best] - _AS_WELL).squeeze(-1)
    if len(near) < 2 or float(score[best]) < _THERE:
        return best
    near = near[score[near].argsort(descending=True)[:_FEW]]
    return int(near[left.log_evidence(tried, near).argmax()])


def _movers(basis: Tensor) -> Tensor | None:
    """The one joint or parameter that each column moves, `m`, or None where one moves several; basis:
    `g x s x k x m`."""
    there = torch.nan_to_num(basis).flatten(0, -3).abs().amax(0) > 0
    return there.to(torch.int8).argmax(0) if bool((there.sum(0) <= 1).all()) else None


def _of(values: Tensor, rows: Tensor | None, dim: int) -> Tensor:
    return values if rows is None else values.index_select(dim, rows)


def _of_run(values: Tensor, columns: list[int]) -> Tensor:
    """Some of the columns, without a copy where they are contiguous."""
    run = range(columns[0], columns[0] + len(columns)) if columns else range(0)
    return values[..., run.start : run.stop] if list(run) == columns else values[..., columns]


def _parts(shapes: tuple[Shape, ...], coefficients: int) -> list[_Part]:
    """Shapes in groups that share a coefficient; one with no columns of its own belongs to all."""
    parts: list[_Part] = []
    for h, shape in enumerate(shapes):
        mine = set(range(coefficients) if shape.columns is None else shape.columns)
        joined = [p for p in parts if mine & set(p.columns)]
        parts = [p for p in parts if not mine & set(p.columns)]
        members = sorted({h, *(k for p in joined for k in p.shapes)})
        parts.append(_Part(members, sorted(mine.union(*(p.columns for p in joined)))))
    return parts


def _tied(shapes: tuple[Shape, ...], parts: list[_Part]) -> list[_Part]:
    """Parts of one shape each that are made alike as one, the others as they are."""
    found: dict[tuple[str, tuple[float, ...]] | int, _Part] = {}
    for i, part in enumerate(parts):
        first = shapes[part.shapes[0]]
        key = (first.alike, first.grid) if first.alike and part.one else i
        before = found.get(key)
        if before is not None:
            part = _Part(before.shapes + part.shapes, sorted(before.columns + part.columns), True)
        found[key] = part
    return [*found.values()]
