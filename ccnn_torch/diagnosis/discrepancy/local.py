"""Discrepancy terms whose place is searched: a bump along a joint, in time or in the workspace, an edge, a sine of
time, jumps; and the product of two drivers, of which neither alone moves a joint so.

Bumps of every place at once share one prior scale, and the evidence charges each of them; a dent or a table is in one
place alone. So that place is searched, and the search is charged as that for a period is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom, discrepancy
from ccnn_torch.diagnosis.candidates.nuisance import (
    FINE,
    ROUNDS,
    NuisanceFit,
    SharedColumns,
    TrialColumns,
    search_charge,
)
from ccnn_torch.diagnosis.discrepancy.smooth import (
    carried_moves,
    driver_of,
    frame_moves,
    joint_moves,
    platform_moves,
    spread_out,
    unit_range,
)
from ccnn_torch.diagnosis.residual.whitening import Whitening
from ccnn_torch.display import number_text
from ccnn_torch.effects import Situation

CROSS = " × "
"""Between the two drivers in the name of a product."""
# Places evaluated along a joint's track and in the workspace, and radii as shares of half the range.
_ALONG, _WITHIN = 21, 40
_RADII_ALONG, _RADII_WITHIN = (0.1, 0.17, 0.3), (0.25, 0.4, 0.65)
# Powers of the way beyond an edge.
_BENDS = (1, 2, 3)
# Rows that a bump has to touch: fewer are bad rows.
_TOUCHED = 4.0
# From a bell to a flat top, and how flat at most (power of the distance).
_POWER, _POWERS = 2.0, (1.0, 8.0)
# A place is then mended by steps of this share of its radius, halved where none is better, so many times.
_STEP, _STEPS = 0.4, 10
# Values of the residual, at most, on which places are evaluated.
_MOST_VALUES = 1800
# Times the noise up to which a row's residual counts.
_BELIEVED = 20.0
# A platform turns where its rotation matrix changes by this.
_TURNS = 1e-6
# Periods in the time of the rows: from where the waves of any course end, to so many rows a period, or so many in all.
_SLOWEST, _ROWS_A_PERIOD, _MOST = 8.0, 3.0, 130.0
_PERIOD_STEP = 1 / 3
# Rows before the first possible jump and after the last, and places that are tried, at most.
_FEWEST_ROWS, _PLACES = 5, 120
# Jumps of one thing, at most; log evidence for each of its columns that one beside another must bring.
_MOST_JUMPS, _ONE_MORE = 8, 3.0


class _Ground(NamedTuple):
    """What local terms are to explain.

    Attributes:
        white: noise, all rows weighing alike.
        few: rows evaluated, `t`.
        plain: what is to be explained there.
        times: how many rows there are for each that is evaluated.
    """

    white: Whitening
    few: Tensor
    plain: NuisanceFit
    times: float

    def beside(self, raw: Tensor) -> tuple[SharedColumns, NuisanceFit]:
        """Columns `s x c0 x k` [m, rad] that are multiplied, in the rows evaluated, and what is to be explained beside
        them: what is the same in all rows is in no place."""
        lead = self.white(raw)[self.few]
        return SharedColumns(lead), self.plain.beside(lead)


def local_discrepancies(
    situation: Situation, jacobian: Tensor, target: Tensor, white: Whitening, others: Tensor
) -> list[Atom]:
    """The best bump and edge of each joint's track, and bump of the time and of the workspace; the best jumps, sine of
    time and pair of drivers.

    Args:
        situation: `s` rows.
        jacobian: by the joints, where the model is linear, `s x c0 x n`; 0 in rows that are left out.
        target: what a linear model has to explain, `s x c0` [m, rad].
        white: noise and weights.
        others: columns of what else is there, in plausible sizes, `s x c0 x P`.
    """
    moved = joint_moves(situation, jacobian)
    y = white(target)
    # A place is found in a part of many rows as well.
    few = torch.randperm(len(y), generator=torch.Generator().manual_seed(0))[: _MOST_VALUES // y.shape[1]]
    counted = _Ground(white, few, NuisanceFit(y[few], white(others)[few]), len(y) / len(few))
    # Rows that were set aside count as well, as far as they can be believed: they may be the middle of a bump.
    white = replace(white, weight=torch.ones_like(white.weight))
    y = white(target)
    y = y * (_BELIEVED / torch.linalg.vector_norm(y, dim=-1, keepdim=True).clamp_min(_BELIEVED))
    ground = _Ground(white, few, NuisanceFit(y[few], white(others)[few]), counted.times)

    middles = torch.linspace(-1, 1, _ALONG, dtype=moved.dtype).unsqueeze(-1)
    drivers = [f"joint {joint.name}" for joint in situation.mechanism.joints]
    tracks = unit_range(situation.joints).mT[..., None]
    own = moved.movedim(-1, 0)[..., None]
    # A bump that is large has its form in the rows that are hardly believed.
    found = [
        bump
        for rows in (ground, counted)
        for bump in _bump_terms(rows, drivers, tracks, _places(middles, _RADII_ALONG), own)
    ]
    found += _edge_terms(counted, situation, tracks[..., 0], moved)
    place = unit_range(situation.place[:, situation.lengths] if situation.lengths else situation.place)
    places = _places(spread_out(place, _WITHIN), _RADII_WITHIN)
    # What pulls the platform acts through the joints; what bends a measurement does not.
    platform = platform_moves(situation)
    kinds = [moved, platform]
    for raw in [torch.stack(kinds)] if moved.shape == platform.shape else [k[None] for k in kinds]:
        found += _bump_terms(ground, ["workspace"] * len(raw), place.expand(len(raw), -1, -1), places, raw)
    # A stand that the sun warms for a while tilts, and comes back.
    clock = situation.covariates.get("time", torch.arange(len(y), dtype=moved.dtype))
    clock, stand = unit_range(clock[:, None].to(moved.dtype))[None], frame_moves(situation)[None]
    if stand.shape[-1]:
        found += _bump_terms(ground, ["time"], clock, _places(middles, _RADII_ALONG), stand)
    found += _products(ground, situation, moved)
    moving = {"the frame": platform, "several joints": moved}
    moving |= {f"joint {j.name}": moved[..., i : i + 1] for i, j in enumerate(situation.mechanism.joints)}
    rotation = situation.platform[1]
    if rotation is not None and float((rotation - rotation[:1]).abs().max()) > _TURNS:
        moving["the tool"] = carried_moves(situation)[..., :3] @ rotation
    if len(y) >= 4 * _FEWEST_ROWS:
        found += [_jumps(ground, what, columns) for what, columns in moving.items()]
    if "time" in situation.covariates:
        found += _sway(ground, situation.covariates["time"], platform)
    return found


def _bump_terms(ground: _Ground, drivers: Sequence[str], points: Tensor, places: Tensor, raw: Tensor) -> list[Atom]:
    """Those of the best bump for each driver.

    Args:
        ground: what is to be explained.
        drivers: `n` names.
        points: of all rows, `n x s x d`.
        places: to begin with, `g x (d + 2)`.
        raw: columns that bumps multiply, `n x s x c0 x m` [m, rad].
    """
    lead = torch.stack([ground.white(r)[ground.few] for r in raw])
    best = _searched(points[:, ground.few], places, lead, ground.plain.beside(lead), ground.times)
    made = []
    for driver, where, columns, place, charge in zip(drivers, points, raw, *best, strict=True):
        if place.isnan().any():
            continue
        bump = _bumps(where, place[None])[:, :, None]
        # By itself, and about the mean of the rows where the model was fitted to these. A constant of its own would
        # let it stand for an offset of the joints, which the library knows.
        made += [discrepancy(driver, columns * (bump - shift), -float(charge)) for shift in (0.0, bump.mean(0))]
    return made


def _edge_terms(ground: _Ground, situation: Situation, tracks: Tensor, moved: Tensor) -> list[Atom]:
    """Those of the best edge along each joint's track, beyond which it is pulled: a hose goes taut, a stop is touched.

    Args:
        ground: what is to be explained.
        situation: `s` rows.
        tracks: of the joints, `n x s` in [-1, 1].
        moved: what each joint's plausible deviation does to the pose, `s x c0 x n` [m, rad].
    """
    grid = torch.linspace(-1, 1, 2 * _ALONG - 1, dtype=moved.dtype)[1:-1]
    made = []
    for i, track in enumerate(tracks):
        columns = moved[..., i : i + 1]
        lead, left = ground.beside(columns)
        beyond = torch.cat([_beyond(track, grid, side) for side in (1.0, -1.0)])
        ramps = torch.cat([beyond**power for power in _BENDS])
        score = left.gain(TrialColumns(ramps[:, ground.few, None, None], lead))
        touched = (ramps > 0).sum(-1)
        score = torch.where((touched > _TOUCHED) & (touched < len(track) - _TOUCHED), score, -torch.inf)
        if not bool(torch.isfinite(score).any()):
            continue
        best, joint, command = int(score.argmax()), situation.mechanism.joints[i], situation.joints[:, i]
        ramp, odds = ramps[best], -search_charge(ground.times * score)
        way, where = divmod(best % len(beyond), len(grid))
        low, high = float(command.min()), float(command.max())
        edge = low + (high - low) * (float(grid[where]) + 1) / 2
        note = f"joint {joint.name} is pulled {('above', 'below')[way]} {number_text(edge, 3)} {joint.unit}"
        # By itself, and about the mean of the rows, as a bump is.
        both = (columns * (ramp - shift)[:, None, None] for shift in (0.0, ramp.mean()))
        made += [discrepancy(f"joint {joint.name}", each, odds, note=note) for each in both]
    return made


def _beyond(track: Tensor, edges: Tensor, side: float) -> Tensor:
    """How far rows are beyond each edge, as a share of the way from it to the end, `g x s`."""
    return (side * (track - edges[:, None])).clamp_min(0) / (1 - side * edges[:, None])


def _places(middles: Tensor, radii: tuple[float, ...]) -> Tensor:
    """Each middle with each radius' logarithm and that of the power, `g x (d + 2)`."""
    logs = torch.tensor(radii, dtype=middles.dtype).log().repeat_interleave(len(middles))[:, None]
    return torch.cat([middles.repeat(len(radii), 1), logs, torch.full_like(logs, math.log(_POWER))], -1)


def _bumps(points: Tensor, places: Tensor) -> Tensor:
    """exp(-(distance / radius)^power), `... x s x g`; points: `... x s x d`, places: `... x g x (d + 2)`."""
    far = torch.cdist(points, places[..., :-2]) / places[..., None, :, -2].exp()
    return torch.exp(-(far ** places[..., None, :, -1].exp().clamp(*_POWERS)))


def _searched(points: Tensor, places: Tensor, lead: Tensor, left: NuisanceFit, times: float) -> tuple[Tensor, Tensor]:
    """The place of the bump that explains most, `n x (d + 2)`, NaN where no bump touches some of the rows only; and
    what looking for it costs in log odds, `n`.

    Args:
        points: of the rows evaluated, `n x s x d`.
        places: to begin with, `g x (d + 2)`.
        lead: whitened columns that a bump multiplies, `n x s x c x m`.
        left: what is to be explained, `n`.
        times: how many rows there are for each of these.
    """

    led_by = SharedColumns(lead)

    def gain(tried: Tensor) -> Tensor:
        bumps = _bumps(points, tried)
        touched = bumps.sum(-2)
        score = left.gain(TrialColumns(bumps.mT[..., None, None], led_by))
        return torch.where((touched > _TOUCHED) & (touched < points.shape[-2] / 2), score, -torch.inf)

    score = gain(places.expand(len(points), -1, -1))
    reached, first = score.max(-1)
    place = places[first]
    step = torch.full_like(place, _STEP)
    step[:, :-2] *= place[:, -2:-1].exp()
    each = torch.arange(len(place))
    for _ in range(_STEPS):
        tried = place[:, None] + torch.cat([torch.diag_embed(step), -torch.diag_embed(step)], -2)
        most, which = gain(tried).max(-1)
        better = (most > reached)[:, None]
        place = torch.where(better, tried[each, which], place)
        step = torch.where(better, step, step / 2)
        reached = torch.maximum(most, reached)
    charge = torch.tensor([search_charge(times * s) for s in score], dtype=score.dtype)
    return torch.where(reached[:, None] > -torch.inf, place, torch.nan), charge


def _sway(ground: _Ground, time: Tensor, raw: Tensor) -> list[Atom]:
    """The sine of time that explains most, its search charged, with its period in its `note`; none where there are too
    few rows for any.

    Args:
        ground: what is to be explained.
        time: of each row, `s` [s].
        raw: shifts and turns of the platform, `s x c0 x k` [m, rad].
    """
    span = float(time.max() - time.min())
    fastest = min(len(time) / _ROWS_A_PERIOD, _MOST)
    if span <= 0 or fastest < _SLOWEST + 1:
        return []
    share = (time - time.min()) / span
    lead, left = ground.beside(raw)

    def gain(periods: Tensor) -> Tensor:
        return left.gain(TrialColumns(_waves(share[ground.few], periods)[:, :, None], lead))

    grid = torch.arange(_SLOWEST, fastest, _PERIOD_STEP, dtype=time.dtype)
    score = gain(grid)
    best, reached, step = grid[score.argmax()], float(score.max()), _PERIOD_STEP
    for _ in range(ROUNDS):
        close = best + step * torch.linspace(-1, 1, FINE, dtype=time.dtype)
        finer = gain(close)
        if float(finer.max()) > reached:
            best, reached = close[finer.argmax()], float(finer.max())
        step *= 2 / (FINE - 1)
    columns = (raw[..., None] * _waves(share, best[None])[0][:, None, None]).flatten(-2)
    note = f"what follows the time is a sway with a period of {span / float(best):.3g} s"
    return [discrepancy("time", columns, -search_charge(ground.times * score), note=note)]


def _waves(share: Tensor, periods: Tensor) -> Tensor:
    """Sine and cosine, `g x s x 2`; share: of the time, `s`; periods in all of it, `g`."""
    angle = 2 * math.pi * share * periods[:, None]
    return torch.stack([torch.sin(angle), torch.cos(angle)], -1)


def _jumps(ground: _Ground, what: str, raw: Tensor) -> Atom:
    """The likeliest jump, and as many more beside it as are worth their search, all of which is charged.

    Args:
        ground: what is to be explained.
        what: may have moved, as `note` says.
        raw: columns of a shift of it, `s x c0 x k` [m, rad]; rows in the order measured.
    """
    rows, (lead, left) = len(raw), ground.beside(raw)
    step = max(1, -(-(rows - 2 * _FEWEST_ROWS) // _PLACES))
    places = torch.arange(_FEWEST_ROWS, rows - _FEWEST_ROWS, step)
    found: list[int] = []
    charge = 0.0
    while len(found) < _MOST_JUMPS:

        def gain(places: Tensor, left: NuisanceFit = left) -> Tensor:
            return left.gain(TrialColumns(_steps(ground.few, places)[..., None, None], lead))

        score = gain(places)
        own = search_charge(ground.times * score)
        worth = ground.times * (float(score.max()) - raw.shape[-1]) / 2 - own
        if found and worth < _ONE_MORE * raw.shape[-1]:
            break
        best = int(places[score.argmax()])
        close = torch.arange(max(best - step + 1, _FEWEST_ROWS), min(best + step, rows - _FEWEST_ROWS))
        best = int(close[gain(close).argmax()])
        found, charge = [*found, best], charge + own
        white = ground.white(raw)[ground.few]
        left = left.beside(white * _steps(ground.few, torch.tensor([best]))[0][:, None, None])
    found.sort()
    steps = _steps(torch.arange(rows), torch.tensor(found))
    acting = torch.cat([raw * own[:, None, None] for own in steps], -1)
    note = f"a jump of {what}" if len(found) == 1 else f"{len(found)} jumps of {what}"
    return discrepancy("time", acting, -charge, note=note, begins=tuple(found))


def _steps(number: Tensor, places: Tensor) -> Tensor:
    """0 before each place and 1 from it on, `g x s`."""
    return (number >= places[:, None]).to(torch.float64)


def _products(ground: _Ground, situation: Situation, moved: Tensor) -> list[Atom]:
    """The pair of drivers whose product explains most in one joint, beside both of them alone; its search charged.

    One term is of that joint alone, one of all joints.

    Args:
        ground: what is to be explained.
        situation: `s` rows.
        moved: what each joint's plausible deviation does to the pose, `s x c0 x n` [m, rad].
    """
    few, white = ground.few, ground.white(moved)[ground.few]
    drivers = [_drivers(situation, k) for k in range(moved.shape[-1])]
    pairs = list(combinations(drivers[0], 2))
    if not pairs:
        return []
    scores = []
    for k, own in enumerate(drivers):
        lead = white[..., k : k + 1]
        alone = torch.stack([torch.ones(len(few), dtype=lead.dtype), *(v[few] for v in own.values())], -1)
        both = torch.stack([own[a][few] * own[b][few] for a, b in pairs])
        left = ground.plain.beside(lead * alone[:, None])
        scores.append(left.gain(TrialColumns(both[..., None, None], SharedColumns(lead))))
    score = torch.stack(scores)
    k, pair = divmod(int(score.argmax()), len(pairs))
    first, second = (drivers[k][name] for name in pairs[pair])
    features = torch.stack([first * second, first, second], -1)
    name, odds = CROSS.join(pairs[pair]), -search_charge(ground.times * score.flatten())
    every = (moved[..., None] * features[:, None, None]).flatten(-2)
    note = f"their product moves joint {situation.mechanism.joints[k].name}"
    return [
        discrepancy(name, moved[..., k : k + 1] * features[:, None], odds, note=note),
        discrepancy(name, every, odds + math.log(moved.shape[-1])),
    ]


def _drivers(situation: Situation, joint: int) -> dict[str, Tensor]:
    """What may drive a joint together with something else, `s` each in [-1, 1]; loads by their torque on it."""
    tracks = unit_range(situation.joints)
    found = {f"joint {j.name}": tracks[:, i] for i, j in enumerate(situation.mechanism.joints)}
    for name, value in situation.covariates.items():
        driver = driver_of(name)
        if driver is not None and not driver.startswith(("load", "speed")) and bool((value != value[0]).any()):
            found[driver] = unit_range(value[:, None])[:, 0]
    for name in (name for name in situation.covariates if name.startswith("load_")):
        # 0 where the load does not act on this joint: every joint has the same drivers.
        torque = situation.with_covariates({name: situation.covariates[name]}).load_torque[:, joint]
        found[driver_of(name) or name] = torque / torque.abs().amax().clamp_min(1e-300)
    return found
