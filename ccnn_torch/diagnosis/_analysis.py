"""From rows to the posterior over sets of candidates: whitening, shapes, search, and again where they point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis._again import known_shapes, settled
from ccnn_torch.diagnosis._atoms import Atom
from ccnn_torch.diagnosis._candidates import cleaned, first_candidates, plain_atom, renewed_candidates
from ccnn_torch.diagnosis._catch_all import catch_alls
from ccnn_torch.diagnosis._dictionary import Dictionary, Found
from ccnn_torch.diagnosis._linear import remainder, tangent
from ccnn_torch.diagnosis._local import local_catch_alls
from ccnn_torch.diagnosis._richest import fitted_whitening
from ccnn_torch.diagnosis._search import search
from ccnn_torch.diagnosis._straight import straight_catch_alls
from ccnn_torch.diagnosis._whitening import NO_NOISE, Whitening, moving_channels, reweighted
from ccnn_torch.effects import Acting, Effect, Situation, pose_residual

__all__ = ["Analysis", "analyse", "frame_columns"]

# Rows are left out where the Jacobian is worse conditioned than this and than ten times the usual.
_CONDITION = 50.0
# Or where the joints move the platform so many times as far as usual.
_GAIN = 3.0
_FAR_BELOW = 0.5
# No third look where, with its shapes looked for beside its best, the library is so far behind (log odds).
_FAR_BEHIND = 20.0
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
        dictionary: atoms, their columns and Gram matrices in the end.
        y: what the atoms explain, whitened, `s x c`; rows that count.
        found: sets, most probable first.
        near_singular: `s`, bool.
        floor: mean square of the noise in the units of `y`: 1 where it was given, else that of the richest fit or,
            where that is far less, of the most probable set.
        idle: effects that change no pose in these rows, and were no candidates.
    """

    situation: Situation
    measured: Tensor
    residual: Tensor
    whitening: Whitening
    dictionary: Dictionary
    y: Tensor
    found: list[Found]
    near_singular: Tensor
    floor: float
    idle: tuple[str, ...] = ()

    def acting(self, found: Found) -> list[Acting]:
        """The effects of a set with their most probable numbers; catch-alls are left out."""
        out = []
        for i, mean in zip(found.members, found.mean, strict=True):
            atom = self.dictionary.atoms[i]
            if atom.effect is not None:
                out.append(Acting(atom.effect, atom.shape, atom.spread(self.situation, mean)))
        return out


def analyse(situation: Situation, measured: Tensor, effects: Sequence[Effect], noise: Tensor | None) -> Analysis:
    """The whole search.

    Args:
        situation: `s` rows.
        measured: poses, `s x p` [SI].
        effects: candidates, all of which the rows have the covariates for.
        noise: standard deviation of each pose channel, `c0` [m, rad], or None.
    """
    residual = pose_residual(situation, measured)
    channels = moving_channels(situation)
    near = _near_singular(situation, channels)
    usable = torch.isfinite(residual).all(-1) & torch.isfinite(situation.jacobian).flatten(1).all(-1) & ~near
    residual = torch.where(usable[:, None], residual, 0.0)

    atoms = [cleaned(plain_atom(situation, situation, e), usable) for e in effects]
    names = [e.name for e in effects]
    rest = [*catch_alls(situation, names), *straight_catch_alls(situation, names)]
    rest = [cleaned(a, usable) for a in rest if bool((torch.isfinite(a.columns).flatten(1).all(-1) | ~usable).all())]
    fitted = frame_columns(situation, usable)
    # What does not show at all in these rows is no candidate (latency at rest).
    size = [
        float(
            (a.columns[:, channels] / residual[usable][:, channels].abs().amax(0).clamp_min(1e-15)[:, None]).abs().max()
        )
        for a in atoms
    ]
    idle = tuple(e.name for e, s in zip(effects, size, strict=True) if s <= 1e-9)
    effects = [e for e in effects if e.name not in idle]
    atoms = [a for a, s in zip(atoms, size, strict=True) if s > 1e-9]
    everything = [a.columns for a in (*atoms, *rest) if not (a.catch_all and a.name.startswith("joint"))]
    white = fitted_whitening(residual, [fitted, *everything], channels, noise, usable)

    rich = white.sigma
    fixed, starts = first_candidates(situation, atoms, white, residual, usable, fitted)
    jacobian = torch.where(usable[:, None, None], situation.jacobian, 0.0)
    local = [cleaned(a, usable) for a in local_catch_alls(situation, jacobian, residual, white, fitted)]
    # Only where to start from: a part of the rows will do.
    few = _drawn(white.keep(), len(channels))
    every = [*fixed, *starts, *rest, *local]
    result = _searched(situation, measured, residual, white, every, near, rich, fitted, few)

    # Again about the best library set, with shapes looked for beside it and the noise that the best set of all leaves.
    before: frozenset[str] | None = None
    for _ in range(2):
        best = next(f for f in result.found if not any(result.dictionary.atoms[i].catch_all for i in f.members))
        if before is not None and result.found[0].log_posterior - best.log_posterior > _FAR_BEHIND:
            break
        acting = result.acting(best)
        act = frozenset(a.effect.name for a in acting)
        new, left = _renewed(result, noise, usable), remainder(situation, measured, acting)
        known: Mapping[str, Sequence[Atom]] = {}
        if before is not None:
            # Shapes found beside more than there is are as good, where what was too much explains nothing any more.
            if act <= before and settled(result.dictionary, result.y, best, result.whitening, new, left):
                break
            known = known_shapes(result.dictionary, result.found, best, act == before)
        before = act
        there, target = tangent(situation, left, acting)
        ok = usable & torch.isfinite(target).all(-1) & torch.isfinite(there.jacobian).flatten(1).all(-1)
        if int(ok.sum()) < 0.9 * int(usable.sum()):
            there, target, ok = situation, residual, usable
        target = torch.where(ok[:, None], target, 0.0)
        white = new if bool((ok == usable).all()) else _renewed(result, noise, ok)
        atoms = renewed_candidates(
            situation, there, measured, target, effects, acting, starts, known, white, ok, fitted
        )
        # The first of a name has the shapes found now; its parts and earlier shapes add next to nothing.
        newest = {a.name: a.columns for a in reversed(atoms)}
        beside = torch.cat([fitted, *(newest[name] for name in sorted(act))], -1)
        again = local_catch_alls(situation, jacobian, target, white, beside)
        places = [*local, *(cleaned(a, ok) for a in again)]
        result = _searched(situation, measured, target, white, [*atoms, *rest, *places], near, rich, fitted)
    return replace(result, idle=idle)


def _near_singular(situation: Situation, channels: Tensor) -> Tensor:
    """Rows whose Jacobian is far worse conditioned than the others', `s`."""
    jacobian = torch.nan_to_num(situation.jacobian[:, channels]).clone()
    jacobian[:, channels >= 3] *= 0.3
    values = torch.linalg.svdvals(jacobian)
    condition = values[:, 0] / values[:, -1].clamp_min(1e-300)
    far: Tensor = (condition > _CONDITION) & (condition > 10 * condition.median())
    # First order does not hold where the joints move the platform much more, and a few such rows have the whole gap.
    far = far | (values[:, 0] > _GAIN * values[:, 0].median())
    return far


def frame_columns(situation: Situation, usable: Tensor) -> Tensor:
    """What frames that were fitted to these rows can do, `s x c0 x r`, in sizes that no evidence holds back."""
    unknown = getattr(situation.mechanism, "unknown_frames", ())
    index = [k for k, g in enumerate(situation.mechanism.geometry) if g.name.partition("_")[0] in unknown]
    columns = situation.parameter_jacobian[..., index] if index else situation.jacobian[..., :0]
    return torch.where(usable[:, None, None], columns, 0.0)


def _searched(
    situation: Situation,
    measured: Tensor,
    target: Tensor,
    white: Whitening,
    atoms: list[Atom],
    near: Tensor,
    rich: Tensor,
    fitted: Tensor,
    few: Tensor | None = None,
) -> Analysis:
    """few: rows for a quick look, `t`; None = all that count, thoroughly."""
    keep = white.keep() if few is None else few
    rows = slice(None) if len(keep) == len(target) else keep
    columns, y = [white(a.columns)[rows] for a in atoms], white(target)[rows]
    if fitted.shape[-1]:
        # What was fitted before takes its part out of everything.
        u, s, _ = torch.linalg.svd(white(fitted)[rows].flatten(0, 1), full_matrices=False)
        q = u[:, s > 1e-9 * s[0]]
        y = (y.flatten() - q @ (q.mT @ y.flatten())).reshape(y.shape)
        columns = [(c.flatten(0, 1) - q @ (q.mT @ c.flatten(0, 1))).reshape(c.shape) for c in columns]
    # Noise that was given is right to some per cent, however many rows there are.
    known = white.known * (1 + y.numel() / 100)
    dictionary, found = search(atoms, columns, y, known, quick=few is not None)
    # The richest fit knows no shapes: where these are most of the gap the best set leaves far less.
    left = found[0].rss / max(y.numel() - found[0].effective, 1.0)
    floor = min(float((rich / white.sigma).square().mean()), 1.0)
    floor = left if white.known == 0 and left < _FAR_BELOW * floor else floor
    return Analysis(situation, measured, target, white, dictionary, y, found, near, floor)


def _drawn(rows: Tensor, channels: int) -> Tensor:
    """As many of the rows as are enough to start from, in order."""
    drawn = torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[: max(_START // channels, 1)]
    return rows[drawn.sort().values]


def _renewed(result: Analysis, noise: Tensor | None, usable: Tensor) -> Whitening:
    """Noise and weights from what the most probable set of all leaves."""
    best, white = result.found[0], result.whitening
    raw = result.residual
    for i, mean in zip(best.members, best.mean, strict=True):
        raw = raw - result.dictionary.atoms[i].columns @ mean
    raw = raw[:, white.channels]
    free = 1 - best.effective / max(result.dictionary.grams.values, 1.0)
    if noise is None:
        rows = (white.weight > 0) & usable
        spread = raw[rows].abs().median(0).values * 1.4826 / max(free, 0.1) ** 0.5
        rms = result.residual[rows][:, white.channels].abs().median(0).values * 1.4826
        white = Whitening(
            white.channels, torch.maximum(spread, 1e-4 * rms).clamp_min(NO_NOISE), white.weight, white.known
        )
    return reweighted(white, raw, usable, free)
