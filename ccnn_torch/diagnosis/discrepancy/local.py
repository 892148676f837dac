"""Local discrepancy terms: a bump along a joint or in the workspace, with searched place and width; a periodic term.

Bumps of every place at once share one prior scale, and the evidence charges each of them; a dent or a table is in one
place alone. So that place is searched, and the search is charged as that for a period is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.candidates.nuisance import NuisanceFit, SharedColumns, TrialColumns, search_charge
from ccnn_torch.diagnosis.discrepancy.interaction import interaction_discrepancies
from ccnn_torch.diagnosis.discrepancy.smooth import joint_moves, platform_moves, spread_out, unit_range
from ccnn_torch.diagnosis.residual.whitening import Whitening
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.priors import OUTSIDE

# Places evaluated along a joint's track and in the workspace, and radii as shares of half the range.
_ALONG, _WITHIN = 21, 40
_RADII_ALONG, _RADII_WITHIN = (0.1, 0.17, 0.3), (0.25, 0.4, 0.65)
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
# What else is there may have so many plausible sizes.
_LOOSE = 10.0
# A platform turns where its rotation matrix changes by this.
_TURNS = 1e-6
# Periods in the time of the rows: from where the waves of any course end, to so many rows a period, or so many in all.
_SLOWEST, _ROWS_A_PERIOD, _MOST = 8.0, 3.0, 130.0
_PERIOD_STEP = 1 / 3
# Values between the neighbours of the best, so often.
_FINE, _ROUNDS = 9, 3
# Rows before the first possible jump and after the last, and places that are tried, at most.
_FEWEST_ROWS, _PLACES = 5, 120


def local_discrepancies(
    situation: Situation, jacobian: Tensor, target: Tensor, white: Whitening, others: Tensor
) -> list[Atom]:
    """The best bump of each joint's track and of the workspace; the best jump, sine of time and pair of drivers.

    Args:
        situation: `s` rows.
        jacobian: by the joints, where the model is linear, `s x c0 x n`; 0 in rows that are left out.
        target: what a linear model has to explain, `s x c0` [m, rad].
        white: noise and weights.
        others: columns of what else is there, in plausible sizes, `s x c0 x P`.
    """
    # Rows that were set aside count as well, as far as they can be believed: they may be the middle of a bump.
    white = replace(white, weight=torch.ones_like(white.weight))
    moved = joint_moves(situation, jacobian)
    y = white(target)
    y = y * (_BELIEVED / torch.linalg.vector_norm(y, dim=-1, keepdim=True).clamp_min(_BELIEVED))
    # A place is found in a part of many rows as well.
    few = torch.randperm(len(y), generator=torch.Generator().manual_seed(0))[: _MOST_VALUES // y.shape[1]]
    plain = NuisanceFit(y[few], _LOOSE * white(others)[few])

    def atoms(drivers: Sequence[str], points: Tensor, places: Tensor, raw: Tensor) -> list[Atom]:
        """Those of the best bump for each driver; points: `n x s x d`; raw: the columns that its bumps multiply,
        `n x s x c0 x m`."""
        lead = torch.stack([white(r) for r in raw])
        # What is the same in all places is no bump.
        left = plain.beside(_LOOSE * lead[:, few])
        best = _searched(points[:, few], places, lead[:, few], left, len(y) / len(few))
        made = []
        for driver, where, columns, place, charge in zip(drivers, points, raw, *best, strict=True):
            if place.isnan().any():
                continue
            bump = _bumps(where, place[None])[:, :, None]
            # By itself, and about the mean of the rows where the model was fitted to these. A constant of its own would
            # let it stand for an offset of the joints, which the library knows.
            for shift in (0.0, bump.mean(0)):
                made.append(Atom(driver, None, raw.new_zeros(0), columns * (bump - shift), OUTSIDE - float(charge)))
        return made

    middles = torch.linspace(-1, 1, _ALONG, dtype=moved.dtype).unsqueeze(-1)
    drivers = [f"joint {joint.name}" for joint in situation.mechanism.joints]
    tracks = unit_range(situation.joints).mT[..., None]
    found = atoms(drivers, tracks, _places(middles, _RADII_ALONG), moved.movedim(-1, 0)[..., None])
    lengths = [k for k, c in enumerate(situation.mechanism.pose) if c.unit == "m"]
    place = unit_range(situation.pose[:, lengths] if lengths else situation.pose)
    places = _places(spread_out(place, _WITHIN), _RADII_WITHIN)
    # What pulls the platform acts through the joints; what bends a measurement does not.
    platform = platform_moves(situation)
    kinds = [moved, platform]
    for raw in [torch.stack(kinds)] if moved.shape == platform.shape else [k[None] for k in kinds]:
        found += atoms(["workspace"] * len(raw), place.expand(len(raw), -1, -1), places, raw)
    lead = white(platform)
    moves = white(moved)
    found += interaction_discrepancies(situation, moved, moves, few, plain, _LOOSE)
    moving = {"the frame": platform, "several joints": moved}
    moving |= {f"joint {j.name}": moved[..., i : i + 1] for i, j in enumerate(situation.mechanism.joints)}
    rotation = situation.platform[1]
    if rotation is not None and float((rotation - rotation[:1]).abs().max()) > _TURNS:
        moving["the tool"] = platform[..., :3] @ rotation
    found += jump_discrepancies(moving, {name: white(m) for name, m in moving.items()}, few, plain, _LOOSE)
    if "time" in situation.covariates:
        found += periodic_discrepancy(
            situation.covariates["time"], platform, lead, few, plain.beside(_LOOSE * lead[few])
        )
    return found


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


def periodic_discrepancy(time: Tensor, raw: Tensor, lead: Tensor, few: Tensor, left: NuisanceFit) -> list[Atom]:
    """The sine of time that explains most, its search charged, with its period in its `note`; none where there are too
    few rows for any.

    Args:
        time: of each row, `s` [s].
        raw: shifts and turns of the platform, `s x c0 x k` [m, rad].
        lead: the same whitened, `s x c x k`.
        few: rows evaluated, `t`.
        left: what is to be explained there.
    """
    span = float(time.max() - time.min())
    fastest = min(len(time) / _ROWS_A_PERIOD, _MOST)
    if span <= 0 or fastest < _SLOWEST + 1:
        return []
    share = (time - time.min()) / span
    looked_at = SharedColumns(lead[few])

    def gain(periods: Tensor) -> Tensor:
        return left.gain(TrialColumns(_waves(share[few], periods)[:, :, None], looked_at))

    grid = torch.arange(_SLOWEST, fastest, _PERIOD_STEP, dtype=time.dtype)
    score = gain(grid)
    best, reached, step = grid[score.argmax()], float(score.max()), _PERIOD_STEP
    for _ in range(_ROUNDS):
        close = best + step * torch.linspace(-1, 1, _FINE, dtype=time.dtype)
        finer = gain(close)
        if float(finer.max()) > reached:
            best, reached = close[finer.argmax()], float(finer.max())
        step *= 2 / (_FINE - 1)
    charge = search_charge(len(lead) / len(few) * score)
    columns = (raw[..., None] * _waves(share, best[None])[0][:, None, None]).flatten(-2)
    note = f"what follows the time is a sway with a period of {span / float(best):.3g} s"
    return [Atom("time", None, columns.new_zeros(0), columns, OUTSIDE - charge, note=note)]


def _waves(share: Tensor, periods: Tensor) -> Tensor:
    """Sine and cosine, `g x s x 2`; share: of the time, `s`; periods in all of it, `g`."""
    angle = 2 * math.pi * share * periods[:, None]
    return torch.stack([torch.sin(angle), torch.cos(angle)], -1)


def jump_discrepancies(
    moved: Mapping[str, Tensor], whitened: Mapping[str, Tensor], few: Tensor, plain: NuisanceFit, loose: float
) -> list[Atom]:
    """The likeliest jump of everything that may have moved, its search charged; `note` says what moved.

    Args:
        moved: what may have moved -> columns of a shift of it, `s x c0 x k` [m, rad]; rows in the order measured.
        whitened: the same, `s x c x k`.
        few: rows evaluated, `t`.
        plain: what is to be explained there.
        loose: size of what else is there, in plausible sizes.
    """
    rows = len(next(iter(moved.values())))
    if rows < 4 * _FEWEST_ROWS:
        return []
    step = max(1, -(-(rows - 2 * _FEWEST_ROWS) // _PLACES))
    number = torch.arange(rows)
    found = []
    for what, columns in moved.items():
        lead = whitened[what][few]
        shared, left = SharedColumns(lead), plain.beside(loose * lead)

        def gain(places: Tensor, shared: SharedColumns = shared, left: NuisanceFit = left) -> Tensor:
            return left.gain(TrialColumns(_steps(number[few], places)[..., None, None], shared))

        places = torch.arange(_FEWEST_ROWS, rows - _FEWEST_ROWS, step)
        score = gain(places)
        best = int(places[score.argmax()])
        close = torch.arange(max(best - step + 1, _FEWEST_ROWS), min(best + step, rows - _FEWEST_ROWS))
        best = int(close[gain(close).argmax()])
        charge = search_charge(rows / len(few) * score)
        acting = columns * _steps(number, torch.tensor([best]))[0][:, None, None]
        prior = OUTSIDE - charge
        found.append(Atom("time", None, lead.new_zeros(0), acting, prior, note=f"a jump of {what}", begins=best))
    return found


def _steps(number: Tensor, places: Tensor) -> Tensor:
    """0 before each place and 1 from it on, `g x s`."""
    return (number >= places[:, None]).to(torch.float64)
