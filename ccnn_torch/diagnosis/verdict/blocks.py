"""The blocks of a diagnosis from an analysis and its judgement; why rows do not distinguish two effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ccnn_torch.diagnosis.residual.whitening import LEAST_FREE
from ccnn_torch.diagnosis.result import effect_block, gap_block
from ccnn_torch.diagnosis.search.analysis import Analysis
from ccnn_torch.diagnosis.shrink.held_out import held_out
from ccnn_torch.diagnosis.verdict.fewest import fewest, together
from ccnn_torch.diagnosis.verdict.intervals import spread_of
from ccnn_torch.diagnosis.verdict.judgement import Judgement
from ccnn_torch.effects import Coefficient
from ccnn_torch.evidence.shrink import Gap, HeldOut, draws, shrink_of


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
    senses |= {f"q{name.removeprefix('theta')}": sense for name, sense in senses.items() if name.startswith("theta")}
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
