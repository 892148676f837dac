"""Candidates of a diagnosis as groups of whitened columns: library effects at given shapes, and discrepancy terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ccnn_torch.effects import EXACT, Coefficient, Effect, Situation, signature
from ccnn_torch.evidence.form_error import OF_EXACT, OF_FORM, OF_SMOOTH
from ccnn_torch.evidence.priors import OUTSIDE


@dataclass(frozen=True)
class Atom:
    """One candidate cause with its columns.

    Attributes:
        name: of the effect, or the driver of a discrepancy term (`workspace`, `joint q1`, `load z`, …).
        effect: None for a discrepancy term.
        shape: values of the effect's shapes, `h` [SI]; empty for a discrepancy term.
        columns: first-order change of the pose per plausible size of each coefficient, `s x c x m` [m, rad].
        log_prior: log prior odds, the search over shapes charged.
        used: the coefficients that the columns belong to; None = all, in order.
        plain: whether a discrepancy term has straight lines, planes or gentle curves only.
        note: what is to be said of a discrepancy term that was found, without a full stop.
        begins: rows from each of which on it is another one, counted from 0; () = it is the same all along.
    """

    name: str
    effect: Effect | None
    shape: Tensor
    columns: Tensor
    log_prior: float
    used: tuple[int, ...] | None = None
    plain: bool = False
    note: str = ""
    begins: tuple[int, ...] = ()

    def coefficients(self, situation: Situation) -> tuple[Coefficient, ...]:
        """Those that the columns belong to; () for a discrepancy term."""
        if self.effect is None:
            return ()
        every = self.effect.coefficients(situation)
        return every if self.used is None else tuple(every[i] for i in self.used)

    def spread(self, situation: Situation, mean: Tensor) -> Tensor:
        """All of the effect's coefficients [SI] from those of the columns in plausible sizes, `m`."""
        assert self.effect is not None
        every = scales(self.effect.coefficients(situation), mean)
        if self.used is None:
            return every * mean
        index = torch.tensor(self.used)
        return torch.zeros_like(every).index_copy(0, index, every[index] * mean)

    @property
    def is_discrepancy(self) -> bool:
        """Whether it describes something outside the library."""
        return self.effect is None

    @property
    def form_error(self) -> float:
        """Share of its squares by which its form may be wrong in every direction."""
        return OF_SMOOTH if self.effect is None else OF_EXACT if self.name in EXACT else OF_FORM


def discrepancy(
    driver: str,
    columns: Tensor,
    log_odds: float = 0.0,
    plain: bool = False,
    note: str = "",
    begins: tuple[int, ...] = (),
) -> Atom:
    """A discrepancy term; log_odds: of it beside the usual one; the others as in `Atom`."""
    return Atom(driver, None, columns.new_zeros(0), columns, OUTSIDE + log_odds, None, plain, note, begins)


def scales(coefficients: Sequence[Coefficient], like: Tensor) -> Tensor:
    """Plausible sizes, `m`."""
    return torch.tensor([c.scale for c in coefficients], dtype=like.dtype, device=like.device)


def scaled_signature(situation: Situation, effect: Effect, shape: Tensor) -> Tensor:
    """Signature per plausible size, `... x s x c x m`."""
    return signature(situation, effect, shape) * scales(effect.coefficients(situation), situation.joints)


def default_shape(situation: Situation, effect: Effect) -> Tensor:
    """The middle of every grid, `h`."""
    grids = [s.grid for s in effect.shapes(situation)]
    return torch.tensor([g[len(g) // 2] for g in grids], dtype=situation.joints.dtype, device=situation.joints.device)


def textbook_shapes(situation: Situation, effect: Effect) -> tuple[Tensor, tuple[int, ...]]:
    """The shapes for which nobody needs to look, `h` (once a turn, for one), and the coefficients that none depends on
    for which one has to."""
    return _known_shapes(situation, effect, [s.textbook for s in effect.shapes(situation)])


def told_shapes(situation: Situation, effect: Effect) -> tuple[Tensor, tuple[int, ...]]:
    """As `textbook_shapes`, at the shapes that the machine's file tells; no coefficients where it tells none."""
    told = [s.told for s in effect.shapes(situation)]
    value, used = _known_shapes(situation, effect, told)
    return value, used if any(v is not None for v in told) else ()


def _known_shapes(
    situation: Situation, effect: Effect, known: Sequence[float | None]
) -> tuple[Tensor, tuple[int, ...]]:
    shapes, count = effect.shapes(situation), len(effect.coefficients(situation))
    value = [s.grid[0] if v is None else v for s, v in zip(shapes, known, strict=True)]
    searched = {c for s, v in zip(shapes, known, strict=True) if v is None for c in s.columns or range(count)}
    used = tuple(k for k in range(count) if k not in searched)
    return torch.tensor(value, dtype=situation.joints.dtype, device=situation.joints.device), used
