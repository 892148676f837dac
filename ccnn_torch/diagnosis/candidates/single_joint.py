"""Parts of effects: in one joint or leg, or in a few, those that explain most; and without what is secondary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ccnn_torch.diagnosis.candidates.atom import Atom
from ccnn_torch.diagnosis.residual.whitening import Whitening
from ccnn_torch.effects import Situation
from ccnn_torch.evidence.single_groups import GroupProducts, fit_single_groups, own_products

# Spread of the log size of an effect that is in one joint or leg alone.
_SIZE_SPREAD = 4.0
# What it costs to be told with secondary coefficients or without.
_EITHER = math.log(2.0)


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
        return [sorted(self.chosen + p) if not set(p) <= set(self.chosen) else p for p in self.parts]

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
    situation: Situation, atoms: Sequence[Atom], white: Whitening, y: Sequence[Tensor]
) -> list[Atom | None]:
    """Of every effect that is in several joints or legs the coefficients of the one that explains most, and of others
    beside it that the evidence is for, up to half of them; None where there is but one.

    Args:
        situation: `s` rows.
        atoms: effects with all of their coefficients.
        white: noise and weights.
        y: what each is to explain, `s x c0` [m, rad].
    """
    choices: dict[int, _Choice] = {}
    for k, (atom, residual) in enumerate(zip(atoms, y, strict=True)):
        parts = _parts(situation, atom)
        if len(parts) > 1:
            target = white(residual)
            choices[k] = _Choice(parts, own_products(white(atom.columns), target), target.square().sum())
    while going := [c for c in choices.values() if not c.done]:
        cut = [[GroupProducts(c.own.xx[p][:, p], c.own.xy[p]) for p in c.wider()] for c in going]
        counts = [len(group) for group in cut]
        squares = torch.stack([c.squares for c in going]).repeat_interleave(torch.tensor(counts))
        values = float(len(y[0]) * len(white.channels))
        evidence = fit_single_groups(
            [own for group in cut for own in group], squares, values, 0.0, _SIZE_SPREAD
        ).log_evidence
        for choice, mine in zip(going, torch.split(evidence, counts), strict=True):
            choice.take(mine)
    return [_cut(atom, choices[k]) if k in choices else None for k, atom in enumerate(atoms)]


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


def _cut(atom: Atom, choice: _Choice) -> Atom:
    return _with(atom, choice.chosen, choice.lots * choice.charge)


def _with(atom: Atom, chosen: list[int], charge: float) -> Atom:
    """With these coefficients of its own alone."""
    return replace(atom, columns=atom.columns[..., chosen], log_prior=atom.log_prior - charge, used=tuple(chosen))


def _parts(situation: Situation, atom: Atom) -> list[list[int]]:
    """Numbers of the coefficients of each joint or leg."""
    assert atom.effect is not None
    found: dict[int | str, list[int]] = {}
    for k, c in enumerate(atom.effect.coefficients(situation)):
        owner = c.joint if c.leg is None else c.leg
        if owner is not None:
            found.setdefault(owner, []).append(k)
    return list(found.values())
