"""From rows to the posterior over sets of candidates: whitening, shapes, search, and again where they point."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.candidates.library import (
    Known,
    candidates_about_nominal,
    candidates_about_set,
    default_atom,
    has_usual_shape,
    without_unused_rows,
)
from ccnn_torch.diagnosis.discrepancy.local import local_discrepancies
from ccnn_torch.diagnosis.discrepancy.smooth import linear_discrepancies, smooth_discrepancies
from ccnn_torch.diagnosis.progress import at_step
from ccnn_torch.diagnosis.residual.correlation import INDEPENDENT, LOG_PRIOR, Correlation, possible_correlations
from ccnn_torch.diagnosis.residual.linearisation import remainder, tangent
from ccnn_torch.diagnosis.residual.noise_estimate import fitted_whitening
from ccnn_torch.diagnosis.residual.rows import frame_columns, near_singular, only_usable
from ccnn_torch.diagnosis.residual.whitening import (
    Whitening,
    device_axes,
    moving_channels,
    renewed,
    size_of_fitted,
    without_fitted,
    without_frames,
)
from ccnn_torch.diagnosis.search.convergence import (
    discrepancy_is_active,
    has_new_effects,
    is_converged,
    known_shapes,
    most_probable_shapes,
)
from ccnn_torch.effects import Acting, Effect, Situation, measured_channels, pose_residual
from ccnn_torch.evidence.beam import search
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet
from ccnn_torch.evidence.marginal_likelihood import Grams, fit_sets, groups_of

# Share of the rows at which the machine must be linearised about a set; else it is so about the nominal machine.
_LINEARISED = 0.9
# Values for which the weight of a noise that was given grows by one: it is right to some per cent.
_VALUES_A_UNIT = 100
_NOISE_REDUCTION = 0.5
# No third search where, with its shapes searched beside its best, the library is so far behind (log odds).
_MUCH_LESS_PROBABLE = 20.0
# An effect shows where a coefficient of plausible size makes this share of the gap.
_SHOWN = 1e-9
# Values of the residual that the search for a set to start from takes, at most.
_START = 900


class Rows(NamedTuple):
    """What every search uses.

    Attributes:
        situation: `s` rows.
        measured: poses, `s x p`.
        near_singular: `s`, bool.
        usable: rows that may count, `s`, bool.
        effects: candidates that show in these rows.
        idle: names of effects that change no pose in these rows.
        discrepancies: terms that are candidates beside any set.
        sigma: standard deviation of the noise under the largest model, `c` [m, rad].
    """

    situation: Situation
    measured: Tensor
    near_singular: Tensor
    usable: Tensor
    effects: list[Effect]
    idle: tuple[str, ...]
    discrepancies: list[Atom]
    sigma: Tensor


@dataclass(frozen=True)
class Analysis:
    """What the rows say, after one search.

    Attributes:
        rows: what every search uses.
        residual: what a linear model has to explain, `s x c0` [m, rad].
        fitted: what frames that are fitted to the rows do about the machine with the set's effects, `s x c0 x r`.
        whitening: channels, noise and row weights.
        correlation: of the noise between the rows that count.
        about: names of the effects about which the machine is linear; None = it is so about the nominal machine.
        atoms: candidates.
        dictionary: their columns and Gram matrices.
        found: sets, most probable first.
        floor: mean square of the noise in the units of the dictionary: 1 where it was given, else that of the largest
            model or, where that is far less, of the most probable set.
        instrument: standard deviation of the noise that the records show without a model, `c0` [m, rad], or None.
    """

    rows: Rows
    residual: Tensor
    fitted: Tensor
    whitening: Whitening
    correlation: Correlation
    about: frozenset[str] | None
    atoms: tuple[Atom, ...]
    dictionary: Dictionary
    found: list[FittedSet]
    floor: float
    instrument: Tensor | None = None

    @property
    def situation(self) -> Situation:
        """The rows."""
        return self.rows.situation

    @property
    def measured(self) -> Tensor:
        """Poses, `s x p`."""
        return self.rows.measured

    @property
    def near_singular(self) -> Tensor:
        """`s`, bool."""
        return self.rows.near_singular

    @property
    def best_of_library(self) -> FittedSet:
        """The most probable set without a discrepancy term."""
        return next(f for f in self.found if not any(self.atoms[i].is_discrepancy for i in f.members))

    @cached_property
    def plain(self) -> tuple[Tensor, Tensor]:
        """Columns of the dictionary and what they explain, as they are in the rows, `s x c x P` and `s x c`, whitened:
        with what rows share."""
        if self.correlation.value:
            columns = [self.residual[..., None], *(self.atoms[i].columns for i in self.dictionary.groups)]
            first, *own = _whitened(self.whitening, self.fitted, INDEPENDENT, columns)
            return torch.cat([first[..., :0], *own], -1), first[..., 0]
        return self.dictionary.columns, self.dictionary.y

    @property
    def noise_is_known(self) -> bool:
        """Whether the noise was given or the records show it."""
        return self.whitening.known > 0 or self.instrument is not None

    @property
    def gap(self) -> float:
        """Squares above the noise, in the units of the dictionary."""
        return max(float(self.dictionary.grams.yy) - self.floor * self.dictionary.grams.values, 1e-300)

    def whitened(self, columns: Iterable[Tensor]) -> list[Tensor]:
        """Columns `s x c0 x m` [m, rad] in the rows that count, as those of the dictionary, `t x c x m` each."""
        return _whitened(self.whitening, self.fitted, self.correlation, columns)

    def acting(self, found: FittedSet) -> list[Acting]:
        """The effects of a set with their most probable numbers; discrepancy terms are left out."""
        out = []
        for i, mean in zip(found.members, found.mean, strict=True):
            atom = self.atoms[i]
            if atom.effect is not None:
                out.append(Acting(atom.effect, atom.shape, atom.spread(self.situation, mean)))
        return out


def analyse(
    situation: Situation,
    measured: Tensor,
    effects: Sequence[Effect],
    noise: Tensor | None,
    instrument: Tensor | None = None,
) -> Analysis:
    """The whole search.

    Args:
        situation: `s` rows.
        measured: poses, `s x p` [SI].
        effects: candidates, all of which the rows have the covariates for.
        noise: standard deviation of each pose channel, `c0` [m, rad], or None.
        instrument: the same as the records show it without a model: what is left above it is no noise.
    """
    state = _about_nominal(situation, measured, effects, noise)
    # The first search takes about a tenth of the time, the second of two about a set is often shorter.
    for done in (0.1, 0.5):
        at_step("searching the effects", done)
        nearer = _about_best_set(state)
        if nearer is None:
            break
        state = nearer
    at_step("searching the effects", 0.8)
    state = _with_shared_noise(state)
    if instrument is not None and noise is None and state.correlation.target is None:
        # The floor is that of the instrument where the best fit leaves more; sets are as probable as before.
        floor = float((instrument[state.whitening.channels] / state.whitening.sigma).square().mean())
        state = replace(state, floor=min(state.floor, floor), instrument=instrument)
    return state


def _about_nominal(situation: Situation, measured: Tensor, effects: Sequence[Effect], noise: Tensor | None) -> Analysis:
    """About the nominal machine, on a part of the rows: only where to start from."""
    residual = pose_residual(situation, measured)
    near = near_singular(situation)
    usable = torch.isfinite(residual).all(-1) & torch.isfinite(situation.jacobian).flatten(1).all(-1) & ~near
    residual, fitted = only_usable(residual, usable), frame_columns(situation, usable)
    atoms = [without_unused_rows(default_atom(situation, situation, e), usable) for e in effects]
    names = [e.name for e in effects]
    rest = _discrepancies(situation, names)
    known = [a for a in rest if bool((torch.isfinite(a.columns.sum((1, 2))) | ~usable).all())]
    rest = [without_unused_rows(a, usable) for a in known if bool(a.columns[usable].any())]
    # What does not show at all in these rows is no candidate (latency at rest).
    channels = moving_channels(situation)
    largest = residual[usable][:, channels].abs().amax(0).clamp_min(1e-15)
    atoms = [a for a in atoms if a.columns.shape[-1]]
    atoms = [a for a in atoms if float((a.columns[:, channels] / largest[:, None]).abs().max()) > _SHOWN]
    everything = [a.columns for a in (*atoms, *rest) if not (a.is_discrepancy and a.name.startswith("joint"))]
    seen = measured_channels(situation, measured)
    about = channels, noise, usable, seen, device_axes(situation), situation.mechanism.channels
    white = fitted_whitening(residual, [fitted, *everything], *about)

    of_effects = candidates_about_nominal(situation, atoms, white, residual, usable, fitted)
    local = local_discrepancies(situation, only_usable(situation.jacobian, usable), residual, white, fitted)
    rest += [without_unused_rows(a, usable) for a in local]
    shown = [a.effect for a in atoms if a.effect is not None]
    idle = tuple(e.name for e in effects if all(e.name != s.name for s in shown))
    rows = Rows(situation, measured, near, usable, shown, idle, rest, white.sigma)
    drawn = torch.randperm(len(white.keep()), generator=torch.Generator().manual_seed(0))
    few = white.keep()[drawn[: max(_START // len(channels), 1)].sort().values]
    return _searched(rows, residual, fitted, white, [*of_effects, *rest], None, few=few)


def _about_best_set(state: Analysis) -> Analysis | None:
    """About the machine with the effects of the most probable set of the library, on all rows, under the noise that the
    most probable set of all leaves; None where the search has converged."""
    rows, found, atoms, best = state.rows, state.found, state.atoms, state.best_of_library
    situation, before = rows.situation, state.about
    if before is not None and found[0].log_posterior - best.log_posterior > _MUCH_LESS_PROBABLE:
        return None
    acting = state.acting(best)
    names = frozenset(a.effect.name for a in acting)
    white, left = _renewed(state, rows.usable), remainder(situation, rows.measured, acting)
    starts = [a for a in atoms if a.effect is not None and a.shape.numel()]
    if before is None:
        # Of the shapes found at first stay those of effects that act, since what else acts now may have hidden the
        # better ones, and of the others the likeliest and that of the textbook.
        likely = most_probable_shapes(atoms, found)
        starts = [a for a in starts if a.name in names or a is likely.get(a.name) or has_usual_shape(situation, a)]
        shapes, local = Known(starts, {}, True), True
    else:
        sought = names if names == before else None
        framed = without_frames(state.whitening, left, state.fitted)
        if not has_new_effects(state.dictionary, found, best, before, state.gap) and is_converged(
            state.dictionary, best, state.whitening, white, framed
        ):
            if torch.equal(white.keep(), state.whitening.keep()):
                return None
            # Other rows are set aside, and nothing else has changed.
            sought = frozenset()
        shapes = Known(starts, known_shapes(atoms, found, best, sought), False)
        # Local terms are searched again only if a discrepancy term is active.
        local = discrepancy_is_active(state.dictionary, found, best)
    there, target = tangent(situation, left, acting)
    ok = rows.usable & torch.isfinite(target).all(-1) & torch.isfinite(there.jacobian).flatten(1).all(-1)
    if int(ok.sum()) < _LINEARISED * int(rows.usable.sum()):
        there, target, ok = situation, pose_residual(situation, rows.measured), rows.usable
    target, fitted = only_usable(target, ok), frame_columns(there, ok)
    white = white if bool((ok == rows.usable).all()) else _renewed(state, ok)
    every = candidates_about_set(
        situation, there, rows.measured, target, rows.effects, acting, shapes, white, ok, fitted
    )
    # The first of a name has the shapes found now; its parts and earlier shapes add next to nothing.
    newest = {a.name: a.columns for a in reversed(every)}
    every += rows.discrepancies
    if local:
        beside = torch.cat([fitted, *(newest[name] for name in sorted(names))], -1)
        jacobian = only_usable(situation.jacobian, rows.usable)
        again = local_discrepancies(situation, jacobian, target, white, beside)
        every += [without_unused_rows(a, ok) for a in again]
    return _searched(rows, target, fitted, white, every, names)


def _discrepancies(situation: Situation, beside: Sequence[str]) -> list[Atom]:
    """Terms for each driver; of rows of two places what the driver does at both."""
    places, rows = situation.places, len(situation.joints)
    if len(places) > 1:
        situation = replace(
            situation,
            joints=torch.cat([place.joints for place in places]),
            guess=torch.cat([place.pose for place in places]),
            covariates={n: torch.cat([place.covariates[n] for place in places]) for n in situation.covariates},
        )
    found = [*smooth_discrepancies(situation, beside, rows), *linear_discrepancies(situation, beside)]
    return [
        replace(a, columns=a.columns.reshape(len(places), rows, *a.columns.shape[1:]).sum(0)) if len(places) > 1 else a
        for a in found
    ]


def _with_shared_noise(state: Analysis) -> Analysis:
    """The same candidates under noise that rows share, where the best sets found are more probable then."""
    if state.whitening.seen is not None:
        # Rows that lack values have no noise in them that they could share.
        return state
    atoms, white, keep = state.atoms, state.whitening, state.whitening.keep()
    sets = {(), state.best_of_library.members, state.found[0].members}
    members = sorted({i for s in sets for i in s})
    columns = [state.residual[..., None], *(atoms[i].columns for i in members)]
    places = dict(zip(members, groups_of(columns[1:]), strict=True))
    possible, grams, scores = possible_correlations(state.situation, keep), [], []
    for correlation in possible:
        flat = torch.cat(_whitened(white, state.fitted, correlation, columns), -1).flatten(0, 1)
        grams.append(flat.mT @ flat)
        score = correlation.log_determinant(*state.dictionary.y.shape) + (LOG_PRIOR if correlation.value else 0.0)
        # What any size of the frames is as probable for.
        scores.append(score - size_of_fitted(correlation(white(state.fitted)[keep])))
    # A set under every correlation, side by side.
    every = torch.stack(grams)
    known = Grams(every[:, 1:, 1:], every[:, 1:, 0], every[:, 0, 0], white.count())
    each = [
        fit_sets(known, [[places[i] for i in s]] * len(possible), state.dictionary.noise_dof).log_evidence
        + sum(atoms[i].log_prior for i in s)
        for s in sets
    ]
    likely = torch.stack(each).amax(0)
    correlation = possible[int((likely + likely.new_tensor(scores)).argmax())]
    if not correlation.value:
        return state
    return _searched(state.rows, state.residual, state.fitted, white, atoms, state.about, correlation)


def _searched(
    rows: Rows,
    target: Tensor,
    fitted: Tensor,
    white: Whitening,
    atoms: Sequence[Atom],
    about: frozenset[str] | None,
    correlation: Correlation = INDEPENDENT,
    few: Tensor | None = None,
) -> Analysis:
    """few: rows for a quick look, `t`; None = all that count, thoroughly; the others as in `Analysis`."""
    first, *columns = _whitened(white, fitted, correlation, [target[..., None], *(a.columns for a in atoms)], few)
    y = first[..., 0]
    # Noise that was given is right to some per cent, however many rows there are.
    values = white.count(few)
    known = white.known * (1 + values / _VALUES_A_UNIT)
    dictionary, found = search(atoms, columns, y, known, quick=few is not None, values=values)
    # The largest model knows no shapes: where these are most of the gap the best set leaves far less.
    left = found[0].rss / max(values - found[0].effective, 1.0)
    floor = min(float((rows.sigma / white.sigma).square().mean()), 1.0)
    # Nor does it know what rows share.
    floor = left if white.known == 0 and (correlation.value or left < _NOISE_REDUCTION * floor) else floor
    return Analysis(rows, target, fitted, white, correlation, about, tuple(atoms), dictionary, found, floor)


def _whitened(
    white: Whitening, fitted: Tensor, correlation: Correlation, values: Iterable[Tensor], rows: Tensor | None = None
) -> list[Tensor]:
    """Values `s x c0 x m` each in the rows that count, or in these rows, `t x c x m`: in units of the noise, without
    what rows share and without what was fitted."""
    keep = white.keep() if rows is None else rows
    counted = slice(None) if len(keep) == len(fitted) else keep
    frames, *columns = [correlation(white(v)[counted]) for v in (fitted, *values)]
    return without_fitted(frames, columns)


def _renewed(state: Analysis, usable: Tensor) -> Whitening:
    """Noise and weights from what the most probable set of all and the frames beside it leave."""
    white, best, left = state.whitening, state.found[0], state.residual
    for i, mean in zip(best.members, best.mean, strict=True):
        left = left - state.atoms[i].columns @ mean
    free = 1 - best.effective / max(state.dictionary.grams.values, 1.0)
    left = without_frames(white, left, state.fitted)
    return renewed(white, white.picked(left), white.picked(state.residual), free, usable)
