"""Geometry and effects fitted to rows together, and which effects the rows ask for.

The model is that of the diagnosis: whitened rows, linear in the coefficients about the machine as fitted so far, each
group of coefficients with a normal prior whose scale is brought to its most probable value (MacKay 1992). What the
rows do not show is drawn to 0, so that many effects can be there at once. Frames of groups of points are as large as
they have to be: where a plate stands is no error of the machine, and what they can do is no evidence.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.coordinates import plausible_error
from ccnn_torch.diagnosis.candidates.atom import scales, textbook_shapes, told_shapes
from ccnn_torch.diagnosis.candidates.shape_search import Scan, SearchRows
from ccnn_torch.diagnosis.from_file import Known, one_row_at_a_time
from ccnn_torch.diagnosis.residual.linearisation import remainder, signature_at
from ccnn_torch.diagnosis.residual.noise_estimate import fitted_whitening
from ccnn_torch.diagnosis.residual.rows import fitted_frames, in_groups
from ccnn_torch.diagnosis.residual.whitening import Whitening, device_axes, moving_channels, renewed
from ccnn_torch.effects import Acting, Effect, Situation, measured_channels, moved
from ccnn_torch.evidence.marginal_likelihood import SPREAD, Fits, Grams, fit_sets, grams_of
from ccnn_torch.evidence.priors import EFFECT, WIDE
from ccnn_torch.mechanisms import Mechanism
from ccnn_torch.numerics.least_squares import levenberg_marquardt
from ccnn_torch.numerics.outliers import inlying

# Estimates of prior scales, noise and weights of the rows, at most, and what they change in what is left from which
# there is no other, as a share of it.
_ROUNDS, _SETTLED = 4, 1e-2
# Steps of Levenberg and Marquardt at each, at most, the first damping, and the share of the coefficients that a last
# step may change.
_STEPS, _DAMPING, _LAST = 12, 1e-8, 0.1
# Standard deviation of a frame's coordinate where the rows leave it open, in plausible errors, and the share of the
# largest below which they leave a direction open.
_ANYWHERE, _OPEN = 1e2, 1e-9
# What a coefficient of plausible size moves by rounding alone: a joint that no weight pulls at [m, rad].
_NOTHING = 1e-12
# Estimates of the noise before shapes are searched.
_RENEWALS = 2
# Periods that are looked for of an effect that may have any, beside once a turn, which needs no search: a gear train
# errs with more than one.
_TIMES = 2
# Groups of which it is fitted whether the rows are as probable without them, before all others are.
_TRIED = 4
# Standard deviation of log α² of a part of an effect: a factor of 1.6 in α. What metals grow by is known; thermometers
# that warm together would have a part grow by one and shrink by the other, ten times as much as any.
_OF_PART = 1.0
_PARAMETERS, _FRAMES, _NO_PARTS = "parameters", "frames", ("", "secondary")
_Label = tuple[str, str]


class JointFit(NamedTuple):
    """Effects with their coefficients, and the machine's parameters without those effects, `k` [SI], or `s x k` where
    groups of rows have frames of their own."""

    acting: list[Acting]
    parameters: Tensor


def fit_jointly(
    situation: Situation, measured: Tensor, known: Sequence[Known], usable: Tensor, loose: Sequence[int]
) -> JointFit:
    """Fit the coefficients of effects, with the shapes that they have, and parameters beside them.

    Rows that are far off are set aside or weighed down, as in the diagnosis.

    Args:
        situation: all rows on the nominal machine, `s x n`.
        measured: poses, `s x p` [SI].
        known: effects with shapes; of their coefficients those that are used.
        usable: rows to fit to, `s` bool.
        loose: numbers of the parameters that are fitted beside.

    Returns:
        The effects, 0 for coefficients that are not used; and all parameters; frames of groups of rows are fitted group
        by group.
    """
    model = _Model(situation, known, loose)
    at = model.nominal.new_zeros(model.size)
    rows = model.about(at, measured, usable)
    white = rows.whitening()
    for _ in range(_ROUNDS):
        white = replace(white, weight=torch.where(rows.fine[:, None], white.weight, 0.0))
        fit = _fitted(rows, white)
        before, (at, rows) = rows, _most_probable(rows, at, white, fit, measured)
        change, left = (white(v).norm() for v in (rows.left - before.left, rows.left))
        white = rows.renewed(white, fit, rows.left)
        if float(change) <= _SETTLED * float(left):
            break
    return JointFit(model.acting(at), model.parameters(at))


def _most_probable(rows: _Rows, at: Tensor, white: Whitening, fit: Fits, measured: Tensor) -> tuple[Tensor, _Rows]:
    """The most probable coefficients at the prior scales and the noise of a fit, and the rows about them.

    A step that leads away from the rows, or to where one of them cannot be, is shortened (Levenberg-Marquardt): what
    the rows hardly show may turn so far that the linear model is no model of it.
    """
    model, begin = rows.model, at
    free, likely = rows.likely(fit)
    if not len(free):
        return at, rows
    # What the prior asks of a coefficient, in units of the noise.
    drawn = 1 / likely
    seen = [(at[free], rows)]

    def both(values: Tensor) -> tuple[Tensor, Tensor]:
        if not torch.equal(values[0], seen[-1][0]):
            seen.append((values[0], model.about(begin.index_copy(0, free, values[0]), measured, rows.fine)))
        here = seen[-1][1]
        left = torch.cat([white(here.left).flatten(), drawn * values[0]])
        slope = torch.cat([-white(here.columns[..., free]).flatten(0, 1), drawn.diag()])
        return left.where((here.fine == rows.fine).all(), torch.inf)[None], slope[None]

    found = levenberg_marquardt(
        lambda values: both(values)[0],
        at[free][None],
        both=both,
        max_iterations=_STEPS,
        tolerance=_LAST,
        damping=_DAMPING,
    ).value[0]
    return begin.index_copy(0, free, found), next(r for values, r in seen if torch.equal(values, found))


def effects_that_pay(
    situation: Situation, measured: Tensor, effects: Sequence[Effect], usable: Tensor, loose: Sequence[int]
) -> list[Known]:
    """The effects without which the rows would be less probable, beside all others, with their shapes.

    All are there at first, at the shapes of the textbook or, where that is more probable, at those that the rows show.
    One that may have any period is there with those of the textbook and of the machine's file, and with as many more as
    the rows show up to `_TIMES`; each stands or falls by itself. Then the one that adds least to the marginal
    likelihood is left out, or what is secondary in it, as long as it adds less than it costs to have it in the library.
    What stands for another one is left out so, too.

    Args:
        situation, measured, usable, loose: as in `fit_jointly`.
        effects: candidates, all of which the rows have the covariates for.
    """
    start = fit_jointly(situation, measured, [], usable, loose).parameters
    first = [_at(textbook_shapes, effect, situation) for effect in effects]
    settled = [k for k in first if not k.shape.numel() or _has_any_period(k.effect, situation)]
    searched = [k for k in first if not any(k is one for one in settled)]
    # Those of any period do nothing as yet.
    searched += [replace(k, used=()) for k in settled if k.shape.numel() for _ in range(_TIMES)]
    settled += [k for effect in effects if (k := _at(told_shapes, effect, situation)).used]
    model = _Model(situation, [*settled, *searched], loose)
    rows = model.about(model.begin(start), measured, usable)
    white = rows.whitening()
    for _ in range(_RENEWALS):
        white = rows.renewed(white, *_left_by_all(rows, white))
    scans: dict[str, Scan] = {}
    for i, one in enumerate(searched, len(settled)):
        scan = scans.get(one.effect.name) or Scan(situation, rows.there, one.effect, white)
        scans[one.effect.name] = scan
        rows = _at_better_shape(rows, i, scan)
    return _without_idle(rows, white)


def on_fitted_frames(situation: Situation) -> Situation:
    """The same rows on a machine whose nominal parameters are the situation's, each as if it were isolated.

    Frames that groups of rows have for themselves stay parameters by row.
    """
    if situation.parameters is not None and situation.parameters.dim() == 1:
        mechanism = situation.mechanism.with_nominal(situation.parameters)
        situation = replace(situation, mechanism=mechanism, parameters=None)
    return one_row_at_a_time(situation)


def loose_parameters(mechanism: Mechanism, identify: bool) -> list[int]:
    """Numbers of the parameters that are fitted beside effects: all of them, or those of unknown frames."""
    unknown = getattr(mechanism, "unknown_frames", ())
    return [
        k for k, g in enumerate(mechanism.geometry) if (identify and not g.held) or g.name.partition("_")[0] in unknown
    ]


def _loosened(situation: Situation, loose: Sequence[int]) -> tuple[list[int], Tensor]:
    """Numbers of the parameters that are fitted, and what each of these changes, `k x m`; where groups of rows have
    frames of their own one for each group, `s x k x m`."""
    eye = torch.eye(len(situation.mechanism.geometry), dtype=situation.joints.dtype)
    if situation.parameters is None or situation.parameters.dim() == 1:
        return [*loose], eye[:, [*loose]]
    frames, groups = [k for frame in fitted_frames(situation) for k in frame], in_groups(situation)
    own = [k for k in loose if k not in frames]
    spread = torch.cat([eye[:, own].expand(len(groups), -1, -1), eye[:, frames] @ groups], -1)
    return own + [frames[j] for j in groups.amax(0).argmax(0).tolist()], spread


class _Model:
    """Effects and parameters as one vector of coefficients, each in plausible sizes."""

    def __init__(self, situation: Situation, known: Sequence[Known], loose: Sequence[int]) -> None:
        self.situation, self.known = situation, [*known]
        self.loose, self.spread = _loosened(situation, loose)
        self.nominal = situation.mechanism.resolve(situation.parameters)
        geometry = situation.mechanism.geometry
        self.sizes = [scales(k.effect.coefficients(situation), self.nominal) for k in known]
        self.sizes.append(self.nominal.new_tensor([plausible_error(geometry[k]) for k in self.loose]))
        self.size = sum(map(len, self.sizes))

    def parts(self, at: Tensor) -> list[Tensor]:
        """Coefficients [SI] effect by effect, and last the parameters' change."""
        return [c * s for c, s in zip(torch.split(at, [len(s) for s in self.sizes]), self.sizes, strict=True)]

    def begin(self, parameters: Tensor) -> Tensor:
        """The vector of a machine without effects."""
        # Each column is of one parameter, in all rows or in those of a group.
        spread = self.spread if self.spread.dim() == 3 else self.spread[None]
        change = (parameters - self.nominal).expand(spread.shape[:-1])[..., None]
        found = (spread * change).sum((0, 1)) / spread.sum((0, 1)) / self.sizes[-1]
        return torch.cat([found.new_zeros(self.size - len(found)), found])

    def acting(self, at: Tensor) -> list[Acting]:
        """The effects."""
        return [Acting(k.effect, k.shape, c) for k, c in zip(self.known, self.parts(at), strict=False)]

    def parameters(self, at: Tensor) -> Tensor:
        """All of them, `k`, or `s x k`."""
        changed: Tensor = self.nominal + self.spread @ self.parts(at)[-1]
        return changed

    def about(self, at: Tensor, measured: Tensor, usable: Tensor) -> _Rows:
        """The rows as a linear model about the machine with these coefficients."""
        acting, parameters = self.acting(at), self.parameters(at)
        there = moved(self.situation, acting)
        assert there.parameters is not None
        there = replace(there, parameters=there.parameters + parameters - self.nominal)
        columns = [self.columns(there, k) for k in self.known]
        columns.append(there.parameter_jacobian @ self.spread * self.sizes[-1])
        every = torch.cat(columns, -1)
        left = remainder(self.situation, measured, acting, parameters)
        fine = usable & torch.isfinite(left).all(-1) & torch.isfinite(every).flatten(1).all(-1)
        left = torch.where(fine[:, None], left, 0.0)
        every = torch.where(fine[:, None, None], every, 0.0)
        seen = measured_channels(self.situation, measured)
        return _Rows(self, there, fine, every, left, left + every @ at, seen)

    def columns(self, there: Situation, known: Known) -> Tensor:
        """Of one effect, `s x c x m`; 0 for coefficients that are not used."""
        columns = signature_at(self.situation, there, known.effect, known.shape)
        used = torch.zeros(columns.shape[-1], dtype=torch.bool)
        used[list(known.used)] = True
        return torch.where(used, columns, 0.0)

    def labels(self) -> list[tuple[str, str]]:
        """What the coefficients of a group have in common: the effect they are of, by number, and which part."""
        found = [
            (str(i), c.part or ("secondary" if c.secondary else ""))
            for i, k in enumerate(self.known)
            for c in k.effect.coefficients(self.situation)
        ]
        mechanism = self.situation.mechanism
        # Of whole poses a motion of all groups would go over from the first link to their frames, and each command
        # would have to make up for it.
        points = len(mechanism.pose) <= 3
        anywhere = ["base"] if mechanism.frame_per and points else []
        for p in (mechanism.geometry[k] for k in self.loose):
            frame = p.name.partition("_")[0]
            part = frame if frame in getattr(mechanism, "unknown_frames", ()) else p.unit
            found.append((_FRAMES, "") if part in anywhere else (_PARAMETERS, part))
        return found


@dataclass(frozen=True)
class _Rows:
    """Rows, linear about a machine.

    Attributes:
        there: the machine.
        fine: rows that count, `s`.
        columns: change of the pose by each coefficient in plausible sizes, `s x c x P` [m, rad].
        left: what the machine leaves, `s x c` [m, rad].
        target: what the linear model has to explain, `s x c` [m, rad].
        seen: which values were measured, `s x c` bool; None = all.
    """

    model: _Model
    there: Situation
    fine: Tensor
    columns: Tensor
    left: Tensor
    target: Tensor
    seen: Tensor | None

    @property
    def grouped(self) -> dict[tuple[str, str], Tensor]:
        """The columns of each group with a prior that do anything."""
        return {label: group for label, group in self._acting().items() if label[0] != _FRAMES}

    @property
    def groups(self) -> list[Tensor]:
        return [*self.grouped.values()]

    @property
    def frames(self) -> Tensor:
        """The columns of the frames that do anything."""
        return self._acting().get((_FRAMES, ""), torch.arange(0))

    def likely(self, fit: Fits) -> tuple[Tensor, Tensor]:
        """The columns that do anything, and how large a fit to `groups` takes their coefficients to be: standard
        deviations in plausible sizes, over that of the noise."""
        own = [s.expand(len(g)).exp() for g, s in zip(self.groups, fit.log_scale[0], strict=False)]
        wide = fit.noise.new_full((len(self.frames),), _ANYWHERE**2)
        return torch.cat([self.frames, *self.groups]), (torch.cat([wide, *own]) / fit.noise[0]).sqrt()

    def _acting(self) -> dict[tuple[str, str], Tensor]:
        acts = self.columns.abs().amax((0, 1)) > _NOTHING
        found: dict[tuple[str, str], list[int]] = {}
        for k, label in enumerate(self.model.labels()):
            if acts[k]:
                found.setdefault(label, []).append(k)
        return {label: torch.tensor(group) for label, group in found.items()}

    def whitening(self) -> Whitening:
        """Noise from the richest fit; rows that only all effects together explain count as yet."""
        here = self.model.situation
        columns, channels = [self.columns[..., g] for g in self._acting().values()], moving_channels(here)
        white = fitted_whitening(
            self.target, columns, channels, None, self.fine, self.seen, device_axes(here), here.mechanism.channels
        )
        # A plate that stands elsewhere than it was thought makes no outliers of its rows.
        left = white.picked(self.without_frames(white, self.left[..., None])[0][..., 0]) / white.sigma
        near = inlying(left.norm(dim=-1), self.fine, len(white.channels), 0)
        return replace(white, weight=(self.fine & near)[:, None].expand_as(left).to(left.dtype))

    def grams(self, white: Whitening) -> Grams:
        """Inner products of what the frames cannot do."""
        every, seen = self.without_frames(white, torch.cat([self.columns, self.target[..., None]], -1))
        return grams_of(white(every[..., :-1]), white(every[..., -1]))._replace(values=white.count() - seen)

    def without_frames(self, white: Whitening, values: Tensor) -> tuple[Tensor, int]:
        """Values `s x c x m` less what the frames can make of them, and how many of these the rows show."""
        placed = self.columns[..., self.frames]
        if not placed.shape[-1]:
            return values, 0
        within = white(placed).flatten(0, 1), white(values).flatten(0, 1)
        found = torch.linalg.lstsq(*within, rcond=_OPEN, driver="gelsd")
        return values - placed @ found.solution, int(found.rank)

    def renewed(self, white: Whitening, fit: Fits, left: Tensor) -> Whitening:
        """Noise and weights from what a fit leaves, `s x c` [m, rad]."""
        values = max(white.count(), 1.0)
        placed = self.without_frames(white, self.target[..., None])[1]
        free = 1 - (float(fit.effective[0]) + placed) / values
        return renewed(white, white.picked(left), white.picked(self.target), free, self.fine)

    def with_shape(self, i: int, known: Known) -> _Rows:
        """The same with another shape of one of the effects, which does nothing yet."""
        model = _Model(self.model.situation, [*self.model.known], self.model.loose)
        model.known[i] = known
        own = torch.where(self.fine[:, None, None], model.columns(self.there, known).nan_to_num(), 0.0)
        columns = self.columns.clone()
        columns[..., _span(model, i)] = own
        return replace(self, model=model, columns=columns)


def _span(model: _Model, i: int) -> slice:
    begin = sum(len(s) for s in model.sizes[:i])
    return slice(begin, begin + len(model.sizes[i]))


def _has_any_period(effect: Effect, situation: Situation) -> bool:
    """Whether an effect has shapes and the textbook none for any of them."""
    shapes = effect.shapes(situation)
    return bool(shapes) and all(s.usual is None for s in shapes)


def _at(
    shapes: Callable[[Situation, Effect], tuple[Tensor, tuple[int, ...]]], effect: Effect, situation: Situation
) -> Known:
    """An effect at its shapes of the textbook or of the machine's file, without what has none there."""
    value, used = shapes(situation, effect)
    return Known(effect, value, value.new_zeros(len(effect.coefficients(situation))), used)


def _at_better_shape(rows: _Rows, i: int, scan: Scan) -> _Rows:
    """With one of the effects at the shapes that explain most beside the others, where that pays for their search."""
    known, white = rows.model.known[i], scan.white
    without = rows.with_shape(i, replace(known, used=()))
    # The others are as large as they are likely to be: what is free explains a wave as well.
    which, likely = without.likely(_fitted(without, white))
    found = scan.best(SearchRows(white(rows.target), white(without.columns[..., which]) * likely / WIDE))
    used = tuple(range(len(known.coefficients))) if found.used is None else found.used
    tried = rows.with_shape(i, replace(known, shape=found.value, used=used))
    evidence = [float(_fitted(r, white).log_evidence) for r in (rows, tried)]
    return tried if evidence[1] - found.charge > evidence[0] else rows


def _fitted(rows: _Rows, white: Whitening) -> Fits:
    return _fit(rows.grams(white), [rows.grouped])


def _is_part(label: _Label) -> bool:
    """Whether a group is a named part of an effect."""
    return label[0].isdigit() and label[1] not in _NO_PARTS


def _fit(grams: Grams, sets: Sequence[Mapping[_Label, Tensor]]) -> Fits:
    """Of sets of groups; a part of an effect that is there or not for itself is about as large as is plausible."""
    named = [[_OF_PART if _is_part(label) else SPREAD for label in s] for s in sets]
    most = max(1, *map(len, named))
    spread = torch.tensor([[*s, *[SPREAD] * (most - len(s))] for s in named], dtype=grams.yy.dtype)
    return fit_sets(grams, [[*s.values()] for s in sets], 0.0, spread=spread)


def _left_by_all(rows: _Rows, white: Whitening) -> tuple[Fits, Tensor]:
    """A fit of everything that is there, and what it leaves, `s x c` [m, rad]: less than the noise of `whitening`,
    which adds causes one by one as long as each pays."""
    fit, which = _fitted(rows, white), torch.cat([*rows.groups, rows.frames[:0]])
    left = rows.target - rows.columns[..., which] @ fit.mean[0][: len(which)]
    return fit, rows.without_frames(white, left[..., None])[0][..., 0]


def _gained_without(fit: Fits, groups: Mapping[_Label, Tensor], removed: Sequence[Sequence[_Label]]) -> Tensor:
    """Log evidence that a fit gains without some of its groups, the scales of the others as they are: the density of
    their coefficients at 0 after the rows over that before (Savage-Dickey ratio; Dickey 1971)."""
    ends = torch.tensor([len(g) for g in groups.values()]).cumsum(0).tolist()
    places = {label: torch.arange(end - len(g), end) for (label, g), end in zip(groups.items(), ends, strict=True)}
    found = []
    for labels in removed:
        k = torch.cat([places[label] for label in labels])
        # In units of the prior.
        mean, spread = fit.mean[0, k] / fit.scale[0, k], torch.linalg.cholesky(fit.inverse[0][k][:, k])
        far = torch.linalg.solve_triangular(spread, mean[:, None], upper=False).square().sum()
        found.append(-0.5 * far - spread.diagonal().log().sum())
    return torch.stack(found)


def _without_idle(rows: _Rows, white: Whitening) -> list[Known]:
    """The effects whose marginal likelihood pays for them, one after the other."""
    grams, groups = rows.grams(white), rows.grouped
    parts = Counter(name for name, part in groups if _is_part((name, part)))
    while True:
        names = [label for label in groups if label[0] != _PARAMETERS]
        # With an effect goes what is secondary in it.
        removed = [[n for n in names if n[0] == name and part in ("", n[1])] for name, part in names]
        if not removed:
            break
        # An effect costs its place in the library; what is secondary in one that is there is as likely there as not,
        # and of many parts, each by a thermometer of its own, one or so is there (Scott and Berger 2010).
        worth = torch.tensor(
            [-math.log(parts[n[0]]) if _is_part(n) else 0.0 if n[1] else EFFECT for n in names], dtype=grams.yy.dtype
        )
        gain = _gained_without(_fit(grams, [groups]), groups, removed) - worth
        order, fitted = gain.argsort(descending=True).tolist(), list[int]()
        # Those that gain most with the scales as they are, and all before none is said to.
        for some in (order[:_TRIED], order[_TRIED:]):
            sets = [{label: g for label, g in groups.items() if label not in removed[k]} for k in some]
            evidence = _fit(grams, [groups, *sets]).log_evidence
            gain[some] = evidence[1:] - evidence[0] - worth[some]
            # An effect stays until its idle parts are gone, whose number is no evidence against what is left of it.
            idle = {name for (name, part), g in zip(names, gain.tolist(), strict=True) if part and g >= 0}
            fitted += some
            able = [k for k in fitted if gain[k] >= 0 and (names[k][1] or names[k][0] not in idle)]
            if able:
                break
        else:
            break
        gone = removed[max(able, key=lambda k: float(gain[k]))]
        groups = {label: g for label, g in groups.items() if label not in gone}
    kept = torch.zeros(rows.model.size, dtype=torch.bool)
    for group in groups.values():
        kept[group] = True
    found = []
    for i, one in enumerate(rows.model.known):
        used = tuple(torch.nonzero(kept[_span(rows.model, i)]).squeeze(-1).tolist())
        if used:
            found.append(replace(one, used=used))
    return found
