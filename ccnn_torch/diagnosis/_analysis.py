"""From rows to the posterior over sets of candidates: whitening, shapes, search, and again where they point."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis._atoms import Atom, default_shape
from ccnn_torch.diagnosis._catch_all import catch_alls
from ccnn_torch.diagnosis._evidence import alone, grams_of
from ccnn_torch.diagnosis._linear import remainder, signature_at, tangent
from ccnn_torch.diagnosis._search import Found, Library, search
from ccnn_torch.diagnosis._shapes import Scan, Shaped
from ccnn_torch.diagnosis._whitening import Whitening, fitted_whitening, moving_channels, reweighted
from ccnn_torch.effects import Acting, Effect, Situation, pose_residual

__all__ = ["Analysis", "analyse"]

LOG_PRIOR = math.log(0.1)
# Rows are left out where the Jacobian is worse conditioned than this and than ten times the usual.
_CONDITION = 50.0
# Effects with so many coefficients are looked for in one joint or leg, too; spread of their log size there.
_MANY, _SIZE_SPREAD = 8, 4.0
# Or where the joints move the platform so many times as far as usual.
_GAIN = 3.0


@dataclass(frozen=True)
class Analysis:
    """What the rows say.

    Attributes:
        situation: the rows.
        measured: poses, `s x p`.
        residual: measured less nominal, `s x c0` [m, rad].
        whitening: channels, noise and row weights in the end.
        library: atoms and Gram matrices in the end.
        columns: of every atom, whitened, `s x c x P`.
        y: what they explain, whitened, `s x c`.
        found: sets, most probable first.
        near_singular: `s`, bool.
        floor: mean square of the noise in the units of `y`: 1 where it was given, else that of the richest fit.
    """

    situation: Situation
    measured: Tensor
    residual: Tensor
    whitening: Whitening
    library: Library
    columns: Tensor
    y: Tensor
    found: list[Found]
    near_singular: Tensor
    floor: float

    def acting(self, found: Found) -> list[Acting]:
        """The effects of a set with their most probable numbers; catch-alls are left out."""
        out = []
        for i, mean in zip(found.members, found.mean, strict=True):
            atom = self.library.atoms[i]
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

    atoms = [_atom(situation, situation, e, Shaped(default_shape(situation, e), None, 0.0)) for e in effects]
    rest = [a for a in catch_alls(situation) if bool(torch.isfinite(a.columns[usable]).all())]
    atoms = [_cleaned(a, usable) for a in atoms]
    rest = [_cleaned(a, usable) for a in rest]
    fitted = _frame_columns(situation, usable)
    # What does not show at all in these rows is no candidate (latency at rest).
    size = [
        float(
            (a.columns[:, channels] / residual[usable][:, channels].abs().amax(0).clamp_min(1e-15)[:, None]).abs().max()
        )
        for a in atoms
    ]
    effects = [e for e, s in zip(effects, size, strict=True) if s > 1e-9]
    atoms = [a for a, s in zip(atoms, size, strict=True) if s > 1e-9]
    everything = [a.columns for a in (*atoms, *rest) if not (a.catch_all and a.name.startswith("joint"))]
    white = fitted_whitening(residual, [fitted, *everything], channels, noise, usable)

    rich = white.sigma
    # Shapes by themselves and with the rest of the library beside them: two ways to start, both stay candidates.
    fixed = [a for a in atoms if a.shape.numel() == 0]
    fixed += [part for a in fixed if (part := _best_part(situation, a, white, residual)) is not None]
    shaped = [a for a in atoms if a.shape.numel()]
    alone = white(fitted)
    beside = torch.cat([alone, *(white(a.columns) for a in fixed)], -1)
    starts: list[Atom] = []
    for atom in shaped:
        assert atom.effect is not None
        scan = Scan(situation, situation, atom.effect, _only(white, usable))
        for nuisance in (alone, beside):
            shaped_so = scan.best(white(residual), nuisance)
            if not any(a.effect is atom.effect and _same_shape(a, shaped_so) for a in starts):
                starts.append(_cleaned(_atom(situation, situation, atom.effect, shaped_so), usable))
    result = _searched(situation, measured, residual, white, [*fixed, *starts, *rest], near, rich, fitted)

    # Again about the best library set, with shapes looked for beside it and the noise that the best set of all leaves.
    before: tuple[str, ...] | None = None
    for _ in range(2):
        best = next(f for f in result.found if not any(result.library.atoms[i].catch_all for i in f.members))
        acting = result.acting(best)
        if before == (before := tuple(a.effect.name for a in acting)) and noise is not None:
            break
        there, target = tangent(situation, measured, acting)
        ok = usable & torch.isfinite(target).all(-1) & torch.isfinite(there.jacobian).flatten(1).all(-1)
        if int(ok.sum()) < 0.9 * int(usable.sum()):
            there, target, ok = situation, residual, usable
        target = torch.where(ok[:, None], target, 0.0)
        white = _renewed(result, noise, ok)
        atoms = []
        for effect in effects:
            inside = [a for a in acting if a.effect is effect]
            start = inside[0].shape if inside else None
            if not effect.shapes(situation):
                none = Shaped(default_shape(situation, effect), None, 0.0)
                atoms.append(_cleaned(_atom(situation, there, effect, none), ok))
                beside = [a for a in acting if a.effect is not effect]
                left = torch.where(ok[:, None], torch.nan_to_num(remainder(situation, measured, beside)), 0.0)
                part = _best_part(situation, atoms[-1], white, left)
                atoms += [part] if part is not None else []
                continue
            others = [
                white(_cleaned(_atom(situation, there, a.effect, Shaped(a.shape, None, 0.0)), ok).columns)
                for a in acting
                if a.effect is not effect
            ]
            beside = torch.cat([white(fitted), *others], -1)
            shaped_so = Scan(situation, there, effect, _only(white, ok)).best(white(target), beside, start)
            atoms.append(_cleaned(_atom(situation, there, effect, shaped_so), ok))
            # What was found at first stays a candidate: what acts now may have hidden the better shape.
            for old in (a for a in starts if a.effect is effect and not _same_shape(a, shaped_so)):
                so = Shaped(old.shape, old.used, LOG_PRIOR - old.log_prior)
                atoms.append(_cleaned(_atom(situation, there, effect, so), ok))
        result = _searched(situation, measured, target, white, [*atoms, *rest], near, rich, fitted)
    return result


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


def _frame_columns(situation: Situation, usable: Tensor) -> Tensor:
    """What frames that were fitted to these rows can do, `s x c0 x r`, in sizes that no evidence holds back."""
    unknown = getattr(situation.mechanism, "unknown_frames", ())
    index = [k for k, g in enumerate(situation.mechanism.geometry) if g.name.partition("_")[0] in unknown]
    columns = situation.parameter_jacobian[..., index] if index else situation.jacobian[..., :0]
    return torch.where(usable[:, None, None], columns, 0.0)


def _atom(situation: Situation, there: Situation, effect: Effect, shaped: Shaped) -> Atom:
    columns = signature_at(situation, there, effect, shaped.value)
    if shaped.used is not None:
        columns = columns[..., list(shaped.used)]
    return Atom(effect.name, effect, shaped.value, columns, LOG_PRIOR - shaped.charge, shaped.used)


def _same_shape(atom: Atom, shaped: Shaped) -> bool:
    return atom.used == shaped.used and torch.allclose(atom.shape, shaped.value, rtol=1e-3)


def _best_part(situation: Situation, atom: Atom, white: Whitening, y: Tensor) -> Atom | None:
    """Of an effect with many coefficients those of the one joint or leg that explains most of `y`, and of others beside
    it that the evidence is for, up to half of them."""
    assert atom.effect is not None
    coefficients = atom.effect.coefficients(situation)
    owners = [c.joint if c.leg is None else c.leg for c in coefficients]
    parts = [[k for k, o in enumerate(owners) if o == owner] for owner in dict.fromkeys(owners) if owner is not None]
    if len(coefficients) < _MANY or len(parts) < 2:
        return None
    grams = grams_of(white(atom.columns), white(y))
    charge, lots, reached = math.log(len(parts)), 0, -math.inf
    chosen: list[int] = []
    while lots < max(len(parts) // 2, 1):
        wider = [sorted(chosen + p) if not set(p) <= set(chosen) else p for p in parts]
        evidence = alone(grams, [torch.tensor(p) for p in wider], _SIZE_SPREAD)[0][1:]
        best = int(evidence.argmax())
        if float(evidence[best]) < reached + charge or wider[best] == chosen:
            break
        chosen, reached = wider[best], float(evidence[best])
        lots += 1
    return replace(
        atom, columns=atom.columns[..., chosen], log_prior=atom.log_prior - lots * charge, used=tuple(chosen)
    )


def _only(white: Whitening, usable: Tensor) -> Whitening:
    """The same with rows that are left out set to zero."""
    return replace(white, weight=torch.where(usable, white.weight, 0.0))


def _cleaned(atom: Atom, usable: Tensor) -> Atom:
    """With rows that are left out set to zero."""
    columns = torch.where(usable[:, None, None], atom.columns, 0.0)
    return replace(atom, columns=columns)


def _searched(
    situation: Situation,
    measured: Tensor,
    target: Tensor,
    white: Whitening,
    atoms: list[Atom],
    near: Tensor,
    rich: Tensor,
    fitted: Tensor,
) -> Analysis:
    keep = white.keep()
    columns = white(torch.cat([a.columns for a in atoms], -1)) if atoms else white(target)[..., None][..., :0]
    y = white(target)
    if fitted.shape[-1]:
        # What was fitted before takes its part out of everything.
        u, s, _ = torch.linalg.svd(white(fitted).flatten(0, 1), full_matrices=False)
        q = u[:, s > 1e-9 * s[0]]
        y = (y.flatten() - q @ (q.mT @ y.flatten())).reshape(y.shape)
        flat = columns.flatten(0, 1)
        columns = (flat - q @ (q.mT @ flat)).reshape(columns.shape)
    ends = torch.tensor([a.columns.shape[-1] for a in atoms]).cumsum(0).tolist()
    groups = tuple(torch.arange(e - a.columns.shape[-1], e) for a, e in zip(atoms, ends, strict=True))
    # Noise that was given is right to some per cent, however many rows there are.
    known = white.known * (1 + y[keep].numel() / 100)
    library = Library(tuple(atoms), groups, grams_of(columns[keep], y[keep]), known)
    floor = min(float((rich / white.sigma).square().mean()), 1.0)
    return Analysis(situation, measured, target, white, library, columns, y, search(library), near, floor)


def _renewed(result: Analysis, noise: Tensor | None, usable: Tensor) -> Whitening:
    """Noise and weights from what the most probable set of all leaves."""
    best, white = result.found[0], result.whitening
    theta = torch.zeros(result.columns.shape[-1], dtype=result.columns.dtype)
    for i, mean in zip(best.members, best.mean, strict=True):
        theta[result.library.groups[i]] = mean
    raw = result.residual - torch.cat([a.columns for a in result.library.atoms], -1) @ theta
    free = 1 - best.effective / max(result.library.grams.values, 1.0)
    if noise is None:
        rows = (white.weight > 0) & usable
        spread = raw[rows][:, white.channels].abs().median(0).values * 1.4826 / max(free, 0.1) ** 0.5
        rms = result.residual[rows][:, white.channels].abs().median(0).values * 1.4826
        white = Whitening(white.channels, torch.maximum(spread, 1e-4 * rms).clamp_min(1e-15), white.weight, white.known)
    return reweighted(white, raw, usable, free)
