"""From rows to the posterior over sets of candidates: whitening, shapes, search, and again where they point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
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
from ccnn_torch.diagnosis.discrepancy.linear import linear_discrepancies
from ccnn_torch.diagnosis.discrepancy.local import local_discrepancies
from ccnn_torch.diagnosis.discrepancy.smooth import smooth_discrepancies
from ccnn_torch.diagnosis.progress import at_step
from ccnn_torch.diagnosis.residual.correlation import INDEPENDENT, Correlation
from ccnn_torch.diagnosis.residual.linearisation import remainder, tangent
from ccnn_torch.diagnosis.residual.noise_estimate import fitted_whitening
from ccnn_torch.diagnosis.residual.rows import frame_columns, near_singular
from ccnn_torch.diagnosis.residual.whitening import Whitening, moving_channels, renewed, without_frames
from ccnn_torch.diagnosis.search.convergence import (
    discrepancy_is_active,
    has_new_effects,
    is_converged,
    known_shapes,
    most_probable_shapes,
)
from ccnn_torch.diagnosis.search.shared_noise import (
    Explanation,
    likeliest_correlation,
    possible_correlations,
    without_fitted,
)
from ccnn_torch.effects import Acting, Effect, Situation, pose_residual
from ccnn_torch.evidence.beam import search
from ccnn_torch.evidence.dictionary import Dictionary, FittedSet

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


@dataclass(frozen=True)
class Analysis:
    """What the rows say.

    Attributes:
        situation: the rows.
        measured: poses, `s x p`.
        residual: measured less nominal, `s x c0` [m, rad].
        whitening: channels, noise and row weights in the end.
        atoms: candidates in the end.
        dictionary: their columns and Gram matrices.
        y: what the atoms explain, whitened, `s x c`; rows that count.
        found: sets, most probable first.
        near_singular: `s`, bool.
        floor: mean square of the noise in the units of `y`: 1 where it was given, else that of the richest fit or,
            where that is far less, of the most probable set.
        instrument: standard deviation of the noise that the records show without a model, `c0` [m, rad], or None.
        fitted: what frames that are fitted to the rows do about the machine with the set's effects, `s x c0 x r`.
        idle: effects that change no pose in these rows, and were no candidates.
        correlation: of the noise between the rows that count.
        shared: columns of all atoms and `y` before what rows share was taken out of them; None where that is nothing.
        outside: whitened columns of every discrepancy term, by its number, in the dictionary or not, `s x c x m` each.
    """

    situation: Situation
    measured: Tensor
    residual: Tensor
    whitening: Whitening
    atoms: tuple[Atom, ...]
    dictionary: Dictionary
    y: Tensor
    found: list[FittedSet]
    near_singular: Tensor
    floor: float
    fitted: Tensor
    idle: tuple[str, ...] = ()
    correlation: Correlation = INDEPENDENT
    shared: tuple[Tensor, Tensor] | None = None
    outside: Mapping[int, Tensor] = field(default_factory=dict)
    instrument: Tensor | None = None

    @property
    def plain(self) -> tuple[Tensor, Tensor]:
        """Columns of all atoms and what they explain, as they are in the rows, `s x c x P` and `s x c`, whitened."""
        return (self.dictionary.columns, self.y) if self.shared is None else self.shared

    @property
    def noise_is_known(self) -> bool:
        """Whether the noise was given or the records show it."""
        return self.whitening.known > 0 or self.instrument is not None

    @property
    def gap(self) -> float:
        """Squares above the noise, in the units of `y`."""
        return max(float(self.dictionary.grams.yy) - self.floor * self.dictionary.grams.values, 1e-300)

    def acting(self, found: FittedSet) -> list[Acting]:
        """The effects of a set with their most probable numbers; discrepancy terms are left out."""
        out = []
        for i, mean in zip(found.members, found.mean, strict=True):
            atom = self.atoms[i]
            if atom.effect is not None:
                out.append(Acting(atom.effect, atom.shape, atom.spread(self.situation, mean)))
        return out


class _Rows(NamedTuple):
    """What every search uses: the rows, `measured` poses `s x p`, the `noise` that was given, rows that are `usable`
    and those `near` a singularity, `s`; and 0 in rows that are left out: the `residual`, `s x c0`, what was `fitted` to
    them before, `s x c0 x r`, and the joints' `jacobian`, `s x c0 x n`."""

    situation: Situation
    measured: Tensor
    noise: Tensor | None
    usable: Tensor
    near: Tensor
    residual: Tensor
    fitted: Tensor
    jacobian: Tensor


class _Fixed(NamedTuple):
    """What stays for any findings: effects that show, discrepancy terms, those of one place or sway found at first,
    and the noise of the richest fit, `c`."""

    effects: list[Effect]
    rest: list[Atom]
    local: list[Atom]
    rich: Tensor


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
    rows = _rows_of(situation, measured, noise)
    result, fixed = _search_about_nominal(rows, effects)
    # Again about the best library set, with shapes searched beside it and the noise that the best set of all leaves.
    before: frozenset[str] | None = None
    for turn in range(2):
        # The first look takes about a tenth of the time, the second of two turns is often shorter.
        at_step("searching the effects", (0.1, 0.5)[turn])
        atoms = result.atoms
        best = next(f for f in result.found if not any(atoms[i].is_discrepancy for i in f.members))
        if before is not None and result.found[0].log_posterior - best.log_posterior > _MUCH_LESS_PROBABLE:
            break
        acting = result.acting(best)
        act = frozenset(a.effect.name for a in acting)
        white, left = _renewed(result, noise, rows.usable), remainder(situation, measured, acting)
        shapes = Known([a for a in atoms if a.effect is not None and a.shape.numel()], {}, before is None)
        if before is not None:
            old, sought = result.whitening, act if act == before else None
            if not has_new_effects(result.dictionary, result.found, best, before, result.gap) and is_converged(
                result.dictionary, result.y, best, old, white, without_frames(result.whitening, left, result.fitted)
            ):
                if torch.equal(white.keep(), old.keep()):
                    break
                # Other rows are bad ones, and nothing else has changed.
                sought = frozenset()
            shapes = shapes._replace(kept=known_shapes(result.atoms, result.found, best, sought))
        else:
            shapes = shapes._replace(starts=_kept_shapes(situation, shapes.starts, result, act))
        # A bump is not searched again where nothing outside the library does anything.
        local = before is None or discrepancy_is_active(result.dictionary, result.found, best)
        before = act
        result = _search_about_set(rows, fixed, result, acting, white, left, shapes, local)
    at_step("searching the effects", 0.8)
    result = _with_shared_noise(rows._replace(fitted=result.fitted), fixed.rich, result)
    if instrument is not None and noise is None and result.correlation.target is None:
        result = _above_instrument(result, instrument)
    shown = {e.name for e in fixed.effects}
    return replace(result, idle=tuple(e.name for e in effects if e.name not in shown))


def _rows_of(situation: Situation, measured: Tensor, noise: Tensor | None) -> _Rows:
    residual = pose_residual(situation, measured)
    near = near_singular(situation, moving_channels(situation))
    usable = torch.isfinite(residual).all(-1) & torch.isfinite(situation.jacobian).flatten(1).all(-1) & ~near
    residual = torch.where(usable[:, None], residual, 0.0)
    jacobian = torch.where(usable[:, None, None], situation.jacobian, 0.0)
    return _Rows(situation, measured, noise, usable, near, residual, frame_columns(situation, usable), jacobian)


def _search_about_nominal(rows: _Rows, effects: Sequence[Effect]) -> tuple[Analysis, _Fixed]:
    """About the nominal machine, on a part of the rows: only where to start from."""
    situation, usable = rows.situation, rows.usable
    channels = moving_channels(situation)
    atoms = [without_unused_rows(default_atom(situation, situation, e), usable) for e in effects]
    names = [e.name for e in effects]
    rest = [*smooth_discrepancies(situation, names), *linear_discrepancies(situation, names)]
    known = [a for a in rest if bool((torch.isfinite(a.columns.sum((1, 2))) | ~usable).all())]
    rest = [without_unused_rows(a, usable) for a in known if bool(a.columns[usable].any())]
    # What does not show at all in these rows is no candidate (latency at rest).
    largest = rows.residual[usable][:, channels].abs().amax(0).clamp_min(1e-15)
    atoms = [a for a in atoms if float((a.columns[:, channels] / largest[:, None]).abs().max()) > _SHOWN]
    everything = [a.columns for a in (*atoms, *rest) if not (a.is_discrepancy and a.name.startswith("joint"))]
    white = fitted_whitening(rows.residual, [rows.fitted, *everything], channels, rows.noise, usable)

    atoms_of_effects, starts = candidates_about_nominal(situation, atoms, white, rows.residual, usable, rows.fitted)
    local = local_discrepancies(situation, rows.jacobian, rows.residual, white, rows.fitted)
    shown = [a.effect for a in atoms if a.effect is not None]
    fixed = _Fixed(shown, rest, [without_unused_rows(a, usable) for a in local], white.sigma)
    every = [*atoms_of_effects, *starts, *rest, *fixed.local]
    few = _drawn(white.keep(), len(channels))
    return _searched(rows, rows.residual, white, every, fixed.rich, few), fixed


def _kept_shapes(situation: Situation, starts: Sequence[Atom], result: Analysis, acting: Set[str]) -> list[Atom]:
    """Of the shapes found at first those that stay candidates: of effects that act all, since what else acts now may
    have hidden the better ones, and of the others the likeliest and that of the textbook."""
    likely = most_probable_shapes(result.atoms, result.found)
    return [a for a in starts if a.name in acting or a is likely.get(a.name) or has_usual_shape(situation, a)]


def _search_about_set(
    rows: _Rows,
    fixed: _Fixed,
    result: Analysis,
    acting: Sequence[Acting],
    white: Whitening,
    left: Tensor,
    shapes: Known,
    local: bool,
) -> Analysis:
    """About the machine with the best set's effects, on all rows.

    Args:
        rows, standing: what stays.
        result: of the search before.
        acting: effects of its best set.
        white: noise and weights that its most probable set leaves.
        left: what those effects leave by the machine itself, `s x c0` [m, rad].
        shapes: found before.
        local: whether bumps are searched again.
    """
    situation, usable = rows.situation, rows.usable
    there, target = tangent(situation, left, acting)
    ok = usable & torch.isfinite(target).all(-1) & torch.isfinite(there.jacobian).flatten(1).all(-1)
    if int(ok.sum()) < _LINEARISED * int(usable.sum()):
        there, target, ok = situation, rows.residual, usable
    target = torch.where(ok[:, None], target, 0.0)
    white = white if bool((ok == usable).all()) else _renewed(result, rows.noise, ok)
    rows = rows._replace(fitted=frame_columns(there, ok))
    atoms = candidates_about_set(
        situation,
        there,
        rows.measured,
        target,
        fixed.effects,
        acting,
        shapes,
        white,
        ok,
        rows.fitted,
    )
    again: list[Atom] = []
    if local:
        # The first of a name has the shapes found now; its parts and earlier shapes add next to nothing.
        newest = {a.name: a.columns for a in reversed(atoms)}
        beside = torch.cat([rows.fitted, *(newest[name] for name in sorted({a.effect.name for a in acting}))], -1)
        again = local_discrepancies(situation, rows.jacobian, target, white, beside)
    every = [*atoms, *fixed.rest, *fixed.local, *(without_unused_rows(a, ok) for a in again)]
    return _searched(rows, target, white, every, fixed.rich)


def _above_instrument(result: Analysis, instrument: Tensor) -> Analysis:
    """The noise floor is that of the instrument where the best fit leaves more; sets are as probable as before."""
    white = result.whitening
    floor = float((instrument[white.channels] / white.sigma).square().mean())
    return replace(result, floor=min(result.floor, floor), instrument=instrument)


def _with_shared_noise(rows: _Rows, rich: Tensor, result: Analysis) -> Analysis:
    """The same candidates under noise that rows share, where the best sets found are more probable then."""
    white, atoms = result.whitening, result.atoms
    keep = white.keep()
    library = next(f for f in result.found if not any(atoms[i].is_discrepancy for i in f.members))
    sets = [
        Explanation([white(atoms[i].columns)[keep] for i in members], sum(atoms[i].log_prior for i in members))
        for members in {(), library.members, result.found[0].members}
    ]
    correlation = likeliest_correlation(
        white(result.residual)[keep],
        white(rows.fitted)[keep],
        sets,
        possible_correlations(rows.situation, keep),
        result.dictionary.noise_dof,
    )
    if not correlation.value:
        return result
    return _searched(rows, result.residual, white, [*atoms], rich, correlation=correlation)


def _searched(
    rows: _Rows,
    target: Tensor,
    white: Whitening,
    atoms: list[Atom],
    rich: Tensor,
    few: Tensor | None = None,
    correlation: Correlation = INDEPENDENT,
) -> Analysis:
    """target: what a linear model has to explain, `s x c0`; rich: noise of the richest fit, `c`; few: rows for a quick
    look, `t`; None = all that count, thoroughly; correlation: of the noise of the rows that count."""
    keep = white.keep() if few is None else few
    counted = slice(None) if len(keep) == len(target) else keep
    columns, y = [white(a.columns)[counted] for a in atoms], white(target)[counted]
    fitted = white(rows.fitted)[counted]
    plain = without_fitted(fitted, [y[..., None], *columns]) if correlation.value else []
    fitted, y, columns = correlation(fitted), correlation(y), [correlation(c) for c in columns]
    first, *columns = without_fitted(fitted, [y[..., None], *columns])
    y = first[..., 0]
    # Noise that was given is right to some per cent, however many rows there are.
    known = white.known * (1 + y.numel() / _VALUES_A_UNIT)
    dictionary, found = search(atoms, columns, y, known, quick=few is not None)
    shared = None
    if plain:
        x = torch.zeros_like(dictionary.columns)
        for i, group in dictionary.groups.items():
            x[..., group] = plain[1 + i]
        shared = x, plain[0][..., 0]
    # The richest fit knows no shapes: where these are most of the gap the best set leaves far less.
    left = found[0].rss / max(y.numel() - found[0].effective, 1.0)
    floor = min(float((rich / white.sigma).square().mean()), 1.0)
    # Nor does it know what rows share.
    floor = left if white.known == 0 and (correlation.value or left < _NOISE_REDUCTION * floor) else floor
    return Analysis(
        rows.situation,
        rows.measured,
        target,
        white,
        tuple(atoms),
        dictionary,
        y,
        found,
        rows.near,
        floor,
        rows.fitted,
        correlation=correlation,
        shared=shared,
        outside={i: c for i, (a, c) in enumerate(zip(atoms, columns, strict=True)) if a.is_discrepancy},
    )


def _drawn(rows: Tensor, channels: int) -> Tensor:
    """As many of the rows as are enough to start from, in order."""
    drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[: max(_START // channels, 1)]
    return rows[drawn.sort().values]


def _renewed(result: Analysis, noise: Tensor | None, usable: Tensor) -> Whitening:
    """Noise and weights from what the most probable set of all and the frames beside it leave."""
    best = result.found[0]
    left = result.residual
    for i, mean in zip(best.members, best.mean, strict=True):
        left = left - result.atoms[i].columns @ mean
    free = 1 - best.effective / max(result.dictionary.grams.values, 1.0)
    left = without_frames(result.whitening, left, result.fitted)
    return renewed(result.whitening, left, result.residual, free, noise is not None, usable)
