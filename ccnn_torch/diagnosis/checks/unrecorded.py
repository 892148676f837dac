"""What was not recorded: covariates and the effects that they would show; what the order of the rows tells of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations, product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import is_temperature
from ccnn_torch.diagnosis.candidates.atom import default_shape, scaled_signature, textbook_shapes
from ccnn_torch.diagnosis.residual.rows import picked
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.effects import Effect, Situation, missing_on, pose_residual
from ccnn_torch.effects.backlash import Backlash
from ccnn_torch.effects.covariates import covariate_units, draw_covariates
from ccnn_torch.effects.thermal import Thermal
from ccnn_torch.effects.time import ROW, FrameDrift, Homing
from ccnn_torch.errors import InputError
from ccnn_torch.evidence.dictionary import gain_beside
from ccnn_torch.records.commanded import SECOND

# Speeds are not among them: rows at rest, as most are, have none.
_KINDS = ("temperature", "time", "direction", "load")
# A usual row is found among so many.
_ROWS = 60


def missing_covariates(
    analysis: Analysis, effects: Sequence[Effect], lacking: Mapping[str, str], found: Sequence[str], seed: int
) -> list[dict[str, Any]]:
    """The block `missing_covariates` of diagnosis.json: what to record beside the pose, most promising first.

    The plausible size of an effect is what its coefficients, each of its plausible size, do to the median row under
    conditions drawn for them (`draw_covariates`: a shift in a hall, loads of 60 N and 6 N·m). What a simulator takes
    and was not told goes by the simulator's name. Where something that no effect describes follows the time, or growth
    follows it, the temperature comes first.

    Args:
        analysis: of the rows.
        effects: all candidates.
        lacking: what is missing for those of them that the rows cannot show, by name.
        found: names of the verdict, and drivers of what no effect describes.
        seed: of the conditions drawn.
    """
    rows = torch.unique(torch.linspace(0, len(analysis.situation.joints) - 1, _ROWS).round().long())
    here = picked(analysis.situation, rows)
    mechanism, units = here.mechanism, covariate_units(here.mechanism) | {"temperature": "degC"}
    drawn = draw_covariates(mechanism, here.joints, torch.Generator().manual_seed(seed))
    names = [*here.covariates]
    # Growth by the time alone is shown, but not what it grows with.
    guessed = set() if any(map(is_temperature, names)) else {Thermal.name}
    kinds = {k: [n for n in drawn if n.startswith(k) and n not in names] for k in _KINDS}
    # One machine for all of them: its derivatives may be dear.
    there = replace(here, covariates=drawn | dict(here.covariates))
    position = bool(analysis.whitening.lengths.any())
    alike = [k for k, c in enumerate(mechanism.channels) if (c.unit == "m") == position]
    shown: dict[tuple[str, ...], dict[str, float]] = {}
    for effect in (e for e in effects if lacking.get(e.name) or e.name in guessed):
        added = next((a for a in _additions(kinds) if not effect.missing(mechanism, [*names, *a])), None)
        size = 0.0
        # A user's own effect that fails on columns that were not recorded must not cost the verdict.
        with suppress(InputError):
            size = 0.0 if added is None or missing_on(effect, there) else _plausible(there, effect, alike)
        if added is not None and size > 0:
            shown.setdefault(added, {})[effect.name] = size
    for condition in mechanism.lacking(names):
        if condition.name in drawn:
            other = replace(here, covariates={**here.covariates, condition.name: drawn[condition.name]})
            size = _usual(pose_residual(other, here.pose)[:, alike])
            if size > 0:
                shown.setdefault((condition.name,), {})[mechanism.name] = size
    entries: list[dict[str, Any]] = [
        {"columns": [f"{n}[{units[n]}]" for n in added], "effects": sizes, "unit": "m" if position else "rad"}
        for added, sizes in shown.items()
    ]
    first = "temperature" if {"time", *guessed} & {*found} else ""
    return sorted(
        entries, key=lambda e: (not first or not e["columns"][0].startswith(first), -max(e["effects"].values()))
    )


def _additions(kinds: Mapping[str, list[str]]) -> Iterator[tuple[str, ...]]:
    """Columns that might be added: those of one kind, then of two."""
    there = [k for k in kinds if kinds[k]]
    for count in (1, 2):
        for some in combinations(there, count):
            yield tuple(n for k in some for n in kinds[k])


def _plausible(situation: Situation, effect: Effect, channels: Sequence[int]) -> float:
    """What an effect of plausible size does to the usual row in channels of one unit [m] or [rad]."""
    main = [i for i, c in enumerate(effect.coefficients(situation)) if not c.secondary]
    columns = scaled_signature(situation, effect, default_shape(situation, effect))[..., main]
    return _usual(columns[:, channels])


def _usual(change: Tensor) -> float:
    """Size of a change of the usual row, given as `s x c` or by parts, `s x c x m` [m] or [rad]."""
    return float(torch.nan_to_num(change).square().flatten(1).sum(1).median().sqrt())


# Log odds that directions, and numbers of rows, must gain beside the verdict, and beyond so many times what those of as
# many random orders gain: in any order a row at the edge is reached from nearer the middle, so that directions
# correlate a little with the place. Numbers of rows are then asked beside everything else.
_DIRECTIONS, _ROWS_IN_ORDER, _ORDERS = (10.0, 2.0), (5.0, 1.0), 4


class OfOrder(NamedTuple):
    """Columns that the order of the rows tells where they were not recorded.

    Attributes:
        effects: what they would show.
        columns: of rows and an order of theirs, by name, `s` each.
        clearly: log odds that they must gain, and times what random orders gain.
        every: of each grid of its shapes every so many values are tried, from the first on; () = the middle
            ones, and those of the textbook.
    """

    effects: tuple[Effect, ...]
    columns: Callable[[Situation, Tensor], dict[str, Tensor]]
    clearly: tuple[float, float]
    every: tuple[int, ...] = ()

    def signatures(self, there: Situation) -> list[Tensor]:
        """Of the effects at each of the shapes tried, `s x c x m` each; there: rows with the columns."""
        found = []
        for effect in self.effects:
            shapes = [default_shape(there, effect), textbook_shapes(there, effect)[0]]
            if self.every:
                grids = [s.grid[::n] for s, n in zip(effect.shapes(there), self.every, strict=False)]
                shapes = [torch.tensor(values, dtype=torch.float64) for values in product(*grids)]
            found += [scaled_signature(there, effect, shape) for shape in shapes]
        return found


def of_order(situation: Situation) -> dict[str, OfOrder]:
    """Kinds of columns that are not there: `direction`, and `row`, which stands for the time."""
    found = {} if situation.directed else {"direction": OfOrder((Backlash(),), _directions, _DIRECTIONS)}
    return (
        found
        if "time" in situation.covariates
        else found | {ROW: OfOrder((FrameDrift(), Homing()), _numbers, _ROWS_IN_ORDER, (5, 3))}
    )


def measured_order(situation: Situation) -> Tensor:
    """The rows, `s`, by their time where that was recorded, else as in the file."""
    time = situation.covariates.get("time")
    return torch.arange(len(situation.joints)) if time is None else time.argsort(stable=True)


def order_shows(analysis: Analysis, judgement: Judgement, columns: Mapping[str, Tensor], kind: OfOrder) -> bool:
    """Whether what a verdict leaves follows these columns, far more than those of the same rows in random orders.

    Args:
        analysis: of the rows.
        judgement: the verdict without them.
        columns: of the same rows, `s` each.
        kind: what made them.
    """
    situation, drawn = analysis.situation, torch.Generator().manual_seed(0)
    orders = (torch.randperm(len(analysis.residual), generator=drawn) for _ in range(_ORDERS))
    gain, *by_chance = (
        max(gain_beside(analysis.dictionary, judgement.found, analysis.whitened(kind.signatures(there))))
        for own in (columns, *(kind.columns(situation, order) for order in orders))
        for there in [situation.with_covariates({**situation.covariates, **own})]
    )
    alone, times = kind.clearly
    return gain > alone + times * max(0.0, *by_chance)


def _directions(situation: Situation, order: Tensor) -> dict[str, Tensor]:
    """Sign of each motor's way from the row before in an order of the rows, to the second place from the first.

    One that stands still keeps its sign; before its first motion it is 0.
    """
    turns = torch.stack([place.motor_turns for place in situation.places], 1)
    visited = turns[order].flatten(0, 1)
    way = visited.diff(dim=0, prepend=visited[:1]).sign()
    rows = torch.arange(len(way))[:, None].expand_as(way)
    last = torch.where(way != 0, rows, 0).cummax(0).values
    signs = torch.empty_like(turns)
    signs[order] = way.gather(0, last).reshape(turns.shape)
    return {
        f"direction{i + 1}{ending}": way
        for ending, place in zip(("", SECOND), signs.unbind(1), strict=False)
        for i, way in enumerate(place.unbind(-1))
    }


def _numbers(situation: Situation, order: Tensor) -> dict[str, Tensor]:
    return {ROW: order.argsort().to(situation.joints.dtype)}
