"""The blocks of a diagnosis from an analysis and its judgement; why rows do not distinguish two effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom, scales
from ccnn_torch.diagnosis.residual.linearisation import signature_at
from ccnn_torch.diagnosis.residual.rows import frame_columns
from ccnn_torch.diagnosis.residual.whitening import LEAST_FREE, ROUNDING
from ccnn_torch.diagnosis.result import effect_block, gap_block
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.shrink.held_out import held_out
from ccnn_torch.diagnosis.verdict.findings import ZERO_OF
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.effects import Coefficient, Situation, moved
from ccnn_torch.evidence.dictionary import FittedSet, covariance
from ccnn_torch.evidence.marginal_likelihood import fit_sets, grams_of, groups_of
from ccnn_torch.evidence.shrink import FOLDS, Gap, HeldOut, draws, shrink_of


def by_block(made: Blocks) -> dict[str, Any] | None:
    """`by_block` of diagnosis.json; None where the verdict names nothing, or there are too few rows for blocks.

    The names and their shapes (periods, lags) are those of all rows; their numbers, and frames that are not known, are
    fitted to the rows outside of the block.

    Args:
        made: the diagnosis' held-out rows, its names and its draws.
    """
    analysis, judgement = made.analysis, made.judgement
    atoms = analysis.atoms
    members = [i for i in judgement.found.members if atoms[i].name in judgement.names]
    white, keep = analysis.whitening, analysis.whitening.keep()
    framed, fresh = white(analysis.fitted)[keep], white(frame_columns(analysis.situation, white.counted))[keep]
    number = cut(analysis.situation.joints[keep], fresh)
    if not members or not bool(torch.bincount(number, minlength=FOLDS).all()):
        return None
    columns = torch.cat([white(atoms[i].columns) for i in members], -1)[keep]
    groups = groups_of(atoms[i].columns for i in members)
    nominal, target = white(made.residual)[keep], white(analysis.residual)[keep]
    before, left, uncertain = nominal.clone(), target.clone(), torch.zeros_like(target)
    for k in range(FOLDS):
        there = number == k
        before[there] = nominal[there] - fresh[there] @ _frames(fresh[~there])(nominal[~there])
        alone = _frames(framed[~there])
        x, y = columns[~there], target[~there]
        # Frames are as large as they have to be: what they can do is no evidence.
        apart, rest = x - framed[~there] @ alone(x), y - framed[~there] @ alone(y)
        fit = fit_sets(grams_of(apart, rest), [groups], analysis.dictionary.noise_dof)
        mean = fit.mean[0]
        frame = alone(y - x @ mean)
        here = columns[there] - framed[there] @ alone(x)
        left[there] = target[there] - columns[there] @ mean - framed[there] @ frame
        uncertain[there] = ((here @ fit.covariance[0]) * here).sum(-1)
    weight = white.weight[keep].sqrt()
    held = HeldOut(left / weight * white.sigma, uncertain / weight.square() * white.sigma.square())
    start = before / weight * white.sigma
    gap = made.main(held, start)
    channels = made.position if bool(made.position.any()) else ~made.position

    def sizes(values: Tensor) -> list[float]:
        squares = values[:, channels].square().sum(-1)
        return [float(squares[number == k].mean().sqrt()) for k in range(FOLDS)]

    return {
        "unit": "m" if bool(made.position.any()) else "rad",
        "before": gap.before,
        "after": gap.after,
        "noise_floor": gap.floor,
        "shrink": gap.shrink,
        "shrink_ci95": None if gap.interval is None else list(gap.interval),
        "blocks": [
            {"rows": int((number == k).sum()), "before": b, "after": a}
            for k, (b, a) in enumerate(zip(sizes(start), sizes(held.left), strict=True))
        ],
    }


def _frames(columns: Tensor) -> Callable[[Tensor], Tensor]:
    """Least-squares coefficients of frames' columns `s x c x r` for values `s x c` or `s x c x m`: `r` or `r x m`."""
    inverse = torch.linalg.pinv(columns.flatten(0, 1), rtol=ROUNDING)
    return lambda values: inverse @ values.flatten(0, 1)


def cut(joints: Tensor, frames: Tensor) -> Tensor:
    """Number of each row's block along the direction in which the joints vary most, `s` int64.

    Args:
        joints: `s x n`; each counts in units of its spread.
        frames: columns of the frames, `s x c x r`: rows with the same ones among them not zero share their frame.
    """
    centred = joints - joints.mean(0)
    scaled = centred / centred.square().mean(0).sqrt().clamp_min(1e-12)
    along = scaled @ torch.linalg.svd(scaled, full_matrices=False)[2][0]
    # One column more that all rows have: there may be no frames at all.
    theirs = torch.nn.functional.pad((frames != 0).any(1), (0, 1), value=True)
    shared = torch.unique(theirs, dim=0, return_inverse=True)[1]
    found = torch.empty_like(shared)
    for group in shared.unique():
        mine = torch.nonzero(shared == group).squeeze(-1)
        order = mine[along[mine].argsort(stable=True)]
        found[order] = torch.arange(len(mine)) * FOLDS // len(mine)
    return found


# Step of a derivative by a shape, as a share of its grid's narrowest step.
_STEP = 1e-3


class Spread(NamedTuple):
    """Attributes:
    coefficients: covariance, atom by atom, in units of their plausible sizes, `m x m`.
    shapes: standard deviation of each shape that was searched between the values of its grid [SI], by the atom's place
        in the set and the shape's number.
    """

    coefficients: Tensor
    shapes: dict[tuple[int, int], float]


def spread_of(analysis: Analysis, found: FittedSet) -> Spread:
    """Covariance of the coefficients of a set, what is not known of its shapes included.

    The model is linear in the coefficients for given shapes; about the shapes that were found it is taken as linear in
    these, too (Laplace's approximation; MacKay 1992), with a normal prior as wide as their grids.
    """
    given = covariance(analysis.dictionary, found)
    there = moved(analysis.situation, analysis.acting(found))
    keys, columns, priors = [], [], []
    for place, (i, mean) in enumerate(zip(found.members, found.mean, strict=True)):
        atom = analysis.atoms[i]
        for h, step in _free_shapes(analysis.situation, atom).items():
            keys.append((place, h))
            columns.append(_derivative(analysis.situation, there, atom, mean, h, step))
            assert atom.effect is not None
            grid = atom.effect.shapes(analysis.situation)[h].grid
            priors.append(12 / (grid[-1] - grid[0]) ** 2)
    if not keys:
        return Spread(given, {})
    (by_shape,) = analysis.whitened([torch.stack(columns, -1)])
    index = torch.cat([analysis.dictionary.groups[i] for i in found.members])
    own, by_shape = analysis.dictionary.columns[..., index].flatten(0, 1), by_shape.flatten(0, 1)
    across = given @ (own.mT @ by_shape) / found.noise
    precision = by_shape.mT @ by_shape / found.noise + torch.diag(by_shape.new_tensor(priors))
    shapes = torch.linalg.inv(precision - (own.mT @ by_shape).mT @ across / found.noise)
    deviations = shapes.diagonal().clamp_min(0).sqrt().tolist()
    return Spread(given + across @ shapes @ across.mT, dict(zip(keys, deviations, strict=True)))


def _free_shapes(situation: Situation, atom: Atom) -> dict[int, float]:
    """Numbers of an atom's shapes of which values between those of the grid are possible, with a small step of each."""
    if atom.effect is None:
        return {}
    used = None if atom.used is None else set(atom.used)
    return {
        h: _STEP * min(high - low for low, high in zip(shape.grid, shape.grid[1:], strict=False))
        for h, shape in enumerate(atom.effect.shapes(situation))
        if shape.refined and len(shape.grid) > 1 and (used is None or shape.columns is None or used & {*shape.columns})
    }


def _derivative(situation: Situation, there: Situation, atom: Atom, mean: Tensor, h: int, step: float) -> Tensor:
    """Of what an atom does by one of its shapes, `s x c` [m or rad per SI unit of the shape]; within the grid."""
    assert atom.effect is not None
    grid = atom.effect.shapes(situation)[h].grid
    size = scales(atom.effect.coefficients(situation), mean)
    ends = []
    for end in (max(float(atom.shape[h]) - step, grid[0]), min(float(atom.shape[h]) + step, grid[-1])):
        shape = atom.shape.clone()
        shape[h] = end
        done = signature_at(situation, there, atom.effect, shape) @ (atom.spread(situation, mean) / size)
        ends.append((end, torch.nan_to_num(done)))
    (low, before), (high, after) = ends
    change: Tensor = (after - before) / (high - low)
    return change


# Squares that are not seen in all rows together, in noise variances.
_UNSEEN = 0.1
# Times what a verdict leaves that a part of its numbers may leave.
_KEPT = 1.2
# Times the largest number of the fit that one may be when fewer do the same: so many may have shared an error.
_LARGER = 10.0
# Share by which the gains of numbers that do the same may differ.
_TIE = 1e-6


def fewest(gram: Tensor, mean: Tensor, spread: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Numbers of a model that do to the rows what all of them do, as few as can be found one by one.

    Some numbers do the very same to all poses, as shifts along parallel axes do, and a fit spreads an error over them.
    Others do nearly the same: metres of one less those of another would be a millimetre of a third, and are no way to
    tell it.

    Args:
        gram: inner products of what the numbers do, each by its plausible size, `m x m`.
        mean, spread: the numbers as fitted, in plausible sizes, `m`, and their covariance, `m x m`.
        noise: variance of one value.

    Returns:
        The numbers, `m`, 0 for those that are not needed; standard deviations, `m`, those of the fit for these.
    """
    deviation = spread.diagonal().clamp_min(0).sqrt()
    target, chosen, found = gram @ mean, torch.zeros(len(mean), dtype=torch.bool), torch.zeros_like(mean)
    most = _LARGER * max(float(mean.abs().amax()), 1.0)

    def unseen(these: Tensor, values: Tensor) -> bool:
        same = float((values - these) @ gram @ (values - these)) <= _UNSEEN * noise
        return same and float(these.abs().amax()) <= most

    def solved(these: Tensor) -> Tensor:
        values = torch.zeros_like(mean)
        values[these] = torch.linalg.solve(gram[these][:, these], target[these])
        return values

    while not unseen(found, mean):
        cross = gram[chosen]
        free = gram.diagonal() - (cross * torch.linalg.solve(gram[chosen][:, chosen], cross)).sum(0)
        lacking = target - gram @ found
        gain = lacking.square() / free
        gain[chosen | (free <= _UNSEEN * noise) | (lacking.abs() > most * free)] = 0.0
        if not bool((gain > 0).any()):
            return mean, deviation
        # Of numbers that do the same the first, whatever the rounding.
        chosen[torch.nonzero(gain >= (1 - _TIE) * gain.max())[0]] = True
        found = solved(chosen)
    for i in torch.nonzero(chosen).squeeze(-1).tolist():
        chosen[i] = False
        if unseen(fewer := solved(chosen), mean):
            found = fewer
        else:
            chosen[i] = True
    # As well as they are known where the others are what the model has.
    inner, cross = spread[~chosen][:, ~chosen], spread[~chosen]
    known = spread.diagonal() - (cross * torch.linalg.solve(inner, cross)).sum(0)
    return found, torch.where(chosen, known.clamp_min(0).sqrt(), deviation)


def together(gram: Tensor, mean: Tensor, deviation: Tensor, left: float) -> int:
    """How many of the clearest numbers have to be entered together to leave no more than 1.2 times what all leave.

    Args:
        gram, mean: as for `fewest`.
        deviation: standard deviations, `m`, which say which numbers are the clearest.
        left: squares that all of them leave.
    """
    gone = mean.clone()
    for count, i in enumerate((mean.abs() / deviation).argsort(descending=True).tolist()):
        if float(gone @ gram @ gone) <= (_KEPT**2 - 1) * left:
            return count
        gone[i] = 0.0
    return len(mean)


class Blocks:
    """Gap, effects and shrink, all on the same held-out rows."""

    def __init__(self, analysis: Analysis, judgement: Judgement, residual: Tensor, seed: int) -> None:
        """residual: nominal, `s x c0` [m, rad]; seed: of folds and draws."""
        white = analysis.whitening
        self.analysis, self.judgement, self.residual = analysis, judgement, residual
        self.before = white.picked(residual)[white.keep()]
        self.floor = noise_floor(analysis)
        self.position = white.lengths
        atoms = analysis.atoms
        self.candidates = _candidates(analysis, judgement)
        members = judgement.found.members
        alone = [[i] for i in self.candidates.values()]
        # The verdict's effects one after the other, the largest first; the last has them all.
        place = {atoms[i].name: i for i in members if not atoms[i].is_discrepancy}
        steps = [[place[n] for n in judgement.names[:k]] for k in range(len(judgement.names) + 1)]
        self.draws = draws(len(self.before), seed)
        held = held_out(analysis, [*steps, *alone], seed)
        self.steps, self.together = held[1 : len(steps)], held[len(steps) - 1]
        self.alone: dict[str, HeldOut] = dict(zip(self.candidates, held[len(steps) :], strict=True))
        self.apart = signature_angles(analysis, judgement)

    def gap(self, held: HeldOut, position: bool, before: Tensor | None = None) -> Gap:
        """In position [m] or rotation [rad]; before: `s x c` [m, rad], None = the nominal residual."""
        channels = self.position if position else ~self.position
        # Means are over what was measured.
        times = self.analysis.whitening.times
        before = self.before if before is None else before
        held = held if times is None else HeldOut(held.left * times.sqrt(), held.uncertain * times)
        free = self.analysis.dictionary.grams.values - self.judgement.found.effective
        dof = 0.0 if self.analysis.noise_is_known else max(free, 1.0)
        before = before if times is None else before * times.sqrt()
        return shrink_of(before, held, self.floor, channels, dof, self.draws)

    def main(self, held: HeldOut, before: Tensor | None = None) -> Gap:
        """In position where the machine has one, else in rotation; before: as for `gap`."""
        return self.gap(held, bool(self.position.any()), before)


def blocks(made: Blocks) -> tuple[dict[str, Any], dict[str, Any] | None, list[dict[str, Any]]]:
    """`gap`, `gap_rotation`, `effects` of diagnosis.json."""
    position, rotation = bool(made.position.any()), bool((~made.position).any())
    gap = gap_block(made.main(made.together), "m" if position else "rad")
    turned = gap_block(made.gap(made.together, False), "rad") if rotation and position else None
    judged = made.judgement
    effects = [
        effect_block(
            name,
            judged.marginal.get(name, 0.0),
            _parameters(made, name),
            made.main(made.alone[name]),
            judged.classes.get(name, ()),
            made.apart.get(name, {}),
        )
        for name in _ordered(made)
    ]
    return gap, turned, effects


def noise_floor(analysis: Analysis) -> Tensor:
    """Variance of the noise, `c`: given, shown by the records, or the mean square that the most probable set leaves."""
    white, best = analysis.whitening, analysis.found[0]
    if white.known > 0 or not analysis.dictionary.grams.values:
        return white.sigma.square()
    if analysis.instrument is not None:
        return analysis.instrument[white.channels].square()
    keep = white.keep()
    x, left = analysis.plain
    for i, mean in zip(best.members, best.mean, strict=True):
        left = left - x[..., analysis.dictionary.groups[i]] @ mean
    free = max(1 - best.effective / analysis.dictionary.grams.values, LEAST_FREE)
    # No more than the richest fit leaves.
    share = min(analysis.floor / max(float(left.square().mean()) / free, 1e-300), 1.0)
    noise = (left / white.weight[keep].sqrt() * white.sigma).square().mean(0) / free * share
    return noise if white.times is None else noise * white.times


def _parameters(made: Blocks, name: str) -> dict[str, dict[str, Any]]:
    """Value and standard deviation in the verdict's set, beside the corrections of its form; else alone.

    With the joint, leg or link that it belongs to, and of a parameter of the mechanism what its model has.
    """
    analysis = made.analysis
    atoms = analysis.atoms
    own = made.judgement.fullest if name in made.judgement.names else made.judgement.acting
    if not any(atoms[i].name == name for i in own.members):
        alone = made.candidates[name]
        own = next(f for f in analysis.found if f.members == (alone,))
    place = next(k for k, i in enumerate(own.members) if atoms[i].name == name)
    atom = atoms[own.members[place]]
    assert atom.effect is not None
    start = sum(len(m) for m in own.mean[:place])
    mean, here = own.mean[place], slice(start, start + len(own.mean[place]))
    whole = spread_of(analysis, own)
    spread = whole.coefficients[here, here]
    deviation = spread.diagonal().clamp_min(0).sqrt()
    needed: dict[str, int] = {}
    if atom.effect.kind == "parameters":
        group = analysis.dictionary.groups[own.members[place]]
        gram = analysis.dictionary.grams.xx[group][:, group]
        mean, deviation = fewest(gram, mean, spread, own.noise)
        needed = {"together": together(gram, mean, deviation, own.rss)}
    coefficients = atom.coefficients(analysis.situation)
    mechanism = analysis.situation.mechanism
    nominal = {p.name: float(v) for p, v in zip(mechanism.geometry, mechanism.nominal, strict=True)}
    found: dict[str, dict[str, Any]] = {
        c.name: {"value": float(v) * c.scale, "sd": float(d) * c.scale, "unit": c.unit, "part": _part(c, name)}
        | needed
        | ({"nominal": nominal[c.name]} if atom.effect.kind == "parameters" and c.name in nominal else {})
        for c, v, d in zip(coefficients, mean, deviation, strict=True)
    }
    senses = {p.name: p.sense for p in mechanism.geometry if p.sense}
    senses |= {
        f"q{name.removeprefix('theta')}": sense
        for name, sense in senses.items()
        if name.startswith("theta") and not sense.startswith(ZERO_OF)
    }
    for label, block in found.items():
        if sense := senses.get(label.rpartition(": ")[2], ""):
            block["sense"] = sense
    for parameter in mechanism.geometry:
        same = parameter.name if atom.effect.kind == "parameters" else parameter.same_as.removeprefix(f"{name} ")
        if parameter.word and same in found:
            found[same] |= {"word": parameter.word, "shown": parameter.shown}
    for coefficient, i in getattr(atom.effect, "counted_from", lambda _: {})(analysis.situation).items():
        if coefficient in found:
            joint, middle = mechanism.joints[i], float(analysis.situation.middle[i])
            found[coefficient]["about"] = {"joint": joint.name, "value": middle, "unit": joint.unit}
    used = None if atom.used is None else set(atom.used)
    for h, (shape, value) in enumerate(zip(atom.effect.shapes(analysis.situation), atom.shape.tolist(), strict=True)):
        if used is None or shape.columns is None or used & set(shape.columns):
            deviation_of = whole.shapes.get((place, h))
            found[shape.name] = {"value": value, "sd": deviation_of, "unit": shape.unit, "searched": True}
    return found


def _part(coefficient: Coefficient, effect: str) -> str | None:
    """The one leg, joint or link that a coefficient belongs to, in words."""
    if coefficient.leg is not None:
        return f"leg {coefficient.leg}"
    if coefficient.joint is None:
        return None
    return f"{'link' if effect == 'geometry' else 'joint'} {coefficient.joint.removeprefix('q')}"


def _candidates(analysis: Analysis, judgement: Judgement) -> dict[str, int]:
    """Of each library name the atom that the verdict's set uses, or that is most probable alone."""
    atoms = analysis.atoms
    best = {atoms[i].name: i for i in judgement.found.members if not atoms[i].is_discrepancy}
    for found in analysis.found:
        if len(found.members) == 1 and not atoms[found.members[0]].is_discrepancy:
            best.setdefault(atoms[found.members[0]].name, found.members[0])
    return best


def _ordered(made: Blocks) -> list[str]:
    marginal = made.judgement.marginal
    tie = {n: made.alone[n].left.square().sum() for n in made.alone}
    return sorted(made.alone, key=lambda n: (-marginal.get(n, 0.0), float(tie[n]), n))


_RANK = 1e-9


def signature_angles(analysis: Analysis, judgement: Judgement) -> dict[str, dict[str, dict[str, float]]]:
    """Of each of the verdict's effects how far its signature is from those that may replace it.

    A signature is the fitted part of an effect in units of the noise, the verdict's other effects projected out. The
    angle is the principal one between it and all that the other effect can do (Björck and Golub 1973): 0 where the
    other can do the very same. What no fit of the other can copy is the sine of the angle times the size of the
    signature, the root of a sum of squares over all rows: below about 3 noise hides it, at any angle.

    Returns:
        `{effect: {other: {"angle" [rad], "separation" [1, times the noise]}}}`.
    """
    atoms = analysis.atoms
    found = judgement.found
    flat = analysis.dictionary.columns.flatten(0, 1)

    def columns(members: Sequence[int]) -> Tensor:
        return torch.cat([flat[:, :0], *(flat[:, analysis.dictionary.groups[i]] for i in members)], -1)

    block: dict[str, dict[str, dict[str, float]]] = {}
    for i, mean in zip(found.members, found.mean, strict=True):
        like = judgement.classes.get(atoms[i].name, ())
        if not like:
            continue
        beside = span_of(columns([j for j in found.members if j != i]))
        own = _without(beside, columns([i]) @ mean[:, None])[:, 0]
        size = float(torch.linalg.vector_norm(own))
        block[atoms[i].name] = {}
        for name in like:
            # Where a name has several atoms (shapes), the closest one.
            spans = [span_of(_without(beside, columns([j]))) for j, a in enumerate(atoms) if a.name == name]
            angle = min(_angle(own, span) for span in spans)
            block[atoms[i].name][name] = {"angle": angle, "separation": size * math.sin(angle)}
    return block


def span_of(x: Tensor) -> Tensor:
    """Orthonormal columns of what the columns of x span, `N x r`."""
    if not x.shape[-1]:
        return x
    u, s, _ = torch.linalg.svd(x, full_matrices=False)
    span: Tensor = u[:, s > _RANK * s.max().clamp_min(1e-300)]
    return span


def _without(span: Tensor, x: Tensor) -> Tensor:
    return x - span @ (span.mT @ x)


def _angle(line: Tensor, span: Tensor) -> float:
    """Between a vector and a subspace, by its sine: the arc cosine is blind to small angles."""
    outside = torch.linalg.vector_norm(_without(span, line[:, None]))
    inside = torch.linalg.vector_norm(span.mT @ line)
    return float(torch.atan2(outside, inside))
