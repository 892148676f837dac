"""Candidates of a search: every effect at its best shapes, about the nominal machine and about a set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom, default_shape, textbook_shapes, told_shapes
from ccnn_torch.diagnosis.candidates.shape_search import Scan, SearchRows, Shaped
from ccnn_torch.diagnosis.residual.linearisation import remainder, signature_at
from ccnn_torch.diagnosis.residual.rows import only_usable
from ccnn_torch.diagnosis.residual.whitening import Whitening, without_fitted
from ccnn_torch.effects import EXACT, Acting, Effect, Situation
from ccnn_torch.effects.joints import Coupling
from ccnn_torch.evidence.marginal_likelihood import GroupProducts, Prior, fit_single_groups, own_products
from ccnn_torch.evidence.priors import EFFECT

# What it costs to be told with secondary coefficients or without.
_EITHER = math.log(2.0)
# Columns of a coupling from which each one more is a cause of its own: of eight pairs with their zeros, or of all pairs
# of four joints.
_FEW_COUPLED = 16


class Known(NamedTuple):
    """Shapes found before.

    Attributes:
        starts: they stay candidates, since what acts now may have hidden the better ones.
        kept: by names of effects whose shapes are not searched again those that they have.
        alone: whether shapes of what acts are searched with nothing beside it, too.
    """

    starts: Sequence[Atom]
    kept: Mapping[str, Sequence[Atom]]
    alone: bool


def default_atom(situation: Situation, there: Situation, effect: Effect) -> Atom:
    """The effect with all coefficients, at the middle of its grids; `there`: the machine about which it is linear."""
    return _atom(situation, there, effect, Shaped(default_shape(situation, effect), None, 0.0))


def without_unused_rows(atom: Atom, usable: Tensor) -> Atom:
    """With rows that are left out set to zero."""
    return atom if bool(usable.all()) else replace(atom, columns=only_usable(atom.columns, usable))


def candidates_about_nominal(
    situation: Situation, atoms: Sequence[Atom], white: Whitening, residual: Tensor, usable: Tensor, fitted: Tensor
) -> list[Atom]:
    """Effects without shapes, whole and in part; and those with shapes, at what suits the residual.

    Shapes are searched by themselves and with the rest of the library beside them: two ways to start, both stay
    candidates, and so do the shapes that are usual where an effect has such.

    Args:
        situation: `s` rows.
        atoms: of all effects at the middle of their grids.
        white: noise and weights.
        residual: `s x c0` [m, rad].
        usable: `s`, bool.
        fitted: columns of what was fitted before, `s x c0 x r`.
    """
    whole = [a for a in atoms if a.shape.numel() == 0]
    parts = [p for p in single_joint_atoms(situation, whole, white, [residual] * len(whole), fitted) if p is not None]
    parts += without_secondary(situation, whole)
    bare = white(fitted)
    beside = torch.cat([bare, *(white(a.columns) for a in whole)], -1)
    grounds = [SearchRows(white(residual), nuisance, quick=True) for nuisance in (bare, beside)]
    starts: list[Atom] = []
    for atom in (a for a in atoms if a.shape.numel()):
        assert atom.effect is not None
        scan = Scan(situation, situation, atom.effect, _only(white, usable))
        looked_for = (scan.best(ground) for ground in grounds)
        for shaped in (*_usual(situation, atom.effect), *looked_for):
            if not any(a.effect is atom.effect and _same_shape(a, shaped) for a in starts):
                starts.append(without_unused_rows(_atom(situation, situation, atom.effect, shaped), usable))
    starts += _in_few_joints(situation, starts, white, residual, fitted)
    return [*map(_charged, [*whole, *parts]), *starts]


def candidates_about_set(
    situation: Situation,
    there: Situation,
    measured: Tensor,
    target: Tensor,
    effects: Sequence[Effect],
    acting: Sequence[Acting],
    known: Known,
    white: Whitening,
    usable: Tensor,
    fitted: Tensor,
) -> list[Atom]:
    """All effects about the machine `there`, to which those that act bring it; shapes searched beside these.

    Args:
        situation, there: rows on the nominal machine, and on the other.
        measured: poses, `s x p`.
        target: what a linear model about `there` has to explain, `s x c0` [m, rad].
        effects: candidates.
        acting: those of the best set.
        known: of shapes.
        white, usable, fitted: as in `candidates_about_nominal`.
    """

    def beside(others: Sequence[Acting]) -> Tensor:
        return only_usable(torch.nan_to_num(remainder(situation, measured, others)), usable)

    def ground(others: Sequence[Acting]) -> SearchRows:
        names = tuple(a.effect.name for a in others)
        if names not in grounds:
            grounds[names] = made(others)
        return grounds[names]

    def made(others: Sequence[Acting]) -> SearchRows:
        columns = [_atom(situation, there, a.effect, Shaped(a.shape, None, 0.0)) for a in others]
        present = torch.cat([white(fitted), *(white(without_unused_rows(c, usable).columns) for c in columns)], -1)
        return SearchRows(white(target), present)

    grounds: dict[tuple[str, ...], SearchRows] = {}
    rigid = [e for e in effects if not e.shapes(situation)]
    whole = [without_unused_rows(default_atom(situation, there, e), usable) for e in rigid]
    # In which joints an effect is, is asked beside what acts, and beside that without one: what stands for it hides it.
    fewer = {a.effect.name: beside([b for b in acting if b is not a]) for a in acting}
    all_act = beside(acting)
    asked, left = [], []
    for atom in whole:
        here = [fewer[atom.name]] if atom.name in fewer else [all_act, *fewer.values()]
        asked += [atom] * len(here)
        left += here
    parts: dict[tuple[str, tuple[int, ...] | None], Atom] = {}
    for part in single_joint_atoms(situation, asked, white, left, fitted):
        if part is not None:
            parts.setdefault((part.name, part.used), part)
    atoms = [*map(_charged, [*whole, *parts.values(), *without_secondary(situation, whole)])]
    for effect in (e for e in effects if e.shapes(situation)):
        others = [a for a in acting if a.effect is not effect]
        start = next((a.shape for a in acting if a.effect is effect), None)
        shapes: list[Shaped] = []
        if effect.name in known.kept:
            found = known.kept[effect.name]
        else:
            # What acts beside an effect may be there to mend a wrong shape: the right one needs nothing beside it.
            beside_what = [others, []] if known.alone and start is not None and others else [others]
            scan = Scan(situation, there, effect, _only(white, usable))
            shapes = [scan.best(ground(them), start) for them in beside_what]
            found = [a for a in known.starts if a.effect is effect]
        shapes += [Shaped(a.shape, a.used, EFFECT - a.log_prior) for a in found]
        own: list[Atom] = []
        for shaped in shapes:
            if not any(_same_shape(a, shaped) for a in own):
                own.append(without_unused_rows(_atom(situation, there, effect, shaped), usable))
        atoms += [*own, *_in_few_joints(situation, own, white, beside(others), fitted)]
    return atoms


def _atom(situation: Situation, there: Situation, effect: Effect, shaped: Shaped) -> Atom:
    columns = signature_at(situation, there, effect, shaped.value)
    if shaped.used is not None:
        columns = columns[..., list(shaped.used)]
    return Atom(effect.name, effect, shaped.value, columns, EFFECT - shaped.charge, shaped.used)


def _usual(situation: Situation, effect: Effect) -> list[Shaped]:
    """The shapes of the textbook and of the machine's file, which need no search; none where there are no such ones."""
    known = [shapes(situation, effect) for shapes in (textbook_shapes, told_shapes)]
    count = len(effect.coefficients(situation))
    return [Shaped(value, None if len(used) == count else used, 0.0) for value, used in known if used]


def _charged(atom: Atom) -> Atom:
    """A coupling of many pairs of joints with the cost of a cause for each: no arm has a belt from every joint to every
    other one, and such a set of belts fits whatever a device does smoothly."""
    more = atom.columns.shape[-1] - _FEW_COUPLED if isinstance(atom.effect, Coupling) else 0
    return replace(atom, log_prior=atom.log_prior + more * EFFECT) if more > 0 else atom


def has_usual_shape(situation: Situation, atom: Atom) -> bool:
    """Whether an atom has the shapes that are usual for its effect."""
    usual = [] if atom.effect is None else _usual(situation, atom.effect)
    return any(_same_shape(atom, shaped) for shaped in usual)


def _same_shape(atom: Atom, shaped: Shaped) -> bool:
    return atom.used == shaped.used and torch.allclose(atom.shape, shaped.value, rtol=1e-3)


def _only(white: Whitening, usable: Tensor) -> Whitening:
    """The same with rows that are left out set to zero."""
    return replace(white, weight=only_usable(white.weight, usable))


@dataclass
class _Choice:
    """Of one effect, what has been chosen so far.

    Attributes:
        parts: numbers of the coefficients of each joint or leg.
        own: products of all of the columns among themselves and with what is to be explained.
        squares: of what is to be explained, 0-dim.
    """

    parts: list[list[int]]
    own: GroupProducts
    squares: Tensor
    chosen: list[int] = field(default_factory=list)
    lots: int = 0
    reached: float = -math.inf
    done: bool = False

    def wider(self) -> list[list[int]]:
        """What is chosen with each of the parts."""
        return [sorted({*self.chosen, *p}) if not set(p) <= set(self.chosen) else p for p in self.parts]

    def take(self, evidence: Tensor) -> None:
        """The best of `wider`, whose log evidences these are, where it is worth the choice."""
        best = int(evidence.argmax())
        wider = self.wider()[best]
        if float(evidence[best]) < self.reached + self.charge or wider == self.chosen:
            self.done = True
            return
        self.chosen, self.reached, self.lots = wider, float(evidence[best]), self.lots + 1
        self.done = self.lots >= max(len(self.parts) // 2, 1)

    @property
    def charge(self) -> float:
        """What it costs in log odds to choose one of the parts."""
        return math.log(len(self.parts))


def single_joint_atoms(
    situation: Situation, atoms: Sequence[Atom], white: Whitening, y: Sequence[Tensor], fitted: Tensor
) -> list[Atom | None]:
    """Of every effect that is in several joints or legs the coefficients of the one that explains most, and of others
    beside it that the evidence is for, up to half of them; None where there is but one.

    Args:
        situation: `s` rows.
        atoms: effects with all of their coefficients.
        white: noise and weights.
        y: what each is to explain, `s x c0` [m, rad].
        fitted: as of `candidates_about_nominal`; what a joint does alike is none of its own.
    """
    parts = {k: each for k, atom in enumerate(atoms) if len(each := _parts(situation, atom)) > 1}
    whitened = [white(v) for k in parts for v in (atoms[k].columns, y[k][..., None])]
    free = iter(without_fitted(white(fitted), whitened))
    choices = {
        k: _Choice(parts[k], own_products(columns, target), target.square().sum())
        for k, columns, target in zip(parts, free, free, strict=True)
    }
    while going := [c for c in choices.values() if not c.done]:
        cut = [[GroupProducts(c.own.xx[p][:, p], c.own.xy[p]) for p in c.wider()] for c in going]
        counts = [len(group) for group in cut]
        squares = torch.stack([c.squares for c in going]).repeat_interleave(torch.tensor(counts))
        prior = Prior(float(len(y[0]) * len(white.channels)), 0.0)
        evidence = fit_single_groups([own for group in cut for own in group], squares, prior)[0].log_evidence
        for choice, mine in zip(going, torch.split(evidence, counts), strict=True):
            choice.take(mine)
    return [
        _with(atom, (c := choices[k]).chosen, c.lots * c.charge) if k in choices else None
        for k, atom in enumerate(atoms)
    ]


def _in_few_joints(
    situation: Situation, shaped: Sequence[Atom], white: Whitening, y: Tensor, fitted: Tensor
) -> list[Atom]:
    """Of effects with shapes, whose form is exact, those in few joints: what it would be in the others mends nothing.

    y: what they are to explain, `s x c0` [m, rad].
    """
    exact = [a for a in shaped if a.name in EXACT and a.used is None]
    return [one for one in single_joint_atoms(situation, exact, white, [y] * len(exact), fitted) if one is not None]


def without_secondary(situation: Situation, atoms: Sequence[Atom]) -> list[Atom]:
    """Of the effects that have secondary coefficients the others alone, and all but those that only mend a form.

    One scale for all would charge for the zeros of joints that count from the middle, and a term of no effect would
    then be the cheaper name for their gains.
    """
    found = []
    for atom in atoms:
        coefficients = atom.coefficients(situation)
        main = [k for k, c in enumerate(coefficients) if not c.secondary]
        formed = [k for k, c in enumerate(coefficients) if not c.mends]
        parts = [main] if main == formed else [main, formed]
        found += [_with(atom, part, _EITHER) for part in parts if 0 < len(part) < len(coefficients)]
    return found


def _with(atom: Atom, chosen: list[int], charge: float) -> Atom:
    """With these coefficients of its own alone."""
    return replace(atom, columns=atom.columns[..., chosen], log_prior=atom.log_prior - charge, used=tuple(chosen))


def _parts(situation: Situation, atom: Atom) -> list[list[int]]:
    """Numbers of the coefficients of each joint or leg, or of what the effect says that its parts are."""
    assert atom.effect is not None
    if isinstance(atom.effect, Coupling):
        return atom.effect.parts(situation)
    found: dict[int | str, list[int]] = {}
    for k, c in enumerate(atom.effect.coefficients(situation)):
        owner = c.joint if c.leg is None else c.leg
        if owner is not None:
            found.setdefault(owner, []).append(k)
    return list(found.values())
